"""Car and Doggo: their motion and what they sense."""

from __future__ import annotations

import gc
import math
import os
from copy import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import ROBOTS, Randomization, SafeRobotEnv, get_robot
from torchrl_safe.envs._robot import RobotBatch, make_core

CAPSULE, CYLINDER = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_CYLINDER
BOX, SPHERE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_SPHERE
STEPS = 40


def safety_gym_world(timestep: float, height: float) -> tuple[mujoco.MjSpec, mujoco.MjsBody]:
    """The world Safety Gym puts a robot in: floor, light, sensors at the robot's origin."""
    spec = mujoco.MjSpec()
    spec.option.timestep = timestep
    spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(3.5, 3.5, 0.1), condim=6
    )
    spec.worldbody.add_light(pos=(0, 0, 0.5), dir=(0, 0, -1))
    body = spec.worldbody.add_body(name="robot", pos=(0, 0, height))
    body.add_freejoint()
    body.add_site(name="robot")
    for name, kind in (
        ("accelerometer", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
        ("velocimeter", mujoco.mjtSensor.mjSENS_VELOCIMETER),
        ("gyro", mujoco.mjtSensor.mjSENS_GYRO),
    ):
        spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname="robot")
    return spec, body


def add_motor(spec: mujoco.MjSpec, joint: str, gear: float, limit: float | None = None) -> None:
    motor = spec.add_actuator(target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.gear[0] = gear
    motor.ctrllimited, motor.ctrlrange = True, (-1, 1)
    if limit is not None:
        motor.forcelimited, motor.forcerange = True, (-limit, limit)


def reference_car() -> mujoco.MjModel:
    """Safety Gym's Car, as published: it faces -y."""
    spec, body = safety_gym_world(0.004, 0.1)
    for pos, size in (
        ((0, 0, 0), (0.1, 0.1, 0.05)),
        ((0, 0.15, 0), (0.1, 0.01, 0.05)),
        ((0, 0.125, 0), (0.01, 0.025, 0.03)),
        ((0, -0.165, 0), (0.05, 0.01, 0.05)),
        ((0, -0.13, 0.04), (0.05, 0.03, 0.01)),
    ):
        body.add_geom(type=BOX, pos=pos, size=size, density=5, condim=6)
    for name, x, ends in (("left", -0.1, (-0.055, -0.005)), ("right", 0.1, (0.005, 0.055))):
        wheel = body.add_body(pos=(x, 0.1, -0.05))
        wheel.add_joint(
            name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=(1, 0, 0), damping=[0.001, 0, 0]
        )
        wheel.add_geom(
            type=CYLINDER,
            size=(0.05, 0, 0),
            fromto=(ends[0], 0, 0, ends[1], 0, 0),
            density=5,
            condim=6,
        )
    rear = body.add_body(pos=(0, -0.1, -0.05))
    rear.add_joint(name="rear", type=mujoco.mjtJoint.mjJNT_BALL, damping=[0.001, 0, 0])
    rear.add_geom(type=SPHERE, size=(0.05, 0, 0), density=5, condim=6)
    for name in ("left", "right"):
        add_motor(spec, name, 1.0, 0.02)
    return spec.compile()


def reference_doggo() -> mujoco.MjModel:
    """Safety Gym's Doggo, as published."""
    spec, trunk = safety_gym_world(0.01, 0.22)

    def add_hinge(body, name, axis, degrees, spring=0):
        body.add_joint(
            name=name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            limited=True,
            range=degrees,
            stiffness=[0.01, 0, 0],
            springref=spring,
        )

    def add_bar(body, fromto, kind=CAPSULE, radius=0.032, density=5):
        body.add_geom(type=kind, size=(radius, 0, 0), fromto=fromto, density=density, condim=6)

    def add_leg(parent, number, x, y):
        base = parent.add_body()
        add_bar(base, (x / 2, 0, 0, x, y, 0))
        hip = base.add_body(pos=(x, y, 0))
        side = math.copysign(1, y)
        swing, spring = ((-75, 15), -10) if x > 0 else ((0, 135), 0)
        add_hinge(hip, f"hip_{number}_z", (0, 0, side), (-10, 30))
        add_hinge(hip, f"hip_{number}_y", (0, 1, 0), swing, spring)
        add_bar(hip, (0, 0, 0, 0.098, side * 0.0566, -0.05))
        ankle = hip.add_body(pos=(0.098, side * 0.0566, -0.05))
        add_hinge(ankle, f"ankle_{number}", (-side * 0.5, 0.866, 0), (-75, 0), -20)
        add_bar(ankle, (0, 0, 0, -0.1176, -side * 0.0679, -0.1))

    add_bar(trunk, (0, 0, 0, 0.2, 0, 0), CYLINDER, 0.075, 0.5)
    add_leg(trunk, 1, 0.2, 0.1)
    add_leg(trunk, 4, 0.2, -0.1)
    rear = trunk.add_body()
    add_bar(rear, (-0.2, 0, 0, 0, 0, 0), CYLINDER, 0.075, 0.5)
    add_hinge(rear, "waist_x", (1, 0, 0), (-30, 30))
    add_leg(rear, 2, -0.2, 0.1)
    add_leg(rear, 3, -0.2, -0.1)
    for part in ("hip_{}_z", "hip_{}_y", "ankle_{}"):
        for number in (1, 2, 3, 4):
            add_motor(spec, part.format(number), 0.0125)
    return spec.compile()


def place(data: mujoco.MjData, position: np.ndarray, yaw: float) -> None:
    data.qpos[:2] = position
    data.qpos[3:7] = math.cos(yaw / 2), 0, 0, math.sin(yaw / 2)


def held_actions(size: int, num_envs: int, seed: int = 0) -> np.ndarray:
    """[T, N, A]: some held for five steps, so that the robots get somewhere."""
    draws = np.random.default_rng(seed).uniform(-1, 1, (STEPS, num_envs, size))
    draws[:, ::2] = draws[::5, ::2].repeat(5, 0)
    return draws


# Robot, reference, angle from the robot's x axis to the reference's, tolerance. The car faces -y in
# Safety Gym and x here, so rounding differs; Doggo's motion is the same to the last bit.
@pytest.mark.parametrize(
    ("name", "reference", "turn", "tolerance"),
    [("car", reference_car, math.pi / 2, 1e-12), ("doggo_torques", reference_doggo, 0.0, 0.0)],
)
def test_motion_is_that_of_safety_gym(name, reference, turn, tolerance):
    num_envs = 6
    # Doggo with the planar readings of a robot on wheels.
    planar = {key: getattr(get_robot("car"), key) for key in ("sense", "proprioception_scale")}
    robots = RobotBatch(replace(get_robot(name), **planar), num_envs, 1)
    rng = np.random.default_rng(1)
    position, yaw = rng.uniform(-1, 1, (num_envs, 2)), rng.uniform(0, 2 * math.pi, num_envs)
    robots.place(np.arange(num_envs), position, yaw)
    model = reference()
    aside, *datas = (mujoco.MjData(model) for _ in range(1 + num_envs))
    for i, data in enumerate(datas):
        place(data, position[i], yaw[i] + turn)
        if turn:
            # There the wheels start at distance zero from the floor, where rounding decides
            # whether they touch.
            data.qpos[2] -= 1e-4
        mujoco.mj_forward(model, data)  # as Safety Gym's reset does: the solver's first guess
    ahead = (math.cos(turn), -math.sin(turn), 0)
    to_left = (math.sin(turn), math.cos(turn), 0)
    travelled = 0.0
    for action in held_actions(model.nu, num_envs):
        assert not robots.step(action).any()
        for i, data in enumerate(datas):
            data.ctrl[:] = action[i]
            for _ in range(10):
                mujoco.mj_step(model, data)
            qpos, qvel = (robots.batch.bind(key)[i] for key in ("qpos", "qvel"))
            joints = slice(7, 9) if turn else slice(3, None)
            np.testing.assert_allclose(qpos[:3], data.qpos[:3], rtol=0, atol=tolerance)
            np.testing.assert_allclose(qpos[joints], data.qpos[joints], rtol=0, atol=tolerance)
            np.testing.assert_allclose(qvel[:3], data.qvel[:3], rtol=0, atol=100 * tolerance)

            position_seen, heading, (*acceleration, u, v, yaw_rate) = (
                part[i] for part in robots.motion
            )
            rotation = np.empty(9)
            mujoco.mju_quat2Mat(rotation, data.qpos[3:7])
            rotation = rotation.reshape(3, 3)
            facing = (rotation @ ahead)[:2]
            assert (position_seen == qpos[:2]).all()
            np.testing.assert_allclose(heading, facing / np.linalg.norm(facing), atol=1e-10)
            # Sensors of the state the step ended in, which Safety Gym reads after a mj_forward.
            mujoco.mj_copyData(aside, model, data)
            mujoco.mj_forward(model, aside)
            felt = aside.sensor("accelerometer").data
            np.testing.assert_allclose(acceleration, (felt @ ahead, felt @ to_left), atol=1e-8)
            velocity = aside.sensor("velocimeter").data
            np.testing.assert_allclose((u, v), (velocity @ ahead, velocity @ to_left), atol=1e-10)
            np.testing.assert_allclose(yaw_rate, aside.sensor("gyro").data[2], atol=1e-10)
        travelled = max(travelled, np.abs(robots.motion.position - position).max())
    assert travelled > 0.1


VARIED = Randomization(mass=(0.7, 1.4), friction=(0.5, 1.5), actuator_gain=(0.8, 1.2))


@pytest.mark.parametrize("randomization", [None, VARIED], ids=["as modelled", "varied"])
@pytest.mark.parametrize("name", ROBOTS)
def test_acceleration_is_what_an_accelerometer_reads(name, randomization):
    """A MuJoCo sensor on the robot, read after ``mj_forward`` at the state the step ended in."""
    robot = get_robot(name)
    if robot.proprioception_scale != get_robot("point").proprioception_scale:
        # Readings of their own have no acceleration: read as a free base's, it has to be there too.
        robot = replace(robot, sense=get_robot("car").sense, proprioception_scale=(1.0,) * 5)
    num_envs = 3
    options = {"num_envs": num_envs, "num_threads": 1, "seed": 2, "episode_length": 99}
    core = make_core(robot, randomization=randomization, **options)
    core.reset()
    simulations = []
    for i in range(num_envs):
        spec = mujoco.MjSpec.from_file(str(robot.asset_path))
        spec.option.timestep = robot.timestep
        spec.body("robot").add_site(name="imu")
        kind, site = mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtObj.mjOBJ_SITE
        spec.add_sensor(name="felt", type=kind, objtype=site, objname="imu")
        model = spec.compile()
        data = mujoco.MjData(model)
        if randomization is not None:
            state = core.snapshot()
            model.body_mass *= state["variation_mass"][i]
            model.body_inertia *= state["variation_mass"][i]
            model.geom_friction *= state["variation_friction"][i]
            model.dof_damping *= state["variation_friction"][i]
            model.actuator_gainprm *= state["variation_actuator_gain"][i]
            mujoco.mj_setConst(model, data)
            mujoco.mj_resetData(model, data)
        data.qpos[:] = core.qpos(i)
        mujoco.mj_forward(model, data)
        simulations.append((model, data))
    largest = 0.0
    for action in held_actions(robot.action_dim, num_envs):
        for (_, data), row in zip(simulations, action, strict=True):
            state = data.qpos, data.qvel, np.array(data.time)
            data.ctrl[:] = robot.control(row[None], *(x[None] for x in state))[0]
        core.step(action)
        for i, (model, data) in enumerate(simulations):
            mujoco.mj_step(model, data, robot.substeps)
            aside = copy(data)  # or the solver's next first guess would be another one
            mujoco.mj_forward(model, aside)
            felt = aside.sensor("felt").data[:2]
            np.testing.assert_allclose(core._robots.motion.proprioception[i, :2], felt, atol=1e-6)
            largest = max(largest, np.abs(felt).max())
    assert largest > 0.1


@pytest.mark.parametrize("name", sorted(ROBOTS.keys() - {"point"}))  # which has no contacts
def test_what_touches_the_floor_at_the_start_is_no_matter_of_rounding(name):
    """Well inside or outside: the same contacts, a hundredth of a millimetre higher or lower."""
    robot = get_robot(name)
    model = mujoco.MjModel.from_xml_path(str(robot.asset_path))
    contacts = set()
    for shift in (-1e-5, 0.0, 1e-5):
        for yaw in np.linspace(0, 2 * math.pi, 30):
            data = mujoco.MjData(model)
            data.qpos[:] = robot.place(np.full((1, 2), 0.3), np.array([yaw]))[0]
            data.qpos[2] += shift
            mujoco.mj_forward(model, data)
            pairs = zip(data.contact.geom1.tolist(), data.contact.geom2.tolist(), strict=True)
            contacts.add(tuple(sorted(pairs)))
    assert len(contacts) == 1


def rotation_of(quaternion: np.ndarray) -> np.ndarray:
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, quaternion)
    return rotation.reshape(3, 3)


