"""The velocity tasks beside Gymnasium's own environments and Safety-Gymnasium's records."""

from __future__ import annotations

import copy
import pickle
import warnings
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from scipy import stats

from torchrl_safe.envs import (
    VELOCITY_TASKS,
    GymVelocityEnv,
    GymVelocityVectorEnv,
    SafeVelocityEnv,
    check_safe_env,
)
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs._velocity import VelocityCore
from torchrl_safe.envs.tasks.velocity import VelocityTask, get_velocity_task

EVERY = pytest.mark.parametrize("task", VELOCITY_TASKS.values(), ids=list(VELOCITY_TASKS))
REFERENCE = np.load(Path(__file__).parent / "reference" / "velocity.npz")
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
# Ahead and in the plane, by Safety-Gymnasium 1.0.0.
LIMITS = {
    "half_cheetah": 3.2096,
    "hopper": 0.7402,
    "walker2d": 2.3415,
    "ant": 2.6222,
    "humanoid": 1.4149,
    "swimmer": 0.2282,
}
IN_THE_PLANE = ("ant", "humanoid")


def identifier(task: VelocityTask) -> str:
    return f"torchrl_safe/Safety{task.title}Velocity-v1"


def original(task: VelocityTask) -> gymnasium.Env:
    """Gymnasium's own environment, bare."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # there is a version 5
        return gymnasium.make(f"{task.title}-v4").unwrapped


def core(task: VelocityTask | str, num_envs: int, **options) -> VelocityCore:
    options = {"num_threads": 1, "seed": 0, "episode_length": 1000} | options
    return VelocityCore(task, num_envs=num_envs, **options)


def put(simulator: VelocityCore, **fields: np.ndarray) -> None:
    """Writes fields of the simulations, by MuJoCo's names, or entries of a snapshot."""
    snapshot = simulator.snapshot()
    model = mujoco.MjModel.from_xml_path(str(simulator.task.asset_path))
    data = mujoco.MjData(model)
    physical = {name: value for name, value in fields.items() if name not in snapshot}
    for row, state in enumerate(snapshot["physics"]):
        mujoco.mj_setState(model, data, state, STATE)
        for name, value in physical.items():
            getattr(data, name)[:] = value[row]
        mujoco.mj_getState(model, data, state, STATE)
    entries = {name: value for name, value in fields.items() if name in snapshot}
    simulator.restore(snapshot | entries)


def get(simulator: VelocityCore, name: str) -> np.ndarray:
    """A field of the simulations, by MuJoCo's name: [N, ...]."""
    model = mujoco.MjModel.from_xml_path(str(simulator.task.asset_path))
    data = mujoco.MjData(model)
    rows = []
    for state in simulator.snapshot()["physics"]:
        mujoco.mj_setState(model, data, state, STATE)
        rows.append(getattr(data, name).copy())
    return np.array(rows)


def random_actions(simulator: VelocityCore, steps: int) -> np.ndarray:
    low, high = simulator.action_range
    size = (steps, simulator.num_envs, simulator.action_dim)
    return np.random.default_rng(1).uniform(low, high, size)


