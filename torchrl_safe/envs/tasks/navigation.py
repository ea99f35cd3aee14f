"""The Jackal task: a sequence of goals among boxes, in a walled room, seen by a planar lidar.

SafeTAC's task for the Jackal robot: coming closer than half a metre to anything costs, touching it
ends the episode and costs as much as the rest of it could. Layouts, averaging of the lidar and the
room are those of the authors' earlier release. Boxes and walls are arrays here: the episode ends
at the first contact, so they never have to push back.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.reflection import Reflection
from torchrl_safe.envs.robots import Array, Motion, Robot
from torchrl_safe.envs.tasks.base import (
    Mask,
    Objects,
    Outcome,
    Prop,
    Sensed,
    check_options,
    length,
    observation_in_mirror,
    observe,
    offsets,
    pursue_goal,
)

_LAYOUT_ATTEMPTS = 200  # layouts drawn before giving up
_RAYS_PER_BIN = 5  # a bin averages the rays up to this many to either side of its own


@dataclass(frozen=True)
class NavigationTask:
    """The options of the navigation task; lengths in metres.

    Args:
        num_boxes (int): boxes in a layout, B.
        box_half_size (float): half the side of a box.
        wall_distance (float): distance of the four walls from the origin, where the robot starts.
        grid_extent (float): boxes and goals lie on a grid over [-grid_extent, grid_extent]^2.
        grid_size (int): points of the grid along a side.
        start_clearance (float): boxes and goals are outside [-start_clearance, start_clearance]^2.
        goal_radius (float): the goal is reached at this distance.
        goal_clearance (float): a goal is further than this from the discs around the boxes.
        goal_spacing (float): a goal is further than this from the one before it.
        goal_range (float): distances to the goal beyond this one look like it.
        lidar_bins (int): bins of the lidar.
        lidar_range (float): how far the lidar sees.
        safe_distance (float): nearer than this is a violation.
        cost_slope (float): steepness of the cost at ``safe_distance``, per metre.
        binary_cost (bool): whether the cost is 1 in violation and 0 otherwise instead.
        discount (float): that of the remaining cost which a contact adds, in (0, 1).

    Raises:
        TypeError: if a count is no integer.
        ValueError: if an option is out of range.

    Examples:
        >>> NavigationTask(num_boxes=4).num_boxes
        4
    """

    num_boxes: int = 8
    box_half_size: float = 0.25
    wall_distance: float = 4.0
    grid_extent: float = 2.25
    grid_size: int = 10
    start_clearance: float = 1.0
    goal_radius: float = 0.25
    goal_clearance: float = 0.7
    goal_spacing: float = 2.0
    goal_range: float = 3.0
    lidar_bins: int = 26
    lidar_range: float = 3.0
    safe_distance: float = 0.5
    cost_slope: float = 10.0
    binary_cost: bool = False
    discount: float = 0.99

    def __post_init__(self) -> None:
        check_options(self, smallest={"num_boxes": 0, "grid_size": 2, "lidar_bins": 1})
        if not self.discount < 1.0:
            raise ValueError(f"discount must be in (0, 1), got {self.discount}.")
        if self.wall_distance <= self.grid_extent + self.box_half_size:
            raise ValueError(
                "wall_distance must be larger than grid_extent + box_half_size = "
                f"{self.grid_extent + self.box_half_size}, got {self.wall_distance}."
            )

    @property
    def max_cost(self) -> float | tuple[float, ...]:
        """The largest cost of a step: a contact with endless steps remaining."""
        return 1.0 / (1.0 - self.discount)

    @property
    def extent(self) -> float:
        """The boxes' part of the room; the walls are further away."""
        return self.grid_extent + self.box_half_size

    @property
    def props(self) -> tuple[Prop, ...]:
        """The goal in green and flat, boxes and walls."""
        half, far = self.box_half_size, self.wall_distance
        grey, thick, high = (0.45, 0.45, 0.50, 1.0), 0.05, 0.25
        return (
            Prop("goal", "disc", (self.goal_radius, 0.01), (0.15, 0.75, 0.30, 0.45)),
            Prop("boxes", "box", (half, half, half), (0.20, 0.35, 0.90, 1.0), True),
            Prop(((0.0, far + thick), (0.0, -far - thick)), "box", (far, thick, high), grey),
            Prop(((far + thick, 0.0), (-far - thick, 0.0)), "box", (thick, far, high), grey),
        )

    def rays(self, scan: Array) -> tuple[Array, Array]:
        """The rays that meet something."""
        rays = _lidar(self).rays[scan > 0.0]
        return np.arctan2(rays[:, 1], rays[:, 0]), (1.0 - scan[scan > 0.0]) * self.lidar_range

    def reflection(self, robot: Robot) -> Reflection | None:
        """See :func:`torchrl_safe.envs.tasks.base.observation_in_mirror`."""
        return observation_in_mirror(robot, self.lidar_bins)

    def observation_size(self, robot: Robot) -> int:
        """Goal direction (2) and distance (1), proprioception, lidar."""
        return 3 + len(robot.proprioception_scale) + self.lidar_bins

    def sample(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Array, Objects]:
        """The robot at the origin, turned anyhow; the objects are goal, its distance, and boxes."""
        if robot.footprint is None:
            raise ValueError(f"robot {robot.name!r} has no footprint, so nothing can touch it.")
        if self.start_clearance < robot.keepout + self.box_half_size:
            raise ValueError(
                "start_clearance must be at least the robot's keepout + box_half_size = "
                f"{robot.keepout + self.box_half_size}, got {self.start_clearance}."
            )
        goal, boxes = sample_layout(self, streams, rows)
        yaw = streams.uniform(rows, 1)[:, 0] * (2.0 * np.pi)
        objects = {"goal": goal, "goal_distance": length(goal), "boxes": boxes}
        return np.zeros_like(goal), yaw, objects

    def sense(self, robot: Robot, motion: Motion, objects: Objects) -> Sensed:
        """Lidar, its cost, and contacts; the scan is one reading per ray."""
        assert robot.footprint is not None
        boxes = objects["boxes"]
        distance = ray_distances(self, motion.position, motion.heading, boxes)
        touching = contact(self, robot.footprint, motion.position, motion.heading, boxes)
        cost, violation = proximity_cost(self, (distance @ _lidar(self).average).min(-1))
        scan = 1.0 - distance / self.lidar_range
        return Sensed(scan, cost, violation | touching, touching)

    def advance(
        self,
        robot: Robot,
        motion: Motion,
        objects: Objects,
        sensed: Sensed,
        remaining: NDArray[np.int64],
        streams: RandomStreams,
    ) -> Outcome:
        """The reward to the goal the step started with; contacts end episodes and are paid for."""
        last, boxes = objects["goal"], objects["boxes"]

        def draw(rows: NDArray[np.integer]) -> Array:
            return sample_goal(self, last[rows], boxes[rows], streams, rows)

        goal, distance, reward, goal_met = pursue_goal(
            motion.position, last, objects["goal_distance"], self.goal_radius, draw
        )
        left = remaining * sensed.contact
        return Outcome(
            {"goal": goal, "goal_distance": distance, "boxes": boxes},
            reward,
            sensed.cost + remaining_cost(left, self.discount),
            sensed.violation + left,
            goal_met,
            terminated=sensed.contact,
        )

    def observe(
        self, robot: Robot, motion: Motion, objects: Objects, scan: Array
    ) -> NDArray[np.float32]:
        """See :func:`torchrl_safe.envs.tasks.base.observe`; the rays are averaged into bins."""
        bins = scan @ _lidar(self).average
        scale = np.array(robot.proprioception_scale)
        return observe(motion, objects["goal"], bins, scale, self.goal_range)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Where things can be: points [G, 2], and per pair of them what excludes what, [G, G] bool."""

    points: Array
    near_a_box: Mask  # a goal at j is too close to a box at i
    apart: Mask  # a goal at j can follow one at i


@lru_cache(maxsize=16)
def _grid(task: NavigationTask) -> _Grid:
    axis = np.linspace(-task.grid_extent, task.grid_extent, task.grid_size)
    points = np.stack(np.meshgrid(axis, axis), -1).reshape(-1, 2)
    points = points[np.abs(points).max(-1) >= task.start_clearance]
    near_a_box = ~_apart(points, points, _reach(task))
    return _Grid(points, near_a_box, _apart(points, points, task.goal_spacing))


def _apart(points: Array, others: Array, distance: float) -> Mask:
    """Whether points [G, 2] are further than a distance from others [..., K, 2]: [..., K, G]."""
    x = others[..., 0, None] - points[:, 0]
    y = others[..., 1, None] - points[:, 1]
    return x * x + y * y > distance * distance


def _reach(task: NavigationTask) -> float:
    """How far from a box's centre its clearance reaches."""
    return task.goal_clearance + np.sqrt(2.0) * task.box_half_size


