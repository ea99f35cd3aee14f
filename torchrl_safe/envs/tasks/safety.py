"""Safety-Gymnasium's navigation tasks: what their families share.

The robot shows the sensors of its body and a lidar per kind of object. Each source of cost is due
in a step or not, and the cost of the step is 1 if any is, else 0. Facts and numbers are those of
Safety-Gymnasium 1.0.0, whose own episodes the tests replay; no code is. Rewards are measured to the
goal that the step started with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.reflection import Reflection
from torchrl_safe.envs.robots import Array, Motion, Robot
from torchrl_safe.envs.tasks.base import (
    Mask,
    Objects,
    Outcome,
    Prop,
    Sensed,
    length,
    lidar_readings,
)
from torchrl_safe.envs.tasks.bodies import (
    Bodies,
    Body,
    Readings,
    own_in_mirror,
    own_size,
    read_sensors,
)
from torchrl_safe.envs.tasks.layout import place_goal, scatter

_REWARD_CLIP = 10.0
_CANDIDATES = 100  # positions tried for an object; more would favour other layouts


@dataclass(frozen=True)
class Kind:
    """A kind of object in a layout.

    Attributes:
        name (str): the name of the objects.
        count (int): how many, K.
        keepout (float): radius around each kept clear of the others' own, metres.
        prop (Prop): how a picture shows them.
        body (Body, optional): what of them can be touched.
    """

    name: str
    count: int
    keepout: float
    prop: Prop
    body: Body | None = None


@dataclass(frozen=True)
class SafetyTask:
    """The base of the tasks: layouts, lidars, observations, costs and rewards of N environments.

    Args:
        level (int): 0, 1 or 2.
        separate_costs (bool): whether each source of cost has a cost of its own, such as
            ``hazards_cost``, instead of one for all of them. Default: ``False``.

    Raises:
        TypeError: if ``separate_costs`` is no bool.
        ValueError: if the level is none of the family's, or has no costs that could be separated.
    """

    level: int = 1
    separate_costs: bool = False

    levels: ClassVar[tuple[int, ...]] = (0, 1, 2)
    episode_length: ClassVar[int] = 1000
    lidar_bins: ClassVar[int] = 16
    lidar_range: ClassVar[float] = 3.0
    reward_clip: ClassVar[float] = _REWARD_CLIP
    same_in_mirror: ClassVar[bool] = False  # whether left and right are alike to the task

    def __post_init__(self) -> None:
        if isinstance(self.level, bool) or self.level not in self.levels:
            raise ValueError(f"level must be one of {self.levels}, got {self.level!r}.")
        if not isinstance(self.separate_costs, bool):
            raise TypeError(f"separate_costs must be a bool, got {self.separate_costs!r}.")
        if self.separate_costs and not self.sources:
            raise ValueError(f"separate_costs must be False at level {self.level}: nothing costs.")

    # What a family says of itself.

    @property
    def extent(self) -> float:
        """Objects are placed in the square [-extent, extent]^2."""
        raise NotImplementedError

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The objects, in the order in which they are placed and shown."""
        raise NotImplementedError

    @property
    def sources(self) -> tuple[str, ...]:
        """What can cost, S names."""
        return ()

    def start(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Objects]:
        """Draws robot position [n, 2] and objects."""
        kinds = self.kinds
        keepout = np.repeat([kind.keepout for kind in kinds], [kind.count for kind in kinds])
        keepouts = np.append(robot.keepout, keepout)
        layout = scatter(keepouts, self.extent, streams, rows, _CANDIDATES)
        objects, first = {}, 1
        for kind in kinds:
            objects[kind.name] = layout[:, first : first + kind.count]
            first += kind.count
        return layout[:, 0], objects

    def judge(
        self, readings: Readings, objects: Objects, streams: RandomStreams, robot: Robot
    ) -> tuple[Objects, Array, Mask]:
        """Objects after the step, reward [N] and whether the goal was met [N]."""
        raise NotImplementedError

    def costs(self, readings: Readings, objects: Mapping[str, Array]) -> dict[str, Mask]:
        """Which of the sources are due, [N] bool each."""
        return {}

    def begin(self, position: Array, objects: Objects) -> Objects:
        """What the first step's reward is measured from, by where the robots are, [n, 3]."""
        return {}

    # What follows from it.

    @property
    def cost_names(self) -> tuple[str, ...]:
        """The names of separate costs."""
        return self.sources if self.separate_costs else ()

    @property
    def max_cost(self) -> float | tuple[float, ...]:
        """The largest cost of a step; of each of separate costs."""
        return (1.0,) * len(self.sources) if self.separate_costs else 1.0

    @property
    def bodies(self) -> Bodies:
        """What can be touched."""
        return tuple(kind.body for kind in self.kinds if kind.body is not None)

    @property
    def props(self) -> tuple[Prop, ...]:
        """All objects."""
        return tuple(kind.prop for kind in self.kinds)

    def rays(self, scan: Array) -> tuple[Array, Array]:
        """A beam through the middle of each bin in which some lidar reads something."""
        nearest = scan.reshape(-1, self.lidar_bins).max(0, initial=0.0)
        hit = np.flatnonzero(nearest > 0.0)
        turn: Array = 2.0 * np.pi / self.lidar_bins * (hit + np.float64(0.5))
        return turn, (1.0 - nearest[hit]) * self.lidar_range

    def observation_size(self, robot: Robot) -> int:
        """The robot's sensors and a lidar per kind of object."""
        return own_size(robot) + self.lidar_bins * len(self.kinds)

    def sample(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Array, Objects]:
        """Robot, turned anyhow, and objects; what can be pushed is turned anyhow, too."""
        position, objects = self.start(robot, streams, rows)
        moving = [body for body in self.bodies if body.hold != "fixed"]
        yaws = streams.uniform(rows, 1 + sum(body.count for body in moving)) * (2.0 * np.pi)
        first = 1
        for body in moving:
            objects[f"{body.name}_yaw"] = yaws[:, first : first + body.count]
            first += body.count
        place = np.insert(position, 2, robot.height, axis=1)
        return position, yaws[:, 0], objects | self.begin(place, objects)

    def sense(self, robot: Robot, motion: Motion, objects: Objects) -> Sensed:
        """Lidars, but the goal's and the buttons' as :meth:`observe` shows them; and the cost."""
        readings = read_sensors(robot, self.bodies, motion.proprioception)
        scan = np.concatenate(
            [self.lidar(readings, _places(readings, objects, kind.name)) for kind in self.kinds]
            or [np.zeros((len(motion.proprioception), 0))],
            1,
        )
        costs, none = self.costs(readings, objects), np.zeros(len(scan), bool)
        due = np.zeros((len(scan), len(self.sources)), bool)
        for k, source in enumerate(self.sources):
            due[:, k] = costs[source]
        violation = due if self.separate_costs else np.any(due, axis=1)
        return Sensed(scan, violation.astype(float), violation, contact=none, due=due)

    def advance(
        self,
        robot: Robot,
        motion: Motion,
        objects: Objects,
        sensed: Sensed,
        remaining: NDArray[np.int64],
        streams: RandomStreams,
    ) -> Outcome:
        """The reward of the step; a reached goal moves."""
        readings = read_sensors(robot, self.bodies, motion.proprioception)
        moved = {name: np.array(place[..., :2]) for name, place in readings.positions.items()}
        objects, reward, goal_met = self.judge(readings, objects | moved, streams, robot)
        clip = self.reward_clip
        return Outcome(
            objects,
            np.clip(reward, -clip, clip),
            sensed.cost,
            sensed.violation.astype(np.int64),
            goal_met,
            terminated=readings.position[:, 2] <= robot.lowest,
        )

    def reflection(self, robot: Robot) -> Reflection | None:
        """What becomes of what is shown if left is right; None where something tells them apart."""
        own, bins = own_in_mirror(robot), self.lidar_bins
        if own is None or robot.mirrored is None or not self.same_in_mirror:
            return None
        # A direction at an angle t ahead of the sensors' x axis comes to -t, or to pi - t where the
        # robot drives along their y axis.
        last = bins if own[0] > 0 else bins // 2
        scan = [(last - 1 - place) % bins for place in range(bins)]
        shown = [len(own) + 1 + k * bins + place for k in range(len(self.kinds)) for place in scan]
        return Reflection([*own, *shown], robot.mirrored[1])

    def observe(
        self, robot: Robot, motion: Motion, objects: Objects, scan: Array
    ) -> NDArray[np.float32]:
        """Sensors and lidars, unscaled."""
        readings = read_sensors(robot, self.bodies, motion.proprioception)
        out = np.concatenate((readings.own, scan), 1, dtype=np.float32)
        first, bins = readings.own.shape[1], self.lidar_bins
        for number, kind in enumerate(self.kinds):
            if kind.name == "goal":  # it may have moved since
                start = first + number * bins
                out[:, start : start + bins] = self.lidar(readings, objects["goal"])
        return out

    def lidar(self, readings: Readings, places: Array) -> Array:
        """The lidar [N, B] of objects [N, K, 2] on the floor, seen in the robot's tilting frame."""
        x = places[..., 0] - readings.position[:, :1]
        y = places[..., 1] - readings.position[:, 1:2]
        z = -readings.position[:, 2:]
        ahead = np.empty((*x.shape, 2))
        for i, axis in enumerate((readings.x_axis, readings.y_axis)):
            ahead[..., i] = x * axis[:, :1] + y * axis[:, 1:2] + z * axis[:, 2:]
        return lidar_readings(ahead, length(ahead), self.lidar_bins, self.lidar_range)

    def next_goal(
        self,
        readings: Readings,
        objects: Objects,
        robot: Robot,
        streams: RandomStreams,
        rows: NDArray[np.integer],
    ) -> Array:
        """A new goal [n, 1, 2] for the environments ``rows``, clear of where everything is now."""
        position = readings.position[rows, None, :2]
        around = {name: value[rows] for name, value in objects.items()}
        return self._draw_goal(position, around, robot, streams, rows)

    def _draw_goal(
        self,
        position: Array,
        objects: Objects,
        robot: Robot,
        streams: RandomStreams,
        rows: NDArray[np.integer],
    ) -> Array:
        kinds = [kind for kind in self.kinds if kind.name != "goal"]
        keepout = np.repeat([kind.keepout for kind in kinds], [kind.count for kind in kinds])
        others = np.concatenate([position, *(objects[kind.name] for kind in kinds)], 1)
        goal = next(kind for kind in self.kinds if kind.name == "goal")
        keepouts = np.append(robot.keepout, keepout)
        return place_goal(goal.keepout, self.extent, others, keepouts, streams, rows)[:, None]


