"""The goal task: layouts, lidar, reward, cost and observation over a batch, without a simulator.

A robot drives to a goal disc among hazard discs, which do not block it but cost it to enter; a
reached goal moves elsewhere. This is Safety Gym's ``Goal1`` without its vase, with the smooth cost
and the reward of SafeTAC, equation (19).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.reflection import Reflection
from torchrl_safe.envs.robots import Array, Motion, Robot, to_robot_frame
from torchrl_safe.envs.tasks.base import (
    Objects,
    Outcome,
    Prop,
    Sensed,
    check_options,
    length,
    lidar_readings,
    observation_in_mirror,
    observe,
    offsets,
    pursue_goal,
)
from torchrl_safe.envs.tasks.layout import place_goal, scatter


@dataclass(frozen=True)
class GoalTask:
    """The options of the goal task; lengths in metres.

    Args:
        num_hazards (int): hazards in a layout, H.
        extent (float): objects are placed in the square [-extent, extent]^2.
        hazard_radius (float): radius of a hazard.
        hazard_keepout (float): radius around a hazard's centre kept clear of other objects' own.
        goal_radius (float): the goal is reached at this distance from its centre.
        goal_keepout (float): as ``hazard_keepout``.
        lidar_bins (int): angular bins of the lidar, B.
        lidar_range (float): distance at which the lidar reads zero.
        cost_slope (float): steepness of the cost at a hazard's rim, per metre.
        binary_cost (bool): whether the cost is 1 inside a hazard and 0 outside instead.

    Raises:
        TypeError: if a count is no integer.
        ValueError: if an option is out of range.

    Examples:
        >>> GoalTask(num_hazards=4).num_hazards
        4
    """

    num_hazards: int = 8
    extent: float = 1.5
    hazard_radius: float = 0.2
    hazard_keepout: float = 0.18
    goal_radius: float = 0.3
    goal_keepout: float = 0.305
    lidar_bins: int = 16
    lidar_range: float = 3.0
    cost_slope: float = 10.0
    binary_cost: bool = False

    def __post_init__(self) -> None:
        # With two bins or fewer the two neighbours of a bin coincide.
        check_options(self, smallest={"num_hazards": 0, "lidar_bins": 3})
        if self.goal_keepout >= self.extent:
            raise ValueError(
                f"goal_keepout must be smaller than extent={self.extent}, got {self.goal_keepout}."
            )
        if self.num_hazards and self.hazard_keepout >= self.extent:
            raise ValueError(
                f"hazard_keepout must be smaller than extent={self.extent}, "
                f"got {self.hazard_keepout}."
            )

    @property
    def max_cost(self) -> float:
        """The largest cost of a step."""
        return 1.0

    @property
    def props(self) -> tuple[Prop, ...]:
        """The goal in green, hazards in blue, flat."""
        return (
            Prop("goal", "disc", (self.goal_radius, 0.01), (0.15, 0.75, 0.30, 0.45)),
            Prop("hazards", "disc", (self.hazard_radius, 0.01), (0.20, 0.35, 0.90, 0.55), True),
        )

    def rays(self, scan: Array) -> tuple[Array, Array]:
        """A beam through the middle of each bin that reads something."""
        hit = np.flatnonzero(scan > 0.0)
        turn = 2.0 * np.pi / self.lidar_bins
        return turn * (hit.astype(np.float64) + 0.5), (1.0 - scan[hit]) * self.lidar_range

    def reflection(self, robot: Robot) -> Reflection | None:
        """See :func:`torchrl_safe.envs.tasks.base.observation_in_mirror`."""
        return observation_in_mirror(robot, self.lidar_bins)

    def observation_size(self, robot: Robot) -> int:
        """Goal direction (2) and distance (1), proprioception, lidar."""
        return 3 + len(robot.proprioception_scale) + self.lidar_bins

    def sample(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Array, Objects]:
        """See :func:`sample_layout`; the objects are goal, its distance, and hazards."""
        position, yaw, goal, hazards = sample_layout(self, robot.keepout, streams, rows)
        distance = length(goal - position)
        return position, yaw, {"goal": goal, "goal_distance": distance, "hazards": hazards}

    def sense(self, robot: Robot, motion: Motion, objects: Objects) -> Sensed:
        """Lidar and cost of the hazards; nothing blocks the robot."""
        offset, distance = hazard_distances(motion.position, objects["hazards"])
        scan = lidar(self, offset, distance, motion.heading)
        return Sensed(scan, *hazard_cost(self, distance), contact=np.zeros(len(scan), bool))

    def advance(
        self,
        robot: Robot,
        motion: Motion,
        objects: Objects,
        sensed: Sensed,
        remaining: NDArray[np.int64],
        streams: RandomStreams,
    ) -> Outcome:
        """The reward to the goal the step started with; a reached goal moves."""
        position, hazards = motion.position, objects["hazards"]

        def draw(rows: NDArray[np.integer]) -> Array:
            return sample_goal(self, robot.keepout, position[rows], hazards[rows], streams, rows)

        goal, distance, reward, goal_met = pursue_goal(
            position, objects["goal"], objects["goal_distance"], self.goal_radius, draw
        )
        return Outcome(
            {"goal": goal, "goal_distance": distance, "hazards": hazards},
            reward,
            sensed.cost,
            sensed.violation.astype(np.int64),
            goal_met,
            terminated=sensed.contact,
        )

    def observe(
        self, robot: Robot, motion: Motion, objects: Objects, scan: Array
    ) -> NDArray[np.float32]:
        """See :func:`observe`."""
        return observe(motion, objects["goal"], scan, np.array(robot.proprioception_scale))


def sample_layout(
    task: GoalTask, robot_keepout: float, streams: RandomStreams, rows: NDArray[np.integer]
) -> tuple[Array, Array, Array, Array]:
    """Draws where robot, goal and hazards start, clear of each other, in environments ``rows``.

    Objects are drawn one after the other, uniformly in the square shrunk by their keepout, and
    redrawn until their keepout discs do not overlap the earlier ones; an object that finds no
    place starts its layout again.

    Args:
        task (GoalTask): the options.
        robot_keepout (float): keepout of the robot, metres.
        streams (RandomStreams): one stream per environment, advanced in place.
        rows (array): [n], the environments to draw for.

    Returns:
        tuple of arrays: robot [n, 2], yaw [n], goal [n, 2], hazards [n, H, 2].

    Raises:
        ValueError: if some environment found no layout: the objects do not fit the square.
    """
    keepout = (robot_keepout, task.goal_keepout) + (task.hazard_keepout,) * task.num_hazards
    try:
        layout = scatter(np.array(keepout), task.extent, streams, rows)
    except ValueError as error:
        raise ValueError(f"{task}: {error}") from error
    yaw = streams.uniform(rows, 1)[:, 0] * (2.0 * np.pi)
    return layout[:, 0], yaw, layout[:, 1], layout[:, 2:]


def sample_goal(
    task: GoalTask,
    robot_keepout: float,
    robot: Array,
    hazards: Array,
    streams: RandomStreams,
    rows: NDArray[np.integer],
) -> Array:
    """Draws a new goal clear of hazards and robot, for the environments ``rows``.

    The first legal one of 256 uniform candidates is taken. A robot in the middle of a crowded
    layout can leave no legal place at all: then the candidate with the most clearance is taken, so
    the draw always ends.

    Args:
        task (GoalTask): the options.
        robot_keepout (float): keepout of the robot, metres.
        robot (array): [n, 2].
        hazards (array): [n, H, 2].
        streams (RandomStreams): one stream per environment, advanced in place.
        rows (array): [n], the environments to draw for.

    Returns:
        array: [n, 2].
    """
    others = np.concatenate((robot[:, None], hazards), 1)
    keepouts = np.array((robot_keepout,) + (task.hazard_keepout,) * task.num_hazards)
    return place_goal(task.goal_keepout, task.extent, others, keepouts, streams, rows)


def hazard_distances(position: Array, hazards: Array) -> tuple[Array, Array]:
    """Offsets [N, H, 2] and distances [N, H] from the robots [N, 2] to the hazards [N, H, 2]."""
    offset = offsets(position, hazards)
    return offset, length(offset)


def lidar(task: GoalTask, offset: Array, distance: Array, heading: Array) -> Array:
    """Nearness of the hazards around the robot, by direction.

    A hazard at distance d reads ``max(0, 1 - d / lidar_range)`` in the bin it lies in, and that
    times its position within the bin in the next one, times the complement in the previous one; a
    bin keeps its largest reading. Bin 0 starts straight ahead, bins count to the left.

    Args:
        task (GoalTask): the options.
        offset (array): [N, H, 2], hazard minus robot, world frame.
        distance (array): [N, H].
        heading (array): [N, 2].

    Returns:
        array: [N, B] in [0, 1].
    """
    ahead = to_robot_frame(offset, heading[:, None])
    return lidar_readings(ahead, distance, task.lidar_bins, task.lidar_range)


def hazard_cost(task: GoalTask, distance: Array) -> tuple[Array, NDArray[np.bool_]]:
    """SafeTAC equation (19): ``sigmoid(cost_slope (hazard_radius - d))`` of the nearest hazard.

    With ``binary_cost``, 1 inside a hazard and 0 outside, as in Safety Gym.

    Args:
        task (GoalTask): the options.
        distance (array): [N, H], distances to the hazards after the step.

    Returns:
        tuple of arrays: cost [N] in [0, 1], and whether the robot is inside a hazard [N].
    """
    nearest = distance.min(-1, initial=np.inf)
    violation = nearest <= task.hazard_radius
    if task.binary_cost:
        return violation.astype(float), violation
    return expit(task.cost_slope * (task.hazard_radius - nearest)), violation
