"""Domain randomisation: against models compiled with the drawn values, and as state."""

from __future__ import annotations

import math
import pickle

import mujoco
import numpy as np
import pytest
import scipy.stats
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import (
    JACKAL_REAL,
    JACKAL_TRAINING,
    Randomization,
    SafeRobotEnv,
    get_robot,
)
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs._robot import make_core
from torchrl_safe.envs.randomization import Variation, add_noise, drop_readings

WIDE = Randomization(
    mass=(0.5, 2.0),
    friction=(0.3, 1.5),
    actuator_gain=(0.7, 1.3),
    actuator_delay=(0, 3),
    sensor_noise=(0.01, 0.1),
    lidar_dropout=(0.1, 0.3),
)


def make(robot: str = "jackal", num_envs: int = 5, num_threads: int = 1, **options) -> SafeRobotEnv:
    options = {"randomization": WIDE} | options
    return SafeRobotEnv(robot, num_envs=num_envs, num_threads=num_threads, **options)


def core(robot: str, randomization: Randomization | None, num_envs: int = 4):
    return make_core(
        robot,
        num_envs=num_envs,
        num_threads=1,
        seed=0,
        episode_length=1000,
        randomization=randomization,
    )


def drive(env: SafeRobotEnv, steps: int, seed: int = 0) -> TensorDict:
    generator = torch.Generator().manual_seed(seed)
    out = []
    for _ in range(steps):
        action = torch.rand(*env.batch_size, 2, generator=generator) * 2 - 1
        out.append(env.step(TensorDict({"action": action}, env.batch_size))["next"])
    return torch.stack(out)


class TestPhysics:
    @pytest.mark.parametrize("robot", ["point", "jackal"])
    def test_motion_is_that_of_a_model_compiled_with_the_values(self, robot):
        varied = core(
            robot, Randomization(mass=(0.5, 2), friction=(0.3, 1.5), actuator_gain=(0.7, 1.3))
        )
        varied.reset()
        robot = get_robot(robot)
        state = varied.snapshot()
        datas = []
        for i in range(4):
            mass, friction, gain = (
                state[f"variation_{name}"][i] for name in ("mass", "friction", "actuator_gain")
            )
            spec = mujoco.MjSpec.from_file(str(robot.asset_path))
            spec.option.timestep = robot.timestep
            for geom in spec.geoms:
                geom.friction *= friction
                # A mass that is given, or density times volume.
                if np.isfinite(geom.mass):
                    geom.mass *= mass
                geom.density *= mass
            for body in spec.bodies:
                body.mass *= mass
                body.inertia *= mass
            for joint in spec.joints:
                joint.damping *= friction
            for actuator in spec.actuators:
                actuator.gainprm *= gain
            model = spec.compile()
            data = mujoco.MjData(model)
            data.qpos[:] = varied.qpos(i)
            mujoco.mj_forward(model, data)
            datas.append((model, data))
        rng = np.random.default_rng(0)
        for _ in range(12):
            action = rng.uniform(-1, 1, (4, 2))
            varied.step(action)
            for i, (model, data) in enumerate(datas):
                qpos, qvel = data.qpos[None], data.qvel[None]
                data.ctrl[:] = robot.control(action[[i]], qpos, qvel, np.array([data.time]))[0]
                mujoco.mj_step(model, data, robot.substeps)
                # Point's stiff servo makes something of rounding.
                np.testing.assert_allclose(varied.qpos(i), data.qpos, atol=1e-5)

    def test_robots_differ(self):
        plain, varied = core("jackal", None), core("jackal", WIDE)
        for c in (plain, varied):
            c.reset()
            for _ in range(20):
                c.step(np.full((4, 2), 0.5))
        speeds = [c._robots.motion.proprioception[:, 0] for c in (plain, varied)]
        assert np.ptp(speeds[0]) < 1e-6
        assert np.ptp(speeds[1]) > 0.05

    def test_neutral_ranges_change_nothing(self):
        frames = []
        for randomization in (None, Randomization()):
            c = core("jackal", randomization)
            c.reset()
            # The same state: with a randomisation, other numbers of the streams are used up.
            layout = {"boxes": np.full((4, 8, 2), 2.0), "goal": np.ones((4, 2))}
            state = c.snapshot() | layout
            state["physics"][:, 4:8] = (1, 0, 0, 0)
            c.restore(state)
            rng = np.random.default_rng(0)
            frames.append([c.step(rng.uniform(-1, 1, (4, 2))).observation for _ in range(15)])
        assert np.array_equal(*frames)

    def test_gain_scales_the_speed(self):
        slow = core("jackal", Randomization(actuator_gain=(0.8, 0.8)))
        slow.reset()
        for _ in range(25):
            slow.step(np.full((4, 2), (0.0, 0.0)))  # half a metre per second
        np.testing.assert_allclose(slow._robots.motion.proprioception[:, 0], 0.4, rtol=0.02)

    @pytest.mark.parametrize("delay", [0, 1, 3])
    def test_delay(self, delay):
        """The motion under delayed commands is the plain one, that many steps later."""
        late = core("point", Randomization(actuator_delay=(delay, delay)))
        plain = core("point", Randomization())
        late.reset()
        plain.reset()
        start = late._robots.motion.position
        expected, got = [], []
        rng = np.random.default_rng(1)
        for action in rng.uniform(-1, 1, (10, 4, 2)):
            plain.step(action)
            expected.append(plain._robots.motion)
            late.step(action)
            got.append(late._robots.motion)
        for t in range(delay):
            assert (got[t].position == start).all()
        for t in range(10 - delay):
            for x, y in zip(got[t + delay], expected[t], strict=True):
                np.testing.assert_allclose(x, y, atol=1e-9)

    def test_each_environment_has_its_own_delay(self):
        c = core("point", Randomization(actuator_delay=(0, 3)), num_envs=40)
        c.reset()
        delay = c.snapshot()["variation_actuator_delay"].astype(int)
        assert set(delay) == {0, 1, 2, 3}
        start = c._robots.motion.position.copy()
        first = np.full(40, -1)
        for t in range(5):
            c.step(np.full((40, 2), (1.0, 0.0)))
            moved = np.linalg.norm(c._robots.motion.position - start, axis=-1) > 1e-9
            first[moved & (first < 0)] = t
        assert (first == delay).all()

    def test_an_episode_does_not_inherit_commands(self):
        c = core("point", Randomization(actuator_delay=(2, 2)))
        c.reset()
        for _ in range(3):
            c.step(np.ones((4, 2)))
        c.reset(np.array([True, False, True, False]))
        start = c._robots.motion.position.copy()
        c.step(np.zeros((4, 2)))
        moved = (c._robots.motion.position != start).any(-1)
        assert moved.tolist() == [False, True, False, True]