class TestGymnasium:
    """Beside Gymnasium's own environments, from the same states and under the same actions."""

    @EVERY
    def test_every_step(self, task):
        simulator, reference = core(task, 2, num_threads=2), original(task)
        reset = simulator.reset()
        qpos, qvel = get(simulator, "qpos"), get(simulator, "qvel")
        actions = random_actions(simulator, 200)
        frames = [simulator.step(action) for action in actions]
        for row in range(2):
            reference.reset(seed=0)
            reference.set_state(qpos[row], qvel[row])
            np.testing.assert_allclose(reset.observation[row], reference._get_obs(), atol=1e-9)
            for action, frame in zip(actions[:, row], frames, strict=True):
                observation, reward, terminated, _, info = reference.step(action)
                np.testing.assert_allclose(frame.observation[row], observation, atol=1e-9)
                assert frame.reward[row] == pytest.approx(reward, abs=1e-9)
                assert frame.terminated[row] == terminated
                velocity = info["x_velocity"]
                if task.name in IN_THE_PLANE:
                    velocity = np.hypot(velocity, info["y_velocity"])
                assert frame.cost[row] == float(velocity > LIMITS[task.name])
                assert frame.violation[row] == bool(frame.cost[row])

    @EVERY
    def test_the_first_step_after_a_partial_reset(self, task):
        simulator, reference = core(task, 3), original(task)
        simulator.reset()
        actions = random_actions(simulator, 6)
        for action in actions[:5]:
            simulator.step(action)
        frame = simulator.reset(np.array([False, True, False]))
        reference.reset(seed=0)
        reference.set_state(get(simulator, "qpos")[1], get(simulator, "qvel")[1])
        np.testing.assert_allclose(frame.observation[1], reference._get_obs(), atol=1e-9)
        frame = simulator.step(actions[5])
        observation, reward, *_ = reference.step(actions[5, 1])
        np.testing.assert_allclose(frame.observation[1], observation, atol=1e-9)
        assert frame.reward[1] == pytest.approx(reward, abs=1e-9)

    @EVERY
    def test_spaces(self, task):
        ours, theirs = gymnasium.make(identifier(task)), original(task)
        assert ours.observation_space == theirs.observation_space
        assert ours.action_space == theirs.action_space

    @EVERY
    def test_initial_states_are_drawn_alike(self, task):
        ours = core(task, 600).reset().observation
        reference = original(task)
        theirs = np.array([reference.reset(seed=seed)[0] for seed in range(600)])
        joints = [column for column in range(ours.shape[1]) if np.ptp(theirs[:, column]) > 1e-9]
        assert np.array_equal(joints, np.flatnonzero(np.ptp(ours, axis=0) > 1e-9))
        p_values = [stats.ks_2samp(ours[:, j], theirs[:, j]).pvalue for j in joints]
        assert min(p_values) > 1e-3 / len(joints)

    @EVERY
    def test_initial_states_are_independent_across_environments_and_episodes(self, task):
        simulator = core(task, 300)
        first, second = simulator.reset().observation, simulator.reset().observation
        joint = 2  # no robot's is constant
        for x, y in ((first[1:], first[:-1]), (first, second)):
            assert abs(stats.pearsonr(x[:, joint], y[:, joint]).statistic) < 0.25


class TestSafetyGymnasium:
    """Beside steps of Safety-Gymnasium 1.0.0 on MuJoCo 2.3.3, each from its recorded state."""

    @staticmethod
    def replay(task: VelocityTask):
        prefix = f"{task.title}/"
        names = [name for name in REFERENCE if name.startswith(prefix)]
        record = {name.removeprefix(prefix): REFERENCE[name] for name in names}
        simulator = core(task, len(record["reward"]))
        simulator.reset()
        put(simulator, **{k: record[k] for k in ("qpos", "qvel", "qacc_warmstart", "position")})
        return record, simulator.step(record["action"])

    @EVERY
    def test_steps(self, task):
        record, frame = self.replay(replace(task, margin_scale=0.5))
        assert 0.1 < record["cost"].mean() < 0.9  # it is a test of both
        assert np.array_equal(frame.cost, record["cost"])
        assert np.array_equal(frame.terminated, record["terminated"])
        # The Humanoid's solver stops before it has converged, at another place.
        reward_atol, error = (1e-5, 1e-4) if task.name == "humanoid" else (1e-12, 1e-6)
        np.testing.assert_allclose(frame.reward, record["reward"], rtol=0.0, atol=reward_atol)
        scale = np.maximum(np.abs(record["observation"]).max(0), 1.0)  # recorded in float32
        assert (np.abs(frame.observation - record["observation"]) / scale).max() < error

    @EVERY
    def test_on_gymnasium_s_margins_costs_are_still_equal(self, task):
        record, frame = self.replay(task)
        assert np.array_equal(frame.cost, record["cost"])
        assert np.array_equal(frame.terminated, record["terminated"])
        largest = {"ant": 0.5, "hopper": 0.02, "humanoid": 0.01}.get(task.name, 1e-12)
        np.testing.assert_allclose(frame.reward, record["reward"], rtol=0.0, atol=largest)

    @EVERY
    def test_the_limits(self, task):
        assert task.velocity_threshold == LIMITS[task.name]
        assert task.planar == (task.name in IN_THE_PLANE)


