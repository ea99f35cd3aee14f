"""The Gymnasium interface: registration, Gymnasium's own checker, what users lean on, bad input."""

from __future__ import annotations

import copy
import json
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from torchrl_safe.envs import ROBOTS, GoalTask, GymRobotEnv, GymRobotVectorEnv

POINT = "torchrl_safe/PointGoal-v0"


def identifier(robot: str) -> str:
    return f"torchrl_safe/{robot.title().replace('_', '')}Goal-v0"


def make_vec(num_envs: int = 3, **options) -> GymRobotVectorEnv:
    return gymnasium.make_vec(POINT, num_envs=num_envs, num_threads=1, **options)


class TestRegistration:
    @pytest.mark.parametrize("robot", ROBOTS)
    def test_make(self, robot):
        env = gymnasium.make(identifier(robot))
        assert isinstance(env.unwrapped, GymRobotEnv)
        observation, _ = env.reset(seed=0)
        assert observation in env.observation_space

    @pytest.mark.parametrize("robot", ROBOTS)
    def test_make_vec(self, robot):
        envs = gymnasium.make_vec(identifier(robot), num_envs=3, num_threads=1)
        assert isinstance(envs, GymRobotVectorEnv)
        observations, _ = envs.reset(seed=0)
        assert observations in envs.observation_space

    def test_ids(self):
        robots = ("Point", "Car", "Doggo", "DoggoTorques", "Jackal")
        registered = {name for name in gymnasium.registry if name.startswith("torchrl_safe/")}
        goals = {name for name in registered if name.endswith("Goal-v0")}
        assert goals == {f"torchrl_safe/{robot}Goal-v0" for robot in robots}
        robots = ("HalfCheetah", "Hopper", "Walker2d", "Ant", "Humanoid", "Swimmer")
        assert registered >= {f"torchrl_safe/Safety{robot}Velocity-v1" for robot in robots}

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
@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")
def test_gymnasiums_checker(robot):
    """With one warning, of what is so. Its render checks are in test_render."""
    check_env(gymnasium.make(identifier(robot)).unwrapped, skip_render_check=True)


class TestLength:
    """Gymnasium has a name for it, and whoever reads the spec must find what is so."""

    @staticmethod
    def steps(env) -> int:
        env.reset(seed=0)
        for count in range(1, 2_000):
            *_, terminated, truncated, _ = env.step(0.0 * env.action_space.sample())
            if np.any(terminated | truncated):
                return count
        return 0

    @pytest.mark.parametrize(
        ("options", "length"),
        [
            ({}, 1000),
            ({"episode_length": 7}, 7),
            ({"episode_length": 1_200}, 1_200),
            ({"max_episode_steps": 7}, 7),
            ({"max_episode_steps": 7, "episode_length": 7}, 7),
        ],
    )
    @pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
    def test_is_what_the_spec_says(self, make, options, length):
        env = make(POINT, **options)
        assert self.steps(env) == length
        assert env.spec.max_episode_steps == length
        assert make(env.spec).spec.max_episode_steps == length

    def test_cut_from_outside(self):
        options = {"max_episode_steps": 5, "vectorization_mode": "sync"}
        assert self.steps(gymnasium.make_vec(POINT, num_envs=2, **options)) == 5

    def test_the_task_knows_it(self):
        """A collision counts for the steps that would have remained."""
        envs = [
            gymnasium.make_vec(identifier("jackal"), num_envs=8, num_threads=1, **{name: 300})
            for name in ("episode_length", "max_episode_steps")
        ]
        for env in envs:
            env.reset(seed=0)
        for step in range(300):
            action = np.tile(np.float32([1.0, 0.0]), (8, 1))
            (*_, terminated, _, infos), (*_, infos_too) = (env.step(action) for env in envs)
            assert (infos["violations"] == infos_too["violations"]).all()
            if terminated.any():
                assert (infos["violations"][terminated] == 300 - step).all()
                return
        pytest.fail("no robot met anything")

    def test_rejects(self):
        with pytest.raises(ValueError, match="two names of one thing, got 5 and 6"):
            make_vec(episode_length=5, max_episode_steps=6)
        with pytest.raises(ValueError, match="max_episode_steps must be at least 1, got -1"):
            make_vec(max_episode_steps=-1)


