"""The task that teaches Doggo's legs: walk where a command says, and do not fall over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs import Robot
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.legs import INPUT_SIZE, STEP, controller_input
from torchrl_safe.envs.robots import Array, Motion, to_robot_frame
from torchrl_safe.envs.tasks import Objects, Outcome, Prop, Sensed

VERTICAL = 8  # the reading that is one on a level robot, and minus one on its back
TIPPED = 0.3  # below this it is falling


@dataclass(frozen=True)
class Walking:
    """Commands, in the world's frame, and what following them is worth.

    A command is a direction and a share of the top speed: all of it in half of the draws, else
    uniform. It is held for 40 steps on average; in one episode of eight it changes at every step,
    as it does under a policy that is still to learn where to go.

    The reward is in metres per second: ``wanted - |progress - wanted|`` along the command, less
    ``tilt_cost`` times the square of how much the trunk leans (1 minus the vertical): swaying is
    cheap, being about to fall is not. A robot that tips over is a violation, and ends its episode.

    Args:
        top_speed (float): metres per second that are wanted at most.
        tilt_cost (float): metres per second that leaning by a right angle costs.
        num_directions (int or None): in tests, robot i keeps walking at full speed at i /
            num_directions of a full turn to the left of where it was put down.
    """

    top_speed: float = 0.6
    tilt_cost: float = 4.0
    num_directions: int | None = None

    max_cost = 1.0
    extent = 3.0
    props: tuple[Prop, ...] = ()

    def rays(self, scan: Array) -> tuple[Array, Array]:
        """There is no lidar."""
        return np.zeros(0), np.zeros(0)

    def observation_size(self, robot: Robot) -> int:
        """That of what the controller sees."""
        return INPUT_SIZE

    def sample(
        self, robot: Robot, streams: RandomStreams, rows: NDArray[np.integer]
    ) -> tuple[Array, Array, Objects]:
        """At the origin, facing anywhere."""
        draws = streams.uniform(rows, 2)
        yaw = 2.0 * np.pi * draws[:, 0]
        if self.num_directions is None:
            command, hold = draw_command(streams, rows), np.where(draws[:, 1] < 0.125, 1.0, 40.0)
        else:
            direction = yaw + 2.0 * np.pi * rows / self.num_directions
            command, hold = unit(direction), np.full(len(rows), np.inf)
        position = np.zeros((len(rows), 2))
        objects = {"command": command, "hold": hold, "last": position, "step": np.zeros(len(rows))}
        return position, yaw, objects

    def sense(self, robot: Robot, motion: Motion, objects: Objects) -> Sensed:
        """Whether it stands."""
        tipped = motion.proprioception[:, VERTICAL] < TIPPED
        return Sensed(np.zeros((len(tipped), 0)), tipped.astype(float), tipped, tipped)

    def advance(
        self,
        robot: Robot,
        motion: Motion,
        objects: Objects,
        sensed: Sensed,
        remaining: NDArray[np.int64],
        streams: RandomStreams,
    ) -> Outcome:
        """Rewards progress along the command, and draws another one now and then."""
        command = objects["command"]
        length = np.hypot(command[:, 0], command[:, 1])
        velocity = (motion.position - objects["last"]) / STEP
        progress = (velocity * command).sum(1) / np.maximum(length, 1e-9)
        wanted = self.top_speed * length
        leaning = 1.0 - motion.proprioception[:, VERTICAL]
        reward = wanted - np.abs(progress - wanted) - self.tilt_cost * leaning**2
        if self.num_directions is None:
            rows = np.arange(len(command))
            renewed = streams.uniform(rows, 1) < 1.0 / objects["hold"][:, None]
            command = np.where(renewed, draw_command(streams, rows), command)
        return Outcome(
            {**objects, "command": command, "last": motion.position, "step": objects["step"] + 1.0},
            reward,
            sensed.cost,
            sensed.violation.astype(np.int64),
            goal_met=np.zeros(len(reward), bool),
            terminated=sensed.contact,
        )

    def observe(
        self, robot: Robot, motion: Motion, objects: Objects, scan: Array
    ) -> NDArray[np.float32]:
        """What the controller sees."""
        command = to_robot_frame(objects["command"], motion.heading)
        seen = controller_input(command, motion.proprioception, objects["step"] * STEP)
        return seen.astype(np.float32)


def unit(angle: Array) -> Array:
    """Unit vectors [N, 2]."""
    return np.column_stack((np.cos(angle), np.sin(angle)))


def draw_command(streams: RandomStreams, rows: NDArray[np.integer]) -> Array:
    """Directions times shares of the top speed, [n, 2]."""
    turn, full, share = streams.uniform(rows, 3).T
    return np.where(full < 0.5, 1.0, share)[:, None] * unit(2.0 * np.pi * turn)
