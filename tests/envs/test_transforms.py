"""TorchRL's transforms with two rewards: what the docs say of each, and the versions of ours."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import (
    ActionDiscretizer,
    Compose,
    DoubleToFloat,
    EnvBase,
    FrameSkipTransform,
    GymEnv,
    InitTracker,
    MultiStepTransform,
    NoopResetEnv,
    RewardScaling,
    RewardSum,
    SerialEnv,
    StepCounter,
    TargetReturn,
    TransformedEnv,
)
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import SafeFrameSkip, SafeRobotEnv, check_safe_env, cost_from_info

SKIP = 4


class Script(EnvBase):
    """Plays what is written: reward, cost, violation, violations and end of each step, [T, N]."""

    def __init__(self, **columns):
        self.columns = columns
        num_envs = len(columns["reward"][0])
        super().__init__(batch_size=[num_envs])
        leaf = Unbounded((num_envs, 1))
        flag = Bounded(0, 1, (num_envs, 1), dtype=torch.bool)
        self.observation_spec = Composite(
            observation=leaf,
            violation=flag,
            violations=Unbounded((num_envs, 1), dtype=torch.int64),
            shape=[num_envs],
        )
        self.action_spec = leaf
        self.full_reward_spec = Composite(
            reward=leaf, cost=Bounded(0.0, 1.0, (num_envs, 1)), shape=[num_envs]
        )
        self.count = 0

    def _reset(self, tensordict=None, **kwargs):
        self.count = 0
        return self.observation_spec.zero()

    def _step(self, tensordict):
        columns = {
            name: torch.as_tensor(np.asarray(table[self.count]))[:, None]
            for name, table in self.columns.items()
        }
        self.count += 1
        observation = torch.full((*self.batch_size, 1), float(self.count))
        return TensorDict({**columns, "observation": observation}, self.batch_size)

    def _set_seed(self, seed):
        pass


def follow(env, actions) -> TensorDict:
    env.set_seed(3)
    td, steps = env.reset(), []
    for action in actions:
        stepped, td = env.step_and_maybe_reset(td.set("action", action.clone()))
        steps.append(stepped["next"].clone())
    return torch.stack(steps)


class TestSafeFrameSkip:
    def make(self, *transforms, **options):
        env = SafeRobotEnv(num_envs=3, num_threads=1, **options)
        return TransformedEnv(env, Compose(*transforms)) if transforms else env

    def test_against_steps_one_by_one(self):
        torch.manual_seed(0)
        actions = 2 * torch.rand(6, 3, 2) - 1
        slow = follow(self.make(), actions.repeat_interleave(SKIP, 0))
        fast = follow(self.make(SafeFrameSkip(SKIP)), actions)
        for key in ("reward", "cost"):
            sums = slow[key].double().reshape(6, SKIP, 3, 1).sum(1)
            torch.testing.assert_close(fast[key].double(), sums, rtol=1e-6, atol=1e-6)
        assert (fast["observation"] == slow["observation"][SKIP - 1 :: SKIP]).all()

    def test_by_hand(self):
        """Environment 1 ends in the second frame of three: what follows is not its own."""
        script = {
            "reward": np.float32([[1.0, 1.0], [2.0, 2.0], [4.0, 4.0]]),
            "cost": np.float32([[0.0, 0.5], [1.0, 0.25], [0.0, 1.0]]),
            "violation": np.array([[False, False], [True, False], [False, True]]),
            "violations": np.array([[0, 0], [1, 7], [0, 9]]),
            "done": np.array([[False, False], [False, True], [False, False]]),
        }
        env = TransformedEnv(Script(**script), SafeFrameSkip(3))
        step = env.rand_step(env.reset())["next"]
        assert step["reward"].flatten().tolist() == [7.0, 3.0]
        assert step["cost"].flatten().tolist() == [1.0, 0.75]
        assert step["violation"].flatten().tolist() == [True, False]
        # One violating frame of three is a violating step; seven are three.
        assert step["violations"].flatten().tolist() == [1, 3]
        assert step["done"].flatten().tolist() == [False, True]
        assert step["observation"].flatten().tolist() == [3.0, 2.0]
        assert env.full_reward_spec["cost"].space.high.flatten().tolist() == [3.0, 3.0]

    @pytest.mark.parametrize("length", [SKIP, 10])
    def test_ends_with_the_episode(self, length):
        rollout = self.make(SafeFrameSkip(SKIP), episode_length=length).rollout(10)
        assert rollout.shape == (3, -(-length // SKIP))
        frames = self.make(episode_length=length).rollout(length)
        assert rollout["next", "truncated"][:, -1].all()
        assert frames["next", "truncated"][:, -1].all()

    def test_contract(self):
        check_safe_env(self.make(SafeFrameSkip(SKIP), episode_length=10), time_limit=3)
        check_safe_env(self.make(SafeFrameSkip(SKIP), episode_length=10, stagger=True))

    def test_between_other_transforms(self):
        """Those before it see frames, those behind it steps; actions are translated once."""
        before = (ActionDiscretizer(5), StepCounter(), RewardSum(in_keys=["cost"]))
        behind = (RewardSum(in_keys=["cost"], out_keys=["behind"]),)
        env = self.make(*before, SafeFrameSkip(SKIP), *behind)
        check_env_specs(env)
        rollout = env.rollout(3)["next"]
        assert rollout["step_count"][0].flatten().tolist() == [4, 8, 12]
        torch.testing.assert_close(rollout["episode_cost"], rollout["behind"])

    def test_foreign_costs(self):
        make = lambda: cost_from_info(  # noqa: E731
            GymEnv("torchrl_safe/PointGoal-v0"), {"a": "cost", "b": lambda info: 0.5}
        )
        env = make().append_transform(SafeFrameSkip(SKIP))
        step = env.rand_step(env.reset())["next"]
        assert step["b_cost"].item() == 0.5 * SKIP
        assert step["b_violation"].all()
        several = SerialEnv(2, lambda: make().append_transform(SafeFrameSkip(SKIP)))
        assert (several.rollout(2)["next", "b_cost"] == 0.5 * SKIP).all()

    def test_rejects(self):
        with pytest.raises(ValueError, match="greater or equal to one"):
            SafeFrameSkip(0)


class TestWhatTheDocsSay:
    """Of TorchRL's own; an upgrade that changes one of these changes the page."""

    @pytest.mark.parametrize("transform", [FrameSkipTransform(2), NoopResetEnv(2)])
    def test_one_reward_only(self, transform):
        env = TransformedEnv(SafeRobotEnv(num_envs=1, num_threads=1), transform)
        with pytest.raises(KeyError, match="reward_key requested but more than one key"):
            env.rollout(2)

    def test_target_return(self):
        env = SafeRobotEnv(num_envs=2, num_threads=1)
        with pytest.raises(ValueError, match="multiple rewards are located at the same level"):
            TransformedEnv(env, TargetReturn(10.0)).rollout(2)
        env = TransformedEnv(
            env,
            Compose(
                TargetReturn(10.0, in_keys=["reward"]),
                TargetReturn(25.0, in_keys=["cost"], out_keys=["target_cost"]),
            ),
        )
        check_env_specs(env)
        rollout = env.rollout(3)["next"]
        left = 25.0 - rollout["cost"].double().cumsum(1)
        torch.testing.assert_close(rollout["target_cost"].double(), left, rtol=1e-6, atol=1e-5)

    def test_bounded_cost(self):
        env = SafeRobotEnv(num_envs=2, num_threads=1)
        with pytest.raises(NotImplementedError, match="BoundedContinuous"):
            TransformedEnv(env, RewardScaling(0.0, 2.0, in_keys=["cost"])).rollout(2)

    def test_multi_step(self):
        """Left to its defaults it adds up rewards and leaves the cost of one step."""
        rollout = SafeRobotEnv(num_envs=2, num_threads=1).rollout(6)
        cost = rollout["next", "cost"][..., 0]
        sums = cost[:, :-1] + 0.5 * cost[:, 1:]
        for keys, possible in ((["reward"], cost), (["reward", "cost"], sums)):
            transform = MultiStepTransform(2, 0.5, reward_keys=keys)
            transform._inv_call(rollout[:, :3].clone())  # waits for what comes next
            out = transform._inv_call(rollout[:, 3:].clone())["next", "cost"].flatten()
            assert torch.isclose(out[:, None], possible.flatten(), rtol=1e-5).any(1).all()

    def test_the_rest(self):
        env = TransformedEnv(
            SafeRobotEnv(num_envs=2, num_threads=1),
            Compose(
                DoubleToFloat(),
                StepCounter(),
                InitTracker(),
                RewardSum(),
                RewardScaling(0.0, 2.0),
            ),
        )
        check_env_specs(env)
        assert {"episode_reward", "episode_cost"} <= set(env.rollout(3)["next"].keys())
