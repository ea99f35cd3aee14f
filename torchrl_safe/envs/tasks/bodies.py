"""Objects that a robot can touch: what a task brings into the physics model, and what it reads.

A task with an attribute ``bodies``, a tuple of :class:`Body`, maybe empty, gets a model with them
in it and with the sensors that :func:`read_sensors` takes apart. Where the bodies start is said by
its objects of the same names: positions ``objects["vases"]`` [N, K, 2] and, if they are turned,
``objects["vases_yaw"]`` [N, K].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.robots import Array, Robot

Shape = Literal["box", "cylinder", "sphere"]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Body:
    """Some bodies that are alike.

    Attributes:
        name (str): the name of the task's objects that say where they are.
        count (int): how many, K.
        hold (str): ``"fixed"`` where they are put, ``"free"`` to be pushed, or ``"towed"``: free,
            and pulled around a circle at one radian per second.
        height (float): of the centre above the floor at the start, metres.
        shape (str): ``"box"``, ``"cylinder"`` or ``"sphere"``.
        size (tuple of float): half sizes along x, y and z; radius and half the height; radius.
        density (float): kilograms per cubic metre.
        knobs (tuple): further boxes, each its half sizes and its centre in the body's frame.
        travel (float): radius of the circle of what is towed, metres.
        lift (float): height added by the tow, metres.
    """

    name: str
    count: int
    hold: Literal["fixed", "free", "towed"]
    height: float
    shape: Shape
    size: tuple[float, ...]
    density: float = 1000.0
    knobs: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()
    travel: float = 0.0
    lift: float = 0.0


Bodies = tuple[Body, ...]

# Of the robot's site "robot", in the order of Safety Gym's observation.
ROBOT_SENSORS = ("accelerometer", "velocimeter", "gyro", "magnetometer")
BALL_SENSORS = ("angular velocity", "orientation")  # 3 and 4 numbers for each ball
FRAME_SENSORS = ("position", "x axis", "y axis", "velocity")  # of the same site, in the world


class Readings(NamedTuple):
    """The sensors of N models, taken apart.

    Attributes:
        own (array): [N, P], what Safety Gym's robots show of themselves: accelerometer,
            velocimeter, gyro and magnetometer (3 each), angular velocities of the ball joints (3
            each) and their rotation matrices (9 each).
        position (array): [N, 3], the robot in the world.
        x_axis (array): [N, 3], axis of the robot's sensors in the world.
        y_axis (array): [N, 3].
        velocity (array): [N, 3], of the robot in the world.
        touched (dict of arrays): per kind of body [N, K] bool, whether the robot touches it.
        positions (dict of arrays): per kind of body that moves [N, K, 3].
        velocities (dict of arrays): likewise, in the world.
    """

    own: Array
    position: Array
    x_axis: Array
    y_axis: Array
    velocity: Array
    touched: dict[str, Mask]
    positions: dict[str, Array]
    velocities: dict[str, Array]


def own_size(robot: Robot) -> int:
    """Length P of what a robot shows of itself."""
    return 3 * len(ROBOT_SENSORS) + 12 * len(robot.balls)


def read_sensors(robot: Robot, bodies: Bodies, sensors: Array) -> Readings:
    """Takes apart what the sensors of a model with bodies read.

    Args:
        robot (Robot): the robot.
        bodies (tuple of Body): the bodies.
        sensors (array): [N, S].

    Returns:
        Readings: views, except for the rotation matrices.
    """
    num_envs, plain = len(sensors), 3 * len(ROBOT_SENSORS)
    own = sensors[:, :plain]
    start = plain
    if robot.balls:
        turning, matrices = [], []
        for _ in robot.balls:
            matrix = _rotation(sensors[:, start + 3 : start + 7])
            # Measured in the robot's frame, shown in the ball's.
            turning.append(np.einsum("nji,nj->ni", matrix, sensors[:, start : start + 3]))
            matrices.append(matrix.reshape(num_envs, 9))
            start += 7
        own = np.concatenate((own, *turning, *matrices), 1)
    frame = sensors[:, start : start + 12].reshape(num_envs, 4, 3)
    start += 12
    touched: dict[str, Mask] = {}
    positions: dict[str, Array] = {}
    velocities: dict[str, Array] = {}
    for body in bodies:
        touched[body.name] = sensors[:, start : start + body.count] > 0.0
        start += body.count
    for found in (positions, velocities):
        for body in bodies:
            if body.hold != "fixed":
                end = start + 3 * body.count
                found[body.name] = sensors[:, start:end].reshape(num_envs, body.count, 3)
                start = end
    one, two, three, four = frame.transpose(1, 0, 2)
    return Readings(own, one, two, three, four, touched, positions, velocities)


def _rotation(quaternion: Array) -> Array:
    """Matrices [N, 3, 3] of unit quaternions [N, 4]."""
    w, x, y, z = quaternion.T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)
