"""The Jackal task with a second cost: a limit on collisions and one on speed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array, Motion, Robot
from torchrl_safe.envs.tasks.base import Objects, Outcome, Sensed
from torchrl_safe.envs.tasks.navigation import NavigationTask


@dataclass(frozen=True)
class NavigationSpeedTask(NavigationTask):
    """The navigation task with two costs, ``"collision"`` and ``"speed"``.

    The cost of a collision is :class:`NavigationTask`'s. That of speed is 1 in a step whose speed
    ahead or backwards is above ``speed_limit``, else 0, as in Safety-Gymnasium's velocity tasks. An
    environment writes them as ``collision_cost`` and ``speed_cost``, each with its violation.

    Args:
        speed_limit (float): metres per second. The Jackal drives at 1 at most. Default: 0.5.

    Raises:
        ValueError: if an option is out of range.

    Examples:
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> env = SafeRobotEnv("jackal", task="navigation_speed", num_envs=2, num_threads=1)
        >>> env.rollout(3)["next", "speed_cost"].shape
        torch.Size([2, 3, 1])
    """

    speed_limit: float = 0.5

    cost_names: ClassVar[tuple[str, ...]] = ("collision", "speed")

    @property
    def max_cost(self) -> float | tuple[float, ...]:
        """The largest collision and speed cost of a step."""
        return 1.0 / (1.0 - self.discount), 1.0

    def sense(self, robot: Robot, motion: Motion, objects: Objects) -> Sensed:
        """What :class:`NavigationTask` senses, with cost and violation [N, 2]."""
        sensed = super().sense(robot, motion, objects)
        # The first reading of a robot on wheels.
        fast = np.abs(motion.proprioception[:, 0]) > self.speed_limit
        return sensed._replace(
            cost=np.stack((sensed.cost, fast), 1),
            violation=np.stack((sensed.violation, fast), 1),
        )

    def advance(
        self,
        robot: Robot,
        motion: Motion,
        objects: Objects,
        sensed: Sensed,
        remaining: NDArray[np.int64],
        streams: RandomStreams,
    ) -> Outcome:
        """As in :class:`NavigationTask`; the steps after a contact stand at the speed cost 0."""
        collision: Array = sensed.cost[:, 0]
        alone = sensed._replace(cost=collision, violation=sensed.violation[:, 0])
        outcome = super().advance(robot, motion, objects, alone, remaining, streams)
        return outcome._replace(
            cost=np.stack((outcome.cost, sensed.cost[:, 1]), 1),
            violations=np.stack((outcome.violations, sensed.violation[:, 1]), 1),
        )
