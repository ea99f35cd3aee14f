"""The velocity tasks: Gymnasium's robots run ahead, and must not run faster than they are allowed.

Robots, rewards, health and observations are those of Gymnasium's environments, version 4 (Towers et
al., arXiv:2407.17032), costs those of Safety-Gymnasium, version 1 of its velocity tasks (Ji et al.,
arXiv:2310.12567). Everything here is a pure function over a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from torchrl_safe.envs._random import RandomStreams

__all__ = ["VELOCITY_TASKS", "VelocityTask", "get_velocity_task"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Readings = Mapping[str, Array]  # of N simulations by MuJoCo's names of fields, [N, ...] each

_MODELS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
_TORSO = 1  # the body behind the world


def _always(qpos: Array, qvel: Array) -> Mask:
    return np.ones(len(qpos), bool)


def _root(readings: Readings, masses: Array) -> Array:
    return readings["qpos"][:, :1]


@dataclass(frozen=True)
class VelocityTask:
    """A robot that is paid for running along x, and a speed that it must not exceed.

    The reward of a step is ``forward_reward_weight * velocity along x + healthy_reward -
    ctrl_cost_weight * |ctrl|^2``, its cost 1 if the speed is above ``velocity_threshold``, else 0.
    An episode terminates when the robot is no longer healthy. Velocities are the way that the robot
    made in a step, divided by the step's time.

    Args:
        name (str): the name in ``VELOCITY_TASKS``; Gymnasium's model is ``<name>.xml``.
        title (str): the robot in Gymnasium's ids: ``<title>-v4``.
        frame_skip (int): physics steps in an environment step.
        velocity_threshold (float): the largest speed without a cost, m/s.
        ctrl_cost_weight (float): weight of the squared controls in the reward.
        reset_noise_scale (float): how far from its model's pose and rest a robot starts.
        forward_reward_weight (float): weight of the velocity along x. Default: 1.
        healthy_reward (float): of every step, the one that ends an episode too. Default: 0.
        healthy (callable): ``(qpos [N, nq], qvel [N, nv]) -> [N]`` bool. Default: always.
        position (callable): ``(readings, body masses [nbody]) -> [N, 1 or 2]``, what the velocity
            is the velocity of: x, or x and y. Default: x of the robot's root.
        planar (bool): whether the limited speed is that in the plane, whatever the direction, or
            that along x. Default: along x.
        normal_velocities (bool): whether the initial velocities are normal or uniform. Default:
            uniform.
        hidden_positions (int): leading coordinates of ``qpos`` that are not observed: the world
            looks the same everywhere. Default: 1.
        observed_velocity (float): observed velocities are clipped to this. Default: they are not.
        observed (tuple of str): what is observed besides ``qpos`` and ``qvel``, by MuJoCo's names.
        measured (tuple of str): what ``position`` reads besides ``qpos`` and ``qvel``.
        margin_scale (float): what the model's contact margins are multiplied by. MuJoCo adds those
            of two geoms, which 2.3 did not: it took the larger one. As all geoms of a model here
            have the same, 0.5 is the contact that Safety-Gymnasium has. Default: 1, Gymnasium's.

    Raises:
        ValueError: if a number is out of its range.

    Examples:
        >>> from dataclasses import replace
        >>> replace(get_velocity_task("ant"), margin_scale=0.5).velocity_threshold
        2.6222
    """

    name: str
    title: str
    frame_skip: int
    velocity_threshold: float
    ctrl_cost_weight: float
    reset_noise_scale: float
    forward_reward_weight: float = 1.0
    healthy_reward: float = 0.0
    healthy: Callable[[Array, Array], Mask] = _always
    position: Callable[[Readings, Array], Array] = _root
    planar: bool = False
    normal_velocities: bool = False
    hidden_positions: int = 1
    observed_velocity: float = np.inf
    observed: tuple[str, ...] = ()
    measured: tuple[str, ...] = ()
    margin_scale: float = 1.0

    def __post_init__(self) -> None:
        if not isinstance(self.frame_skip, int) or self.frame_skip < 1:
            raise ValueError(f"frame_skip must be an integer >= 1, got {self.frame_skip!r}.")
        for name in ("velocity_threshold", "ctrl_cost_weight", "reset_noise_scale", "margin_scale"):
            value = getattr(self, name)
            if not 0.0 <= value < np.inf:
                raise ValueError(f"{name} must be finite and at least 0, got {value!r}.")

    @property
    def asset_path(self) -> Path:
        """The MJCF file, in the installed Gymnasium."""
        return _MODELS / f"{self.name}.xml"

    def sample(
        self, rest: Array, num_velocities: int, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Array]:
        """Draws where the robots ``rows`` start: qpos [n, nq] and qvel [n, nv].

        Args:
            rest (array): [nq], the pose of the model.
            num_velocities (int): nv.
            streams (RandomStreams): one per environment.
            rows (array): [n], the environments.
        """
        uniform = streams.uniform(rows, len(rest) + num_velocities)
        noise = 2.0 * uniform - 1.0
        if self.normal_velocities:
            # Draws are in [0, 1), on a grid of 2^-53: half a step on, no quantile is infinite.
            noise[:, len(rest) :] = ndtri(uniform[:, len(rest) :] + 2.0**-54)
        noise *= self.reset_noise_scale
        return rest + noise[:, : len(rest)], noise[:, len(rest) :]

    def observe(self, readings: Readings) -> Array:
        """The observation [N, D]: where the joints are, how fast, and what else is observed."""
        qvel = readings["qvel"]
        limit = self.observed_velocity
        parts = [
            readings["qpos"][:, self.hidden_positions :],
            qvel if limit == np.inf else np.minimum(np.maximum(qvel, -limit), limit),
            *(readings[name].reshape(len(qvel), -1) for name in self.observed),
        ]
        return np.concatenate(parts, 1)

    def reward(self, velocity: Array, ctrl: Array) -> Array:
        """What a step was worth [N], by its velocity [N, 1 or 2] and its controls [N, nu]."""
        forward = self.forward_reward_weight * velocity[:, 0]
        return forward + self.healthy_reward - self.ctrl_cost_weight * np.square(ctrl).sum(1)

    def speed(self, velocity: Array) -> Array:
        """The limited speed [N] of velocities [N, 1 or 2].

        Examples:
            >>> get_velocity_task("ant").speed(np.array([[-3.0, 4.0]])).tolist()
            [5.0]
            >>> get_velocity_task("hopper").speed(np.array([[-3.0]])).tolist()
            [-3.0]
        """
        return np.sqrt(np.square(velocity).sum(1)) if self.planar else velocity[:, 0]


def _between(value: Array, low: float, high: float) -> Mask:
    return (low < value) & (value < high)


def _upright(qpos: Array, height: tuple[float, float], angle: float) -> Mask:
    """A robot in the plane of x and z: its height and its lean are in range."""
    return _between(qpos[:, 1], *height) & _between(qpos[:, 2], -angle, angle)


def _hopper_healthy(qpos: Array, qvel: Array) -> Mask:
    joints = np.concatenate((qpos[:, 2:], qvel), 1)
    return _upright(qpos, (0.7, np.inf), 0.2) & _between(joints, -100.0, 100.0).all(1)


def _walker_healthy(qpos: Array, qvel: Array) -> Mask:
    return _upright(qpos, (0.8, 2.0), 1.0)


def _ant_healthy(qpos: Array, qvel: Array) -> Mask:
    return (qpos[:, 2] >= 0.2) & (qpos[:, 2] <= 1.0)


def _humanoid_healthy(qpos: Array, qvel: Array) -> Mask:
    return _between(qpos[:, 2], 1.0, 2.0)


def _torso(readings: Readings, masses: Array) -> Array:
    return readings["xpos"][:, _TORSO, :2]


def _centre_of_mass(readings: Readings, masses: Array) -> Array:
    return np.einsum("b,nbj->nj", masses, readings["xipos"][..., :2]) / masses.sum()


_TASKS = (
    VelocityTask(
        name="half_cheetah",
        title="HalfCheetah",
        frame_skip=5,
        velocity_threshold=3.2096,
        ctrl_cost_weight=0.1,
        reset_noise_scale=0.1,
        normal_velocities=True,
    ),
    VelocityTask(
        name="hopper",
        title="Hopper",
        frame_skip=4,
        velocity_threshold=0.7402,
        ctrl_cost_weight=1e-3,
        reset_noise_scale=5e-3,
        healthy_reward=1.0,
        healthy=_hopper_healthy,
        observed_velocity=10.0,
    ),
    VelocityTask(
        name="walker2d",
        title="Walker2d",
        frame_skip=4,
        velocity_threshold=2.3415,
        ctrl_cost_weight=1e-3,
        reset_noise_scale=5e-3,
        healthy_reward=1.0,
        healthy=_walker_healthy,
        observed_velocity=10.0,
    ),
    VelocityTask(
        name="ant",
        title="Ant",
        frame_skip=5,
        velocity_threshold=2.6222,
        ctrl_cost_weight=0.5,
        reset_noise_scale=0.1,
        healthy_reward=1.0,
        healthy=_ant_healthy,
        position=_torso,
        planar=True,
        normal_velocities=True,
        hidden_positions=2,
        measured=("xpos",),
    ),
    VelocityTask(
        name="humanoid",
        title="Humanoid",
        frame_skip=5,
        velocity_threshold=1.4149,
        ctrl_cost_weight=0.1,
        reset_noise_scale=1e-2,
        forward_reward_weight=1.25,
        healthy_reward=5.0,
        healthy=_humanoid_healthy,
        position=_centre_of_mass,
        planar=True,
        hidden_positions=2,
        observed=("cinert", "cvel", "qfrc_actuator", "cfrc_ext"),
        measured=("xipos",),
    ),
    VelocityTask(
        name="swimmer",
        title="Swimmer",
        frame_skip=4,
        velocity_threshold=0.2282,
        ctrl_cost_weight=1e-4,
        reset_noise_scale=0.1,
        hidden_positions=2,
    ),
)

VELOCITY_TASKS: dict[str, VelocityTask] = {task.name: task for task in _TASKS}


def get_velocity_task(name: str) -> VelocityTask:
    """The task by its name.

    Args:
        name (str): ``"half_cheetah"``, ``"hopper"``, ``"walker2d"``, ``"ant"``, ``"humanoid"`` or
            ``"swimmer"``.

    Raises:
        ValueError: if there is no such task.

    Examples:
        >>> get_velocity_task("ant").velocity_threshold
        2.6222
    """
    if name not in VELOCITY_TASKS:
        raise ValueError(f"task must be one of {sorted(VELOCITY_TASKS)}, got {name!r}.")
    return VELOCITY_TASKS[name]