class TestBounds:
    """Nothing bounds where a robot is, and wrappers that divide by bounds must hear of it."""

    def test_wrappers_refuse(self):
        with pytest.raises(ValueError, match="unbounded"):
            gymnasium.wrappers.RescaleObservation(
                gymnasium.make(POINT), np.float32(-1), np.float32(1)
            )
        with pytest.raises(ValueError, match="to be finite"):
            gymnasium.wrappers.DiscretizeObservation(gymnasium.make(POINT), bins=5)

    def test_wrappers_that_measure(self):
        env = gymnasium.wrappers.NormalizeObservation(gymnasium.make(POINT))
        env.reset(seed=0)
        seen = np.array([env.step(env.action_space.sample())[0] for _ in range(200)])
        assert np.abs(seen).max() > 0.1


class TestResetIsNoStep:
    """Whoever adds up infos has n costs for n rewards."""

    @staticmethod
    def plain(num_envs, seeds, steps, length) -> np.ndarray:
        """Sums of reward and cost over the steps of single environments, [2, N]."""
        sums = np.zeros((2, num_envs))
        for row, seed in enumerate(seeds):
            env = GymRobotEnv(episode_length=length)
            env.reset(seed=seed)
            count = 0
            while count < steps:
                _, reward, _, truncated, info = env.step(np.ones(2))
                sums[:, row] += reward, info["cost"]
                count += 1
                if truncated:
                    env.reset()
                    count += 1  # which takes a step of NEXT_STEP
        return sums

    @pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
    def test_next_step(self, mode):
        seeds = [4, 5]
        envs = gymnasium.make_vec(POINT, num_envs=2, vectorization_mode=mode, episode_length=3)
        envs.reset(seed=seeds)
        sums = np.zeros((2, 2))
        for step in range(1, 9):
            _, rewards, _, _, infos = envs.step(np.ones((2, 2), np.float32))
            sums += rewards, infos["cost"]
            assert infos["_cost"].all()
            assert (infos["cost"] == 0).all() == (step % 4 == 0)
            if step % 4 == 0:
                assert not (infos["violation"] | infos["goal_met"]).any()
                assert (infos["violations"] == 0).all()
        assert sums == pytest.approx(self.plain(2, seeds, 8, 3))

    def test_after_a_reset(self):
        zero = {"cost": 0.0, "violation": False, "violations": 0, "goal_met": False}
        env, envs = GymRobotEnv(), make_vec(autoreset_mode="Disabled")
        assert env.reset(seed=0)[1] == zero
        env.reset()[1]["cost"] = 9.0
        assert env.reset()[1] == zero
        _, infos = envs.reset(seed=0)
        assert all((infos[name] == 0).all() and infos[f"_{name}"].all() for name in zero)
        # Of those that are left alone, it says as little as Gymnasium's own.
        envs.step(envs.action_space.sample())
        mask = np.array([True, False, True])
        _, infos = envs.reset(options={"reset_mask": mask})
        assert all((infos[name] == 0).all() for name in zero)
        assert all((infos[f"_{name}"] == mask).all() for name in zero)


