"""The physics model of a robot, with the bodies and sensors that its task asks for."""

from __future__ import annotations

import mujoco
import numpy as np

from torchrl_safe.envs.robots import Array, Robot
from torchrl_safe.envs.tasks.bodies import Bodies, Body

_SHAPES = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
}
_SENSOR, _OBJECT = mujoco.mjtSensor, mujoco.mjtObj
_TOW_SOLREF = (0.02, 1.5)
_WELD = (0.0,) * 10 + (1.0, 0.0)  # as the two bodies are at the start; torques count as forces


def compile_model(robot: Robot, bodies: Bodies | None = None) -> mujoco.MjModel:
    """The model of a robot.

    Args:
        robot (Robot): the robot.
        bodies (tuple of Body, optional): what is around it; with it, even if it is empty, the
            model has the sensors of :func:`torchrl_safe.envs.tasks.bodies.read_sensors`, and the
            robot's file needs a site ``"robot"``.

    Raises:
        ValueError: if there are bodies and the robot's file has no such site.
    """
    if bodies is None:
        model = mujoco.MjModel.from_xml_path(str(robot.asset_path))
        model.opt.timestep = robot.timestep
        return model
    spec = mujoco.MjSpec.from_file(str(robot.asset_path))
    spec.option.timestep = robot.timestep
    if all(site.name != "robot" for site in spec.sites):
        raise ValueError(f"robot {robot.name!r} has no site 'robot', which its sensors need.")
    _add_robot_sensors(spec, robot)
    if bodies:
        disable = mujoco.mjtDisableBit
        spec.option.disableflags &= ~int(disable.mjDSBL_CONTACT | disable.mjDSBL_CONSTRAINT)
        # Convex shapes touch where they do in the MuJoCo that the tasks come from.
        spec.option.disableflags |= int(disable.mjDSBL_MULTICCD | disable.mjDSBL_NATIVECCD)
        world, plane = spec.worldbody, mujoco.mjtGeom.mjGEOM_PLANE
        if all(geom.type != plane for geom in world.geoms):
            world.add_geom(type=plane, size=(50.0, 50.0, 0.1), condim=6, group=3)
        for body in bodies:
            for i in range(body.count):
                _add_body(spec, body, i)
        _add_body_sensors(spec, bodies)
    return spec.compile()


def state_addresses(model: mujoco.MjModel, body: Body) -> dict[str, np.ndarray]:
    """Where bodies of a kind are in the state: ``qpos``, ``mocap`` and ``anchor``, [K] each."""
    names = _names(body)
    out = {}
    if body.hold == "fixed":
        out["mocap"] = np.array([model.body(name).mocapid.item() for name in names])
    else:
        out["qpos"] = np.array([model.joint(name).qposadr.item() for name in names])
    if body.hold == "towed":
        for key in ("mocap", "anchor"):
            out[key] = np.array([model.body(f"{key}/{name}").mocapid.item() for name in names])
    return out


def pose(body: Body, position: Array, yaw: Array | None) -> tuple[Array, Array]:
    """Positions [n, K, 3] and quaternions [n, K, 4] of bodies at [n, K, 2], turned by [n, K]."""
    xyz = np.empty((*position.shape[:2], 3))
    xyz[..., :2], xyz[..., 2] = position, body.height
    quaternion = np.zeros((*position.shape[:2], 4))
    quaternion[..., 0] = 1.0
    if yaw is not None:
        quaternion[..., 0], quaternion[..., 3] = np.cos(yaw / 2.0), np.sin(yaw / 2.0)
    return xyz, quaternion


def _names(body: Body) -> list[str]:
    return [f"{body.name}/{i}" for i in range(body.count)]


def _add_body(spec: mujoco.MjSpec, body: Body, index: int) -> None:
    world, name = spec.worldbody, _names(body)[index]
    fixed = body.hold == "fixed"
    # What is fixed differs from one environment to the next: its place is state, not model.
    added = world.add_body(name=name, pos=(0.0, 0.0, body.height), mocap=fixed)
    if not fixed:
        added.add_freejoint(name=name)  # without the defaults of the robot's joints
    parts = [(_SHAPES[body.shape], body.size, (0.0, 0.0, 0.0))]
    parts += [(_SHAPES["box"], size, centre) for size, centre in body.knobs]
    for shape, size, centre in parts:
        padded = (*size, 0.0, 0.0)[:3]
        added.add_geom(type=shape, size=padded, pos=centre, density=body.density, condim=6)
    if body.hold == "towed":
        for key in ("mocap", "anchor"):
            world.add_body(name=f"{key}/{name}", mocap=True)
        spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=_OBJECT.mjOBJ_BODY,
            name1=f"mocap/{name}",
            name2=name,
            solref=_TOW_SOLREF,
            data=_WELD,
        )


def _add_robot_sensors(spec: mujoco.MjSpec, robot: Robot) -> None:
    shows = robot.instruments
    site = {"objtype": _OBJECT.mjOBJ_SITE}
    joint = {"objtype": _OBJECT.mjOBJ_JOINT}
    imu = site | {"objname": shows.imu}
    for kind in (
        _SENSOR.mjSENS_ACCELEROMETER,
        _SENSOR.mjSENS_VELOCIMETER,
        _SENSOR.mjSENS_GYRO,
        _SENSOR.mjSENS_MAGNETOMETER,
    ):
        spec.add_sensor(type=kind, **imu)
    for name in shows.touch:
        spec.add_sensor(type=_SENSOR.mjSENS_TOUCH, objname=name, **site)
    for name in shows.hinges:
        spec.add_sensor(type=_SENSOR.mjSENS_JOINTVEL, objname=name, **joint)
    reference = {"reftype": _OBJECT.mjOBJ_SITE, "refname": shows.imu}
    for ball in shows.balls:
        for kind in (_SENSOR.mjSENS_FRAMEANGVEL, _SENSOR.mjSENS_FRAMEQUAT):
            spec.add_sensor(type=kind, objname=ball, **site, **reference)
    if shows.floating:
        for kind in (_SENSOR.mjSENS_FRAMEPOS, _SENSOR.mjSENS_FRAMEANGVEL):
            spec.add_sensor(type=kind, **imu)
    for name in shows.hinges:
        spec.add_sensor(type=_SENSOR.mjSENS_JOINTPOS, objname=name, **joint)
    for kind in (
        _SENSOR.mjSENS_FRAMEPOS,
        _SENSOR.mjSENS_FRAMEXAXIS,
        _SENSOR.mjSENS_FRAMEYAXIS,
        _SENSOR.mjSENS_FRAMELINVEL,
    ):
        spec.add_sensor(type=kind, objname="robot", **site)


def _add_body_sensors(spec: mujoco.MjSpec, bodies: Bodies) -> None:
    root = spec.worldbody.first_body().name
    for body in bodies:
        for name in _names(body):
            spec.add_sensor(
                type=_SENSOR.mjSENS_CONTACT,
                objtype=_OBJECT.mjOBJ_XBODY,  # with all that hangs on it
                objname=root,
                reftype=_OBJECT.mjOBJ_BODY,
                refname=name,
                intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
            )
    for kind in (_SENSOR.mjSENS_FRAMEPOS, _SENSOR.mjSENS_FRAMELINVEL):
        for body in bodies:
            for name in _names(body) if body.hold != "fixed" else ():
                spec.add_sensor(type=kind, objtype=_OBJECT.mjOBJ_XBODY, objname=name)