@dataclass(frozen=True, eq=False)
class _Lidar:
    """Directions of the rays [R, 2], from right to left, and their averages per bin [R, bins]."""

    rays: Array
    average: Array


_FIRST_RAY = np.radians(-135.0)


@lru_cache(maxsize=16)
def _lidar(task: NavigationTask) -> _Lidar:
    count = _RAYS_PER_BIN * (task.lidar_bins + 1) + 1
    angle = np.linspace(_FIRST_RAY, -_FIRST_RAY, count)
    average = np.zeros((count, task.lidar_bins))
    for k in range(task.lidar_bins):
        average[k * _RAYS_PER_BIN : (k + 2) * _RAYS_PER_BIN + 1, k] = 1.0 / (2 * _RAYS_PER_BIN + 1)
    return _Lidar(np.stack((np.cos(angle), np.sin(angle)), -1), average)


def sample_layout(
    task: NavigationTask, streams: RandomStreams, rows: NDArray[np.integer]
) -> tuple[Array, Array]:
    """Draws boxes and a first goal on the points of the grid, for the environments ``rows``.

    The boxes are on different points; layouts are redrawn until there is a goal clear of them, and
    every such goal can be followed by another one, so that the sequence never ends.

    Args:
        task (NavigationTask): the options.
        streams (RandomStreams): one stream per environment, advanced in place.
        rows (array): [n], the environments to draw for.

    Returns:
        tuple of arrays: goal [n, 2], boxes [n, B, 2].

    Raises:
        ValueError: if some environment found no layout.
    """
    grid = _grid(task)
    count, num_boxes = len(grid.points), task.num_boxes
    hint = "use fewer or smaller boxes, smaller clearances and spacing, or a larger grid."
    if num_boxes >= count:
        raise ValueError(f"{num_boxes} boxes and a goal need more than {count} points: {hint}")
    boxes = np.empty((len(rows), num_boxes, 2))
    pending = np.arange(len(rows))
    for _ in range(_LAYOUT_ATTEMPTS):
        draws = streams.uniform(rows[pending], count)
        chosen = draws.argpartition(num_boxes, -1)[:, :num_boxes]
        free = ~grid.near_a_box[chosen].any(1)
        followed = free.astype(np.float32) @ grid.apart.astype(np.float32) > 0.0
        legal = free.any(-1) & np.all(followed | ~free, -1)
        boxes[pending[legal]] = grid.points[chosen[legal]]
        pending = pending[~legal]
        if not pending.size:
            nowhere = np.full((len(rows), 2), np.inf)
            return sample_goal(task, nowhere, boxes, streams, rows), boxes
    raise ValueError(f"no legal layout found in {_LAYOUT_ATTEMPTS} attempts for {task}: {hint}")


