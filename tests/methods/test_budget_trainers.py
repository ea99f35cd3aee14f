"""The methods of budgets, on a knapsack: what is best within a budget is known.

An episode has a step per item. The share of an item that is taken earns as much of its worth and
costs as much of its weight, so that the best that keeps to a budget is Dantzig's greedy filling.
"""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.data import Binary, Bounded, Composite, OneHot, Unbounded
from torchrl.envs import EnvBase, ExplorationType, set_exploration_type

from torchrl_safe.trainers import METHODS
from torchrl_safe.trainers.environments import make_env

WORTH = torch.tensor([0.3, 1.0, 0.2, 0.9])
WEIGHT = torch.tensor([1.0, 0.5, 1.0, 1.5])
BUDGET = 2.0
ITEMS = len(WORTH)


def best():
    """Items by worth per weight, until the budget is full."""
    room, worth = BUDGET, 0.0
    for item in sorted(range(ITEMS), key=lambda i: -WORTH[i] / WEIGHT[i]):
        share = min(1.0, room / WEIGHT[item].item())
        room, worth = room - share * WEIGHT[item].item(), worth + share * WORTH[item].item()
    return worth


class Knapsack(EnvBase):
    """``num_envs`` of them; an action of 1 takes an item, of -1 leaves it."""

    def __init__(self, num_envs):
        super().__init__(batch_size=[num_envs])
        shape, number = (num_envs,), Unbounded((num_envs, 1))
        flag = Binary(1, shape=(num_envs, 1), dtype=torch.bool)
        item = OneHot(ITEMS, shape=(num_envs, ITEMS), dtype=torch.float32)
        self.observation_spec = Composite(observation=item, shape=shape)
        self.action_spec = Bounded(-1, 1, (num_envs, 1))
        self.full_reward_spec = Composite(reward=number, cost=number, shape=shape)
        self.full_done_spec = Composite(done=flag, terminated=flag, truncated=flag, shape=shape)

    def _observe(self, item):
        return nn.functional.one_hot(item % ITEMS, ITEMS).float()

    def _reset(self, tensordict=None):
        start = torch.zeros(self.batch_size, dtype=torch.int64)
        return TensorDict({"observation": self._observe(start)}, self.batch_size)

    def _step(self, tensordict):
        item = tensordict["observation"][..., :ITEMS].argmax(-1)
        share = (1 + tensordict["action"]) / 2
        last = (item == ITEMS - 1)[:, None]
        return TensorDict(
            {
                "observation": self._observe(item + 1),
                "reward": share * WORTH[item][:, None],
                "cost": share * WEIGHT[item][:, None],
                "done": last,
                "terminated": last.clone(),
                "truncated": torch.zeros_like(last),
            },
            self.batch_size,
        )

    def _set_seed(self, seed):
        pass


def knapsacks(num_envs):
    return Knapsack(num_envs)


COMMON = {
    "gamma": 0.99,
    "lmbda": 0.97,
    "cost_limit": BUDGET,
    "limit_unit": "episode",
    "env.num_envs": 500,
    "env.episode_length": ITEMS,
    "eval.num_episodes": 500,
    "eval.num_steps": ITEMS,
    "frames_per_batch": 500 * ITEMS,
    "critic_lr": 0.05,
    "critic_rounds": 1,
    "minibatch_size": 500,
}
PPO = {"policy_lr": 0.03, "num_epochs": 3, "max_kl": 1.0}
TRPO = {"max_kl": 0.05, "damping": 0.01, "cg_iters": 5}
CASES = {
    "ppo_saute": PPO | {"unsafe_reward": -1.0},
    "trpo_saute": TRPO | {"unsafe_reward": -1.0},
    "ppo_early_terminated": PPO | {"termination_reward": -1.0},
    "trpo_early_terminated": TRPO | {"termination_reward": -1.0},
}


def network(inputs, num_outputs):
    return nn.Linear(sum(spec.shape[-1] for spec in inputs), num_outputs)


@pytest.mark.parametrize("name", CASES)
def test_fills_the_budget(name):
    torch.manual_seed(0)
    trainer = METHODS[name](knapsacks, network=network, **COMMON | CASES[name])
    options, source = trainer.options, trainer.source
    env = make_env(options, 500, 0, training=True, source=source)
    trainer.build(env)
    state = env.reset()
    for _ in range(40):
        with torch.no_grad():
            batch = env.rollout(
                ITEMS, trainer.policy, auto_reset=False, tensordict=state, break_when_any_done=False
            )
        state = env.reset()
        trainer.update(batch)
    judge = make_env(options, 1, 0, source=source)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        episode = judge.rollout(ITEMS, trainer.policy)["next"]
    assert episode["budget"][0, -1] >= 0
    assert episode["reward"].sum() >= 0.85 * best()


def test_evaluation_enforces_nothing():
    """Rewards and lengths of evaluated episodes are those of the task, whoever is judged."""
    trainer = METHODS["ppo_early_terminated"](knapsacks, **COMMON)
    options, source = trainer.options, trainer.source
    everything = lambda td: td.set("action", torch.ones(3, 1))  # noqa: E731
    judged = make_env(options, 3, 0, source=source).rollout(10, everything)["next"]
    trained = make_env(options, 3, 0, source=source, training=True).rollout(10, everything)["next"]
    assert judged["reward"][0].flatten().tolist() == WORTH.tolist()
    assert judged["budget"][0].flatten().tolist() == (BUDGET - WEIGHT.cumsum(0)).tolist()
    assert trained["reward"][0].flatten().tolist() == [*WORTH[:2].tolist(), 0.0]


@pytest.mark.parametrize(
    ("named", "budget"),
    [
        ({"cost_limit": 0.1, "limit_unit": "step"}, 100.0),
        ({"cost_limit": 25.0, "limit_unit": "episode"}, 25.0),
        # A discounted sum of 5 at 0.99 is 0.05 in each of 1,000 steps.
        ({"cost_limit": 5.0}, 50.0),
        # Of training episodes a fourth as long, a fourth.
        ({"cost_limit": 5.0, "env.episode_length": 250}, 12.5),
        ({"cost_limit": 5.0, "budget_gamma": 0.999}, 0.05 * (1 - 0.999**1000) / (1 - 0.999)),
    ],
)
def test_budget_of_a_limit(named, budget):
    options = METHODS["ppo_saute"].Options.of(**named)
    env = make_env(options, 2, 0, training=True)
    assert env.reset()["budget"].flatten().tolist() == pytest.approx([budget] * 2, rel=1e-6)