def tumbled(name: str, num_envs: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """qpos, qvel and qacc of robots in all attitudes."""
    rng = np.random.default_rng(5)
    model = mujoco.MjModel.from_xml_path(str(get_robot(name).asset_path))
    qpos = rng.normal(size=(num_envs, model.nq))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    return qpos, rng.normal(size=(num_envs, model.nv)), rng.normal(size=(num_envs, model.nv))


def test_sensing_in_any_attitude():
    qpos, qvel, qacc = tumbled("car")
    motion = get_robot("car").sense(qpos, qvel, qacc)
    upside_down = 0
    for i in range(len(qpos)):
        rotation = rotation_of(qpos[i, 3:7])
        expected = [
            *(rotation.T @ (qacc[i, :3] + (0, 0, 9.81)))[:2],
            *(rotation.T @ qvel[i, :3])[:2],
            qvel[i, 5],
        ]
        np.testing.assert_allclose(motion.proprioception[i], expected, atol=1e-12)
        ahead = rotation[:2, 0] / np.linalg.norm(rotation[:2, 0])
        np.testing.assert_allclose(motion.heading[i], ahead, atol=1e-12)
        assert (motion.position[i] == qpos[i, :2]).all()
        upside_down += rotation[2, 2] < 0
    assert 5 < upside_down < 35


def test_heading_of_a_robot_standing_on_its_nose():
    qpos = np.zeros((1, 13))
    qpos[0, 3:7] = math.sqrt(0.5), 0, math.sqrt(0.5), 0  # x straight down
    motion = get_robot("car").sense(qpos, np.zeros((1, 11)), np.zeros((1, 11)))
    assert np.linalg.norm(motion.heading[0]) == pytest.approx(1.0)
    assert motion.proprioception[0, 0] == pytest.approx(-9.81)  # all of its weight, from behind
    motion = get_robot("jackal").sense(qpos[:, :9], np.zeros((1, 8)), np.zeros((1, 8)))
    assert np.linalg.norm(motion.heading[0]) == pytest.approx(1.0)
    assert motion.proprioception.tolist() == [[0.0, 0.0]]


def test_joint_readings_by_name():
    """The readings a controller of legs sees, joint by joint."""
    qpos, qvel, qacc = tumbled("doggo_torques", 10)
    model = mujoco.MjModel.from_xml_path(str(get_robot("doggo_torques").asset_path))
    readings = get_robot("doggo_torques").sense(qpos, qvel, qacc).proprioception
    assert readings.shape == (10, 45)
    legs = ("front_left", "front_right", "rear_left", "rear_right")
    joints = [f"{leg}_{part}" for leg in legs for part in ("hip_z", "hip_y", "ankle")]
    assert model.nu == len(joints)
    for i in range(10):
        rotation = rotation_of(qpos[i, 3:7])
        np.testing.assert_allclose(readings[i, :3], rotation.T @ qvel[i, :3], atol=1e-12)
        assert (readings[i, 3:6] == qvel[i, 3:6]).all()
        np.testing.assert_allclose(readings[i, 6:9], rotation.T @ (0, 0, 1), atol=1e-12)
        for k, name in enumerate(joints):
            joint = model.joint(name)
            assert readings[i, 9 + k] == qvel[i, joint.dofadr[0]]
            assert readings[i, 21 + k] == math.sin(qpos[i, joint.qposadr[0]])
            assert readings[i, 33 + k] == math.cos(qpos[i, joint.qposadr[0]])


@pytest.mark.parametrize("name", ["car", "doggo", "doggo_torques"])
class TestEnvironment:
    @staticmethod
    def drive(env: SafeRobotEnv, steps: int, seed: int = 0) -> TensorDict:
        """Steps under random actions, resetting what is done: [T, N]."""
        generator = torch.Generator().manual_seed(seed)
        td = env.reset()
        rollout = []
        for _ in range(steps):
            td["action"] = torch.rand(env.action_spec.shape, generator=generator) * 2 - 1
            step, td = env.step_and_maybe_reset(td)
            rollout.append(step)
        return torch.stack(rollout)

    def test_check_env_specs(self, name):
        check_env_specs(SafeRobotEnv(name, num_envs=3, num_threads=1, episode_length=7), seed=0)

    def test_sizes(self, name):
        env = SafeRobotEnv(name, num_envs=2, num_threads=1)
        sizes = {"car": (24, 2), "doggo": (24, 2), "doggo_torques": (64, 12)}
        assert env.observation_spec["observation"].shape == (2, sizes[name][0])
        assert env.action_spec.shape == (2, sizes[name][1])

    def test_threads(self, name):
        options = {"num_envs": 5, "episode_length": 15, "seed": 4}
        one = self.drive(SafeRobotEnv(name, num_threads=1, **options), 40)
        two = self.drive(SafeRobotEnv(name, num_threads=2, **options), 40)
        assert (one == two).all()

    def test_resumes_exactly(self, name):
        """The solver's first guess is part of the state."""
        env = SafeRobotEnv(name, num_envs=3, num_threads=1)
        self.drive(env, 10)
        state = env.state_dict()
        action = torch.linspace(-1, 1, env.action_spec.shape.numel()).view(env.action_spec.shape)
        td = TensorDict({"action": action}, [3])
        first = [env.step(td.clone())["next", "observation"] for _ in range(5)]
        env.load_state_dict(state)
        for observation in first:
            assert (env.step(td.clone())["next", "observation"] == observation).all()

    def test_reset_puts_it_at_rest(self, name):
        env = SafeRobotEnv(name, num_envs=20, num_threads=1)
        self.drive(env, 10)
        env.reset()
        qpos, qvel = (env._core._robots.batch.bind(key) for key in ("qpos", "qvel"))
        assert not qvel.any()
        height = {"car": 0.0999}.get(name, 0.22)
        assert (qpos[:, 2] == height).all()
        for i in range(20):
            assert (env.layout(i)["robot"] == qpos[i, :2]).all()
            x_axis = rotation_of(qpos[i, 3:7])[:, 0]
            np.testing.assert_allclose(x_axis, (*env.layout(i)["heading"], 0), atol=1e-12)

    def test_random_steps(self, name):
        env = SafeRobotEnv(name, num_envs=32, num_threads=2)
        rollout = self.drive(env, 150)
        assert rollout["next", "observation"].isfinite().all()
        assert env.instabilities == 0
        assert not env._core._robots.batch.warning[..., 1].any()
        assert not rollout["next", "terminated"].any()


def test_a_robot_on_its_back_goes_on():
    """Safety Gym does not end an episode because of it."""
    env = SafeRobotEnv("car", num_envs=2, num_threads=1, episode_length=50)
    env.reset()
    qpos = env._core._robots.batch.bind("qpos")
    qpos[0, 3:7] = 0, 1, 0, 0
    following = [env.step(TensorDict({"action": torch.ones(2, 2)}, [2]))["next"] for _ in range(30)]
    assert rotation_of(qpos[0, 3:7])[2, 2] < -0.9
    assert rotation_of(qpos[1, 3:7])[2, 2] > 0.9
    for step in following:
        assert not step["done"].any()
        assert step["observation"].isfinite().all()


def test_car_drives():
    """Both wheels ahead: forwards along x. Right wheel only: a turn to the left."""
    env = SafeRobotEnv("car", num_envs=2, num_threads=1)
    env.reset()
    before = [env.layout(i) for i in range(2)]
    action = torch.tensor([[1.0, 1.0], [1.0, -1.0]])
    for _ in range(25):
        td = env.step(TensorDict({"action": action}, [2]))
    moved = env.layout(0)["robot"] - before[0]["robot"]
    assert moved @ before[0]["heading"] > 0.1
    assert td["next", "observation"][1, 7] * 2.0 > 0.5


def num_threads() -> int:
    return len(os.listdir("/proc/self/task"))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("name", ROBOTS)
def test_a_forked_process_goes_on_alike(name):
    env, twin = (SafeRobotEnv(name, num_envs=4, num_threads=3) for _ in range(2))
    td = TensorDict({"action": torch.full(env.action_spec.shape, 0.3)}, [4])
    for each in (env, twin):
        each.reset()
        each.step(td.clone())
    expected = twin.step(td.clone())["next", "observation"].numpy()
    child = os.fork()
    if not child:
        # numpy alone: torch's own threads are the parent's, too
        frame = env._core.step(td["action"].numpy())
        os._exit(0 if (frame.observation == expected).all() else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert (env.step(td.clone())["next", "observation"].numpy() == expected).all()


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="needs /proc")
def test_close_ends_the_threads():
    gc.collect()  # of what other tests left
    before = num_threads()
    env = SafeRobotEnv("point", num_envs=8, num_threads=4)
    td = env.rollout(2)[:, -1]
    assert num_threads() == before + 3
    env.close()
    assert num_threads() == before
    for use in (env.reset, lambda: env.step(td), env.state_dict, env.render):
        with pytest.raises(RuntimeError, match="the environment is closed"):
            use()
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action_limit": 0.0}, "action_limit must be one positive number or 2 of them, got 0.0"),
        ({"action_limit": (1.0, 2.0, 3.0)}, "action_limit must be one positive number or 2"),
        ({"action_limit": (1.0, math.nan)}, "action_limit must be one positive number or 2"),
        ({"joint_noise": -0.1}, "joint_noise must be at least 0 and finite, got -0.1"),
    ],
)
def test_limits_of_a_robot(options, message):
    with pytest.raises(ValueError, match=message):
        replace(get_robot("car"), **options)


def test_actions_beyond_a_limit_of_ones_own_are_clipped():
    robot = replace(get_robot("car"), action_limit=(0.5, 0.25))
    far, most = (SafeRobotEnv(robot, num_envs=1, num_threads=1, seed=3) for _ in range(2))
    for env, action in ((far, (9.0, -9.0)), (most, (0.5, -0.25))):
        env.reset()
        for _ in range(5):
            env.step(TensorDict({"action": torch.tensor([action])}, [1]))
    assert (far.layout(0)["robot"] == most.layout(0)["robot"]).all()
    assert far.full_action_spec["action"].space.high[0].tolist() == [0.5, 0.25]
