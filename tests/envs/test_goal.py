"""The batched environment: physics, episodes, contracts with TorchRL."""

from __future__ import annotations

import math
import pickle
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.envs import RewardSum, StepCounter, TransformedEnv
from torchrl.envs.utils import RandomPolicy, check_env_specs

from torchrl_safe.envs import GoalTask, SafeRobotEnv, get_robot

# Point, written from the published numbers and with its contacts on.
PLAIN_POINT = """
<mujoco>
  <option timestep=".002"/>
  <default>
    <geom condim="6" density="1"/>
    <motor ctrllimited="true" ctrlrange="-1 1" forcelimited="true" forcerange="-.05 .05"/>
    <velocity ctrllimited="true" ctrlrange="-1 1" forcelimited="true" forcerange="-.05 .05"/>
  </default>
  <worldbody>
    <geom type="plane" size="5 5 .1"/>
    <body name="robot" pos="0 0 .1">
      <joint type="slide" axis="1 0 0" damping=".01"/>
      <joint type="slide" axis="0 1 0" damping=".01"/>
      <joint name="turn" type="hinge" axis="0 0 1" damping=".005"/>
      <geom type="sphere" size=".1" friction="1 .01 .01"/>
      <geom type="box" size=".05 .05 .05" pos=".1 0 0"/>
      <site name="imu"/>
    </body>
  </worldbody>
  <actuator>
    <motor site="imu" gear=".3 0 0 0 0 0"/>
    <velocity joint="turn" gear=".3"/>
  </actuator>
  <sensor>
    <velocimeter name="velocity" site="imu"/>
    <gyro name="gyro" site="imu"/>
    <accelerometer name="acceleration" site="imu"/>
  </sensor>
</mujoco>
"""


def make(num_envs: int = 6, num_threads: int = 1, **options) -> SafeRobotEnv:
    return SafeRobotEnv("point", num_envs=num_envs, num_threads=num_threads, **options)


