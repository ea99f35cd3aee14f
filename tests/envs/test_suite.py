"""The dm_control interface: the suite's manners, TorchRL's wrapper, drawing, bad input."""

from __future__ import annotations

import copy
import os
import pickle

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import DMControlWrapper
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import ROBOTS, GoalTask, NavigationTask, SafeRobotEnv

pytest.importorskip("dm_control")

from dm_control.rl import control
from dm_env import StepType

from torchrl_safe.envs.interfaces import suite
from torchrl_safe.envs.tasks import get_task


def forward(robot: str) -> np.ndarray:
    """Straight ahead at full speed."""
    return np.eye(1, ROBOTS[robot].action_dim)[0]


@pytest.fixture(scope="module")
def opengl():
    env = suite.load()
    try:
        env.physics.render(16, 16)
    except Exception as error:  # whatever a machine without OpenGL raises
        pytest.skip(f"no OpenGL: {error}")
    env.physics.free()


@pytest.mark.parametrize("robot", ROBOTS)
class TestEveryRobot:
    def test_specs(self, robot):
        env = suite.load(robot)
        assert isinstance(env, control.Environment)
        spec = env.observation_spec()  # before the first reset
        assert list(spec) == ["observation", "cost", "violation", "violations", "goal_met"]
        for time_step in (env.reset(), env.step(forward(robot))):
            for name, part in spec.items():
                part.validate(time_step.observation[name])
        seconds = ROBOTS[robot].timestep * ROBOTS[robot].substeps
        assert env.control_timestep() == pytest.approx(seconds)
        assert env.physics.time() == pytest.approx(seconds)

    def test_torchrl(self, robot):
        env = DMControlWrapper(suite.load(robot, random=0, episode_length=5))
        check_env_specs(env)
        rollout = env.rollout(20)["next"]
        assert len(rollout) <= 5
        assert (rollout["truncated"] | rollout["terminated"])[-1].all()
        env.set_seed(4)
        first = env.reset()["observation"]
        env.set_seed(4)
        assert torch.equal(env.reset()["observation"], first)
        env.set_seed(5)
        assert not torch.equal(env.reset()["observation"], first)


@pytest.mark.parametrize("robot", ROBOTS)
class TestAsInTheSuite:
    """What dm_control's own tests of its suite ask of every domain."""

    def test_components_have_names(self, robot):
        model = suite.load(robot).physics.model
        kinds = {
            "body": model.nbody,
            "geom": model.ngeom,
            "joint": model.njnt,
            "camera": model.ncam,
            "light": model.nlight,
            "actuator": model.nu,
            "texture": model.ntex,
            "material": model.nmat,
        }
        for kind, count in kinds.items():
            assert all(model.id2name(i, kind) for i in range(count)), kind

    def test_at_least_two_cameras(self, robot):
        assert suite.load(robot).physics.model.ncam >= 2

    def test_bounds_are_arrays(self, robot):
        spec = suite.load(robot).action_spec()
        assert spec.minimum.shape == spec.maximum.shape == spec.shape
        assert all(low == -1.0 for low in spec.minimum)
        assert all(high == 1.0 for high in spec.maximum)

    def test_environment_arguments(self, robot):
        env = suite.load(robot, None, {"random": 0}, {"flat_observation": True})
        assert set(env.observation_spec()) == {control.FLAT_OBSERVATION_KEY}
        seconds = 2.5 * env.control_timestep()
        env = suite.load(robot, environment_kwargs={"time_limit": seconds})
        env.reset()
        steps = [env.step(np.zeros(env.action_spec().shape)) for _ in range(3)]
        assert [step.last() for step in steps] == [False, False, True]

    def test_seeds_are_task_arguments(self, robot):
        def start(seed):
            env = suite.load(robot, task_kwargs={"random": seed})
            return env.reset().observation["observation"]

        assert (start(3) == start(3)).all()
        assert (start(3) != start(4)).any()

    def test_visualize_reward(self, robot):
        env = suite.load(robot, random=0, visualize_reward=True)
        plain = env.physics.model.geom_rgba.copy()
        env.reset()
        for _ in range(2):
            env.step(np.zeros(env.action_spec().shape))
        np.testing.assert_allclose(env.physics.model.geom_rgba, plain, atol=1e-4)
        env.physics.highlight(1.0)
        changed = (env.physics.model.geom_rgba != plain).any(1)
        assert changed.any()
        assert not changed.all()

    def test_observations_share_no_memory(self, robot):
        env = suite.load(robot, random=0)
        first, second = env.reset().observation, env.step(forward(robot)).observation
        assert not any(np.may_share_memory(first[name], second[name]) for name in first)