def sample_goal(
    task: NavigationTask,
    before: Array,
    boxes: Array,
    streams: RandomStreams,
    rows: NDArray[np.integer],
) -> Array:
    """Draws the next goal: a point of the grid clear of the boxes and away from the one before.

    Args:
        task (NavigationTask): the options.
        before (array): [n, 2], the goal before.
        boxes (array): [n, B, 2].
        streams (RandomStreams): one stream per environment, advanced in place.
        rows (array): [n], the environments to draw for.

    Returns:
        array: [n, 2]; any point of the grid where none is legal.
    """
    points = _grid(task).points
    legal = _apart(points, before[:, None], task.goal_spacing)[:, 0]
    legal &= _apart(points, boxes, _reach(task)).all(1)
    return points[(streams.uniform(rows, len(points)) + legal).argmax(-1)]


def ray_distances(task: NavigationTask, position: Array, heading: Array, boxes: Array) -> Array:
    """How far each ray of the lidar goes before it meets a box or a wall.

    The rays start at the robot's centre, spread over 270 degrees from right to left. A ray that
    meets nothing within ``lidar_range``, or starts outside the walls, reads ``lidar_range``.

    Args:
        task (NavigationTask): the options.
        position (array): [N, 2].
        heading (array): [N, 2].
        boxes (array): [N, B, 2].

    Returns:
        array: [N, R], metres.
    """
    rays, half = _lidar(task).rays, task.box_half_size
    num_rays = len(rays)
    cos, sin = heading[:, :1], heading[:, 1:]
    per_x = _inverse(cos * rays[:, 0] - sin * rays[:, 1])
    per_y = _inverse(sin * rays[:, 0] + cos * rays[:, 1])
    out = task.wall_distance * np.abs(per_x)
    out -= position[:, :1] * per_x
    to_wall_y = task.wall_distance * np.abs(per_y)
    to_wall_y -= position[:, 1:] * per_y
    np.minimum(out, to_wall_y, out=out)
    np.minimum(out, task.lidar_range, out=out)
    out[np.abs(position).max(-1) > task.wall_distance] = task.lidar_range

    # A box meets few rays, those within the angle of the disc around it: no others are looked at.
    radius = np.sqrt(2.0) * half
    offset = offsets(position, boxes)
    x, y = offset[..., 0], offset[..., 1]
    row, column = np.nonzero(x * x + y * y < (task.lidar_range + radius) ** 2)
    x, y = x[row, column], y[row, column]
    distance = np.hypot(x, y)
    spread = np.where(distance > radius, np.arcsin(radius / np.maximum(distance, radius)), np.pi)
    first_ray = np.arctan2(heading[:, 1], heading[:, 0]) + _FIRST_RAY
    bearing = (np.arctan2(y, x) - first_ray[row]) % (2.0 * np.pi)
    # What ends a turn after the first ray or later meets rays from the first one on, too.
    again = np.flatnonzero(bearing + spread >= 2.0 * np.pi)
    pair = np.concatenate((np.arange(len(row)), again))
    bearing = np.concatenate((bearing, bearing[again] - 2.0 * np.pi))
    spread = spread[pair]
    per_angle = (num_rays - 1) / (-2.0 * _FIRST_RAY)
    first = np.maximum(np.ceil((bearing - spread) * per_angle), 0.0).astype(np.intp)
    last = np.minimum(np.floor((bearing + spread) * per_angle), num_rays - 1.0).astype(np.intp)
    count = np.maximum(last - first + 1, 0)
    start = row[pair] * num_rays + first - count.cumsum() + count
    index = np.repeat(start, count)
    index += np.arange(len(index))

    # Slabs: a ray is in a box where it is within both of its strips.
    per_x, per_y = per_x.ravel().take(index), per_y.ravel().take(index)
    centre_x, centre_y = np.repeat(x[pair], count), np.repeat(y[pair], count)
    centre_x *= per_x
    centre_y *= per_y
    half_x = np.abs(per_x, out=per_x)
    half_x *= half
    half_y = np.abs(per_y, out=per_y)
    half_y *= half
    enter = np.maximum(centre_x - half_x, centre_y - half_y)
    centre_x += half_x
    centre_y += half_y
    leave = np.minimum(centre_x, centre_y, out=centre_x)
    hit = np.flatnonzero((enter <= leave) & (leave >= 0.0))
    np.minimum.at(out.reshape(-1), index.take(hit), np.maximum(enter.take(hit), 0.0))
    return out


