"""The Gymnasium interface: what ``gymnasium.make`` and ``make_vec`` build."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from torchrl_safe.envs._core import Core
from torchrl_safe.envs._pool import Mask
from torchrl_safe.envs._random import RandomStreams, check_seed
from torchrl_safe.envs._robot import RobotCore, make_core
from torchrl_safe.envs._velocity import VelocityCore
from torchrl_safe.envs.randomization import Randomization
from torchrl_safe.envs.robots import Array, Robot
from torchrl_safe.envs.tasks import Task
from torchrl_safe.envs.tasks.velocity import VelocityTask

__all__ = ["GymRobotEnv", "GymRobotVectorEnv", "GymVelocityEnv", "GymVelocityVectorEnv"]

_NO_RENDER_MODE = "render() draws nothing: make the environment with a render_mode."


class _SingleEnv(gymnasium.Env[NDArray[Any], NDArray[Any]]):
    """A core of one environment as a :class:`gymnasium.Env`, with the costs in ``info``."""

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012
    _spec: EnvSpec | None = None

    def __init__(self, core: Core[Any]) -> None:
        self._core = core
        self.observation_space, self.action_space = _spaces(core)

    @property
    def spec(self) -> EnvSpec | None:
        """What ``gymnasium.make`` was told, with the steps of an episode."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = _with_length(spec, self._core)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.floating], dict[str, Any]]:
        """Starts an episode; a seed starts the sequence of episodes that belongs to it.

        Args:
            seed (int, optional): without one, the sequence goes on.
            options (dict, optional): there are none.

        Raises:
            ValueError: if the seed is negative or there are options.
            RuntimeError: if the environment is closed.
        """
        _no_options(options)
        check_seed("seed", seed)
        super().reset(seed=seed)
        if seed is not None:
            self._core.seed(seed)
        frame = self._core.reset()
        self._show()
        none = {name: value.dtype.type(0).item() for name, value in self._signals(frame)}
        return frame.observation[0].copy(), none

    def step(
        self, action: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], float, bool, bool, dict[str, Any]]:
        """Advances by one step.

        Args:
            action (array): [A]; components outside the action space are clipped.

        Returns:
            tuple: observation [D], reward, terminated, truncated, info.

        Raises:
            ValueError: if the action has another shape or is not finite; nothing has moved then.
            RuntimeError: before the first reset, or if the environment is closed.
        """
        action = _checked_action(action, self.action_space.shape)
        frame = self._core.step(action[None])
        self._show()
        return (
            frame.observation[0].copy(),
            float(frame.reward[0]),
            bool(frame.terminated[0]),
            bool(frame.truncated[0]),
            {name: value[0].item() for name, value in self._signals(frame)},
        )

    def _signals(self, frame: Any) -> Iterable[tuple[str, NDArray[Any]]]:
        return (self._core.signals(frame) | self._core.sources(frame)).items()

    def _show(self) -> None:
        """Keeps the window up to date, where there is one."""

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Copies of everything the future depends on."""
        return self._core.snapshot()

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Puts a snapshot back; what follows is what followed it.

        Raises:
            ValueError: if it is one of another robot or task; nothing has changed then.
        """
        self._core.restore(snapshot)

    def close(self) -> None:
        """Ends the simulator."""
        self._core.close()


