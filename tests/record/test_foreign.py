"""Evaluation of environments that are not ours: adapted, without goals, without a batch."""

from __future__ import annotations

from functools import partial

import gymnasium
import numpy as np
import pytest
from torchrl.envs import GymWrapper, ParallelEnv, RenameTransform, SerialEnv
from torchrl.envs.utils import ExplorationType

from torchrl_safe.envs import cost_from_info
from torchrl_safe.record import batch_metrics, describe, evaluate, summarize


class TestForeignEnvironments:
    """Without goals, without a batch, with several costs: against sums of the rollout itself."""

    @staticmethod
    def make(costs="cost", **options):
        class Counts(gymnasium.Env):
            observation_space = gymnasium.spaces.Box(0, 9, (1,), np.float32)
            action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

            def reset(self, *, seed=None, options=None):
                super().reset(seed=seed)
                self.count = 0
                return np.float32([0]), {}

            def step(self, action):
                self.count += 1
                info = {"cost": float(self.count), "speed": 0.5}
                return np.float32([self.count]), 2.0, self.count == 4, False, info

        return cost_from_info(GymWrapper(Counts()), costs, **options)

    @staticmethod
    def judge(env):
        return evaluate(env, env.rand_action, exploration_type=ExplorationType.RANDOM, seed=0)

    def test_no_goals_and_no_batch(self):
        env = self.make(violation_above=2.0)
        assert env.batch_size == ()
        episode = self.judge(env)
        assert episode["episode_return"] == 8.0
        assert episode["violations"] == 2.0  # of 1, 2, 3, 4
        assert episode["cost_rate"] == 10.0 / 4
        assert "goals" not in episode.keys()
        assert "goals" not in describe(episode)[0]
        assert summarize(episode)["eval/score"] == pytest.approx(8.0 / 3)
        metrics = batch_metrics(env.rollout(4))
        assert metrics == pytest.approx(
            {"train/reward_per_1000": 2000.0, "train/cost_rate": 2.5, "train/cv_rate": 0.5}
        )

    @pytest.mark.parametrize("cls", [SerialEnv, ParallelEnv])
    def test_workers(self, cls):
        env = cls(2, partial(self.make, violation_above=2.0))
        assert self.judge(env)["violations"].tolist() == [2.0, 2.0]
        env.close()

    def test_several_costs(self):
        env = self.make({"count": "cost", "speed": "speed"}, violation_above=3.0)
        episode = self.judge(env)
        assert "cost" not in episode.keys()
        assert episode["count_cost"] == 10.0
        assert episode["count_discounted_cost"] == pytest.approx(
            1 + 2 * 0.99 + 3 * 0.99**2 + 4 * 0.99**3
        )
        assert episode["count_violations"] == 1.0  # 4 is above 3
        assert episode["count_cv_rate"] == 0.25
        steps = env.rollout(4)["next"]
        assert episode["speed_cost"] == steps["speed_cost"].sum()
        either = steps["count_violation"] | steps["speed_violation"]
        assert episode["violations"] == either.sum()
        metrics = batch_metrics(env.rollout(4))
        assert metrics["train/count_cost_rate"] == 2.5
        assert metrics["train/speed_cv_rate"] == steps["speed_violation"].float().mean()
        assert metrics["train/cv_rate"] == either.float().mean()
        assert summarize(episode)["eval/count_cost"] == describe(episode)[0]["count_cost"] == 10.0
        names = ["count_cost", "count_violation"], ["cost", "violation"]
        env.append_transform(RenameTransform(*names))
        episode = self.judge(env)
        assert episode["violations"] == 1.0
        assert episode["cost_rate"] == 10.0 / 4
