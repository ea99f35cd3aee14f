"""What a task is to the simulator behind the environments, and what tasks share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import lru_cache
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.reflection import Reflection
from torchrl_safe.envs.robots import Array, Motion, Robot, to_robot_frame

Objects = dict[str, Array]  # what a task remembers of N environments: arrays [N, ...] by name
Mask = NDArray[np.bool_]

# What the authors divide by, after shifting; the robot's own readings bring their scales with them.
_DIRECTION_SCALE = 0.7
_DISTANCE_SHIFT, _DISTANCE_SCALE = 1.5, 0.6
_LIDAR_SHIFT, _LIDAR_SCALE = 0.3, 0.3


class Sensed(NamedTuple):
    """What N robots meet where they are.

    Attributes:
        scan (array): [N, R], readings of the lidar: 0 sees nothing, 1 is at the robot.
        cost (array): [N], of being here; [N, m] in a task with m costs.
        violation (array): [N] or [N, m] bool, whether being here breaks the constraint.
        contact (array): [N] bool, whether the robot touches something it must not.
        due (array, optional): [N, S] bool, which of the task's ``sources`` cost it to be here.
    """

    scan: Array
    cost: Array
    violation: Mask
    contact: Mask
    due: Mask | None = None


class Outcome(NamedTuple):
    """What a step of N environments was worth, and where their objects are after it.

    Attributes:
        objects (dict of arrays): the objects after the step; those before it are left alone.
        reward (array): [N].
        cost (array): [N]; [N, m] in a task with m costs.
        violations (array): [N] or [N, m] int64, how many violating steps the step counts for.
        goal_met (array): [N] bool.
        terminated (array): [N] bool.
    """

    objects: Objects
    reward: Array
    cost: Array
    violations: NDArray[np.int64]
    goal_met: Mask
    terminated: Mask


class Prop(NamedTuple):
    """How a picture shows some of a task's objects.

    Attributes:
        objects (str or tuple): their name, an array of positions [N, 2] or [N, K, 2]; or fixed
            positions [K, 2].
        shape (str): ``"disc"`` or ``"box"``.
        size (tuple of float): radius and half the height, or half sizes along x, y and z; metres.
        colour (tuple of float): red, green, blue, opacity.
        hazard (bool): whether the nearest of them turns red during a violation.
    """

    objects: str | tuple[tuple[float, float], ...]
    shape: Literal["disc", "box"]
    size: tuple[float, ...]
    colour: tuple[float, float, float, float]
    hazard: bool = False


class Task(Protocol):
    """A task: the options of an environment and what follows from them, over a batch.

    Methods take arrays and leave them alone; the core holds all state. A row of a result depends
    on the same row of the arguments only. A task with several costs names them in ``cost_names``,
    a tuple of strings. One that can say where its costs come from names S sources in ``sources``.
    One that looks the same in a mirror says so by ``reflection(robot)``, a method that returns a
    :class:`~torchrl_safe.envs.Reflection`.
    """

    @property
    def max_cost(self) -> float | tuple[float, ...]:
        """The largest cost of a step; of each in a task with several."""

    @property
    def extent(self) -> float:
        """Half the side of the square that matters, in metres: what a picture shows."""

    @property
    def props(self) -> tuple[Prop, ...]:
        """What a picture shows besides the robot."""

    def rays(self, scan: Array) -> tuple[Array, Array]:
        """Angles to the left of ahead and lengths in metres, [K] each, of beams that hit something.

        Args:
            scan (array): [R], the lidar's readings in one environment.
        """

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


def goal_reward(before: Array, after: Array, goal_radius: float) -> tuple[Array, Mask]:
    """SafeTAC equation (19): progress to the goal, and one for reaching it.

    ``before - after + 1[after <= goal_radius]``, both distances to the goal the step started with.
    (As printed, the bonus reads the distance before the step; with a reached goal moved at once it
    would never be paid.)

    Args:
        before (array): [N], distance to the goal before the step.
        after (array): [N], distance to the same goal after it.
        goal_radius (float): the goal is reached at this distance.

    Returns:
        tuple of arrays: reward [N] and whether the goal is reached [N].

    Examples:
        >>> import numpy as np
        >>> goal_reward(np.array([1.0, 0.5]), np.array([0.75, 0.25]), 0.3)[0].tolist()
        [0.25, 1.25]
    """
    reached = after <= goal_radius
    return before - after + reached, reached


def pursue_goal(
    position: Array,
    goal: Array,
    distance: Array,
    goal_radius: float,
    draw: Callable[[NDArray[np.integer]], Array],
) -> tuple[Array, Array, Array, Mask]:
    """The reward to the goal that a step started with; a reached goal then moves.

    Args:
        position (array): [N, 2], of the robots after the step.
        goal (array): [N, 2], left alone.
        distance (array): [N], to the goal before the step.
        goal_radius (float): the goal is reached at this distance.
        draw (callable): new goals [n, 2] for the environments ``rows`` [n] that reached theirs.

    Returns:
        tuple of arrays: goal [N, 2] and distance [N] after the step, reward [N], goal_met [N].
    """
    after = length(goal - position)
    reward, goal_met = goal_reward(distance, after, goal_radius)
    if goal_met.any():
        rows = np.flatnonzero(goal_met)
        goal = goal.copy()
        goal[rows] = draw(rows)
        after[rows] = length(goal[rows] - position[rows])
    return goal, after, reward, goal_met


def observe(
    motion: Motion,
    goal: Array,
    scan: Array,
    proprioception_scale: Array,
    goal_range: float = np.inf,
) -> NDArray[np.float32]:
    """The observation, with the fixed scaling of the authors.

    Goal direction in the robot frame / .7 (2), (goal distance - 1.5) / .6, proprioception / its
    scale (P), (lidar - .3) / .3 (B).

    Args:
        motion (Motion): the robots.
        goal (array): [N, 2].
        scan (array): [N, B], the lidar.
        proprioception_scale (array): [P].
        goal_range (float): distances beyond this one look like it.

    Returns:
        array: [N, 3 + P + B], float32.
    """
    offset = goal - motion.position
    distance = length(offset)
    # A robot exactly on the goal has no direction to it: zero.
    direction = offset / np.maximum(distance, 1e-12)[:, None]
    size = motion.proprioception.shape[1]
    out = np.empty((len(goal), 3 + size + scan.shape[1]), np.float32)
    out[:, :2] = to_robot_frame(direction, motion.heading) / _DIRECTION_SCALE
    out[:, 2] = (np.minimum(distance, goal_range) - _DISTANCE_SHIFT) / _DISTANCE_SCALE
    out[:, 3 : 3 + size] = motion.proprioception / proprioception_scale
    out[:, 3 + size :] = (scan - _LIDAR_SHIFT) / _LIDAR_SCALE
    return out


def observation_in_mirror(robot: Robot, bins: int) -> Reflection | None:
    """What becomes of what :func:`observe` shows: the sides of direction and lidar change places.

    Args:
        robot (Robot): the robot.
        bins (int): of the lidar, B; they are counted all around, from straight ahead.

    Returns:
        Reflection: None of a robot that has none.
    """
    if robot.mirrored is None:
        return None
    proprioception, action = robot.mirrored
    size = len(proprioception)
    own = [place + (3 if place > 0 else -3) for place in proprioception]
    lidar = range(3 + size + bins, 3 + size, -1)
    return Reflection([1, -2, 3, *own, *lidar], action)


def length(vector: Array) -> Array:
    """Lengths [...] of vectors [..., 2]."""
    return np.hypot(vector[..., 0], vector[..., 1])


def offsets(position: Array, objects: Array) -> Array:
    """Objects [N, K, 2] minus robots [N, 2]: [N, K, 2], each coordinate in one piece of memory."""
    planes = np.empty((2, *objects.shape[:-1]))
    np.subtract(objects.transpose(2, 0, 1), position.T[:, :, None], out=planes)
    return planes.transpose(1, 2, 0)


def lidar_readings(ahead: Array, distance: Array, bins: int, reach: float) -> Array:
    """Nearness of objects around the robot, by direction: Safety Gym's pseudo-lidar.

    An object at distance d reads ``max(0, 1 - d / reach)`` in the bin it lies in, and that times
    its position within the bin in the next one, times the complement in the previous one; a bin
    keeps its largest reading. Bin 0 starts straight ahead, bins count to the left.

    Args:
        ahead (array): [N, K, 2], object minus robot, in the robot's frame.
        distance (array): [N, K].
        bins (int): angular bins, B; at least 3.
        reach (float): distance at which the lidar reads zero.

    Returns:
        array: [N, B] in [0, 1].
    """
    num_envs = len(ahead)
    turn = np.arctan2(ahead[..., 1], ahead[..., 0])
    turn *= bins / (2.0 * np.pi)
    np.add(turn, bins, out=turn, where=turn < 0.0)
    centre = turn.astype(np.intp)
    within = np.subtract(turn, centre, out=turn)
    reading = distance / reach
    np.subtract(1.0, reading, out=reading)
    np.maximum(0.0, reading, out=reading)
    shares = np.empty((3, *reading.shape))  # of a bin's left neighbour, its own, the right one's
    np.subtract(1.0, within, out=shares[0])
    shares[0] *= reading
    shares[1] = reading
    np.multiply(within, reading, out=shares[2])
    # Column b + 1 is bin b. The margins, where neighbours across the seam fall, are folded back
    # below; there are two on the right because an angle just below zero can round up to a full
    # turn.
    scan = np.zeros((num_envs, bins + 3))
    columns = _columns(num_envs, bins + 3) + centre
    np.maximum.at(scan.reshape(-1), columns.reshape(-1), shares.reshape(-1))
    scan[:, 1:3] = np.maximum(scan[:, 1:3], scan[:, -2:])
    scan[:, bins] = np.maximum(scan[:, bins], scan[:, 0])
    return scan[:, 1:-2]


@lru_cache(maxsize=64)
def _columns(num_envs: int, width: int) -> NDArray[np.intp]:
    """Where three neighbouring columns of an array [N, width] begin, [3, N, 1], in the flat one."""
    return np.arange(3)[:, None, None] + np.arange(0, num_envs * width, width)[:, None]


def check_options(task: Any, smallest: dict[str, int]) -> None:
    """Checks a task's options by the types of their defaults.

    Args:
        task (dataclass): the task; its other numbers must be positive and finite.
        smallest (dict of int): what each count must be at least.

    Raises:
        TypeError: if a count is no integer or a switch no bool.
        ValueError: if a number is out of range.
    """
    for field in fields(task):
        name, value = field.name, getattr(task, field.name)
        if isinstance(field.default, bool):
            if not isinstance(value, bool):
                raise TypeError(f"{name} must be a bool, got {value!r}.")
        elif isinstance(field.default, int):
            if not isinstance(value, int) or isinstance(value, bool):
                raise TypeError(f"{name} must be an int, got {value!r}.")
            if value < smallest[name]:
                raise ValueError(f"{name} must be at least {smallest[name]}, got {value}.")
        elif not isinstance(value, (int, float)) or not 0.0 < value < np.inf:
            raise ValueError(f"{name} must be positive and finite, got {value!r}.")