class _VectorEnv(gymnasium.vector.VectorEnv[NDArray[Any], NDArray[Any], NDArray[Any]]):
    """A core of N environments as a :class:`gymnasium.vector.VectorEnv`."""

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    _spec: EnvSpec | None = None

    def __init__(self, core: Core[Any], autoreset_mode: AutoresetMode | str) -> None:
        self.autoreset_mode = _checked_mode(autoreset_mode)
        self._core = core
        self.metadata = type(self).metadata | {"autoreset_mode": self.autoreset_mode}
        self.num_envs = core.num_envs
        self.single_observation_space, self.single_action_space = _spaces(core)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._over = np.zeros(self.num_envs, bool)

    @property
    def spec(self) -> EnvSpec | None:
        """What ``gymnasium.make_vec`` was told, with the steps of an episode."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = _with_length(spec, self._core)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NDArray[np.floating], dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed (int or sequence, optional): one for all, under which each environment has its own
                stream; or one for each, N of them, which make its episodes those of a
                single environment with that seed. Where there is none, the sequence of episodes
                goes on.
            options (dict, optional): ``{"reset_mask": mask}``, [N] bool, seeds and resets those
                alone.

        Raises:
            ValueError: if a seed is negative or no integer, there is another number of them, the
                mask is not a bool array [N], or there are other options.
            RuntimeError: if the environment is closed.
        """
        options = dict(options or {})
        mask = np.ones(self.num_envs, bool)
        partial = "reset_mask" in options
        if partial:
            mask = np.asarray(options.pop("reset_mask"))
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
                raise ValueError(
                    f"reset_mask must be a bool array of shape {(self.num_envs,)}, "
                    f"got {mask.dtype} {mask.shape}."
                )
        _no_options(options)
        self._seed(seed, mask)
        frame = self._core.reset(mask if partial else None)
        self._over = self._over & ~mask
        return frame.observation.copy(), self._infos(frame, np.zeros_like(mask), mask)

    def _seed(self, seed: int | Sequence[int | None] | None, mask: Mask) -> None:
        """Restarts the random streams of the environments in ``mask`` that have a seed."""
        if not isinstance(seed, (Sequence, np.ndarray)):
            check_seed("seed", seed)
            if seed is None:
                return
            super().reset(seed=int(seed))
            fresh = RandomStreams(seed, self.num_envs).state
        else:
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed must be one or {self.num_envs}, got {len(seeds)} of them.")
            for row, own in enumerate(seeds):
                check_seed(f"seed[{row}]", own)
            mask = mask & np.array([own is not None for own in seeds])
            fresh = np.concatenate([RandomStreams(own, 1).state for own in seeds])
        self._core.rewind(mask, fresh)

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], Array, Mask, Mask, dict[str, Any]]:
        """Advances all environments by one step.

        Args:
            actions (array): [N, A]; components outside the action space are clipped.

        Returns:
            tuple: observations [N, D], rewards [N], terminations [N], truncations [N], infos.

        Raises:
            ValueError: if the actions have another shape or are not finite; nothing has moved then.
            RuntimeError: before the first reset, if an episode is over and autoreset is off, or if
                the environment is closed.
        """
        actions = _checked_action(actions, self.action_space.shape)
        over = self._over
        if over.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            rows = np.flatnonzero(over).tolist()
            raise RuntimeError(f"reset environments {rows} first: their episodes are over.")
        random_state = self._core.random_state
        frame = self._core.step(actions)
        if over.any():
            # Those that are over made a step that nobody sees: it must not draw from their streams.
            self._core.rewind(over, random_state)
            frame = self._core.reset(over)
        done = frame.terminated | frame.truncated
        everywhere = np.ones(self.num_envs, bool)
        infos = self._infos(frame, ~over, everywhere)
        observations = frame.observation
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            if done.any():
                infos |= self._final(frame, done)
                observations = self._core.reset(done).observation
        else:
            self._over = done
        return (
            observations.copy(),
            frame.reward.copy(),
            frame.terminated.copy(),
            frame.truncated.copy(),
            infos,
        )

    def _infos(self, frame: Any, stepped: Mask, shown: Mask) -> dict[str, Any]:
        """What the steps of those in ``stepped`` brought, and Gymnasium's masks, [N] each."""
        infos: dict[str, Any] = {}
        for name, value in (self._core.signals(frame) | self._core.sources(frame)).items():
            infos |= {name: np.where(stepped, value, value.dtype.type(0)), f"_{name}": shown.copy()}
        return infos

    def _final(self, frame: Any, done: Mask) -> dict[str, Any]:
        """Gymnasium's entries of the episodes that ended: arrays [N], valid where masks are set."""
        last = np.full(len(done), None, object)
        for row in np.flatnonzero(done):
            last[row] = frame.observation[row].copy()
        return {
            "final_obs": last,
            "_final_obs": done.copy(),
            "final_info": self._infos(frame, done, done),
            "_final_info": done.copy(),
        }

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the simulator's threads."""
        self._core.close()


