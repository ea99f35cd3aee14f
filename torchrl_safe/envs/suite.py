"""The dm_control face of the environments: ``load("point", "goal")``, as in its suite."""

from __future__ import annotations

import os
import sys
from collections import OrderedDict
from typing import Any

import numpy as np
from dm_env import specs
from numpy.typing import NDArray

from torchrl_safe.envs._core import Core, make_core
from torchrl_safe.envs._random import check_seed
from torchrl_safe.envs._render import Scene, has_display
from torchrl_safe.envs.randomization import Randomization
from torchrl_safe.envs.robots import Array, Robot
from torchrl_safe.envs.tasks import Task

# dm_control chooses how to draw when it is imported, and without a display would choose a window.
if sys.platform == "linux" and not has_display():
    os.environ.setdefault("MUJOCO_GL", "egl")

from dm_control import mujoco
from dm_control.mujoco import wrapper
from dm_control.rl import control
from dm_control.suite import base

__all__ = ["Physics", "SafeTask", "load"]


def load(
    robot: str | Robot = "point",
    task: str | Task = "goal",
    *,
    random: int | np.random.RandomState | None = None,
    episode_length: int = 1000,
    randomization: Randomization | None = None,
) -> control.Environment:
    """An environment of dm_control's reinforcement-learning suite, with a cost.

    Steps are those of :class:`~torchrl_safe.envs.SafeGoalEnv` with one environment and the same
    seed. A time step's ``observation`` holds, besides ``observation`` [D] float32, arrays [1]:
    ``cost`` (float64), ``violation`` and ``goal_met`` (bool), ``violations`` (int64, how many
    violating steps this one counts for). The last time step has discount 1 after a time limit and 0
    after a collision.

    Args:
        robot (str or Robot): the robot, or its name in ``ROBOTS``. Default: ``"point"``.
        task (str or Task): ``"goal"``, the robot's own task, or one with its options.

    Keyword Args:
        random (int, RandomState, optional): seed of the episodes. ``None`` takes one from the
            operating system.
        episode_length (int): steps until the time limit. Default: 1000.
        randomization (Randomization, optional): how the robot differs from its model.

    Returns:
        dm_control.rl.control.Environment: for dm_control's viewer, and for TorchRL's
        ``DMControlWrapper``.

    Raises:
        ValueError: if robot or task is unknown, an option is out of range, or the objects do not
            fit.

    Examples:
        >>> from torchrl_safe.envs import suite
        >>> env = suite.load("point", "goal", random=0)
        >>> time_step = env.reset()
        >>> time_step = env.step([1.0, 0.0])
        >>> time_step.observation["cost"].shape
        (1,)
    """
    if isinstance(task, str) and task != "goal":
        raise ValueError(f"task must be 'goal' or a Task, got {task!r}.")
    core = make_core(
        robot,
        None if isinstance(task, str) else task,
        num_envs=1,
        num_threads=1,
        seed=None,
        episode_length=episode_length,
        randomization=randomization,
    )
    return control.Environment(
        Physics(core), SafeTask(core, random), n_sub_steps=core.robot.substeps
    )


class Physics(mujoco.Physics):
    """The scene as dm_control sees and draws it; the simulator of every face moves it.

    Its model is the robot's with floor, light, goal and hazards, and the camera ``"overview"``. It
    advances by whole environment steps.

    Args:
        core (Core): one environment.
    """

    def __init__(self, core: Core) -> None:
        self._core = core
        self._action = np.zeros(core.action_dim)
        self._scene = Scene(core)
        super().__init__(wrapper.MjData(wrapper.MjModel(self._scene.model)))
        self._scene.data = self.data.ptr

    def start(self) -> None:
        """Starts an episode."""
        self._core.reset()
        self._scene.show(0)

    def set_control(self, control: Any) -> None:
        """Keeps the action [A] for the next step.

        Raises:
            ValueError: if it has another shape.
        """
        action = np.asarray(control, np.float64)
        if action.shape != self._action.shape:
            raise ValueError(f"action must have shape {self._action.shape}, got {action.shape}.")
        self._action = action

    def control(self) -> Array:
        """A copy of the action."""
        return self._action.copy()

    def step(self, nstep: int = 1) -> None:
        """Advances by one environment step, which is ``robot.substeps`` physics steps.

        Raises:
            ValueError: if ``nstep`` is another number, or the action is not finite.
        """
        if nstep != self._core.robot.substeps:
            raise ValueError(f"nstep must be {self._core.robot.substeps}, got {nstep}.")
        self._core.step(self._action[None])
        self.data.time += nstep * self.timestep()
        self._scene.show(0)


class SafeTask(base.Task):
    """Rewards, costs and ends of episodes, read off the simulator of every face.

    Args:
        core (Core): one environment.
        random (int, RandomState, optional): an integer seeds the episodes like every other face's
            ``seed``; from a ``RandomState``, also one put in later, their seed is drawn.

    Raises:
        ValueError: if the seed is negative.
    """

    def __init__(self, core: Core, random: int | np.random.RandomState | None) -> None:
        if not isinstance(random, np.random.RandomState):
            check_seed("random", random)
        super().__init__(random)
        self._core = core
        self._seeded_by: np.random.RandomState | None = None
        if not isinstance(random, np.random.RandomState):
            core.seed(random)
            self._seeded_by = self._random

    def initialize_episode(self, physics: Physics) -> None:
        """Starts an episode; a random state that was exchanged seeds it."""
        if self._random is not self._seeded_by:
            self._core.seed(int(self._random.randint(2**31)))
            self._seeded_by = self._random
        physics.start()

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """[A], float64, in [-1, 1]."""
        return specs.BoundedArray((self._core.action_dim,), np.float64, -1.0, 1.0, name="action")

    def observation_spec(self, physics: Physics) -> OrderedDict[str, specs.Array]:
        """Of what :meth:`get_observation` returns."""
        return OrderedDict(
            (name, specs.Array(value.shape, value.dtype, name=name))
            for name, value in self.get_observation(physics).items()
        )

    def get_observation(self, physics: Physics) -> OrderedDict[str, NDArray[Any]]:
        """What the robot observes [D], and what the step cost [1]."""
        frame = self._core.frame
        return OrderedDict(
            observation=frame.observation[0].copy(),
            cost=frame.cost.copy(),
            violation=frame.violation.copy(),
            violations=frame.violations.copy(),
            goal_met=frame.goal_met.copy(),
        )

    def get_reward(self, physics: Physics) -> float:
        """Of the last step."""
        return float(self._core.frame.reward[0])

    def get_termination(self, physics: Physics) -> float | None:
        """The discount of an episode that is over: 0 if it terminated, 1 if it was truncated."""
        frame = self._core.frame
        if frame.terminated[0]:
            return 0.0
        return 1.0 if frame.truncated[0] else None