def actions(steps: int, num_envs: int = 6, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(steps, num_envs, 2, generator=generator) * 2 - 1


def drive(env: SafeRobotEnv, controls: torch.Tensor, *, reset: bool = True) -> TensorDict:
    """Steps under fixed actions, resetting what is done: [T, N]."""
    td = env.reset() if reset else env.reset(no_reset(env))
    steps = []
    for control in controls:
        td["action"] = control.clone()
        step, td = env.step_and_maybe_reset(td)
        steps.append(step)
    return torch.stack(steps)


def no_reset(env: SafeRobotEnv) -> TensorDict:
    mask = torch.zeros(*env.batch_size, 1, dtype=torch.bool)
    frame = env.fake_tensordict().exclude("next", "action")
    return frame.set("_reset", mask)


def seek(env: SafeRobotEnv) -> torch.Tensor:
    """Actions that turn to the goal and drive at it."""
    out = torch.zeros(*env.batch_size, 2)
    for i in range(len(out)):
        layout = env.layout(i)
        x, y = layout["goal"] - layout["robot"]
        ahead = layout["heading"] @ (x, y)
        left = layout["heading"] @ (y, -x)
        angle = math.atan2(left, ahead)
        out[i, 0] = 1.0 if abs(angle) < 0.5 else 0.0
        out[i, 1] = np.clip(2 * angle, -1, 1)
    return out


def equal(x: TensorDict, y: TensorDict) -> bool:
    return bool((x == y).all())


class TestSpecs:
    @pytest.mark.parametrize("stagger", [False, True])
    @pytest.mark.parametrize("num_envs", [1, 5])
    def test_check_env_specs(self, num_envs, stagger):
        check_env_specs(make(num_envs, stagger=stagger, episode_length=7), seed=0)

    def test_keys_shapes_dtypes(self):
        step = make(3).rollout(2)[:, 0]
        root = {
            "observation": (24, torch.float32),
            "violation": (1, torch.bool),
            "violations": (1, torch.int64),
            "goal_met": (1, torch.bool),
            "diverged": (1, torch.bool),
            "done": (1, torch.bool),
            "terminated": (1, torch.bool),
            "truncated": (1, torch.bool),
        }
        following = root | {"reward": (1, torch.float32), "cost": (1, torch.float32)}
        for td, expected in ((step.exclude("next", "action"), root), (step["next"], following)):
            assert set(td.keys()) == set(expected)
            for key, (size, dtype) in expected.items():
                assert td[key].shape == (3, size)
                assert td[key].dtype == dtype
        spec = make(3).full_reward_spec
        assert set(spec.keys()) == {"reward", "cost"}

    def test_observation_follows_the_lidar(self):
        env = make(2, task=GoalTask(lidar_bins=5, num_hazards=0))
        assert env.reset()["observation"].shape == (2, 13)
        check_env_specs(env)

    def test_device(self):
        env = make(2, device="cpu")
        check_env_specs(env)
        assert env.reset().device == torch.device("cpu")
        assert make(2).reset().device is None


class TestPhysics:
    def test_motion_is_that_of_the_plain_model(self):
        num_envs, steps = 4, 40
        env = make(num_envs)
        env.reset()
        model = mujoco.MjModel.from_xml_string(PLAIN_POINT)
        datas = []
        for i in range(num_envs):
            data = mujoco.MjData(model)
            layout = env.layout(i)
            data.qpos[:2] = layout["robot"]
            data.qpos[2] = math.atan2(*layout["heading"][::-1])
            datas.append(data)
        start = np.array([d.qpos[:2] for d in datas])
        # Held for ten steps, or the noise goes nowhere; some out of range.
        for control in actions(steps // 10, num_envs).repeat_interleave(10, 0) * 1.5:
            following = env.step(TensorDict({"action": control}, [num_envs]))["next"]
            sensed = following["observation"][:, 3:8].numpy() * (8, 8, 0.2, 0.2, 2)
            for i, data in enumerate(datas):
                data.ctrl[:] = control[i].numpy()
                mujoco.mj_step(model, data, 10)
                layout = env.layout(i)
                np.testing.assert_allclose(layout["robot"], data.qpos[:2], atol=1e-12)
                yaw = data.qpos[2]
                np.testing.assert_allclose(
                    layout["heading"], (math.cos(yaw), math.sin(yaw)), atol=1e-12
                )
                mujoco.mj_forward(model, data)
                acceleration = data.sensor("acceleration").data[:2]
                velocity = data.sensor("velocity").data[:2]
                np.testing.assert_allclose(sensed[i, 2:4], velocity, atol=1e-6)
                np.testing.assert_allclose(sensed[i, 4], data.sensor("gyro").data[2], atol=1e-6)
                np.testing.assert_allclose(sensed[i, :2], acceleration, atol=2e-6)
        assert max(np.linalg.norm(d.qpos[:2] - s) for d, s in zip(datas, start, strict=True)) > 0.1
        assert max(abs(d.qvel[2]) for d in datas) > 0.5

    def test_top_speeds(self):
        """1.5 m/s and 3 rad/s: drive and turn force over damping."""
        for control, reading, limit in (((1.0, 0.0), 5, 1.5), ((0.0, 1.0), 7, 3.0)):
            env = make(1)
            td = drive(env, torch.tensor(control).expand(200, 1, 2))
            scale = 0.2 if reading == 5 else 2.0
            speed = td["next", "observation"][-1, 0, reading].item() * scale
            assert abs(speed) == pytest.approx(limit, rel=0.1)

    def test_actions_are_clipped(self):
        controls = actions(20) * 4
        assert equal(drive(make(), controls)["next"], drive(make(), controls.clamp(-1, 1))["next"])


class TestRewardAndCost:
    def test_along_a_rollout(self):
        """Reward and cost from the positions alone, the goal moving exactly when it is reached."""
        env = make(8, seed=3)
        env.reset()
        before = [env.layout(i) for i in range(8)]
        bonuses = violations = 0
        for _ in range(250):
            following = env.step(TensorDict({"action": seek(env)}, [8]))["next"]
            for i in range(8):
                after = env.layout(i)
                old = math.dist(before[i]["goal"], before[i]["robot"])
                new = math.dist(before[i]["goal"], after["robot"])
                bonus = new <= 0.3
                assert following["reward"][i].item() == pytest.approx(old - new + bonus, abs=1e-6)
                assert following["goal_met"][i].item() == bonus
                assert (after["goal"] == before[i]["goal"]).all() != bonus
                if bonus:
                    assert math.dist(after["goal"], after["robot"]) >= 0.705
                nearest = min(math.dist(after["robot"], h) for h in after["hazards"])
                cost = 1 / (1 + math.exp(-10 * (0.2 - nearest)))
                assert following["cost"][i].item() == pytest.approx(cost, abs=1e-6)
                assert following["violation"][i].item() == (nearest <= 0.2)
                assert following["violations"][i].item() == (nearest <= 0.2)
                # The observation shows the new goal.
                shown = following["observation"][i, 2].item() * 0.6 + 1.5
                goal_distance = math.dist(after["goal"], after["robot"])
                assert shown == pytest.approx(goal_distance, abs=1e-5)
                bonuses += bonus
                violations += nearest <= 0.2
                before[i] = after
        assert bonuses >= 8
        assert violations >= 5

    def test_flags_are_false_after_a_reset(self):
        env = make(8, seed=3, episode_length=30)
        td = env.reset()
        for _ in range(90):
            td["action"] = seek(env)
            step, td = env.step_and_maybe_reset(td)
            fresh = step["next", "done"].squeeze(-1)
            for key in ("violation", "violations", "goal_met", "done", "terminated", "truncated"):
                assert not td[key][fresh].any()


class TestEpisodes:
    def test_time_limit_truncates_and_never_terminates(self):
        td = drive(make(3, episode_length=5), actions(12, 3))["next"]
        expected = torch.tensor([(t + 1) % 5 == 0 for t in range(12)])
        assert (td["truncated"].squeeze(-1) == expected[:, None]).all()
        assert (td["done"] == td["truncated"]).all()
        assert not td["terminated"].any()

    def test_stagger_spreads_the_truncations(self):
        env = make(5, episode_length=10, stagger=True)
        first = drive(env, actions(10, 5))["next", "truncated"].squeeze(-1)
        assert (first.sum(0) == 1).all()
        # Environment i starts 2 i steps into its episode.
        assert first.int().argmax(0).tolist() == [9, 7, 5, 3, 1]
        # Later episodes are whole ones.
        second = drive(env, actions(10, 5), reset=False)["next", "truncated"].squeeze(-1)
        assert (second == first).all()

    def test_partial_reset(self):
        env = make(4)
        td = drive(env, actions(5, 4))[-1]
        layouts = [env.layout(i) for i in range(4)]
        mask = torch.tensor([True, False, True, False])
        carried = td["next"].exclude("reward", "cost").clone().set("_reset", mask[:, None])
        after = env.reset(carried.clone())
        for key in ("observation", "violation", "goal_met", "done"):
            assert (after[key][~mask] == td["next", key][~mask]).all()
        for i in range(4):
            same = all((env.layout(i)[k] == layouts[i][k]).all() for k in layouts[i])
            assert same != mask[i].item()
        assert (after["observation"][mask] != td["next", "observation"][mask]).any(-1).all()
        assert (after["observation"][mask][:, 3:8] == 0).all()  # at rest
        # The environment itself, not TorchRL's merging, shows the current frame of the others.
        raw = env._reset(TensorDict({"_reset": torch.zeros(4, 1, dtype=torch.bool)}, [4]))
        assert (raw["observation"] == after["observation"]).all()

    def test_layouts_do_not_depend_on_who_resets_together(self):
        one, other = make(4), make(4)
        one.reset()
        other.reset()
        one.reset(self.masked([1, 2]))
        other.reset(self.masked([2]))
        other.reset(self.masked([1]))
        for i in range(4):
            for key, value in one.layout(i).items():
                assert (value == other.layout(i)[key]).all()

    @staticmethod
    def masked(rows: list[int]) -> TensorDict:
        mask = torch.zeros(4, 1, dtype=torch.bool)
        mask[rows] = True
        return no_reset(make(4)).set("_reset", mask)


class TestDeterminism:
    def test_threads(self):
        options = {"num_envs": 9, "episode_length": 20, "seed": 4}
        controls = actions(60, 9)
        one = drive(SafeRobotEnv(num_threads=1, **options), controls)
        two = drive(SafeRobotEnv(num_threads=2, **options), controls)
        assert equal(one, two)

    def test_seeds(self):
        controls = actions(20)
        first = drive(make(seed=1), controls)
        assert equal(first, drive(make(seed=1), controls))
        assert not equal(first, drive(make(seed=2), controls))
        env = make(seed=2)
        env.set_seed(1)
        assert equal(first, drive(env, controls))
        env.set_seed(1)
        assert equal(first, drive(env, controls))

    def test_environments_differ(self):
        observation = make(6).reset()["observation"]
        assert len(observation.unique(dim=0)) == 6

    def test_results_are_not_views_of_the_state(self):
        env, untouched = make(seed=1, episode_length=4), make(seed=1, episode_length=4)
        td = env.reset()
        untouched_td = untouched.reset()
        for control in actions(10):
            td["action"] = untouched_td["action"] = control
            step, td = env.step_and_maybe_reset(td.clone())
            reference, untouched_td = untouched.step_and_maybe_reset(untouched_td)
            assert equal(step["next"], reference["next"])
            step.zero_()
        shown = env.reset(no_reset(env))
        for leaf in shown.values():
            leaf.zero_()
        assert (env.reset(no_reset(env))["observation"] == td["observation"]).all()


class TestState:
    def test_resumes_exactly(self):
        options = {"seed": 5, "episode_length": 15, "stagger": True}
        env = make(**options)
        drive(env, actions(20))
        saved = env.state_dict()
        expected = drive(env, actions(40, seed=1), reset=False)
        assert equal(expected, self.resumed(env, saved))
        assert equal(expected, self.resumed(make(**options), saved))
        other = make(seed=99, episode_length=15, stagger=True)
        drive(other, actions(3))
        assert equal(expected, self.resumed(other, saved))

    @staticmethod
    def resumed(env: SafeRobotEnv, saved: dict) -> TensorDict:
        env.load_state_dict(saved)
        return drive(env, actions(40, seed=1), reset=False)

    def test_survives_torch_save(self, tmp_path):
        env = make()
        drive(env, actions(5))
        torch.save(env.state_dict(), tmp_path / "env.pt")
        expected = drive(env, actions(5, seed=1), reset=False)
        fresh = make(seed=9)
        fresh.load_state_dict(torch.load(tmp_path / "env.pt", weights_only=True))
        assert equal(expected, drive(fresh, actions(5, seed=1), reset=False))

    def test_is_a_copy(self):
        env = make()
        env.reset()
        saved = env.state_dict()
        kept = {k: v.clone() for k, v in saved.items()}
        drive(env, actions(5), reset=False)
        assert all((saved[k] == kept[k]).all() for k in kept)
        env.load_state_dict(saved)
        drive(env, actions(5), reset=False)
        assert all((saved[k] == kept[k]).all() for k in kept)

    def test_rejects_another_shape_and_changes_nothing(self):
        env = make(3)
        env.reset()
        before = env.state_dict()
        other = make(4)
        other.reset()
        with pytest.raises(ValueError, match=r"must be float64 of shape"):
            env.load_state_dict(other.state_dict())
        with pytest.raises(ValueError, match="must have the entries"):
            env.load_state_dict({"physics": before["physics"]})
        assert all((env.state_dict()[k] == before[k]).all() for k in before)

    def test_an_empty_state_changes_nothing(self):
        env = make(3)
        env.reset()
        before = env.state_dict()
        env.load_state_dict({})
        assert all((env.state_dict()[k] == before[k]).all() for k in before)

    def test_pickles_before_and_after_use(self):
        fresh = pickle.loads(pickle.dumps(make(seed=5)))
        assert equal(drive(fresh, actions(5)), drive(make(seed=5), actions(5)))
        copy = pickle.loads(pickle.dumps(pickle.loads(pickle.dumps(fresh))))
        expected = drive(fresh, actions(5, seed=1), reset=False)
        assert equal(drive(copy, actions(5, seed=1), reset=False), expected)


class TestBadInput:
    @pytest.mark.parametrize(
        ("options", "match"),
        [
            ({"robot": "snake"}, "robot must be one of .*'point'"),
            ({"num_envs": 0}, "num_envs must be an integer >= 1, got 0"),
            ({"num_threads": -1}, "num_threads must be an integer >= 1, got -1"),
            ({"episode_length": 2.5}, "episode_length must be an integer >= 1, got 2.5"),
            ({"seed": -1}, "seed must be None or an integer >= 0"),
            ({"task": GoalTask(num_hazards=80)}, "no legal layout found"),
            ({"task": GoalTask(extent=0.35)}, "does not fit"),
        ],
    )
    def test_constructor(self, options, match):
        with pytest.raises(ValueError, match=match):
            SafeRobotEnv(**options)

    @pytest.mark.parametrize("bad", [math.nan, math.inf])
    def test_action_is_not_finite(self, bad):
        env = make(3)
        env.reset()
        before = env.state_dict()
        action = torch.zeros(3, 2)
        action[1, 0] = bad
        with pytest.raises(ValueError, match=r"action must be finite.*\[1\]"):
            env.step(TensorDict({"action": action}, [3]))
        assert all((env.state_dict()[k] == before[k]).all() for k in before)

    def test_action_has_another_shape(self):
        env = make(3)
        env.reset()
        with pytest.raises(ValueError, match=r"action must have shape \(3, 2\), got \(3, 1\)"):
            env.step(TensorDict({"action": torch.zeros(3, 1)}, [3]))

    def test_step_before_reset(self):
        with pytest.raises(RuntimeError, match="reset the environment"):
            make(3).step(TensorDict({"action": torch.zeros(3, 2)}, [3]))

    def test_mask_has_another_shape(self):
        env = make(3)
        env.reset()
        with pytest.raises(ValueError, match="_reset must have shape"):
            env._reset(TensorDict({"_reset": torch.ones(3, 2, dtype=torch.bool)}, [3]))

    def test_partial_step(self):
        env = make(2)
        td = env.reset()
        td["action"], td["_step"] = torch.zeros(2, 2), torch.tensor([True, False])
        with pytest.raises(NotImplementedError, match="all of its environments"):
            env.step(td)

    @pytest.mark.parametrize("index", [-1, 3])
    def test_index(self, index):
        env = make(3)
        env.reset()
        with pytest.raises(ValueError, match="index must be in"):
            env.layout(index)
        with pytest.raises(ValueError, match="index must be in"):
            env.render(index)


def test_a_diverging_simulation_is_truncated_and_counted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs its warning there
    env, reference = make(3), make(3)
    before = drive(env, actions(5, 3))["next"][-1]
    drive(reference, actions(5, 3))
    state = env.state_dict()
    model = mujoco.MjModel.from_xml_string(PLAIN_POINT)
    # time, qpos, qvel: a velocity beyond MuJoCo's limit of 1e10.
    assert state["physics"][1, 1:3].tolist() == env.layout(1)["robot"].tolist()
    state["physics"][1, 1 + model.nq] = 1e12
    env.load_state_dict(state)
    td = TensorDict({"action": actions(1, 3, seed=2)[0]}, [3])
    expected = reference.step(td.clone())["next"]
    following = env.step(td.clone())["next"]
    assert env.instabilities == 1
    state = env.state_dict()
    env.step(td.clone())
    env.load_state_dict(state)
    assert env.state_dict()["frame_diverged"].tolist() == [False, True, False]
    for key in ("diverged", "truncated"):
        assert following[key].flatten().tolist() == [False, True, False]
    assert not following["terminated"].any()
    assert (following["observation"][1] == before["observation"][1]).all()
    assert following["cost"][1] == before["cost"][1]
    assert following["reward"][1] == 0
    assert equal(following[[0, 2]], expected[[0, 2]])
    _, td = env.step_and_maybe_reset(td)
    td["action"] = torch.zeros(3, 2)
    following = env.step(td)["next"]
    assert env.instabilities == 2
    assert not td["diverged"].any()
    assert not following["done"].any()
    assert following["observation"].isfinite().all()


def test_what_a_step_ends_in_is_checked_too(tmp_path, monkeypatch):
    """The last physics step may break what MuJoCo checks at the start of the next one only."""
    monkeypatch.chdir(tmp_path)
    asset = tmp_path / "frictionless.xml"
    asset.write_text(PLAIN_POINT.replace('damping=".01"', ""))
    # One physics step of two seconds: 9e9 m/s are legal, and lead to where nothing may be.
    point = replace(get_robot("point"), asset=str(asset), timestep=2.0, substeps=1)
    env = SafeRobotEnv(point, num_envs=2, num_threads=1)
    before = env.reset()
    state = env.state_dict()
    state["physics"][0, 1 + 3] = 9e9
    env.load_state_dict(state)
    following = env.step(TensorDict({"action": torch.zeros(2, 2)}, [2]))["next"]
    assert following["diverged"].flatten().tolist() == [True, False]
    assert (following["observation"][0] == before["observation"][0]).all()
    assert env.instabilities == 1


class TestRender:
    @pytest.fixture
    def env(self):
        env = make(3, seed=3)
        env.reset()
        try:
            env.render(0, 16, 16)
        except Exception as error:  # whatever a machine without OpenGL raises
            pytest.skip(f"no OpenGL: {error}")
        yield env
        env.close()

    def test_picture(self, env):
        picture = env.render(1)
        assert picture.shape == (360, 480, 3)
        assert picture.dtype == np.uint8
        assert picture.std() > 5
        assert (env.render(1) == picture).all()
        assert (env.render(2) != picture).any()
        assert env.render(1, 64, 48).shape == (48, 64, 3)

    def test_drawing_changes_nothing(self, env):
        before = env.state_dict()
        env.render(0)
        assert all((env.state_dict()[k] == before[k]).all() for k in before)

    def test_colours(self, env):
        """A goal's green and hazards' blue are seen; red only from inside a hazard."""
        colours = env.render(0).astype(int).reshape(-1, 3)
        red, green, blue = colours.T
        assert ((green > red + 40) & (green > blue + 40)).sum() > 100
        assert ((blue > red + 40) & (blue > green + 40)).sum() > 300
        assert not self.bright_red(env)
        state = env.state_dict()
        state["physics"][0, 1:3] = torch.from_numpy(env.layout(0)["hazards"][0])
        env.load_state_dict(state)
        env.step(TensorDict({"action": torch.zeros(3, 2)}, [3]))
        assert self.bright_red(env) > 50

    @staticmethod
    def bright_red(env: SafeRobotEnv) -> int:
        red, green, blue = env.render(0).astype(int).reshape(-1, 3).T
        return int(((red > 170) & (green < 70) & (blue < 70)).sum())

    def test_size(self, env):
        with pytest.raises(ValueError, match="must be positive"):
            env.render(0, 0, 10)

    def test_pickles_with_a_renderer(self, env):
        assert pickle.loads(pickle.dumps(env)).render(0).shape == (360, 480, 3)


class TestTorchRL:
    def test_transforms(self):
        env = TransformedEnv(
            make(4, episode_length=6),
            RewardSum(in_keys=["reward", "cost"], out_keys=["episode_reward", "episode_cost"]),
        )
        env.append_transform(StepCounter())
        check_env_specs(env)
        td = env.rollout(14, break_when_any_done=False)
        for key in ("reward", "cost"):
            total = td["next", key][:, 6:12].cumsum(1)
            torch.testing.assert_close(td["next", f"episode_{key}"][:, 6:12], total)

    def test_collector(self):
        env = make(4, episode_length=5)
        collector = Collector(
            env, RandomPolicy(env.action_spec), frames_per_batch=32, total_frames=64
        )
        batches = list(collector)
        collector.shutdown()
        assert [b.shape for b in batches] == [torch.Size([4, 8])] * 2
        data = torch.cat(batches, 1)
        assert data["next", "truncated"][:, 4].all()
        # Within an episode the next observation is the following one.
        inside = ~data["next", "done"][:, :-1].squeeze(-1)
        follows = (data["next", "observation"][:, :-1] == data["observation"][:, 1:]).all(-1)
        assert follows[inside].all()
        assert not follows[~inside].any()

    def test_collector_state_loads(self):
        policy = TensorDictModule(torch.nn.Linear(24, 2), ["observation"], ["action"])
        collector = Collector(
            make(2),
            policy,
            frames_per_batch=8,
            total_frames=16,
            auto_register_policy_transforms=False,
        )
        next(iter(collector))
        state = collector.state_dict()
        collector.load_state_dict(state)
        collector.shutdown()

    @pytest.mark.slow
    def test_multi_process_collector(self):
        make_env = partial(SafeRobotEnv, num_envs=2, num_threads=1)
        collector = MultiSyncCollector(
            [make_env, partial(make_env, seed=1)],
            RandomPolicy(make_env().action_spec),
            frames_per_batch=16,
            total_frames=32,
            cat_results="stack",
        )
        try:
            batches = list(collector)
        finally:
            collector.shutdown()
        assert len(batches) == 2
        observation = batches[0]["observation"]
        assert observation.isfinite().all()
        # Workers with other seeds see other layouts.
        assert not (observation[0] == observation[1]).all()
