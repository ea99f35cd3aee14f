"""The robots: a model, how an action drives it, and what it senses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.legs import controller_input, load_legs, torques

Array = NDArray[np.float64]

_ASSETS = Path(__file__).parent / "assets"
_GRAVITY = 9.81

# Doggo's driven joints, counted behind the free base; the waist, number 6, has no motor.
_DOGGO_JOINTS = np.delete(np.arange(13), 6)
# The fastest it is told to walk, as a share of what its controller was trained on: above, it falls
# more often.
_DOGGO_PACE = 0.7

# Safety-Gymnasium numbers legs like this.
_LEGS = ("front_left", "rear_left", "rear_right", "front_right")
_ANT_JOINTS = tuple(f"{leg}_{part}" for leg in _LEGS for part in ("hip", "knee"))
# Knees bend downwards, each in the direction that its file calls positive or negative.
_RIGHT_ANGLES = tuple(
    angle for knee in (1.0, -1.0, -1.0, 1.0) for angle in (0.0, knee * np.pi / 2.0)
)

_JACKAL_WHEEL_RADIUS, _JACKAL_TRACK = 0.098, 0.376


class Motion(NamedTuple):
    """Where a batch of robots is and what it senses of its own motion.

    Attributes:
        position (array): [N, 2], metres, world frame.
        heading (array): [N, 2], unit vector the robot faces, world frame.
        proprioception (array): [N, P], what the robot senses of itself, in its own frame, unscaled;
            in a task with bodies, all that its model's sensors read: see
            :func:`torchrl_safe.envs.tasks.bodies.read_sensors`.
    """

    position: Array
    heading: Array
    proprioception: Array


@dataclass(frozen=True)
class Instruments:
    """What a robot shows of itself in Safety-Gymnasium's tasks, by names in its file.

    Attributes:
        imu (str): the site of accelerometer, velocimeter, gyro and magnetometer.
        touch (tuple of str): sites that feel the force on them.
        hinges (tuple of str): joints, shown by velocity and by sine and cosine of the angle.
        floating (bool): whether the height of the site ``imu`` is shown, and its angular velocity
            in the world.
        balls (tuple of str): sites on passive ball joints, shown by angular velocity and rotation.
    """

    imu: str = "robot"
    touch: tuple[str, ...] = ()
    hinges: tuple[str, ...] = ()
    floating: bool = False
    balls: tuple[str, ...] = ()


@dataclass(frozen=True)
class Robot:
    """A robot, as the environments need to know it.

    Args:
        name (str): the name in the registry.
        asset (str): the MJCF file, relative to the package's ``assets``.
        timestep (float): seconds of one physics step.
        substeps (int): physics steps in one environment step.
        keepout (float): radius in metres of the free disc the robot starts in.
        action_dim (int): size A of the action.
        proprioception_scale (tuple of float): what each of the P proprioceptive readings is
            divided by in the observation.
        place (callable): ``(position [N, 2], yaw [N]) -> qpos [N, nq]``, the robot at rest there.
        control (callable): ``(action [N, A], qpos [N, nq], qvel [N, nv], time [N]) ->
            ctrl [N, nu]``; the time is in seconds since the robot was placed.
        sense (callable): ``(qpos [N, nq], qvel [N, nv], qacc [N, nv]) -> Motion``.
        task (str): the name of the task it does by default.
        footprint (tuple of float, optional): half the length and half the width in metres of the
            rectangle around the robot that must not touch anything, for tasks with obstacles.
        action_limit (float or tuple of float): the largest absolute value of a component of the
            action, or of each.
        frame_turn (float): angle from the robot's heading to the x axis of its site ``"robot"``,
            the frame of the sensors that a task with bodies adds.
        instruments (Instruments): what it shows of itself in such a task.
        height (float): of the site ``"robot"`` where such a task starts, metres.
        lowest (float): such a task is over when the site is at this height or below it.
        joint_noise (float): half the width of the uniform noise on the coordinates behind a free
            base at the start.
        mirrored (tuple of tuples of int, optional): what proprioception and action become in a
            mirror, see :class:`torchrl_safe.envs.Reflection`. None of a robot whose left side is
            not its right one's mirror image.

    Raises:
        ValueError: if a number is out of its range.

    Examples:
        >>> get_robot("point").substeps
        10
    """

    name: str
    asset: str
    timestep: float
    substeps: int
    keepout: float
    action_dim: int
    proprioception_scale: tuple[float, ...]
    place: Callable[[Array, Array], Array]
    control: Callable[[Array, Array, Array, Array], Array]
    sense: Callable[[Array, Array, Array], Motion]
    task: str = "goal"
    footprint: tuple[float, float] | None = None
    action_limit: float | tuple[float, ...] = 1.0
    frame_turn: float = 0.0
    instruments: Instruments = Instruments()
    height: float = 0.1
    lowest: float = -np.inf
    joint_noise: float = 0.0
    mirrored: tuple[tuple[int, ...], tuple[int, ...]] | None = None

    def __post_init__(self) -> None:
        for name in ("timestep", "keepout"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be positive and finite, got {getattr(self, name)}.")
        for name in ("substeps", "action_dim"):
            value = getattr(self, name)
            if not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be an integer >= 1, got {value}.")
        limit = np.atleast_1d(np.asarray(self.action_limit, float))
        if (
            limit.shape not in ((1,), (self.action_dim,))
            or not ((limit > 0) & (limit < np.inf)).all()
        ):
            raise ValueError(
                f"action_limit must be one positive number or {self.action_dim} of them, "
                f"got {self.action_limit}."
            )
        if not 0.0 <= self.joint_noise < np.inf:
            raise ValueError(f"joint_noise must be at least 0 and finite, got {self.joint_noise}.")

    @property
    def asset_path(self) -> Path:
        """The MJCF file of the robot."""
        return _ASSETS / self.asset


def to_robot_frame(vector: Array, heading: Array, out: Array | None = None) -> Array:
    """World vectors seen from the robot: x ahead, y to the left.

    Args:
        vector (array): [..., 2].
        heading (array): [..., 2], unit vectors.
        out (array, optional): [..., 2], written to in place of a new array.

    Returns:
        array: [..., 2].

    Examples:
        >>> import numpy as np
        >>> to_robot_frame(np.array([0.0, 2.0]), np.array([0.0, 1.0])).tolist()
        [2.0, 0.0]
    """
    along, across = vector * heading[..., :1], vector * heading[..., 1:]
    if out is None:
        out = np.empty_like(vector)
    np.add(along[..., 0], across[..., 1], out=out[..., 0])
    np.subtract(along[..., 1], across[..., 0], out=out[..., 1])
    return out


def _place_planar(position: Array, yaw: Array) -> Array:
    return np.column_stack((position, yaw))


def _place_free(position: Array, yaw: Array, height: float, joints: tuple[float, ...]) -> Array:
    """A free base, level at a height, and the joints behind it."""
    qpos = np.zeros((len(position), 7 + len(joints)))
    qpos[:, :2] = position
    qpos[:, 2] = height
    qpos[:, 3], qpos[:, 6] = np.cos(yaw / 2.0), np.sin(yaw / 2.0)
    qpos[:, 7:] = joints
    return qpos


def _control_directly(action: Array, qpos: Array, qvel: Array, time: Array) -> Array:
    return action


def _control_wheels(action: Array, qpos: Array, qvel: Array, time: Array) -> Array:
    """Wheel speeds (left, right), rad/s, for a velocity in [0, 1] m/s and a yaw rate in rad/s."""
    velocity, turn = (action[:, 0] + 1.0) / 2.0, action[:, 1] * (_JACKAL_TRACK / 2.0)
    return np.stack((velocity - turn, velocity + turn), 1) / _JACKAL_WHEEL_RADIUS


def _sense_planar(qpos: Array, qvel: Array, qacc: Array) -> Motion:
    """Acceleration xy, velocity xy and yaw rate of a robot on two slides and a hinge."""
    heading = np.empty((len(qpos), 2))
    np.cos(qpos[:, 2], out=heading[:, 0])
    np.sin(qpos[:, 2], out=heading[:, 1])
    proprioception = np.empty((len(qpos), 5))
    to_robot_frame(qacc[:, :2], heading, out=proprioception[:, :2])
    to_robot_frame(qvel[:, :2], heading, out=proprioception[:, 2:4])
    proprioception[:, 4] = qvel[:, 2]
    return Motion(qpos[:, :2], heading, proprioception)


def _sense_wheels(qpos: Array, qvel: Array, qacc: Array) -> Motion:
    """Forward velocity and yaw rate of a level free base on wheels."""
    w, x, y, z = qpos[:, 3:7].T
    heading = _unit(np.stack((1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z)), 1))
    forward = (heading * qvel[:, :2]).sum(1)
    return Motion(qpos[:, :2], heading, np.stack((forward, qvel[:, 5]), 1))


def _rotation(quaternion: Array) -> Array:
    """Matrices [N, 3, 3] of unit quaternions [N, 4]; columns are the body's axes in the world."""
    w, x, y, z = quaternion.T
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.array(rows).transpose(2, 0, 1)