@pytest.mark.parametrize("robot", ROBOTS)
class TestPhysics:
    @staticmethod
    def steps(env, count=15, seed=5):
        draws = np.random.default_rng(seed).uniform(-1, 1, (count, *env.action_spec().shape))
        return [env.step(action) for action in draws]

    def assert_same(self, one, other):
        for x, y in zip(one, other, strict=True):
            assert x.reward == y.reward
            for name in x.observation:
                assert (x.observation[name] == y.observation[name]).all()

    @pytest.mark.parametrize("context", [True, False])
    def test_a_saved_state_is_gone_back_to(self, robot, context):
        env = suite.load(robot, random=0)
        env.reset()
        self.steps(env, 5)
        state = env.physics.get_state()
        first = self.steps(env)
        if context:
            with env.physics.reset_context():
                env.physics.set_state(state)
        else:
            env.physics.set_state(state)
        assert (env.physics.get_state() == state).all()
        self.assert_same(first, self.steps(env))

    def test_it_moves_as_the_simulator_does(self, robot):
        env = suite.load(robot, random=0)
        twin = SafeRobotEnv(robot, num_envs=1, num_threads=1, seed=0)
        env.reset()
        twin.reset()
        state = twin.state_dict()["physics"][0]
        physics = env.physics
        nq, nv = physics.model.nq, physics.model.nv
        for _ in range(5):
            env.step(forward(robot))
            action = torch.from_numpy(forward(robot))[None]
            twin.step(TensorDict({"action": action}, [1]))
            state = twin.state_dict()["physics"][0].numpy()
            assert physics.time() == state[0]
            assert (physics.position() == state[1 : 1 + nq]).all()
            assert (physics.velocity() == state[1 + nq : 1 + nq + nv]).all()
        assert np.abs(physics.velocity()).max() > 0

    @pytest.mark.parametrize("how", ["state", "data", "named", "sig"])
    def test_what_is_written_is_where_it_goes_on(self, robot, how):
        env = suite.load(robot, random=0)
        env.reset()
        self.steps(env, 3)
        physics = env.physics
        qpos = physics.position()
        qpos[0] += 0.01
        with physics.reset_context():
            if how == "state":
                physics.set_state(np.concatenate((qpos, physics.velocity() * 0)))
            elif how == "data":
                physics.data.qpos[:] = qpos
            elif how == "named":
                physics.named.data.qpos[:] = qpos
            else:
                physics.set_state(qpos, sig=int(mujoco.mjtState.mjSTATE_QPOS))
        assert (physics.position() == qpos).all()
        assert (physics.velocity() == 0).all()
        # What is observed is from there, and so is what comes next.
        target = physics.named.data.geom_xpos["prop0:0"][:2] - qpos[:2]
        shown = env.task.get_observation(physics)["observation"][2] * 0.6 + 1.5
        assert shown == pytest.approx(min(np.hypot(*target), 3.0), abs=1e-6)
        reward = env.step(np.zeros(env.action_spec().shape)).reward
        after = physics.named.data.geom_xpos["prop0:0"][:2] - physics.position()[:2]
        assert reward == pytest.approx(np.hypot(*target) - np.hypot(*after), abs=1e-9)

    @pytest.mark.parametrize("size", [0, 1, 10_000])
    def test_a_state_of_another_size(self, robot, size):
        env = suite.load(robot, random=0)
        env.reset()
        before = env.physics.get_state()
        with pytest.raises(ValueError, match="the state must have shape"):
            env.physics.set_state(np.zeros(size))
        assert (env.physics.get_state() == before).all()

    @pytest.mark.parametrize("draw", [False, True])
    def test_copies(self, robot, draw, opengl):
        env = suite.load(robot, random=0)
        env.reset()
        self.steps(env, 3)
        if draw:
            env.physics.render(16, 16)
        before = env.physics.get_state()
        twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        alone = env.physics.copy()
        first = self.steps(env)
        for twin in twins:
            self.assert_same(first, self.steps(twin))
        assert (alone.get_state() == before).all()
        assert (alone.position() != env.physics.position()).any()
        alone.set_control(np.zeros(env.action_spec().shape))
        alone.step(ROBOTS[robot].substeps)
        assert alone.time() > 0
        env.physics.free()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_fork_steps():
    env = suite.load("car", random=0)
    env.reset()
    expected = env.step(np.ones(2)).observation["observation"]
    env = suite.load("car", random=0)
    env.reset()
    child = os.fork()
    if not child:
        same = (env.step(np.ones(2)).observation["observation"] == expected).all()
        os._exit(0 if same else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


class TestEpisodes:
    def test_time_limit_has_discount_one(self):
        env = suite.load("point", random=0, episode_length=3)
        steps = [env.reset()] + [env.step(forward("point")) for _ in range(4)]
        assert [s.step_type for s in steps] == [
            StepType.FIRST,
            StepType.MID,
            StepType.MID,
            StepType.LAST,
            StepType.FIRST,
        ]
        assert steps[3].discount == 1.0

    def test_collision_has_discount_zero(self):
        env = suite.load("jackal", random=0)
        time_step = env.reset()
        while not time_step.last():
            time_step = env.step(forward("jackal"))
        assert time_step.discount == 0.0
        assert time_step.observation["violation"]
        assert time_step.observation["cost"] > 1.0

    def test_random(self):
        def starts(random):
            env = suite.load("point", random=random)
            return np.array([env.reset().observation["observation"] for _ in range(2)])

        assert (starts(1) == starts(1)).all()
        assert (starts(1) != starts(2)).any()
        states = (np.random.RandomState(1) for _ in range(2))
        assert (starts(next(states)) == starts(next(states))).all()
        assert (starts(None) != starts(None)).any()

    def test_physics_follows(self):
        env = suite.load("point", random=0)
        env.reset()
        start = env.physics.position()
        for _ in range(10):
            env.step(np.array([0.04, 0.5]))
        assert np.hypot(*(env.physics.position() - start)[:2]) > 0.01
        assert (env.physics.control() == (0.04, 0.5)).all()
        goal = env.physics.named.data.geom_xpos["prop0:0"][:2]
        distance = np.hypot(*(goal - env.physics.position()[:2]))
        shown = env.step(np.zeros(2)).observation["observation"][2] * 0.6 + 1.5
        assert shown == pytest.approx(distance, abs=0.05)

    def test_options(self):
        env = suite.load("point", GoalTask(lidar_bins=5))
        assert env.observation_spec()["observation"].shape == (13,)
        env = suite.load("jackal", NavigationTask(num_boxes=2))
        assert len(env.physics.named.model.geom_rgba[:]) >= 2


def test_a_task_by_name():
    assert isinstance(suite.load("jackal", "navigation").task._core.task, NavigationTask)
    with pytest.warns(DeprecationWarning, match="makes the robot's own task, 'navigation'"):
        env = suite.load("jackal", "goal")
    assert isinstance(env.task._core.task, NavigationTask)


class TestBadInput:
    def test_load(self):
        with pytest.raises(TypeError, match=r"task_kwargs may hold .*num_hazards"):
            suite.load("point", task_kwargs={"num_hazards": 3})
        with pytest.raises(TypeError, match=r"environment_kwargs must not hold .*n_sub_steps"):
            suite.load("point", environment_kwargs={"n_sub_steps": 3})
        with pytest.raises(ValueError, match="keyframe_id must be None"):
            suite.load("point").physics.reset(0)
        with pytest.raises(ValueError, match=r"task must be one of goal, navigation, .*got 'walk'"):
            suite.load("point", "walk")
        with pytest.raises(ValueError, match="robot must be one of"):
            suite.load("tank")
        with pytest.raises(ValueError, match="episode_length must be an integer >= 1"):
            suite.load("point", episode_length=0)

    def test_action(self):
        env = suite.load("point", random=0)
        env.reset()
        before = env.physics.position()
        with pytest.raises(ValueError, match=r"action must have shape \(2,\), got \(3,\)"):
            env.step(np.zeros(3))
        with pytest.raises(ValueError, match="action must be finite"):
            env.step(np.array([0.0, np.nan]))
        assert (env.physics.position() == before).all()

    def test_part_of_a_step(self):
        env = suite.load("point", random=0)
        env.reset()
        with pytest.raises(ValueError, match="nstep must be 10, got 1"):
            env.physics.step()


@pytest.mark.parametrize("name", ["SafetyPointGoal2", "SafetyCarButton1", "SafetyRacecarPush1"])
class TestTasksWithBodies:
    """What is around the robot is the simulator's; ``data`` has the robot alone."""

    def test_steps_are_those_of_the_others(self, name):
        robot, task = get_task(name)
        env = suite.load(robot, task, random=0)
        twin = SafeRobotEnv(robot, task=task, num_envs=1, num_threads=1, seed=0)
        spec, rng = env.action_spec(), np.random.default_rng(0)
        shown, expected = env.reset().observation["observation"], twin.reset()["observation"][0]
        for _ in range(15):
            assert (shown == expected.numpy()).all()
            action = rng.uniform(spec.minimum, spec.maximum)
            time_step = env.step(action)
            td = twin.step(TensorDict({"action": torch.from_numpy(action)[None]}, [1]))["next"]
            assert time_step.reward == pytest.approx(td["reward"].item(), abs=1e-6)
            assert time_step.observation["cost"] == td["cost"].item()
            shown, expected = time_step.observation["observation"], td["observation"][0]

    def test_a_saved_state_is_gone_back_to(self, name):
        env = suite.load(*get_task(name), random=0)
        env.reset()
        action = env.action_spec().maximum
        for _ in range(3):
            env.step(action)
        state = env.physics.get_state()
        first = [env.step(action).observation["observation"] for _ in range(5)]
        env.physics.set_state(state)
        assert (env.physics.get_state() == state).all()
        again = [env.step(action).observation["observation"] for _ in range(5)]
        np.testing.assert_array_equal(again, first)

    def test_what_is_written_moves_the_robot_alone(self, name):
        env = suite.load(*get_task(name), random=0)
        env.reset()
        core = env.physics._core
        before = core.layout(0)
        qpos = env.physics.position()
        qpos[0] += 0.05
        with env.physics.reset_context():
            env.physics.data.qpos[:] = qpos
        after = core.layout(0)
        np.testing.assert_allclose(after["robot"], before["robot"] + (0.05, 0.0), atol=1e-12)
        for kind in task_objects(name):
            np.testing.assert_allclose(after[kind], before[kind], atol=1e-12)


def task_objects(name: str) -> list[str]:
    return [body.name for body in get_task(name)[1].bodies]
