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

from torchrl_safe.envs.robots import Array, Instruments, Robot

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

_IMU = 12  # numbers of accelerometer, velocimeter, gyro and magnetometer
_BALL = 7  # angular velocity and orientation
_FLOATING = 6  # position and angular velocity, in the world
_FRAME = 12  # position, x axis, y axis and velocity of the site "robot", in the world


class Readings(NamedTuple):
    """The sensors of N models, taken apart.

    Attributes:
        own (array): [N, P], what Safety-Gymnasium's robots show of themselves: accelerometer,
            velocimeter, gyro and magnetometer (3 each), forces on what feels them, velocities of
            the hinges, angular velocities of the ball joints (3 each), height (1) and angular
            velocity (3) of what floats, sine and cosine of each hinge's angle, rotation matrices of
            the balls (9 each).
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
    shows = robot.instruments
    plain = _IMU + len(shows.touch) + 3 * len(shows.hinges)
    return plain + 4 * shows.floating + 12 * len(shows.balls)


def own_in_mirror(robot: Robot) -> list[int] | None:
    """What becomes of what a robot shows of itself if its left is its right.

    Vectors lose their sideways part's sign, what turns about an axis keeps that part's alone. The
    magnetic field points north, and so does its image in a mirror that runs north.

    Returns:
        list of int: of P places, see :class:`~torchrl_safe.envs.Reflection`; None of a robot that
        has no mirror image, or feels its joints or feet.
    """
    shows = robot.instruments
    if robot.mirrored is None or shows.touch or shows.hinges or shows.floating:
        return None
    ahead_is_x = abs(np.cos(robot.frame_turn)) > abs(np.sin(robot.frame_turn))
    vector = (1, -1, 1) if ahead_is_x else (-1, 1, 1)
    turning = [-sign for sign in vector]
    matrix = [row * column for row in vector for column in vector]
    imu = [*vector, *vector, *turning, *vector]
    signs = imu + turning * len(shows.balls) + matrix * len(shows.balls)
    return [sign * place for place, sign in enumerate(signs, start=1)]


def read_sensors(robot: Robot, bodies: Bodies, sensors: Array) -> Readings:
    """Takes apart what the sensors of a model with bodies read.

    Args:
        robot (Robot): the robot.
        bodies (tuple of Body): the bodies.
        sensors (array): [N, S].

    Returns:
        Readings: views, as far as what is shown is what is measured.
    """
    num_envs = len(sensors)
    own, start = _read_instruments(robot.instruments, sensors)
    frame = sensors[:, start : start + _FRAME].reshape(num_envs, 4, 3)
    start += _FRAME
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


def _read_instruments(shows: Instruments, sensors: Array) -> tuple[Array, int]:
    """What is shown [N, P], and at which column of the sensors [N, S] the rest begins."""
    end = _IMU + len(shows.touch) + len(shows.hinges)
    velocities, shapes = [sensors[:, :end]], []
    for _ in shows.balls:
        matrix = _rotation(sensors[:, end + 3 : end + _BALL])
        # Measured in the robot's frame, shown in the ball's.
        velocities.append(np.einsum("nji,nj->ni", matrix, sensors[:, end : end + 3]))
        shapes.append(matrix.reshape(len(sensors), 9))
        end += _BALL
    if shows.floating:
        velocities.append(sensors[:, end + 2 : end + _FLOATING])
        end += _FLOATING
    if shows.hinges:
        angles = sensors[:, end : end + len(shows.hinges)]
        pairs = np.stack((np.sin(angles), np.cos(angles)), -1)
        shapes.insert(0, pairs.reshape(len(sensors), -1))
        end += len(shows.hinges)
    parts = velocities + shapes
    return parts[0] if len(parts) == 1 else np.concatenate(parts, 1), end


def _rotation(quaternion: Array) -> Array:
    """Matrices [N, 3, 3] of unit quaternions [N, 4]."""
    w, x, y, z = quaternion.T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)
