"""Safety-Gymnasium's Run: drive along a lane as far as possible; its edges cost it to cross."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array, Robot
from torchrl_safe.envs.tasks.base import Mask, Objects, Prop, length
from torchrl_safe.envs.tasks.bodies import Readings
from torchrl_safe.envs.tasks.safety import Kind, SafetyTask

_LANE = 0.5  # half its width
_START = (0.2, 16.5)  # the robot starts this far to either side of (0, 16.5)
_GOAL = np.array((0.0, -1000.0))
_REWARD_FACTOR = 60.0


@dataclass(frozen=True)
class SafetyRunTask(SafetyTask):
    """Safety-Gymnasium's Run.

    Args:
        level (int): 0, there is no other.
        separate_costs (bool): a cost for each source of cost. Default: ``False``.

    Examples:
        >>> SafetyRunTask().episode_length
        500
    """

    level: int = 0

    levels: ClassVar[tuple[int, ...]] = (0,)
    episode_length: ClassVar[int] = 500
    reward_clip: ClassVar[float] = np.inf

    @property
    def extent(self) -> float:
        """Half the side of the square that a picture shows."""
        return 2.0

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Nothing that a lidar sees."""
        return ()

    @property
    def props(self) -> tuple[Prop, ...]:
        """The edges of the lane."""
        return (
            Prop(((_LANE, 0.0), (-_LANE, 0.0)), "box", (0.01, 17.5, 0.02), (0.9, 0.8, 0.1, 0.5)),
        )

    @property
    def sources(self) -> tuple[str, ...]:
        """What can cost."""
        return ("out_of_boundary",)

    def start(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Objects]:
        """The robot at the lane's end."""
        half, y = _START
        x = (streams.uniform(rows, 1) * 2.0 - 1.0) * half
        return np.concatenate((x, np.full_like(x, y)), 1), {}

    def begin(self, position: Array, objects: Objects) -> Objects:
        """The distance to a point far ahead."""
        return {"goal_distance": length(position[:, :2] - _GOAL)}

    def costs(self, readings: Readings, objects: Mapping[str, Array]) -> dict[str, Mask]:
        """Being outside the lane."""
        return {"out_of_boundary": np.abs(readings.position[:, 0]) > _LANE}

    def judge(
        self, readings: Readings, objects: Objects, streams: RandomStreams, robot: Robot
    ) -> tuple[Objects, Array, Mask]:
        """Progress along the lane."""
        distance = length(readings.position[:, :2] - _GOAL)
        reward = _REWARD_FACTOR * (objects["goal_distance"] - distance)
        return objects | {"goal_distance": distance}, reward, np.zeros(len(reward), bool)