class GymRobotEnv(_SingleEnv):
    """One robot and its task as a :class:`gymnasium.Env`, with the cost in ``info``.

    Steps are those of :class:`~torchrl_safe.envs.SafeRobotEnv` with one environment and the same
    seed. A time limit is ``truncated``, a collision ``terminated``. ``info`` holds what the step
    brought, as plain Python numbers; a reset is no step and brings 0 and ``False``:

    * ``cost`` (float);
    * ``violation`` (bool), inside a hazard or in contact;
    * ``violations`` (int), how many violating steps this one counts for;
    * ``goal_met`` (bool), goal reached in this step;
    * in Safety-Gymnasium's tasks, where the cost came from: ``cost_hazards``, ... (float, 0 or 1)
      for each of ``task.sources``, and ``cost_sum``, 1 if any did.

    The observation space has no bounds: no reading of a moving robot has any. Copies and pickles go
    on where the environment stands, without its window or GL context.

    Args:
        robot (str or Robot): the robot, or its name in ``ROBOTS``. Default: ``"point"``.

    Keyword Args:
        task (str or Task, optional): the task with its options, or its name. Default: that of the
            robot.
        randomization (Randomization, optional): how the robots differ from their model.
        episode_length (int): steps until truncation, which is ``spec.max_episode_steps``. The
            argument ``max_episode_steps`` of ``gymnasium.make`` cuts an episode short from outside,
            and the task does not know of it. Default: 1000.
        render_mode (str, optional): ``"rgb_array"``, ``"human"`` (a window) or ``None``.
        width (int): pixels of a picture. Default: 480.
        height (int): pixels of a picture. Default: 360.

    Raises:
        ValueError: if the robot, the task or the render mode is unknown, an option is out of
            range, or the objects do not fit.

    Examples:
        >>> import gymnasium
        >>> import torchrl_safe.envs
        >>> env = gymnasium.make("torchrl_safe/PointGoal-v0")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> sorted(info)
        ['cost', 'goal_met', 'violation', 'violations']
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array", "human"]}  # noqa: RUF012
    _core: RobotCore

    def __init__(
        self,
        robot: str | Robot = "point",
        *,
        task: str | Task | None = None,
        randomization: Randomization | None = None,
        episode_length: int = 1000,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        core = make_core(
            robot,
            task,
            num_envs=1,
            num_threads=1,
            seed=None,
            episode_length=episode_length,
            randomization=randomization,
        )
        super().__init__(core)
        self.metadata = self.metadata | {"render_fps": _checked_fps(self, core, render_mode)}
        self.render_mode = render_mode
        self._size = (width, height)
        self._renderer: Any = None
        self._drawn_at = 0.0

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()

    def render(self) -> NDArray[np.uint8] | None:
        """A picture [H, W, 3], or ``None`` after showing it in a window in real time.

        Raises:
            RuntimeError: if there is no display to open a window on, or the environment is closed.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(_NO_RENDER_MODE)
            return None
        from torchrl_safe.envs._render import SceneRenderer

        human = self.render_mode == "human"
        if self._renderer is None:
            self._renderer = SceneRenderer(self._core, *self._size, window=human)
        picture = self._renderer.draw(0)
        if human:
            # As fast as the robot moves, and no faster.
            period = 1.0 / self.metadata["render_fps"]
            time.sleep(max(0.0, self._drawn_at + period - time.monotonic()))
            self._drawn_at = time.monotonic()
        return picture

    def layout(self) -> dict[str, Array]:
        """Where things are: see :meth:`~torchrl_safe.envs.SafeRobotEnv.layout`."""
        return self._core.layout(0)

    def close(self) -> None:
        """Closes the window or the GL context, and ends the simulator."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_renderer": None}


class GymRobotVectorEnv(_VectorEnv):
    """N environments on a thread pool as a :class:`gymnasium.vector.VectorEnv`.

    ``infos`` holds the arrays ``cost``, ``violation``, ``violations`` and ``goal_met``, [N] each,
    in Safety-Gymnasium's tasks the costs by source as well (see :class:`GymRobotEnv`), and
    Gymnasium's masks ``_cost``, ... of the environments that stepped or were reset. A reset is
    no step and brings 0 and ``False``. The autoreset mode says what happens to environments whose
    episode is over:

    * ``NEXT_STEP``: their next step ignores the action, resets them and returns reward 0 and
      cost 0;
    * ``SAME_STEP``: they are reset at once. The observation is the new episode's; reward and
      ``infos["cost"]`` are the ended one's last, as are ``infos["final_obs"]`` and
      ``infos["final_info"]``;
    * ``DISABLED``: ``reset(options={"reset_mask": mask})`` resets them. TorchRL's ``GymWrapper``
      prefers this mode.

    Args:
        robot (str or Robot): the robot, or its name in ``ROBOTS``. Default: ``"point"``.

    Keyword Args:
        num_envs (int): number of environments, N. Default: 64.
        num_threads (int): simulator threads. Default: 2.
        task (str or Task, optional): the task with its options, or its name. Default: that of the
            robot.
        randomization (Randomization, optional): how the robots differ from their model.
        episode_length (int, optional): steps until truncation. Default: 1000.
        max_episode_steps (int, optional): the same by the name that Gymnasium has for it and
            ``make_vec`` hands on.
        stagger (bool): start the episodes of a full reset at different phases. Default: ``False``.
        autoreset_mode (AutoresetMode or str): Default: ``NEXT_STEP``, as in Gymnasium.
        render_mode (str, optional): ``"rgb_array"`` or ``None``.
        width (int): pixels of a picture. Default: 480.
        height (int): pixels of a picture. Default: 360.

    Raises:
        ValueError: if the robot, the task or a mode is unknown, an option is out of range, the
            objects do not fit, or ``episode_length`` and ``max_episode_steps`` differ.

    Examples:
        >>> import gymnasium
        >>> import torchrl_safe.envs
        >>> envs = gymnasium.make_vec("torchrl_safe/PointGoal-v0", num_envs=3, num_threads=1)
        >>> observations, infos = envs.reset(seed=0)
        >>> *_, infos = envs.step(envs.action_space.sample())
        >>> infos["cost"].shape
        (3,)
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    _core: RobotCore

    def __init__(
        self,
        robot: str | Robot = "point",
        *,
        num_envs: int = 64,
        num_threads: int = 2,
        task: str | Task | None = None,
        randomization: Randomization | None = None,
        episode_length: int | None = None,
        max_episode_steps: int | None = None,
        stagger: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
        width: int = 480,
        height: int = 360,
    ) -> None:
        _checked_mode(autoreset_mode)
        core = make_core(
            robot,
            task,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=None,
            episode_length=_one_length(episode_length, max_episode_steps),
            stagger=stagger,
            randomization=randomization,
        )
        super().__init__(core, autoreset_mode)
        self.metadata = self.metadata | {"render_fps": _checked_fps(self, core, render_mode)}
        self.render_mode = render_mode
        self._size = (width, height)
        self._renderer: Any = None

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture [H, W, 3] of each environment.

        Raises:
            RuntimeError: if the environment is closed.
        """
        if self.render_mode is None:
            gymnasium.logger.warn(_NO_RENDER_MODE)
            return None
        from torchrl_safe.envs._render import SceneRenderer

        if self._renderer is None:
            self._renderer = SceneRenderer(self._core, *self._size)
        return tuple(self._renderer.draw(index) for index in range(self.num_envs))

    def close_extras(self, **kwargs: Any) -> None:
        """Frees the GL context and ends the simulator's threads."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close_extras(**kwargs)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_renderer": None}