class TestCost:
    @EVERY
    def test_by_hand(self, task):
        simulator = core(task, 40)
        simulator.reset()
        qvel = get(simulator, "qvel")
        qvel[:, 0] = np.linspace(-2.5, 2.5, 40) * task.velocity_threshold
        put(simulator, qvel=qvel)
        costs = []
        for action in random_actions(simulator, 10):
            before = simulator.snapshot()["position"]
            frame = simulator.step(action)
            way = simulator.snapshot()["position"] - before
            speed = np.linalg.norm(way, axis=1) if task.planar else way[:, 0]
            limit = task.velocity_threshold * simulator.seconds
            costs.append(frame.cost)
            assert np.array_equal(frame.cost, (speed > limit).astype(float))
        assert 0.1 < np.mean(costs) < 0.9

    def test_running_backwards_counts_in_the_plane_only(self):
        back = np.array([[-9.0, 0.0]])
        assert get_velocity_task("ant").speed(back) == 9.0
        assert get_velocity_task("walker2d").speed(back[:, :1]) == -9.0

    def test_another_limit(self):
        env = SafeVelocityEnv(
            replace(VELOCITY_TASKS["half_cheetah"], velocity_threshold=0.0), num_envs=8
        )
        rollout = env.rollout(20, break_when_any_done=False)
        forward = rollout["next", "cost"] == 1.0
        assert 0.05 < forward.float().mean() < 0.95


class TestEpisodes:
    @pytest.mark.parametrize("name", ["hopper", "walker2d", "ant", "humanoid"])
    def test_unhealthy_robots_terminate(self, name):
        simulator = core(name, 4)
        simulator.reset()
        qpos = get(simulator, "qpos")
        qpos[1:3, 2] = 5.0  # too high, or leaning too far
        put(simulator, qpos=qpos)
        frame = simulator.step(np.zeros((4, simulator.action_dim)))
        assert frame.terminated.tolist() == [False, True, True, False]
        assert not frame.truncated.any()
        # The step that ends an episode is paid for being healthy, too, as in Gymnasium.
        assert (frame.reward > simulator.task.healthy_reward - 3.0).all()

    @pytest.mark.parametrize("name", ["half_cheetah", "swimmer"])
    def test_some_never_do(self, name):
        rollout = SafeVelocityEnv(name, num_envs=4).rollout(50, break_when_any_done=False)
        assert not rollout["next", "terminated"].any()

    def test_time_limit_and_stagger(self):
        env = SafeVelocityEnv("swimmer", num_envs=4, episode_length=8, stagger=True)
        rollout = env.rollout(8, break_when_any_done=False)
        steps = rollout["next", "truncated"].squeeze(-1).float().argmax(1)
        assert steps.tolist() == [7, 5, 3, 1]

    @pytest.mark.parametrize("name", ["hopper", "ant", "humanoid"])
    def test_a_simulation_that_diverges(self, name):
        env = SafeVelocityEnv(name, num_envs=3, num_threads=1)
        td = env.reset()
        td = env.step(td.update(env.full_action_spec.rand()))["next"].exclude("reward", "cost")
        put(env._core, qvel=get(env._core, "qvel") * np.array([[1.0], [1e12], [1.0]]))
        after = env.step(td.update(env.full_action_spec.rand()))["next"]
        assert after["diverged"].flatten().tolist() == [False, True, False]
        assert after["truncated"].flatten().tolist() == [False, True, False]
        assert not after["terminated"][1]
        assert after["reward"][1] == 0.0
        assert torch.equal(after["observation"][1], td["observation"][1])
        assert env.instabilities == 1
        env.reset(after.select().set("_reset", after["diverged"].clone()))
        later = env.rollout(5, auto_reset=False, tensordict=env.reset())
        assert not later["next", "diverged"].any()


