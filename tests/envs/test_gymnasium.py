"""The Gymnasium face: registration, Gymnasium's own checker, what users lean on, bad input."""

from __future__ import annotations

import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from torchrl_safe.envs import ROBOTS, GoalTask, GymGoalEnv, GymGoalVectorEnv

POINT = "torchrl_safe/PointGoal-v0"


def identifier(robot: str) -> str:
    return f"torchrl_safe/{robot.title().replace('_', '')}Goal-v0"


def make_vec(num_envs: int = 3, **options) -> GymGoalVectorEnv:
    return gymnasium.make_vec(POINT, num_envs=num_envs, num_threads=1, **options)


class TestRegistration:
    @pytest.mark.parametrize("robot", ROBOTS)
    def test_make(self, robot):
        env = gymnasium.make(identifier(robot))
        assert isinstance(env.unwrapped, GymGoalEnv)
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space

    @pytest.mark.parametrize("robot", ROBOTS)
    def test_make_vec(self, robot):
        envs = gymnasium.make_vec(identifier(robot), num_envs=3, num_threads=1)
        assert isinstance(envs, GymGoalVectorEnv)
        observations, _ = envs.reset(seed=0)
        assert observations in envs.observation_space

    def test_ids(self):
        robots = ("Point", "Car", "Doggo", "DoggoTorques", "Jackal")
        registered = {name for name in gymnasium.registry if name.startswith("torchrl_safe/")}
        assert registered == {f"torchrl_safe/{robot}Goal-v0" for robot in robots}

    def test_without_an_import(self):
        env = gymnasium.make(f"torchrl_safe.envs:{POINT}")
        assert env.spec.id == POINT

    def test_options_go_through(self):
        env = gymnasium.make(POINT, task=GoalTask(lidar_bins=5), episode_length=2)
        env.reset(seed=0)
        assert env.observation_space.shape == (13,)
        ends = [env.step(env.action_space.sample())[3] for _ in range(2)]
        assert ends == [False, True]

    def test_the_other_vectorizers(self):
        envs = gymnasium.make_vec(POINT, num_envs=2, vectorization_mode="sync")
        envs.reset(seed=0)
        *_, infos = envs.step(envs.action_space.sample())
        assert infos["cost"].shape == (2,)
        assert infos["cost"].dtype == np.float64


@pytest.mark.parametrize("robot", ROBOTS)
def test_gymnasiums_checker(robot):
    """Without a warning, as they are errors here. Its render checks are in test_render."""
    check_env(gymnasium.make(identifier(robot)).unwrapped, skip_render_check=True)


class TestEnv:
    def test_info(self):
        env = gymnasium.make(POINT)
        _, info = env.reset(seed=0)
        *_, stepped = env.step(env.action_space.sample())
        for found in (info, stepped):
            assert {k: type(v) for k, v in found.items()} == {
                "cost": np.float64,
                "violation": np.bool_,
                "violations": np.int64,
                "goal_met": np.bool_,
            }

    def test_seeds(self):
        env, other = gymnasium.make(POINT), gymnasium.make(POINT)
        first = [env.reset(seed=5)[0], env.reset()[0]]
        again = [other.reset(seed=5)[0], other.reset()[0]]
        assert (np.array(first) == again).all()
        assert (first[0] != first[1]).any()
        assert (env.reset(seed=6)[0] != first[0]).any()
        # Without a seed, no two environments are the same.
        assert (GymGoalEnv().reset()[0] != GymGoalEnv().reset()[0]).any()

    def test_snapshot(self):
        env = GymGoalEnv()
        env.reset(seed=0)
        snapshot, layout = env.snapshot(), env.layout()
        first = [env.step(np.array([1.0, 0.3]))[0] for _ in range(3)]
        env.restore(snapshot)
        assert (env.layout()["robot"] == layout["robot"]).all()
        assert (np.array(first) == [env.step(np.array([1.0, 0.3]))[0] for _ in range(3)]).all()

    def test_pickles(self):
        env = GymGoalEnv()
        env.reset(seed=0)
        copy = pickle.loads(pickle.dumps(env))
        action = np.array([0.5, 0.5], np.float32)
        assert (env.step(action)[0] == copy.step(action)[0]).all()