class GymVelocityEnv(_SingleEnv):
    """A velocity task as a :class:`gymnasium.Env`, with the cost in ``info``.

    Spaces, observations and rewards are those of Gymnasium's environment of that robot, version 4,
    in float64. ``info`` holds what the step brought, ``cost`` (float) and ``violation`` (bool); a
    reset is no step and brings 0 and ``False``. There are no pictures: Gymnasium's own environment
    draws the same robot.

    Args:
        task (str or VelocityTask): the task, or its name. Default: ``"half_cheetah"``.

    Keyword Args:
        episode_length (int): steps until truncation, which is ``spec.max_episode_steps``. Default:
            1000.
        render_mode (None): there is no other one.

    Raises:
        TypeError: if the task is something else.
        ValueError: if the task is unknown, an option is out of range or there is a render mode.

    Examples:
        >>> import gymnasium
        >>> import torchrl_safe.envs
        >>> env = gymnasium.make("torchrl_safe/SafetyHalfCheetahVelocity-v1")
        >>> observation, info = env.reset(seed=0)
        >>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> info
        {'cost': 0.0, 'violation': False}
    """

    def __init__(
        self,
        task: str | VelocityTask = "half_cheetah",
        *,
        episode_length: int = 1000,
        render_mode: None = None,
    ) -> None:
        _no_pictures(render_mode)
        super().__init__(
            VelocityCore(task, num_envs=1, num_threads=1, seed=None, episode_length=episode_length)
        )