def _heading(rotation: Array) -> Array:
    """Where the body's x axis points in the plane."""
    return _unit(rotation[:, :2, 0])


def _unit(ahead: Array) -> Array:
    """Vectors [N, 2] of length one; east for none, of a robot that faces straight up or down."""
    length = np.hypot(ahead[:, 0], ahead[:, 1])[:, None]
    return np.where(length > 1e-9, ahead / np.maximum(length, 1e-9), (1.0, 0.0))


def _sense_free(qpos: Array, qvel: Array, qacc: Array) -> Motion:
    """Accelerometer xy, velocity xy and yaw rate of a free base, in its own, tilting frame."""
    rotation = _rotation(qpos[:, 3:7])
    proprioception = np.empty((len(qpos), 5))
    # An accelerometer at rest shows gravity's reaction: tilt is felt.
    felt = qacc[:, :3] + (0.0, 0.0, _GRAVITY)
    proprioception[:, :2] = np.einsum("nji,nj->ni", rotation[:, :, :2], felt)
    proprioception[:, 2:4] = np.einsum("nji,nj->ni", rotation[:, :, :2], qvel[:, :3])
    proprioception[:, 4] = qvel[:, 5]
    return Motion(qpos[:, :2], _heading(rotation), proprioception)


def _sense_joints(qpos: Array, qvel: Array, qacc: Array) -> Motion:
    """What one that drives Doggo's motors has to know, 45 readings.

    Velocity (3) and angular velocity (3) of the trunk and the vertical (3), all in its frame;
    velocity (12), sine (12) and cosine (12) of the driven joints.
    """
    rotation = _rotation(qpos[:, 3:7])
    angle = qpos[:, _DOGGO_JOINTS + 7]
    parts = (
        np.einsum("nji,nj->ni", rotation, qvel[:, :3]),
        qvel[:, 3:6],
        rotation[:, 2],
        qvel[:, _DOGGO_JOINTS + 6],
        np.sin(angle),
        np.cos(angle),
    )
    return Motion(qpos[:, :2], _heading(rotation), np.concatenate(parts, 1))


