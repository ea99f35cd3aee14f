"""The dm_control interface: ``load("point", "goal")``, as in its suite."""

from __future__ import annotations

import copy
import os
import sys
import warnings
from collections import OrderedDict
from typing import Any

import mujoco as mujoco_api
import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import check_seed
from torchrl_safe.envs._render import Scene, check_not_forked, has_display
from torchrl_safe.envs._robot import RobotCore, make_core
from torchrl_safe.envs.randomization import Randomization
from torchrl_safe.envs.robots import Array, Robot, get_robot
from torchrl_safe.envs.tasks import Task

# dm_control chooses how to draw when it is imported, and without a display would choose a window.
if sys.platform == "linux" and not os.environ.get("MUJOCO_GL") and not has_display():
    os.environ["MUJOCO_GL"] = "egl"

try:
    from dm_control import mujoco
    from dm_control.mujoco import wrapper
    from dm_control.rl import control
    from dm_control.suite import base
    from dm_env import specs
except ImportError as error:
    raise ImportError(
        f"the dm_control interface needs dm-control, and importing it fails: {error}. "
        "pip install 'dm-control>=1.0.50,<1.1' installs it on Python 3.10 to 3.12; labmaze, which "
        "it needs, has no wheel for later ones. SafeRobotEnv and gymnasium.make need no dm-control."
    ) from error

__all__ = ["Physics", "SafeTask", "load"]


def load(
    robot: str | Robot = "point",
    task: str | Task | None = None,
    task_kwargs: dict[str, Any] | None = None,
    environment_kwargs: dict[str, Any] | None = None,
    visualize_reward: bool = False,
    *,
    random: int | np.random.RandomState | None = None,
    episode_length: int = 1000,
    randomization: Randomization | None = None,
) -> control.Environment:
    """An environment of dm_control's reinforcement-learning suite, with a cost.

    Steps are those of :class:`~torchrl_safe.envs.SafeRobotEnv` with one environment and the same
    seed. A time step's ``observation`` holds, besides ``observation`` [D] float32, arrays [1]:
    ``cost`` (float64), ``violation`` and ``goal_met`` (bool), ``violations`` (int64, how many
    violating steps this one counts for). The last time step has discount 1 after a time limit and 0
    after a collision.

    Args:
        robot (str or Robot): the robot, or its name in ``ROBOTS``. Default: ``"point"``.
        task (str or Task, optional): the name of a task in ``TASKS``, or a task with its options.
            Default: the robot's own.
        task_kwargs (dict, optional): the keyword arguments below, in the manner of
            ``dm_control.suite.load``; what is in it counts.
        environment_kwargs (dict, optional): for ``dm_control.rl.control.Environment``:
            ``flat_observation``, ``time_limit`` in seconds, ``legacy_step``, which changes nothing.
        visualize_reward (bool): the robot turns yellow with the reward. Default: ``False``.

    Keyword Args:
        random (int, RandomState, optional): seed of the episodes. ``None`` takes one from the
            operating system.
        episode_length (int): steps until the time limit. Default: 1000.
        randomization (Randomization, optional): how the robot differs from its model.

    Returns:
        dm_control.rl.control.Environment: for dm_control's viewer, and for TorchRL's
        ``DMControlWrapper``.

    Raises:
        TypeError: if there is no such keyword argument.
        ValueError: if robot or task is unknown, an option is out of range, or the objects do not
            fit.

    Examples:
        >>> from torchrl_safe.envs.interfaces import suite
        >>> env = suite.load("point", "goal", random=0)
        >>> time_step = env.reset()
        >>> time_step = env.step([1.0, 0.0])
        >>> time_step.observation["cost"].shape
        (1,)
    """
    if not isinstance(robot, Robot):
        robot = get_robot(robot)
    if task == "goal" != robot.task:
        warnings.warn(
            f"load({robot.name!r}, 'goal') makes the robot's own task, {robot.task!r}: say so. "
            "Later versions will make the goal task.",
            DeprecationWarning,
            stacklevel=2,
        )
        task = None
    options: dict[str, Any] = {
        "random": random,
        "episode_length": episode_length,
        "randomization": randomization,
    }
    unknown = (task_kwargs or {}).keys() - options.keys()
    if unknown:
        raise TypeError(
            f"task_kwargs may hold {sorted(options)}, got {sorted(unknown)}; options of a task go "
            "in place of its name: load(robot, GoalTask(...))."
        )
    options |= task_kwargs or {}
    fixed = (environment_kwargs or {}).keys() & {"n_sub_steps", "control_timestep"}
    if fixed:
        raise TypeError(f"environment_kwargs must not hold {sorted(fixed)}: they are the robot's.")
    random = options.pop("random")
    core = make_core(
        robot,
        task,
        num_envs=1,
        num_threads=1,
        seed=None,
        **options,
    )
    safe_task = SafeTask(core, random)
    safe_task.visualize_reward = visualize_reward
    return control.Environment(
        Physics(core),
        safe_task,
        n_sub_steps=core.robot.substeps,
        **(environment_kwargs or {}),
    )