class TestSeeds:
    """Of vector environments, against Gymnasium's own and against single ones."""

    @staticmethod
    def sync(num_envs=3):
        mode = gymnasium.vector.AutoresetMode.DISABLED
        return gymnasium.make_vec(
            POINT,
            num_envs=num_envs,
            vectorization_mode="sync",
            vector_kwargs={"autoreset_mode": mode},
        )

    @pytest.mark.parametrize("kind", [list, tuple, np.array])
    def test_one_for_each(self, kind):
        envs, singles = make_vec(autoreset_mode="Disabled"), [GymRobotEnv() for _ in range(3)]
        seeds = [9, 9, 2]
        expected = np.array([env.reset(seed=s)[0] for env, s in zip(singles, seeds, strict=True)])
        found, _ = envs.reset(seed=kind(seeds))
        assert (found == expected).all()
        assert (self.sync().reset(seed=seeds)[0] == expected).all()
        # And the episodes after it.
        assert (envs.reset()[0] == np.array([env.reset()[0] for env in singles])).all()

    def test_none_goes_on(self):
        envs, singles = make_vec(), [GymRobotEnv() for _ in range(3)]
        for env, seed in zip(singles, [1, 2, 3], strict=True):
            env.reset(seed=seed)
        envs.reset(seed=[1, 2, 3])
        expected = [singles[0].reset(seed=7)[0], singles[1].reset()[0], singles[2].reset()[0]]
        assert (envs.reset(seed=[7, None, None])[0] == np.array(expected)).all()

    @pytest.mark.parametrize("seed", [7, [7, 8, 9], [7, None, 9]])
    def test_a_masked_reset_seeds_what_it_resets(self, seed):
        mask = np.array([True, False, False])
        envs, reference = make_vec(autoreset_mode="Disabled"), make_vec(autoreset_mode="Disabled")
        for env in (envs, reference):
            env.reset(seed=[1, 2, 3])
        first, _ = envs.reset(seed=seed, options={"reset_mask": mask})
        again, _ = envs.reset(seed=seed, options={"reset_mask": mask})
        assert (first[0] == again[0]).all()
        assert (envs.reset()[0][1:] == reference.reset()[0][1:]).all()
        whole = make_vec().reset(seed=seed)[0]
        assert (first[0] == whole[0]).all()

    def test_options_are_left_alone(self):
        options = {"reset_mask": np.array([True, False, False])}
        make_vec().reset(options=options)
        assert list(options) == ["reset_mask"]