def _places(readings: Readings, objects: Mapping[str, Array], name: str) -> Array:
    """Where the objects of a kind are: measured if they move, remembered if they do not."""
    measured = readings.positions.get(name)
    return objects[name] if measured is None else measured[..., :2]


def inside(readings: Readings, places: Array, radius: float) -> Mask:
    """Whether the robot is inside one of the discs at [N, K, 2]."""
    distance = length(places - readings.position[:, None, :2])
    return np.any(distance < radius, axis=-1)


def goal_kind(keepout: float, radius: float = 0.3) -> Kind:
    """The goal, a green disc."""
    prop = Prop("goal", "disc", (radius, 0.01), (0.15, 0.75, 0.30, 0.45))
    return Kind("goal", 1, keepout, prop)


def hazards_kind(count: int, keepout: float, radius: float = 0.2) -> Kind:
    """Hazards, blue discs that cost it to enter."""
    prop = Prop("hazards", "disc", (radius, 0.01), (0.20, 0.35, 0.90, 0.55), True)
    return Kind("hazards", count, keepout, prop)


def vases_kind(count: int) -> Kind:
    """Vases, light boxes that can be pushed; they rest a little deeper than the floor."""
    prop = Prop("vases", "box", (0.1, 0.1, 0.1), (0.0, 0.75, 0.75, 1.0))
    body = Body("vases", count, "free", 0.1 - 4e-5, "box", (0.1, 0.1, 0.1), density=0.001)
    return Kind("vases", count, 0.15, prop, body)


def pillars_kind(count: int) -> Kind:
    """Pillars, cylinders that nothing moves."""
    prop = Prop("pillars", "disc", (0.2, 0.5), (0.5, 0.5, 1.0, 1.0))
    return Kind(
        "pillars", count, 0.3, prop, Body("pillars", count, "fixed", 0.5, "cylinder", (0.2, 0.5))
    )
