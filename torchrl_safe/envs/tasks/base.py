"""What a task is to the simulator behind the environments."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array, Motion, Robot

Objects = dict[str, Array]  # what a task remembers of N environments: arrays [N, ...] by name
Mask = NDArray[np.bool_]


class Sensed(NamedTuple):
    """What N robots meet where they are.

    Attributes:
        scan (array): [N, R], readings of the lidar, before any noise.
        cost (array): [N], of being here.
        violation (array): [N] bool, whether being here breaks the constraint.
        contact (array): [N] bool, whether the robot touches something it must not.
    """

    scan: Array
    cost: Array
    violation: Mask
    contact: Mask


class Outcome(NamedTuple):
    """What a step of N environments was worth, and where their objects are after it.

    Attributes:
        objects (dict of arrays): the objects after the step; those before it are left alone.
        reward (array): [N].
        cost (array): [N].
        violations (array): [N] int64, how many violating steps the step counts for.
        goal_met (array): [N] bool.
        terminated (array): [N] bool.
    """

    objects: Objects
    reward: Array
    cost: Array
    violations: NDArray[np.int64]
    goal_met: Mask
    terminated: Mask


class Task(Protocol):
    """A task: the options of an environment and what follows from them, over a batch.

    Methods take arrays and leave them alone; the core holds all state. A row of a result depends
    on the same row of the arguments only.
    """

    @property
    def max_cost(self) -> float:
        """The largest cost of a step."""

    def observation_size(self, robot: Robot) -> int:
        """Length D of the observation."""

    def sample(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Array, Objects]:
        """Draws robot position [n, 2], yaw [n] and objects for the environments ``rows``.

        Raises:
            ValueError: if the objects do not fit.
        """

    def sense(self, robot: Robot, motion: Motion, objects: Objects) -> Sensed:
        """What the robots meet where they are."""

    def advance(
        self,
        robot: Robot,
        motion: Motion,
        objects: Objects,
        sensed: Sensed,
        remaining: NDArray[np.int64],
        streams: RandomStreams,
    ) -> Outcome:
        """Judges a step that ended here; ``remaining`` [N] steps are left in the episodes."""

    def observe(
        self, robot: Robot, motion: Motion, objects: Objects, scan: Array
    ) -> NDArray[np.float32]:
        """The observation [N, D]."""