class TestSensors:
    def test_noise_is_normal(self):
        streams, rows = RandomStreams(0, 3), np.arange(3)
        deviation = np.array([0.0, 0.5, 2.0])
        noise = add_noise(np.ones((3, 20_000), np.float32), deviation, streams, rows) - 1
        assert noise.dtype == np.float32
        assert (noise[0] == 0).all()
        for row in (1, 2):
            scaled = noise[row] / deviation[row]
            assert scipy.stats.kstest(scaled, "norm").pvalue > 0.01

    def test_dropout_rate(self):
        streams, rows = RandomStreams(0, 3), np.arange(3)
        kept = drop_readings(np.ones((3, 20_000)), np.array([0.0, 0.25, 1.0]), streams, rows)
        assert kept.mean(-1) == pytest.approx([1.0, 0.75, 0.0], abs=0.01)
        assert set(kept.ravel()) == {0.0, 1.0}

    def test_only_the_observation_is_touched(self):
        """The same motion, reward and cost as without; the observation off by the noise."""
        noisy = core("jackal", Randomization(sensor_noise=(0.05, 0.05), lidar_dropout=(0.2, 0.2)))
        plain = core("jackal", Randomization())
        frames = []
        for c in (noisy, plain):
            c.reset()
            rng = np.random.default_rng(0)
            frames.append([c.step(rng.uniform(-1, 1, (4, 2))) for _ in range(30)])
        difference = []
        for a, b in zip(*frames, strict=True):
            for name in ("reward", "cost", "violations", "goal_met", "terminated", "truncated"):
                assert (getattr(a, name) == getattr(b, name)).all()
            difference.append(a.observation - b.observation)
        difference = np.array(difference)
        assert difference[..., :5].std() == pytest.approx(0.05, rel=0.2)
        assert difference[..., 5:].std() > 0.06

    def test_reset_shows_the_sensors_too(self):
        noisy = core("jackal", Randomization(sensor_noise=(0.1, 0.1)))
        assert (noisy.reset().observation[:, 3:5] != 0).all()


