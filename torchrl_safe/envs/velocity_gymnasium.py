"""The Gymnasium face of the velocity tasks: what ``gymnasium.make`` and ``make_vec`` build."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from torchrl_safe.envs._core import Mask
from torchrl_safe.envs._random import RandomStreams, check_seed
from torchrl_safe.envs._velocity import VelocityCore, VelocityFrame
from torchrl_safe.envs.robots import Array
from torchrl_safe.envs.tasks.velocity import VelocityTask

__all__ = ["GymVelocityEnv", "GymVelocityVectorEnv"]


class GymVelocityEnv(gymnasium.Env[NDArray[Any], NDArray[Any]]):
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

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012
    _spec: EnvSpec | None = None

    def __init__(
        self,
        task: str | VelocityTask = "half_cheetah",
        *,
        episode_length: int = 1000,
        render_mode: None = None,
    ) -> None:
        _no_pictures(render_mode)
        self._core = VelocityCore(
            task, num_envs=1, num_threads=1, seed=None, episode_length=episode_length
        )
        self.observation_space, self.action_space = _spaces(self._core)

    @property
    def spec(self) -> EnvSpec | None:
        """What ``gymnasium.make`` was told, with the steps of an episode."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        self._spec = _with_length(spec, self._core)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
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
        return frame.observation[0].copy(), {"cost": 0.0, "violation": False}

    def step(self, action: NDArray[np.floating]) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Advances by one step.

        Args:
            action (array): [A]; components outside the action space are clipped.

        Returns:
            tuple: observation [D], reward, terminated, truncated, info.

        Raises:
            ValueError: if the action has another shape or is not finite; nothing has moved then.
            RuntimeError: before the first reset, or if the environment is closed.
        """
        frame = self._core.step(np.asarray(action)[None])
        return (
            frame.observation[0].copy(),
            float(frame.reward[0]),
            bool(frame.terminated[0]),
            bool(frame.truncated[0]),
            {"cost": float(frame.cost[0]), "violation": bool(frame.violation[0])},
        )

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Copies of everything the future depends on."""
        return self._core.snapshot()

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Puts a snapshot back; what follows is what followed it.

        Raises:
            ValueError: if it is one of another task; nothing has changed then.
        """
        self._core.restore(snapshot)

    def close(self) -> None:
        """Ends the simulator."""
        self._core.close()


class GymVelocityVectorEnv(gymnasium.vector.VectorEnv[NDArray[Any], NDArray[Any], NDArray[Any]]):
    """N environments of a velocity task on a thread pool.

    ``infos`` holds the arrays ``cost`` and ``violation``, [N] each, and Gymnasium's masks ``_cost``
    and ``_violation`` of the environments that stepped or were reset. The autoreset modes are those
    of :class:`~torchrl_safe.envs.GymGoalVectorEnv`.

    Args:
        task (str or VelocityTask): the task, or its name. Default: ``"half_cheetah"``.

    Keyword Args:
        num_envs (int): number of environments, N. Default: 64.
        num_threads (int): simulator threads. Default: 2.
        episode_length (int): steps until truncation. Default: 1000.
        max_episode_steps (int, optional): the same by the name that ``make_vec`` has for it; it
            goes before.
        stagger (bool): start the episodes of a full reset at different phases. Default: ``False``.
        autoreset_mode (AutoresetMode or str): Default: ``NEXT_STEP``, as in Gymnasium.
        render_mode (None): there is no other one.

    Raises:
        TypeError: if the task is something else.
        ValueError: if the task or the mode is unknown, an option is out of range or there is a
            render mode.

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

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }
    _spec: EnvSpec | None = None

    def __init__(
        self,
        task: str | VelocityTask = "half_cheetah",
        *,
        num_envs: int = 64,
        num_threads: int = 2,
        episode_length: int = 1000,
        max_episode_steps: int | None = None,
        stagger: bool = False,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: None = None,
    ) -> None:
        _no_pictures(render_mode)
        modes = [mode.value for mode in AutoresetMode]
        if autoreset_mode not in (*AutoresetMode, *modes):
            raise ValueError(f"autoreset_mode must be one of {modes}, got {autoreset_mode!r}.")
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = type(self).metadata | {"autoreset_mode": self.autoreset_mode}
        self._core = VelocityCore(
            task,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=None,
            episode_length=episode_length if max_episode_steps is None else max_episode_steps,
            stagger=stagger,
        )
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = _spaces(self._core)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._over = np.zeros(num_envs, bool)

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
    ) -> tuple[Array, dict[str, Any]]:
        """Starts new episodes.

        Args:
            seed (int or sequence, optional): one for all, under which each environment has its own
                stream; or one for each, N of them, which make its episodes those of a
                :class:`GymVelocityEnv` with that seed. Where there is none, the sequence of
                episodes goes on.
            options (dict, optional): ``{"reset_mask": mask}``, [N] bool, seeds and resets those
                alone.

        Raises:
            ValueError: if a seed is negative or no integer, there is another number of them, the
                mask is not a bool array [N], or there are other options.
            RuntimeError: if the environment is closed.
        """
        options = dict(options or {})
        chosen = options.pop("reset_mask", None)
        _no_options(options)
        mask = np.ones(self.num_envs, bool) if chosen is None else np.asarray(chosen)
        if mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            raise ValueError(
                f"reset_mask must be a bool array of shape {(self.num_envs,)}, "
                f"got {mask.dtype} {mask.shape}."
            )
        self._seed(seed, mask)
        frame = self._core.reset(None if chosen is None else mask)
        self._over = self._over & ~mask
        return frame.observation.copy(), _infos(frame, np.zeros_like(mask), mask)

    def _seed(self, seed: int | Sequence[int | None] | None, mask: Mask) -> None:
        """Restarts the random streams of the environments in ``mask`` that have a seed."""
        if seed is None:
            return
        if isinstance(seed, (Sequence, np.ndarray)):
            seeds = list(seed)
            if len(seeds) != self.num_envs:
                raise ValueError(f"seed must be one or {self.num_envs}, got {len(seeds)} of them.")
            mask = mask & np.array([own is not None for own in seeds])
            fresh = np.concatenate([RandomStreams(own, 1).state for own in seeds])
        else:
            check_seed("seed", seed)
            super().reset(seed=int(seed))
            fresh = RandomStreams(seed, self.num_envs).state
        self._core.rewind(mask, fresh)

    def step(
        self, actions: NDArray[np.floating]
    ) -> tuple[Array, Array, Mask, Mask, dict[str, Any]]:
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
        over = self._over
        if over.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            rows = np.flatnonzero(over).tolist()
            raise RuntimeError(f"reset environments {rows} first: their episodes are over.")
        frame = self._core.step(np.asarray(actions))
        if over.any():
            frame = self._core.reset(over)
        done = frame.terminated | frame.truncated
        everywhere = np.ones(self.num_envs, bool)
        infos = _infos(frame, ~over, everywhere)
        observations = frame.observation
        if self.autoreset_mode is AutoresetMode.SAME_STEP:
            if done.any():
                infos |= _final(frame, done)
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

    def close_extras(self, **kwargs: Any) -> None:
        """Ends the simulator's threads."""
        self._core.close()