class TestVectorEnv:
    @pytest.mark.parametrize("mode", AutoresetMode)
    def test_mode_is_declared(self, mode):
        for value in (mode, mode.value):
            envs = make_vec(autoreset_mode=value)
            assert envs.metadata["autoreset_mode"] is envs.autoreset_mode is mode
        # Those of the class and of others stay as they were.
        assert GymGoalVectorEnv.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP

    def test_spaces(self):
        envs = make_vec(5)
        assert envs.observation_space.shape == (5, 24)
        assert envs.action_space.shape == (5, 2)
        observations, rewards, terminations, truncations, infos = (
            *envs.reset(seed=0)[:1],
            *envs.step(envs.action_space.sample())[1:],
        )
        assert observations in envs.observation_space
        assert rewards.shape == terminations.shape == truncations.shape == (5,)
        for name in ("cost", "violation", "violations", "goal_met"):
            assert infos[name].shape == (5,)
            assert infos[f"_{name}"].all()

    def test_gymnasiums_wrappers(self):
        envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(make_vec(episode_length=4))
        envs = gymnasium.wrappers.vector.DictInfoToList(envs)
        envs.reset(seed=0)
        for _ in range(4):
            *_, infos = envs.step(envs.action_space.sample())
        assert [info["episode"]["l"] for info in infos] == [4, 4, 4]
        assert all(0.0 < info["cost"] < 1.0 for info in infos)

    def test_results_are_copies(self):
        envs, reference = make_vec(), make_vec()
        observations, infos = envs.reset(seed=0)
        reference.reset(seed=0)
        for value in (observations, *infos.values()):
            value[:] = 1
        action = envs.action_space.sample()
        for value in envs.step(action)[:4]:
            value[:] = 1
        assert (
            envs.step(action)[0] == (reference.step(action), reference.step(action))[1][0]
        ).all()

    def test_partial_reset(self):
        envs = make_vec(autoreset_mode="Disabled")
        envs.reset(seed=0)
        before = envs.step(envs.action_space.sample())[0]
        mask = np.array([True, False, True])
        after, _ = envs.reset(options={"reset_mask": mask})
        assert (after[1] == before[1]).all()
        assert (after[mask] != before[mask]).any(-1).all()

    def test_over_and_not_reset(self):
        envs = make_vec(autoreset_mode="Disabled", episode_length=1)
        envs.reset(seed=0)
        action = envs.action_space.sample()
        envs.step(action)
        with pytest.raises(RuntimeError, match=r"reset environments \[0, 1, 2\] first"):
            envs.step(action)
        envs.reset(options={"reset_mask": np.array([True, False, False])})
        with pytest.raises(RuntimeError, match=r"reset environments \[1, 2\] first"):
            envs.step(action)
        envs.reset()
        envs.step(action)


class TestBadInput:
    @pytest.mark.parametrize("action", [np.zeros(3), np.zeros((1, 2)), 0.5, np.array(["a", "b"])])
    def test_action_shape(self, action):
        env = GymGoalEnv()
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"action must be numbers of shape \(2,\), got"):
            env.step(action)

    def test_action_not_finite_moves_nothing(self):
        env, envs = GymGoalEnv(), make_vec()
        env.reset(seed=0)
        envs.reset(seed=0)
        before, before_vector = env.snapshot(), envs._core.snapshot()
        with pytest.raises(ValueError, match="action must be finite"):
            env.step(np.array([np.nan, 0.0]))
        with pytest.raises(ValueError, match=r"finite; it is not in environments \[1\]"):
            envs.step(np.array([[0.0, 0.0], [np.inf, 0.0], [0.0, 0.0]]))
        for old, core in ((before, env._core), (before_vector, envs._core)):
            assert all((old[name] == value).all() for name, value in core.snapshot().items())

    @pytest.mark.parametrize("cls", [GymGoalEnv, GymGoalVectorEnv])
    def test_constructor(self, cls):
        with pytest.raises(ValueError, match=r"robot must be one of .*'point'.*, got 'tank'"):
            cls("tank")
        with pytest.raises(ValueError, match="render_mode must be None or one of"):
            cls("point", render_mode="ascii")
        with pytest.raises(ValueError, match="episode_length must be an integer >= 1, got 0"):
            cls("point", episode_length=0)
        with pytest.raises(ValueError, match="no legal layout found"):
            cls("point", task=GoalTask(hazard_keepout=1.2))

    def test_vector_constructor(self):
        with pytest.raises(ValueError, match="num_envs must be an integer >= 1, got 0"):
            make_vec(0)
        with pytest.raises(ValueError, match=r"autoreset_mode must be one of .*got 'Later'"):
            make_vec(autoreset_mode="Later")

    def test_reset(self):
        for env in (GymGoalEnv(), make_vec()):
            with pytest.raises(ValueError, match=r"unknown reset options: \['layout'\]"):
                env.reset(options={"layout": 1})
            with pytest.raises(ValueError, match="seed must be None or an integer >= 0"):
                env.reset(seed=-1)
        with pytest.raises(TypeError, match="seed must be one integer or None"):
            make_vec().reset(seed=[1, 2, 3])
        for mask in (np.ones(2, bool), np.ones(3)):
            with pytest.raises(
                ValueError, match=r"reset_mask must be a bool array of shape \(3,\)"
            ):
                make_vec().reset(options={"reset_mask": mask})

    def test_before_reset(self):
        for env in (GymGoalEnv(), make_vec()):
            with pytest.raises(RuntimeError, match="reset the environment"):
                env.step(env.action_space.sample())
