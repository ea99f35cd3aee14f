"""Safety-Gymnasium's Goal: drive to a goal that moves when it is reached, around hazards and vases.

Level 0 has the goal alone, level 1 eight hazards and a vase that may be pushed, level 2 ten hazards
and ten vases that cost to touch and while they move.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array, Robot
from torchrl_safe.envs.tasks.base import Mask, Objects, length, pursue_goal
from torchrl_safe.envs.tasks.bodies import Readings
from torchrl_safe.envs.tasks.safety import (
    Kind,
    SafetyTask,
    goal_kind,
    hazards_kind,
    inside,
    vases_kind,
)

_GOAL_RADIUS = 0.3
_HAZARD_RADIUS = 0.2
_SLOWEST = 1e-4  # a vase slower than this, in m/s, is at rest


@dataclass(frozen=True)
class SafetyGoalTask(SafetyTask):
    """Safety-Gymnasium's Goal at a level.

    Args:
        level (int): 0, 1 or 2.
        separate_costs (bool): a cost for each source of cost. Default: ``False``.

    Examples:
        >>> from torchrl_safe.envs import SafeGoalEnv
        >>> env = SafeGoalEnv("point", task=SafetyGoalTask(1), num_envs=2, num_threads=1)
        >>> env.reset()["observation"].shape
        torch.Size([2, 60])
    """

    same_in_mirror: ClassVar[bool] = True

    @property
    def extent(self) -> float:
        """Half the side of the square of the layouts, metres."""
        return (1.0, 1.5, 2.0)[self.level]

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Goal, hazards and vases."""
        hazards, vases = ((0, 0), (8, 1), (10, 10))[self.level]
        goal = goal_kind(0.305, _GOAL_RADIUS)
        if not hazards:
            return (goal,)
        return (goal, hazards_kind(hazards, 0.18, _HAZARD_RADIUS), vases_kind(vases))

    @property
    def sources(self) -> tuple[str, ...]:
        """What can cost."""
        return ((), ("hazards",), ("hazards", "vases_contact", "vases_velocity"))[self.level]

    def start(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Objects]:
        """A layout whose goal has moved once already."""
        position, objects = super().start(robot, streams, rows)
        goal = self._draw_goal(position[:, None], objects, robot, streams, rows)
        return position, objects | {"goal": goal}

    def begin(self, position: Array, objects: Objects) -> Objects:
        """The distance to the goal."""
        return {"goal_distance": length(objects["goal"][:, 0] - position[:, :2])}

    def costs(self, readings: Readings, objects: Mapping[str, Array]) -> dict[str, Mask]:
        """Being inside a hazard; at level 2, touching a vase and any vase moving."""
        if self.level == 0:
            return {}
        due = {"hazards": inside(readings, objects["hazards"], _HAZARD_RADIUS)}
        if self.level == 2:
            speed = np.linalg.norm(readings.velocities["vases"], axis=-1)
            due["vases_contact"] = np.any(readings.touched["vases"], axis=-1)
            due["vases_velocity"] = (speed >= _SLOWEST).any(-1)
        return due

    def judge(
        self, readings: Readings, objects: Objects, streams: RandomStreams, robot: Robot
    ) -> tuple[Objects, Array, Mask]:
        """Progress to the goal, and one for reaching it."""
        goal, distance, reward, goal_met = pursue_goal(
            readings.position[:, :2],
            objects["goal"][:, 0],
            objects["goal_distance"],
            _GOAL_RADIUS,
            lambda rows: self.next_goal(readings, objects, robot, streams, rows)[:, 0],
        )
        moved = {"goal": goal[:, None], "goal_distance": distance}
        return objects | moved, reward, goal_met