class Physics(mujoco.Physics):
    """The scene as dm_control sees and draws it; the simulator of every interface moves it.

    Its model is the robot's with floor, light, goal and hazards, and the cameras ``"overview"`` and
    ``"follow"``. It advances by whole environment steps. What is written to ``data`` (time, qpos,
    qvel, act) is where the simulator goes on from, at the next step or ``forward``; in between,
    ``data`` shows where the simulator is. A randomised robot is shown as its model.

    Args:
        core (RobotCore): one environment.
    """

    def __init__(self, core: RobotCore) -> None:
        self._core = core
        self._action = np.zeros(core.action_dim)
        self._scene = Scene(core)
        data = wrapper.MjData(wrapper.MjModel(self._scene.model))
        self._scene.data = data.ptr
        self._show()
        super().__init__(data)

    def start(self) -> None:
        """Starts an episode."""
        self._core.reset()
        self._show()

    def reset(self, keyframe_id: int | None = None) -> None:
        """Puts ``data``, not yet the simulator, to the model's defaults.

        Raises:
            ValueError: if there is a ``keyframe_id``: what is around the robot has none.
        """
        if keyframe_id is not None:
            raise ValueError(f"keyframe_id must be None, got {keyframe_id!r}.")
        mujoco_api.mj_resetData(self.model.ptr, self.data.ptr)
        mujoco_api.mj_forward(self.model.ptr, self.data.ptr)

    def after_reset(self) -> None:
        """Hands what was written to ``data`` to the simulator."""
        self.forward()

    def forward(self) -> None:
        """Hands what was written to ``data`` to the simulator, and shows what it makes of it."""
        self._hand_over()
        self._show()

    def get_state(self, sig: int | None = None) -> Array:
        """Everything the future depends on, as one vector.

        It starts with dm_control's, so qpos, qvel and act. Behind it are the rest of the physics,
        where things are, the episode's clock, random stream and last frame.

        Args:
            sig (int, optional): MuJoCo's ``mjtState``: that part of ``data`` alone.
        """
        if sig is not None:
            return super().get_state(sig)
        rest = map(_to_numbers, self._core.snapshot().values())
        return np.concatenate((super().get_state(), *rest))

    def set_state(self, physics_state: NDArray[Any], sig: int | None = None) -> None:
        """Puts back what :meth:`get_state` returned; what follows is what followed it.

        Args:
            physics_state (array): what :meth:`get_state` returned; or its beginning, qpos, qvel and
                act alone, which moves the robot at the next step or ``forward``.
            sig (int, optional): as in :meth:`get_state`.

        Raises:
            ValueError: if it has another size.
        """
        if sig is not None:
            super().set_state(physics_state, sig)
            return
        state = np.asarray(physics_state, np.float64)
        robot, snapshot = super().get_state().size, self._core.snapshot()
        sizes = [_to_numbers(value).size for value in snapshot.values()]
        if state.shape not in ((robot,), (robot + sum(sizes),)):
            raise ValueError(
                f"the state must have shape {(robot + sum(sizes),)}, or {(robot,)} for the robot "
                f"alone, got {state.shape}."
            )
        if state.size > robot:
            parts = np.split(state[robot:], np.cumsum(sizes)[:-1])
            pairs = zip(snapshot.items(), parts, strict=True)
            self._core.restore({name: _from_numbers(x, old) for (name, old), x in pairs})
            self._show()
        super().set_state(state[:robot])

    def copy(self, share_model: bool = False) -> Physics:
        """One with a simulator of its own, which goes on alike; a model is never shared."""
        return copy.deepcopy(self)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._core,), (self._action, super().get_state())

    def __setstate__(self, state: tuple[Array, Array]) -> None:
        self._action, robot = state
        super().set_state(robot)

    def _hand_over(self) -> None:
        """The simulator goes on from ``data`` if somebody has written there."""
        if not self._core.started:
            return
        theirs = self._core.physics()
        ours = {name: np.asarray(getattr(self.data, name))[None] for name in theirs}
        if any((ours[name] != value).any() for name, value in theirs.items()):
            self._core.move(ours)

    def _show(self) -> None:
        """``data`` is where the simulator is."""
        data = self._scene.data
        for name, value in self._core.physics().items():
            if name == "time":
                data.time = value[0]
            else:
                getattr(data, name)[:] = value[0]
        self._scene.show(0)
        mujoco_api.mj_forward(self._scene.model, data)

    def highlight(self, share: float) -> None:
        """Colours the robot: 0 as in its file, 1 all yellow."""
        self._scene.highlight(share)

    def render(self, *args: Any, **kwargs: Any) -> NDArray[Any]:
        """See ``dm_control.mujoco.Physics.render``.

        Raises:
            RuntimeError: if this process was forked from one that has drawn.
        """
        check_not_forked()
        return super().render(*args, **kwargs)

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
        self._hand_over()
        self._core.step(self._action[None])
        self._show()