class TestTorchRL:
    @EVERY
    def test_contract(self, task):
        env, twin = (
            SafeVelocityEnv(task.name, num_envs=3, num_threads=threads, episode_length=9)
            for threads in (1, 2)
        )
        check_safe_env(env, twins=[twin], time_limit=9)

    @EVERY
    def test_a_new_environment_goes_on_from_a_state(self, task):
        first = SafeVelocityEnv(task.name, num_envs=3, num_threads=1, seed=5)
        td = first.reset()
        actions = [first.full_action_spec.rand() for _ in range(12)]
        for action in actions[:6]:
            td = first.step_and_maybe_reset(td.update(action))[1]
        state, start = first.state_dict(), td.clone()

        def go_on(env: SafeVelocityEnv) -> list[torch.Tensor]:
            steps, td = [], start.clone()
            for action in actions[6:]:
                stepped, td = env.step_and_maybe_reset(td.update(action))
                steps.append(torch.cat([stepped["next", "observation"], td["observation"]]))
            return steps

        expected = go_on(first)
        second = SafeVelocityEnv(task.name, num_envs=3, num_threads=2, seed=9)
        second.load_state_dict(state)
        assert all(map(torch.equal, go_on(second), expected))

    def test_a_state_of_another_task_changes_nothing(self):
        env = SafeVelocityEnv("hopper", num_envs=2)
        env.reset()
        before = env.state_dict()
        with pytest.raises(ValueError, match="'physics'"):
            env.load_state_dict(SafeVelocityEnv("ant", num_envs=2).state_dict())
        env.load_state_dict({})
        after = env.state_dict()
        assert all(torch.equal(before[name], after[name]) for name in before)

    def test_episodes_depend_on_the_seed_and_the_index_alone(self):
        few, many = (SafeVelocityEnv("ant", num_envs=n, seed=4).reset() for n in (2, 5))
        assert torch.equal(few["observation"], many["observation"][:2])

    def test_actions_beyond_the_range_are_clipped(self):
        env = SafeVelocityEnv("humanoid", num_envs=1, num_threads=1)
        assert env.action_spec.space.high.unique().tolist() == pytest.approx([0.4])
        env.reset()
        state, steps = env.state_dict(), []
        for size in (0.4, 7.0):
            env.load_state_dict(state)
            td = env.step(env.full_action_spec.zero().apply(lambda x, size=size: x + size))
            steps.append(td["next", "reward"].item())
        assert steps[0] == pytest.approx(steps[1], abs=1e-6)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"task": "dog"}, "task must be one of"),
            ({"num_envs": 0}, "num_envs must be an integer >= 1"),
            ({"num_threads": 1.5}, "num_threads must be an integer >= 1"),
            ({"episode_length": True}, "episode_length must be an integer >= 1"),
            ({"seed": -1}, "seed must be None or an integer >= 0"),
        ],
    )
    def test_bad_options(self, options, message):
        with pytest.raises(ValueError, match=message):
            SafeVelocityEnv(**options)

    def test_bad_tasks(self):
        with pytest.raises(TypeError, match="task must be a VelocityTask"):
            SafeVelocityEnv(3)
        for name in ("velocity_threshold", "margin_scale"):
            with pytest.raises(ValueError, match=f"{name} must be finite"):
                replace(VELOCITY_TASKS["ant"], **{name: -1.0})
        with pytest.raises(ValueError, match="frame_skip must be an integer >= 1"):
            replace(VELOCITY_TASKS["ant"], frame_skip=0)

    def test_bad_actions_move_nothing(self):
        simulator = core("hopper", 2)
        with pytest.raises(RuntimeError, match="reset the environment"):
            simulator.step(np.zeros((2, 3)))
        simulator.reset()
        before = simulator.snapshot()
        with pytest.raises(ValueError, match=r"action must have shape \(2, 3\)"):
            simulator.step(np.zeros((2, 4)))
        with pytest.raises(ValueError, match=r"not in environments \[1\]"):
            simulator.step(np.array([[0.0] * 3, [np.nan] * 3]))
        after = simulator.snapshot()
        assert all(np.array_equal(before[name], after[name]) for name in before)

    def test_partial_steps_and_closed_environments(self):
        env = SafeVelocityEnv("hopper", num_envs=2)
        td = env.reset().update(env.full_action_spec.rand())
        with pytest.raises(NotImplementedError, match="all of its environments"):
            env._step(td.clone().set("_step", torch.ones(2, 1, dtype=torch.bool)))
        with pytest.raises(ValueError, match="_reset must have shape"):
            env._reset(td.select().set("_reset", torch.ones(2, 3, dtype=torch.bool)))
        env.close()
        with pytest.raises(RuntimeError, match="closed"):
            env._step(td)