@pytest.mark.parametrize("make", [GymRobotEnv, make_vec], ids=["single", "vector"])
class TestCopies:
    @pytest.mark.parametrize("clone", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
    @pytest.mark.parametrize("drawn", [False, True])
    def test_go_on_alike(self, make, clone, drawn):
        env = make(render_mode="rgb_array")
        env.reset(seed=0)
        action = np.full(env.action_space.shape, 0.5, np.float32)
        env.step(action)
        if drawn:
            before = env.render()
        other = clone(env)
        assert (env.step(action)[0] == other.step(action)[0]).all()
        assert (env.reset()[0] == other.reset()[0]).all()
        if drawn:
            assert (np.array(env.render()) == np.array(other.render())).all()
            assert np.array(before).shape == np.array(other.render()).shape
        # Neither moves the other.
        env.step(action)
        assert (other.step(action)[0] == env._core.frame.observation.squeeze()).all()
        env.close()
        other.step(action)
        other.close()

    def test_closed(self, make):
        env = make(render_mode="rgb_array")
        env.reset(seed=0)
        env.close()
        env.close()
        for call in (env.reset, lambda: env.step(env.action_space.sample()), env.render):
            with pytest.raises(RuntimeError, match="the environment is closed: make another"):
                call()


def test_made_ones_copy():
    env = gymnasium.make(POINT, render_mode="rgb_array", episode_length=9)
    env.reset(seed=0)
    env.render()
    other = copy.deepcopy(env)
    assert other.spec.max_episode_steps == 9
    assert (env.step(np.ones(2))[0] == other.step(np.ones(2))[0]).all()
    env.close()
    other.close()


class TestEnv:
    def test_info(self):
        env = gymnasium.make(POINT)
        _, info = env.reset(seed=0)
        *_, stepped = env.step(env.action_space.sample())
        for found in (info, stepped):
            assert {k: type(v) for k, v in found.items()} == {
                "cost": float,
                "violation": bool,
                "violations": int,
                "goal_met": bool,
            }
            assert json.loads(json.dumps(found)) == found

    @pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
    def test_info_in_arrays(self, mode):
        envs = gymnasium.make_vec(POINT, num_envs=2, vectorization_mode=mode)
        envs.reset(seed=0)
        *_, infos = envs.step(envs.action_space.sample())
        assert {k: v.dtype for k, v in infos.items() if k[0] != "_"} == {
            "cost": np.float64,
            "violation": np.bool_,
            "violations": np.int64,
            "goal_met": np.bool_,
        }
        envs.close()

    def test_seeds(self):
        env, other = gymnasium.make(POINT), gymnasium.make(POINT)
        first = [env.reset(seed=5)[0], env.reset()[0]]
        again = [other.reset(seed=5)[0], other.reset()[0]]
        assert (np.array(first) == again).all()
        assert (first[0] != first[1]).any()
        assert (env.reset(seed=6)[0] != first[0]).any()
        # Without a seed, no two environments are the same.
        assert (GymRobotEnv().reset()[0] != GymRobotEnv().reset()[0]).any()

    def test_snapshot(self):
        env = GymRobotEnv()
        env.reset(seed=0)
        snapshot, layout = env.snapshot(), env.layout()
        first = [env.step(np.array([1.0, 0.3]))[0] for _ in range(3)]
        env.restore(snapshot)
        assert (env.layout()["robot"] == layout["robot"]).all()
        assert (np.array(first) == [env.step(np.array([1.0, 0.3]))[0] for _ in range(3)]).all()


class TestVectorEnv:
    @pytest.mark.parametrize("mode", AutoresetMode)
    def test_mode_is_declared(self, mode):
        for value in (mode, mode.value):
            envs = make_vec(autoreset_mode=value)
            assert envs.metadata["autoreset_mode"] is envs.autoreset_mode is mode
        # Those of the class and of others stay as they were.
        assert GymRobotVectorEnv.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP

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
        env = GymRobotEnv()
        env.reset(seed=0)
        with pytest.raises(ValueError, match=r"action must be numbers of shape \(2,\), got"):
            env.step(action)

    def test_action_not_finite_moves_nothing(self):
        env, envs = GymRobotEnv(), make_vec()
        env.reset(seed=0)
        envs.reset(seed=0)
        before, before_vector = env.snapshot(), envs._core.snapshot()
        with pytest.raises(ValueError, match="action must be finite"):
            env.step(np.array([np.nan, 0.0]))
        with pytest.raises(ValueError, match=r"finite; it is not in environments \[1\]"):
            envs.step(np.array([[0.0, 0.0], [np.inf, 0.0], [0.0, 0.0]]))
        for old, core in ((before, env._core), (before_vector, envs._core)):
            assert all((old[name] == value).all() for name, value in core.snapshot().items())

    @pytest.mark.parametrize("cls", [GymRobotEnv, GymRobotVectorEnv])
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
        for env in (GymRobotEnv(), make_vec()):
            with pytest.raises(ValueError, match=r"unknown reset options: \['layout'\]"):
                env.reset(options={"layout": 1})
            with pytest.raises(ValueError, match="seed must be None or an integer >= 0"):
                env.reset(seed=-1)
        with pytest.raises(ValueError, match="seed must be one or 3, got 2 of them"):
            make_vec().reset(seed=[1, 2])
        with pytest.raises(ValueError, match=r"seed must be None or an integer >= 0, got 1\.5"):
            make_vec().reset(seed=1.5)
        for bad in (-1, 0.5, "a"):
            with pytest.raises(ValueError, match=r"seed\[1\] must be None or an integer >= 0"):
                make_vec().reset(seed=[1, bad, 2])
        for mask in (np.ones(2, bool), np.ones(3)):
            with pytest.raises(
                ValueError, match=r"reset_mask must be a bool array of shape \(3,\)"
            ):
                make_vec().reset(options={"reset_mask": mask})

    def test_before_reset(self):
        for env in (GymRobotEnv(), make_vec()):
            with pytest.raises(RuntimeError, match="reset the environment"):
                env.step(env.action_space.sample())