class GymVelocityVectorEnv(_VectorEnv):
    """N environments of a velocity task on a thread pool.

    ``infos`` holds the arrays ``cost`` and ``violation``, [N] each, and Gymnasium's masks ``_cost``
    and ``_violation`` of the environments that stepped or were reset. The autoreset modes are those
    of :class:`~torchrl_safe.envs.GymRobotVectorEnv`.

    Args:
        task (str or VelocityTask): the task, or its name. Default: ``"half_cheetah"``.

    Keyword Args:
        num_envs (int): number of environments, N. Default: 64.
        num_threads (int): simulator threads. Default: 2.
        episode_length (int, optional): steps until truncation. Default: 1000.
        max_episode_steps (int, optional): the same by the name that ``make_vec`` has for it.
        stagger (bool): start the episodes of a full reset at different phases. Default: ``False``.
        autoreset_mode (AutoresetMode or str): Default: ``NEXT_STEP``, as in Gymnasium.
        render_mode (None): there is no other one.

    Raises:
        TypeError: if the task is something else.
        ValueError: if the task or the mode is unknown, an option is out of range, there is a
            render mode, or ``episode_length`` and ``max_episode_steps`` differ.

    Examples:
        >>> import gymnasium
        >>> import torchrl_safe.envs
        >>> name = "torchrl_safe/SafetyHopperVelocity-v1"
        >>> envs = gymnasium.make_vec(name, num_envs=3, num_threads=1)
        >>> observations, infos = envs.reset(seed=0)
        >>> *_, infos = envs.step(envs.action_space.sample())
        >>> infos["cost"].shape
        (3,)
    """

    def __init__(
        self,
        task: str | VelocityTask = "half_cheetah",
        *,
        num_envs: int = 64,
        num_threads: int = 2,
        episode_length: int | None = None,
        max_episode_steps: int | None = None,
        stagger: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
    ) -> None:
        _no_pictures(render_mode)
        _checked_mode(autoreset_mode)
        core = VelocityCore(
            task,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=None,
            episode_length=_one_length(episode_length, max_episode_steps),
            stagger=stagger,
        )
        super().__init__(core, autoreset_mode)


def _with_length(spec: EnvSpec | None, core: Core[Any]) -> EnvSpec | None:
    """Gymnasium leaves the length out, as it knows only of limits that it sets itself."""
    return None if spec is None else replace(spec, max_episode_steps=core.episode_length)


def _spaces(core: Core[Any]) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Of observations [D], in the core's type, and actions [A], float32."""
    low, high = (bound.astype(np.float32) for bound in core.action_range)
    shape, dtype = (core.observation_size,), core.frame.observation.dtype.type
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, shape, dtype),
        gymnasium.spaces.Box(low, high, dtype=np.float32),
    )


def _checked_mode(mode: AutoresetMode | str) -> AutoresetMode:
    modes = [mode.value for mode in AutoresetMode]
    if mode not in (*AutoresetMode, *modes):
        raise ValueError(f"autoreset_mode must be one of {modes}, got {mode!r}.")
    return AutoresetMode(mode)


def _one_length(episode_length: int | None, max_episode_steps: int | None) -> int:
    if None not in (episode_length, max_episode_steps) and episode_length != max_episode_steps:
        raise ValueError(
            "episode_length and max_episode_steps are two names of one thing, got "
            f"{episode_length} and {max_episode_steps}."
        )
    if max_episode_steps is not None and max_episode_steps < 1:
        raise ValueError(f"max_episode_steps must be at least 1, got {max_episode_steps}.")
    if episode_length is None:
        return 1000 if max_episode_steps is None else max_episode_steps
    return episode_length


def _checked_fps(env: _SingleEnv | _VectorEnv, core: RobotCore, render_mode: str | None) -> int:
    modes = env.metadata["render_modes"]
    if render_mode is not None and render_mode not in modes:
        raise ValueError(f"render_mode must be None or one of {modes}, got {render_mode!r}.")
    return round(1.0 / (core.robot.timestep * core.robot.substeps))


def _no_pictures(render_mode: Any) -> None:
    if render_mode is not None:
        raise ValueError(
            f"render_mode must be None, got {render_mode!r}: Gymnasium's own environment, which is "
            'equal step by step, draws: gymnasium.make("HalfCheetah-v4", render_mode="rgb_array").'
        )


def _checked_action(action: Any, shape: tuple[int, ...] | None) -> Array:
    action = np.asarray(action)
    if action.shape != shape or action.dtype.kind not in "fiu":
        raise ValueError(
            f"action must be numbers of shape {shape}, got {action.dtype} {action.shape}."
        )
    return action


def _no_options(options: dict[str, Any] | None) -> None:
    if options:
        raise ValueError(f"unknown reset options: {sorted(options)}.")