class TestDraws:
    def test_fill_their_ranges(self):
        n = 4000
        variation = WIDE.sample(RandomStreams(0, n), np.arange(n))
        for name, values in variation._asdict().items():
            low, high = getattr(WIDE, name)
            assert low <= values.min()
            assert values.max() <= high
            if name == "actuator_delay":
                count = np.unique(values, return_counts=True)[1]
                assert scipy.stats.chisquare(count).pvalue > 0.01
            else:
                uniform = scipy.stats.uniform(low, high - low)
                assert scipy.stats.kstest(values, uniform.cdf).pvalue > 0.01
        correlation = np.corrcoef(np.array(variation)) - np.eye(6)
        assert np.abs(correlation).max() < 5 / math.sqrt(n)

    def test_change_at_a_reset_and_only_there(self):
        c = core("point", WIDE)
        c.reset()
        before = c.snapshot()["variation_mass"]
        c.step(np.zeros((4, 2)))
        assert (c.snapshot()["variation_mass"] == before).all()
        c.reset(np.array([False, True, False, False]))
        assert (c.snapshot()["variation_mass"] != before).tolist() == [False, True, False, False]

    def test_the_real_robot_is_held_out(self):
        for name in Variation._fields:
            low, high = getattr(JACKAL_TRAINING, name)
            held_out = getattr(JACKAL_REAL, name)
            assert held_out[0] == held_out[1]
            assert not low <= held_out[0] <= high
        env = make(randomization=JACKAL_REAL)
        check_env_specs(env)
        assert env.rollout(20)["observation"].isfinite().all()


class TestState:
    def test_threads_and_seeds(self):
        rollouts = []
        for num_threads, seed in ((1, 3), (2, 3), (1, 4)):
            env = make(num_envs=7, num_threads=num_threads, seed=seed)
            env.reset()
            rollouts.append(drive(env, 15))
        assert (rollouts[0] == rollouts[1]).all()
        assert not (rollouts[0] == rollouts[2]).all()

    @pytest.mark.parametrize("robot", ["point", "jackal"])
    def test_resumes_exactly(self, robot):
        env = make(robot)
        env.reset()
        drive(env, 10)
        saved = env.state_dict()
        copy = pickle.loads(pickle.dumps(env))
        expected = drive(env, 20, seed=1)
        other = make(robot, seed=9)
        other.reset()
        drive(other, 3)
        other.load_state_dict(saved)
        for resumed in (copy, other):
            assert (drive(resumed, 20, seed=1) == expected).all()
        env.load_state_dict(saved)
        assert (drive(env, 20, seed=1) == expected).all()

    def test_state_of_an_env_without_randomisation_is_refused(self):
        env, plain = make("point"), make("point", randomization=None)
        env.reset()
        plain.reset()
        with pytest.raises(ValueError, match="must have the entries"):
            env.load_state_dict(plain.state_dict())
        with pytest.raises(ValueError, match="must have the entries"):
            plain.load_state_dict(env.state_dict())

    @pytest.mark.parametrize("robot", ["point", "jackal"])
    def test_specs(self, robot):
        check_env_specs(make(robot))


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"mass": (1.2, 0.9)}, r"mass must be a tuple \(low, high\) of finite numbers"),
        ({"mass": 1.0}, "mass must be a tuple"),
        ({"mass": (1.0, math.inf)}, "mass must be a tuple"),
        ({"mass": (0.0, 1.0)}, "mass must be positive"),
        ({"friction": (-1.0, 1.0)}, "friction must be positive"),
        ({"actuator_gain": (math.nan, 1.0)}, "actuator_gain must be a tuple"),
        ({"actuator_delay": (0.0, 2.0)}, r"actuator_delay must be .* of integers"),
        ({"actuator_delay": (-1, 2)}, "actuator_delay must be >= 0"),
        ({"sensor_noise": (-0.1, 0.0)}, "sensor_noise must be >= 0"),
        ({"lidar_dropout": (0.0, 1.5)}, r"lidar_dropout must be in \[0, 1\]"),
    ],
)
def test_bad_ranges(options, match):
    with pytest.raises(ValueError, match=match):
        Randomization(**options)
