"""Costs of foreign environments: highway-env, Safety-Gymnasium's interface, dm_control."""

from __future__ import annotations

import gymnasium
import highway_env  # noqa: F401 (registers its environments)
import numpy as np
import pytest
import torch
from torchrl.envs import (
    DMControlWrapper,
    GymEnv,
    GymWrapper,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)
from torchrl.envs.libs.safety_gymnasium import SafetyGymnasiumWrapper
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import CostToReward, GymGoalEnv, check_safe_env, cost_from_info, suite

POINT = "torchrl_safe/PointGoal-v0"


def assert_costs(rollout, expected) -> None:
    cost = rollout["next", "cost"]
    assert cost.dtype == torch.float32
    assert cost.shape == (*rollout.shape, 1)
    assert (cost.squeeze(-1).numpy() == np.asarray(expected, np.float32)).all()


class SixTuple(gymnasium.Wrapper):
    """``step`` as Safety-Gymnasium has it: obs, reward, cost, terminated, truncated, info."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, info["cost"], terminated, truncated, info


class TestHighway:
    """A package we have no say in; it reports crashes."""

    @staticmethod
    def make() -> GymEnv:
        config = {"vehicles_count": 12, "lanes_count": 2, "duration": 30}
        return GymEnv("highway-fast-v0", config=config, categorical_action_encoding=True)

    def test_contract(self):
        check_safe_env(cost_from_info(self.make(), "crashed"), num_steps=4)

    def test_crash_costs(self):
        env = cost_from_info(self.make(), "crashed")
        env.set_seed(0)
        faster = torch.tensor(3)
        rollout = env.rollout(30, lambda td: td.set("action", faster))
        crashed = [0.0] * (len(rollout) - 1) + [1.0]
        assert rollout["next", "terminated"][-1].all()
        assert_costs(rollout, crashed)
        assert (rollout["next", "violation"].squeeze(-1).numpy() == np.array(crashed)).all()
        # The cost of the step before is in no root entry.
        assert "cost" not in rollout.keys()

    def test_a_cost_of_ones_own(self):
        env = cost_from_info(self.make(), lambda info: max(0.0, info["speed"] - 20.0) / 10.0)
        env.set_seed(0)
        rollout = env.rollout(3, lambda td: td.set("action", torch.tensor(3)))
        assert (rollout["next", "cost"] > 0).all()


class TestCostFromInfo:
    def test_values(self):
        env = cost_from_info(GymWrapper(GymGoalEnv()), violation_above=0.5)
        plain = GymGoalEnv()
        env.set_seed(7)  # resets
        plain.reset(seed=7)
        rollout = env.rollout(30, auto_reset=False, tensordict=env.reset())
        plain.reset()
        infos = [plain.step(action)[4] for action in rollout["action"].numpy()]
        assert_costs(rollout, [info["cost"] for info in infos])

    @pytest.mark.parametrize("mode", ["sync", "vector_entry_point"])
    def test_vector(self, mode):
        vector_kwargs = {"autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED}
        options = {"vector_kwargs": vector_kwargs} if mode == "sync" else vector_kwargs
        envs = gymnasium.make_vec(
            POINT, num_envs=3, vectorization_mode=mode, episode_length=6, **options
        )
        env = cost_from_info(GymWrapper(envs))
        check_safe_env(env, time_limit=6)
        assert env.full_reward_spec["cost"].shape == (3, 1)

    def test_workers(self):
        env = SerialEnv(2, lambda: cost_from_info(GymEnv(POINT)))
        check_env_specs(env)
        assert env.rollout(3)["next", "cost"].shape == (2, 3, 1)

    def test_transforms(self):
        env = cost_from_info(GymEnv(POINT, episode_length=5))
        env.append_transform(RewardSum(in_keys=["reward", "cost"], out_keys=["return", "costs"]))
        env.append_transform(StepCounter())
        check_safe_env(env, time_limit=5)
        rollout = env.rollout(5)["next"]
        assert rollout["costs"][-1] == pytest.approx(rollout["cost"].sum().item())

    def test_missing_key(self):
        env = cost_from_info(GymEnv(POINT), "danger")
        td = env.reset()
        with pytest.raises(KeyError, match=r"info has no 'danger', only .*'cost'"):
            env.rand_step(td)

    def test_rejects(self):
        with pytest.raises(TypeError, match="must be a GymWrapper or GymEnv, got DMControlWrapper"):
            cost_from_info(DMControlWrapper(suite.load()))
        with pytest.raises(TypeError, match="env must not have transforms yet"):
            cost_from_info(TransformedEnv(GymEnv(POINT), StepCounter()))
        with pytest.raises(ValueError, match="frame_skip=2 loses the costs"):
            cost_from_info(GymEnv(POINT, frame_skip=2))
        envs = gymnasium.make_vec(POINT, num_envs=2, autoreset_mode="SameStep")
        with pytest.raises(ValueError, match=r"autoreset_mode='Disabled', got .*SAME_STEP"):
            cost_from_info(GymWrapper(envs))


class TestCostToReward:
    def test_torchrls_safety_gymnasium_wrapper(self):
        env = SafetyGymnasiumWrapper(SixTuple(GymGoalEnv(episode_length=9)))
        assert env.observation_spec["cost"].shape == ()  # why it needs an adapter
        env = TransformedEnv(env, CostToReward(violation_above=0.5))
        check_safe_env(env, time_limit=9)
        plain = GymGoalEnv()
        env.set_seed(2)
        plain.reset(seed=2)
        rollout = env.rollout(9)
        plain.reset()
        infos = [plain.step(action)[4] for action in rollout["action"].numpy()]
        assert_costs(rollout, [info["cost"] for info in infos])

    def test_dm_control(self):
        env = DMControlWrapper(suite.load("point", random=0, episode_length=9))
        env = TransformedEnv(env, CostToReward(violation_key=None))  # it has its own
        check_safe_env(env, time_limit=9)

    def test_names(self):
        env = DMControlWrapper(suite.load("point", random=0))
        env = TransformedEnv(env, CostToReward(violation_key=("flags", "unsafe")))
        check_safe_env(env, violation_key=("flags", "unsafe"))

    def test_another_name_for_the_cost(self):
        env = DMControlWrapper(suite.load("point", random=0, episode_length=9))
        env = TransformedEnv(env, RenameTransform(["cost"], ["danger"]))
        env.append_transform(CostToReward(cost_key="danger", violation_key=None))
        assert {"reward", "danger"} <= set(env.full_reward_spec.keys())
        check_safe_env(env, cost_key="danger", time_limit=9)
        with pytest.raises(Exception, match="cost"):  # the default looks for another
            check_safe_env(env, time_limit=9)

    def test_violation(self):
        env = DMControlWrapper(suite.load("point", random=0))
        env = TransformedEnv(env, CostToReward(violation_key="above", violation_above=0.01))
        rollout = env.rollout(200, lambda td: td.set("action", torch.tensor([1.0, 0.3]).double()))
        cost = rollout["next", "cost"]
        assert (rollout["next", "above"] == (cost > 0.01)).all()
        assert 0 < rollout["next", "above"].sum() < 200
        assert not env.reset()["above"].any()

    def test_rejects(self):
        env = DMControlWrapper(suite.load("point", random=0))
        with pytest.raises(ValueError, match="has an observation 'violation' of its own"):
            _ = TransformedEnv(env, CostToReward()).observation_spec
        with pytest.raises(KeyError, match="there is no observation 'danger' among"):
            _ = TransformedEnv(env, CostToReward("danger")).observation_spec
        with pytest.raises(ValueError, match=r"one number per environment, .* got \(24,\)"):
            _ = TransformedEnv(env, CostToReward("observation")).observation_spec