def contact(
    task: NavigationTask,
    footprint: tuple[float, float],
    position: Array,
    heading: Array,
    boxes: Array,
) -> Mask:
    """Whether the robot's rectangle overlaps a box or reaches a wall, by separating axes.

    Args:
        task (NavigationTask): the options.
        footprint (tuple of float): half the length and half the width of the rectangle.
        position (array): [N, 2], its centre.
        heading (array): [N, 2].
        boxes (array): [N, B, 2].

    Returns:
        array: [N] bool.
    """
    half_length, half_width = footprint
    half = task.box_half_size
    size = np.abs(heading)
    reach = size * half_length + size[:, ::-1] * half_width
    touching = (np.abs(position) + reach).max(-1) >= task.wall_distance
    # Few boxes are near enough to be looked at: those whose disc, of sqrt(2) half sides and a
    # little more, meets the robot's.
    offset = offsets(position, boxes)
    x, y = offset[..., 0], offset[..., 1]
    near = np.hypot(half_length, half_width) + 1.5 * half
    row, column = np.nonzero(x * x + y * y < near * near)
    x, y, (cos, sin) = x[row, column], y[row, column], heading[row].T
    box_reach = half * (np.abs(cos) + np.abs(sin))
    overlap = (np.abs(offset[row, column]) <= half + reach[row]).all(-1)
    overlap &= np.abs(cos * x + sin * y) <= half_length + box_reach
    overlap &= np.abs(cos * y - sin * x) <= half_width + box_reach
    touching[row[overlap]] = True
    return touching


def proximity_cost(task: NavigationTask, nearest: Array) -> tuple[Array, Mask]:
    """``sigmoid(cost_slope (safe_distance - d))`` of the nearest reading d of the lidar.

    With ``binary_cost``, 1 nearer than ``safe_distance`` and 0 elsewhere.

    Args:
        task (NavigationTask): the options.
        nearest (array): [N], the smallest of the lidar's bins, metres.

    Returns:
        tuple of arrays: cost [N] in [0, 1], and whether the robot is too near [N].
    """
    violation = nearest < task.safe_distance
    if task.binary_cost:
        return violation.astype(float), violation
    return expit(task.cost_slope * (task.safe_distance - nearest)), violation


def remaining_cost(steps: NDArray[np.int64], discount: float) -> Array:
    """Discounted cost of ``steps`` [N] more steps at a cost of one each, seen from before them.

    ``gamma + ... + gamma^n = gamma (1 - gamma^n) / (1 - gamma)``.

    Examples:
        >>> import numpy as np
        >>> remaining_cost(np.array([0, 1, 2]), 0.5).tolist()
        [0.0, 0.5, 0.75]
    """
    return discount * (1.0 - discount ** steps.astype(float)) / (1.0 - discount)


def _inverse(x: Array) -> Array:
    """``1 / x``, finite and of the sign of x at zero too."""
    size = np.abs(x)
    np.maximum(size, 1e-12, out=size)
    np.copysign(size, x, out=size)
    return np.divide(1.0, size, out=size)
