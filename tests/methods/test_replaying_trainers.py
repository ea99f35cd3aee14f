"""The trainers of replayed transitions, on the CMDP whose optimum is known."""

from __future__ import annotations

import pytest
import torch
from cmdp import GAMMA, LinearCMDP
from test_known_optimum import ONE, Bilinear, N, mean_action
from torch import nn

from torchrl_safe.trainers import METHODS

OPTIONS = {
    "gamma": GAMMA,
    "cost_gamma": GAMMA,
    "cost_limit": ONE["cost"],
    "env.num_envs": 400,
    "eval.num_episodes": 400,
    "eval.final_episodes": 400,
    "frames_per_batch": 2000,
    "init_frames": 0,
    "replay_buffer.size": 10_000,
    "num_updates": 10,
    "minibatch_size": 200,
    "optim.lr": 0.03,
    "tau": 0.05,
    "lagrangian.init": 1.0,
    "lagrangian.lr": 0.2,
}
# By method: options, and the number of updates. A deterministic policy switches between extremes.
CASES = {
    "td3_lagrangian": (
        {"noise": 0.3, "num_updates": 20, "minibatch_size": 500, "lagrangian.lr": 0.1},
        150,
    ),
    "sac_lagrangian": ({}, 75),
}


def network(inputs, num_outputs):
    """A table of states; of a critic, whose values are linear in the action, two."""
    return nn.Linear(N, num_outputs, bias=False) if len(inputs) == 1 else Bilinear()


@pytest.mark.parametrize("name", CASES)
def test_one_constraint(name):
    """Averaged over the last third of the updates: policy and multiplier circle."""
    torch.manual_seed(0)
    options, num_updates = CASES[name]
    trainer = METHODS[name](LinearCMDP, network=network, **OPTIONS | options)
    env = LinearCMDP(num_envs=400)
    trainer.build(env)
    parameters = trainer.multiplier.module.parameters()
    trainer.multiplier.optim = torch.optim.SGD(parameters, lr=trainer.options.lagrangian.lr)
    state = env.reset()
    values = []
    for i in range(num_updates):
        with torch.no_grad():
            batch = env.rollout(
                5, trainer.policy, auto_reset=False, tensordict=state, break_when_any_done=False
            )
        state = env.maybe_reset(
            batch[:, -1]["next"].select("observation", "done", "terminated", "truncated")
        )
        trainer.update(batch.set(("collector", "traj_ids"), torch.zeros(batch.batch_size)))
        if 3 * i >= 2 * num_updates:
            values.append(env.values(mean_action(trainer.policy)))
    reward, cost = (sum(v[key] for v in values) / len(values) for key in ("reward", "cost"))
    assert cost <= 1.02 * ONE["cost"]
    assert reward >= 0.95 * LinearCMDP(1).optimum(ONE)