def steps_of_torchrl(task: VelocityTask, num_envs: int) -> Iterator[dict[str, np.ndarray]]:
    env = SafeVelocityEnv(task.name, num_envs=num_envs, num_threads=1, seed=3, episode_length=17)
    td = env.reset()
    for action in random_actions(env._core, 40).astype(np.float32):
        stepped, td = env.step_and_maybe_reset(td.update({"action": torch.from_numpy(action)}))
        yield {
            "observation": td["observation"].numpy(),
            **{k: stepped["next", k][..., 0].numpy() for k in ("reward", "cost", "violation")},
        }


class TestFaces:
    @EVERY
    def test_the_vector_environment_makes_the_same_steps(self, task):
        envs = gymnasium.make_vec(
            identifier(task),
            num_envs=3,
            num_threads=2,
            episode_length=17,
            autoreset_mode="SameStep",
        )
        envs.reset(seed=3)
        actions = random_actions(core(task, 3), 40).astype(np.float32)
        for action, expected in zip(actions, steps_of_torchrl(task, 3), strict=True):
            observations, rewards, _, _, infos = envs.step(action)
            assert np.array_equal(observations.astype(np.float32), expected["observation"])
            assert np.array_equal(rewards.astype(np.float32), expected["reward"])
            assert np.array_equal(infos["cost"], expected["cost"])
            assert np.array_equal(infos["violation"], expected["violation"])

    @EVERY
    def test_the_single_environment_makes_the_same_steps(self, task):
        env = GymVelocityEnv(task.name, episode_length=17)
        env.reset(seed=3)
        actions = random_actions(core(task, 1), 40).astype(np.float32)
        for action, expected in zip(actions, steps_of_torchrl(task, 1), strict=True):
            observation, reward, terminated, truncated, info = env.step(action[0])
            if terminated or truncated:
                observation, _ = env.reset()
            assert np.array_equal(observation.astype(np.float32), expected["observation"][0])
            assert np.float32(reward) == expected["reward"][0]
            assert info == {"cost": expected["cost"][0], "violation": expected["violation"][0]}

    @EVERY
    def test_gymnasium_s_checker(self, task):
        with warnings.catch_warnings():
            # That observations have no bounds, as Gymnasium's own have none.
            warnings.filterwarnings("ignore", message=".*(infinity|-infinity|render).*")
            check_env(gymnasium.make(identifier(task)).unwrapped)

    def test_registration(self):
        env = gymnasium.make(identifier(VELOCITY_TASKS["half_cheetah"]))
        assert isinstance(env.unwrapped, GymVelocityEnv)
        assert env.spec.max_episode_steps == 1000
        envs = gymnasium.make_vec("torchrl_safe/SafetyAntVelocity-v1", num_envs=2, num_threads=1)
        assert isinstance(envs, GymVelocityVectorEnv)
        assert envs.spec.max_episode_steps == 1000

    def test_copies_and_pickles_go_on(self):
        env = GymVelocityEnv("humanoid")
        env.reset(seed=0)
        action = np.full(17, 0.1, np.float32)
        env.step(action)
        others = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
        for _ in range(3):
            observation, reward, *_ = env.step(action)
            for other in others:
                again = other.step(action)
                assert np.array_equal(again[0], observation)
                assert again[1] == reward

    def test_snapshots_are_a_way_back(self):
        env = GymVelocityEnv("ant")
        env.reset(seed=0)
        snapshot = env.snapshot()
        expected = env.step(np.ones(8))[0]
        env.restore(snapshot)
        assert np.array_equal(env.step(np.ones(8))[0], expected)

    @pytest.mark.parametrize("mode", list(AutoresetMode))
    def test_autoreset(self, mode):
        envs = GymVelocityVectorEnv(
            "swimmer", num_envs=4, episode_length=4, stagger=True, autoreset_mode=mode
        )
        _, infos = envs.reset(seed=0)
        assert not infos["cost"].any()
        action = np.zeros((4, 2), np.float32)
        *_, truncations, infos = envs.step(action)
        assert truncations.tolist() == [False, False, False, True]
        if mode is AutoresetMode.SAME_STEP:
            assert infos["_final_obs"].tolist() == truncations.tolist()
            assert infos["final_obs"][3].shape == (8,)
            assert infos["final_info"]["cost"][3] == infos["cost"][3]
        elif mode is AutoresetMode.NEXT_STEP:
            _, rewards, _, truncations, infos = envs.step(action)
            assert (rewards[3], infos["cost"][3]) == (0.0, 0.0)
            assert infos["_cost"].all()
            assert truncations.tolist() == [False, False, True, False]
        else:
            with pytest.raises(RuntimeError, match=r"reset environments \[3\]"):
                envs.step(action)
            _, infos = envs.reset(options={"reset_mask": truncations})
            assert infos["_cost"].tolist() == truncations.tolist()
            envs.step(action)

    def test_seeds(self):
        envs = GymVelocityVectorEnv("hopper", num_envs=2, num_threads=1)
        observations, _ = envs.reset(seed=[7, 8])
        for row, seed in enumerate((7, 8)):
            assert np.array_equal(GymVelocityEnv("hopper").reset(seed=seed)[0], observations[row])
        assert np.array_equal(envs.reset(seed=[7, 8])[0], observations)
        assert not np.array_equal(envs.reset()[0], observations)
        for bad, message in (([1], "one or 2"), (-1, "seed must be")):
            with pytest.raises(ValueError, match=message):
                envs.reset(seed=bad)

    def test_bad_input(self):
        env = GymVelocityEnv("hopper")
        with pytest.raises(ValueError, match="unknown reset options"):
            env.reset(options={"speed": 1})
        with pytest.raises(ValueError, match="render_mode must be None"):
            GymVelocityEnv("hopper", render_mode="rgb_array")
        with pytest.raises(ValueError, match="autoreset_mode must be one of"):
            GymVelocityVectorEnv("hopper", autoreset_mode="Never")
        envs = GymVelocityVectorEnv("hopper", num_envs=2)
        with pytest.raises(ValueError, match="reset_mask must be a bool array"):
            envs.reset(options={"reset_mask": np.ones(2)})
        env.reset(seed=0)
        env.close()
        with pytest.raises(RuntimeError, match="closed"):
            env.step(np.zeros(3))


class TestTask:
    def test_uniform_noise_is_uniform_and_normal_noise_normal(self):
        for name, law in (("swimmer", stats.uniform(-1, 2)), ("ant", stats.norm())):
            task = VELOCITY_TASKS[name]
            qpos, qvel = task.sample(np.full(3, 2.0), 4, RandomStreams(0, 5000), np.arange(5000))
            assert (np.abs(qpos - 2.0) <= task.reset_noise_scale).all()
            noise = (qvel / task.reset_noise_scale).ravel()
            assert stats.kstest(noise, law.cdf).pvalue > 1e-3
            assert np.isfinite(qvel).all()

    def test_tasks_travel_to_other_processes(self):
        for task in VELOCITY_TASKS.values():
            assert pickle.loads(pickle.dumps(task)) == task