class SafeTask(base.Task):
    """Rewards, costs and ends of episodes, read off the simulator of every interface.

    Args:
        core (RobotCore): one environment.
        random (int, RandomState, optional): an integer seeds the episodes like every other
            interface's ``seed``; from a ``RandomState``, also one put in later, their seed is
            drawn.

    Raises:
        ValueError: if the seed is negative.
    """

    def __init__(self, core: RobotCore, random: int | np.random.RandomState | None) -> None:
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
        super().initialize_episode(physics)

    def after_step(self, physics: Physics) -> None:
        """Colours the robot by the reward, if ``visualize_reward`` is set."""
        if self.visualize_reward:
            # As the suite does: near the largest reward, differences are seen better.
            physics.highlight(float(np.clip(self.get_reward(physics), 0.0, 1.0)) ** 4)

    def action_spec(self, physics: Physics) -> specs.BoundedArray:
        """[A], float64; most robots' is in [-1, 1]."""
        low, high = self._core.action_range
        return specs.BoundedArray(high.shape, np.float64, low, high, name="action")

    def get_observation(self, physics: Physics) -> OrderedDict[str, NDArray[Any]]:
        """What the robot observes [D], and what the step cost [1]."""
        frame = self._core.frame
        signals = {name: value.copy() for name, value in self._core.signals(frame).items()}
        return OrderedDict(observation=frame.observation[0].copy(), **signals)

    def get_reward(self, physics: Physics) -> float:
        """Of the last step."""
        return float(self._core.frame.reward[0])

    def get_termination(self, physics: Physics) -> float | None:
        """The discount of an episode that is over: 0 if it terminated, 1 if it was truncated."""
        frame = self._core.frame
        if frame.terminated[0]:
            return 0.0
        return 1.0 if frame.truncated[0] else None


def _to_numbers(value: NDArray[Any]) -> Array:
    """[...] of any type as float64 [n]; a float64 does not hold 64 random bits, so it gets 32."""
    bits = value.view(np.uint32) if value.dtype == np.uint64 else value
    return bits.astype(np.float64).ravel()


def _from_numbers(numbers: Array, like: NDArray[Any]) -> NDArray[Any]:
    """What :func:`_to_numbers` was given, of the shape and type of ``like``."""
    if like.dtype == np.uint64:
        return numbers.astype(np.uint32).view(np.uint64).reshape(like.shape)
    return numbers.astype(like.dtype).reshape(like.shape)