def _no_pictures(render_mode: Any) -> None:
    if render_mode is not None:
        raise ValueError(
            f"render_mode must be None, got {render_mode!r}: Gymnasium's own environment, which is "
            'equal step by step, draws: gymnasium.make("HalfCheetah-v4", render_mode="rgb_array").'
        )


def _no_options(options: dict[str, Any] | None) -> None:
    if options:
        raise ValueError(f"unknown reset options: {sorted(options)}.")


def _with_length(spec: EnvSpec | None, core: VelocityCore) -> EnvSpec | None:
    """Gymnasium leaves the length out, as it knows only of limits that it sets itself."""
    return None if spec is None else replace(spec, max_episode_steps=core.episode_length)


def _spaces(core: VelocityCore) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """Of observations [D] and actions [A], as Gymnasium's environments have them."""
    low, high = (bound.astype(np.float32) for bound in core.action_range)
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (core.observation_size,), np.float64),
        gymnasium.spaces.Box(low, high, dtype=np.float32),
    )


def _infos(frame: VelocityFrame, stepped: Mask, shown: Mask) -> dict[str, Any]:
    """What the steps of the environments ``stepped`` brought, and Gymnasium's masks, [N] each."""
    return {
        "cost": np.where(stepped, frame.cost, 0.0),
        "_cost": shown.copy(),
        "violation": stepped & frame.violation,
        "_violation": shown.copy(),
    }


def _final(frame: VelocityFrame, done: Mask) -> dict[str, Any]:
    """Gymnasium's entries of the episodes that ended: arrays [N], valid where the masks are set."""
    last = np.full(len(done), None, object)
    for row in np.flatnonzero(done):
        last[row] = frame.observation[row].copy()
    return {
        "final_obs": last,
        "_final_obs": done.copy(),
        "final_info": _infos(frame, done, done),
        "_final_info": done.copy(),
    }
