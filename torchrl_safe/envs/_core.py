"""Episodes of N simulations: clocks, resets, random streams, state. A subclass says of what.

numpy in, numpy out: every interface of ours (TorchRL, Gymnasium, dm_control) wraps one of these and
translates.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._pool import Mask, Rows, SimulationPool
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array


class Frame(Protocol):
    """What N environments show after a step or a reset: a ``NamedTuple`` of arrays [N, ...].

    Cost and violation are [N], or [N, m] where there are m costs.
    """

    @property
    def observation(self) -> NDArray[np.floating]: ...
    @property
    def reward(self) -> Array: ...
    @property
    def cost(self) -> Array: ...
    @property
    def violation(self) -> Mask: ...
    @property
    def diverged(self) -> Mask: ...
    @property
    def terminated(self) -> Mask: ...
    @property
    def truncated(self) -> Mask: ...
    def _asdict(self) -> dict[str, Any]: ...


F = TypeVar("F", bound=Frame)


class Core(ABC, Generic[F]):
    """N environments with episodes of a fixed length at most.

    A simulation that diverges is put back where it was, and its episode is truncated: it repeats
    its last observation and cost without a reward, and nothing non-finite reaches a learner.
    The frame's ``diverged`` says which did in the last step, ``instabilities`` counts them.

    Args:
        simulations (SimulationPool): what is stepped.
        frame (NamedTuple): what is shown before the first reset.
        action_range (tuple of arrays): low and high, [A] each; actions are clipped to it.

    Keyword Args:
        seed (int or None): seed of the random streams, one per environment.
        episode_length (int): steps after which an episode is truncated.
        stagger (bool): whether a reset of all environments starts them at different phases of an
            episode.

    Attributes:
        reports (tuple of str): the fields of the frame that say what a step brought.
        cost_names (tuple of str): the names of several costs; none where there is one.
        max_cost (float or tuple of float): the largest cost of a step, or of each of several.
    """

    reports: tuple[str, ...]
    cost_names: tuple[str, ...] = ()
    max_cost: float | tuple[float, ...] = 1.0

    def __init__(
        self,
        simulations: SimulationPool,
        frame: F,
        action_range: tuple[Array, Array],
        *,
        seed: int | None,
        episode_length: int,
        stagger: bool,
    ) -> None:
        self.num_envs = simulations.num_envs
        self.episode_length = episode_length
        self.stagger = stagger
        self.action_range = action_range
        self.instabilities = 0
        self.started = False
        self.frame = frame
        self._simulations = simulations
        self._elapsed = np.zeros(self.num_envs, np.int64)
        self._rows: Rows = np.arange(self.num_envs)
        self.seed(seed)

    @property
    def observation_size(self) -> int:
        """Length D of the observation."""
        return self.frame.observation.shape[1]

    @property
    def action_dim(self) -> int:
        """Size A of the action."""
        return len(self.action_range[0])

    def seed(self, seed: int | None) -> None:
        """Restarts the random streams; the current episodes stay until they are reset."""
        self._streams = RandomStreams(seed, self.num_envs)

    @property
    def random_state(self) -> NDArray[np.uint64]:
        """A copy of where each environment's random stream stands, [N]."""
        return self._streams.state.copy()

    def rewind(self, mask: Mask, random_state: NDArray[np.uint64]) -> None:
        """Puts the streams of the environments in ``mask`` [N] where others stand."""
        self._streams.state[mask] = random_state[mask]

    def reset(self, mask: Mask | None = None) -> F:
        """Starts new episodes.

        Args:
            mask (array, optional): [N], the environments to reset; the others keep their state and
                show their current frame. All are reset if there is no mask, or nothing to keep yet.

        Returns:
            Frame: reward zero where reset.
        """
        rows = self._rows if mask is None or not self.started else np.flatnonzero(mask)
        if not rows.size:
            return self.frame
        fresh = self._begin(rows)
        staggered = self.stagger and mask is None
        self._elapsed[rows] = rows * self.episode_length // self.num_envs if staggered else 0
        self.started = True
        new = fresh._asdict()
        self.frame = type(fresh)(
            **{name: with_rows(old, rows, new[name]) for name, old in self.frame._asdict().items()}
        )
        return self.frame

    def step(self, action: Array) -> F:
        """Advances all environments by one step.

        Episodes that are over go on until they are reset.

        Args:
            action (array): [N, A]; components outside the range are clipped.

        Returns:
            Frame: after the step.

        Raises:
            ValueError: if the action has another shape or is not finite; nothing has moved then.
            RuntimeError: before the first reset.
        """
        if not self.started:
            raise RuntimeError("reset the environment before its first step.")
        check_action(action, (self.num_envs, self.action_dim))
        low, high = self.action_range
        # In float64, whatever the interface: a command computed in float32 would be another one.
        diverged = self._simulate(np.minimum(np.maximum(action, low, dtype=np.float64), high))
        self.instabilities += int(diverged.sum())
        self._elapsed += 1
        self.frame = self._judge(diverged)
        return self.frame

    @abstractmethod
    def _begin(self, rows: Rows) -> F:
        """Starts episodes in the environments ``rows``: what they show, [n, ...]."""

    @abstractmethod
    def _simulate(self, action: Array) -> Mask:
        """Moves all under the actions [N, A]; those that diverged are where they were, [N]."""

    @abstractmethod
    def _judge(self, diverged: Mask) -> F:
        """What all show after the step that was simulated."""

    @property
    def remaining(self) -> NDArray[np.int64]:
        """Steps left in each episode, [N]."""
        return np.maximum(self.episode_length - self._elapsed, 0)

    def signals(self, frame: F) -> dict[str, NDArray[Any]]:
        """What a step brought by the names that users read, [N] each.

        Of several costs, ``"speed_cost"``, ``"speed_violation"`` and the like; what is no cost has
        the plain name, too, for all of them together.
        """
        out: dict[str, NDArray[Any]] = {}
        for name in self.reports:
            value: NDArray[Any] = getattr(frame, name)
            if value.ndim == 1:
                out[name] = value
                continue
            out |= {f"{cost}_{name}": value[:, k] for k, cost in enumerate(self.cost_names)}
            if name != "cost":
                out[name] = value.max(-1)
        return out

    def sources(self, frame: F) -> dict[str, NDArray[Any]]:
        """Where the costs of a step came from by the names that Safety-Gymnasium has for them."""
        return {}

    def close(self) -> None:
        """Ends the simulator's threads; steps, resets and snapshots raise from then on."""
        self._simulations.close()

    def _snapshot(self) -> dict[str, NDArray[Any]]:
        """What a subclass remembers besides: no copies."""
        return {}

    def _restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Takes over what :meth:`_snapshot` returned."""

    def snapshot(self) -> dict[str, NDArray[Any]]:
        """Copies of everything the future depends on: physics, layouts, clocks, random streams."""
        state = {
            "physics": self._simulations.state,
            **self._snapshot(),
            "elapsed": self._elapsed,
            "random": self._streams.state,
            "started": np.array(self.started),
            "instabilities": np.array(self.instabilities),
        }
        # What is empty holds nothing; without it, snapshots of earlier versions are still taken.
        frame = {f"frame_{name}": v for name, v in self.frame._asdict().items() if v.size}
        return {name: np.array(value) for name, value in (state | frame).items()}

    def restore(self, snapshot: dict[str, NDArray[Any]]) -> None:
        """Puts a snapshot back; what follows is what followed it.

        Raises:
            ValueError: if the snapshot is of another number of environments, robot or task;
                nothing has changed then.
        """
        check_snapshot(snapshot, self.snapshot())
        copy = {name: np.array(value) for name, value in snapshot.items()}
        self._restore(copy)
        self._simulations.state[:] = copy["physics"]
        self._elapsed = copy["elapsed"]
        self._streams.state = copy["random"]
        self.started = bool(copy["started"])
        self.instabilities = int(copy["instabilities"])
        old = self.frame._asdict()
        self.frame = type(self.frame)(**{k: copy.get(f"frame_{k}", v) for k, v in old.items()})


def check_counts(**counts: int) -> None:
    """Raises a ``ValueError`` unless each is an integer of at least 1."""
    for name, value in counts.items():
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name} must be an integer >= 1, got {value!r}.")


def check_action(action: Array, shape: tuple[int, int]) -> None:
    """Raises a ``ValueError`` unless actions have the shape [N, A] and are finite."""
    if action.shape != shape:
        raise ValueError(f"action must have shape {shape}, got {action.shape}.")
    if not np.isfinite(action).all():
        bad = np.flatnonzero(~np.isfinite(action).all(-1))
        raise ValueError(f"action must be finite; it is not in environments {bad.tolist()}.")


def check_snapshot(snapshot: dict[str, NDArray[Any]], like: dict[str, NDArray[Any]]) -> None:
    """Raises a ``ValueError`` unless it has the entries of another one, of its types and shapes."""
    if snapshot.keys() != like.keys():
        raise ValueError(f"snapshot must have the entries {sorted(like)}, got {sorted(snapshot)}.")
    for name, value in like.items():
        new = snapshot[name]
        if new.shape != value.shape or new.dtype != value.dtype:
            raise ValueError(
                f"snapshot entry {name!r} must be {value.dtype} of shape {value.shape}, "
                f"got {new.dtype} of shape {new.shape}."
            )


def with_rows(array: NDArray[Any], rows: Rows | Mask, new: NDArray[Any]) -> NDArray[Any]:
    """A copy of ``array`` with other rows."""
    out = array.copy()
    out[rows] = new
    return out