def _control_legs(action: Array, qpos: Array, qvel: Array, time: Array, weights: Path) -> Array:
    """Torques for a command to walk: its direction in the robot's frame, and how fast."""
    length = np.hypot(action[:, 0], action[:, 1])[:, None]
    command = _DOGGO_PACE * action / np.maximum(length, 1.0)
    readings = _sense_joints(qpos, qvel, qvel).proprioception
    return torques(load_legs(weights), controller_input(command, readings, time))


_POINT = Robot(
    name="point",
    asset="point.xml",
    timestep=0.002,
    substeps=10,
    keepout=0.4,
    action_dim=2,
    proprioception_scale=(8.0, 8.0, 0.2, 0.2, 2.0),
    place=_place_planar,
    control=_control_directly,
    sense=_sense_planar,
    mirrored=((1, -2, 3, -4, -5), (1, -2)),
)

_JACKAL = Robot(
    name="jackal",
    asset="jackal.xml",
    timestep=0.002,
    substeps=16,
    keepout=0.4,
    action_dim=2,
    proprioception_scale=(0.5, 0.5),
    # At rest the tyres sink into the floor by so much.
    place=partial(_place_free, height=-0.00042, joints=(0.0, 0.0)),
    control=_control_wheels,
    sense=_sense_wheels,
    task="navigation",
    # The wheels reach further than the chassis, in both directions.
    footprint=(0.229, 0.208),
    mirrored=((1, -2), (1, -2)),
)

_CAR = Robot(
    name="car",
    asset="car.xml",
    timestep=0.004,
    substeps=10,
    keepout=0.4,
    action_dim=2,
    proprioception_scale=(8.0, 8.0, 0.2, 0.2, 2.0),
    # At rest wheels and caster sink into the floor by about a tenth of a millimetre. At distance
    # zero, rounding would decide which of them touch.
    place=partial(_place_free, height=0.0999, joints=(0.0, 0.0, 1.0, 0.0, 0.0, 0.0)),
    control=_control_directly,
    sense=_sense_free,
    # Safety-Gymnasium's Car drives along -y.
    frame_turn=np.pi / 2.0,
    instruments=Instruments(balls=("caster",)),
    mirrored=((1, -2, 3, -4, -5), (2, 1)),  # its wheels change places
)

_DOGGO_TORQUES = Robot(
    name="doggo_torques",
    asset="doggo.xml",
    timestep=0.01,
    substeps=10,
    keepout=0.4,
    action_dim=12,
    proprioception_scale=(0.5,) * 3 + (2.0,) * 3 + (1.0,) * 3 + (5.0,) * 12 + (1.0,) * 24,
    place=partial(_place_free, height=0.22, joints=(0.0,) * 13),
    control=_control_directly,
    sense=_sense_joints,
)

_DOGGO = replace(
    _DOGGO_TORQUES,
    name="doggo",
    action_dim=2,
    proprioception_scale=_CAR.proprioception_scale,
    control=partial(_control_legs, weights=_ASSETS / "doggo_legs.safetensors"),
    sense=_sense_free,
)

_ANT = Robot(
    name="ant",
    asset="ant.xml",
    timestep=0.01,
    substeps=10,
    keepout=0.4,
    action_dim=8,
    proprioception_scale=_CAR.proprioception_scale,
    place=partial(_place_free, height=0.18, joints=_RIGHT_ANGLES),
    control=_control_directly,
    sense=_sense_free,
    instruments=Instruments(imu="imu", hinges=_ANT_JOINTS, floating=True),
    height=0.18,
    lowest=0.08,
    joint_noise=0.1,
)

_SAFETY_DOGGO = replace(
    _DOGGO_TORQUES,
    name="safety_doggo",
    asset="safety_doggo.xml",
    proprioception_scale=_CAR.proprioception_scale,
    sense=_sense_free,
    instruments=Instruments(
        touch=tuple(f"{leg}_{end}" for end in ("ankle", "foot") for leg in _LEGS),
        hinges=tuple(f"{leg}_{part}" for part in ("hip_z", "hip_y", "ankle") for leg in _LEGS),
    ),
    height=0.22,
)

_RACECAR = Robot(
    name="racecar",
    asset="racecar.xml",
    timestep=0.004,
    substeps=10,
    keepout=0.4,
    action_dim=2,
    proprioception_scale=_CAR.proprioception_scale,
    # As Car's, its wheels sink in a little.
    place=partial(_place_free, height=0.04997, joints=(0.0,) * 5),
    control=_control_directly,
    sense=_sense_free,
    action_limit=(20.0, 0.785),
    instruments=Instruments(imu="imu"),
    height=0.05,
)

ROBOTS: dict[str, Robot] = {
    robot.name: robot for robot in (_POINT, _CAR, _DOGGO, _DOGGO_TORQUES, _JACKAL)
}

SAFETY_ROBOTS: dict[str, Robot] = {
    "Point": _POINT,
    "Car": _CAR,
    "Ant": _ANT,
    "Doggo": _SAFETY_DOGGO,
    "Racecar": _RACECAR,
}
"""The robots of Safety-Gymnasium's tasks, by their names there; its Doggo is another one."""


def get_robot(name: str) -> Robot:
    """The robot registered under a name.

    Args:
        name (str): a key of ``ROBOTS``.

    Returns:
        Robot: the robot.

    Raises:
        ValueError: if no robot has this name.
    """
    try:
        return ROBOTS[name]
    except KeyError:
        known = ", ".join(map(repr, sorted(ROBOTS)))
        raise ValueError(f"robot must be one of {known}, got {name!r}.") from None
