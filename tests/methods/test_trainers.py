"""The trainers of multipliers, projections and penalties, on the CMDP whose optimum is known.

Here a method is what ``torchrl-safe train`` runs: :meth:`~torchrl_safe.trainers.Trainer.build` and
:meth:`~torchrl_safe.trainers.Trainer.update`, with the steps that this small problem allows.
"""

from __future__ import annotations

import pytest
import torch
from cmdp import GAMMA, LinearCMDP
from test_known_optimum import ONE, TWO, N, mean_action
from torch import nn

from torchrl_safe.trainers import METHODS

COMMON = {
    "gamma": GAMMA,
    "cost_gamma": GAMMA,
    "cost_limit": ONE["cost"],
    "env.num_envs": 400,
    "eval.num_episodes": 400,
    "eval.final_episodes": 400,
    "frames_per_batch": 2000,
    "critic_lr": 0.05,
    "critic_rounds": 1,
    "minibatch_size": 500,
}
GRADIENT = {"policy_lr": 0.03, "num_epochs": 3, "max_kl": 1.0}
MULTIPLIER = {"lagrangian.init": 1.0, "lagrangian.lr": 0.3}
# Of CUP: its price is in nats, and it takes two steps of that size in an update.
SMALL_STEPS = {"policy_lr": 0.02, "max_kl": 0.005, "lagrangian.init": 4.0, "lagrangian.lr": 0.5}
PID = {"lagrangian.init": 1.0, "kp": 1.0, "ki": 0.2, "kd": 1.0}
REGION = {"max_kl": 0.02, "damping": 0.01, "cg_iters": 5}

# By method: options, and the number of updates.
CASES = {
    "ppo_lagrangian": (GRADIENT | MULTIPLIER, 100),
    "ppo_pid": (GRADIENT | PID, 100),
    "trpo_lagrangian": (REGION | MULTIPLIER, 100),
    "trpo_pid": (REGION | PID, 100),
    "cup": (GRADIENT | SMALL_STEPS, 100),
    "crpo": (REGION, 100),
    "pcpo": (REGION, 60),
    "p3o": (GRADIENT, 100),
    "focops": (GRADIENT | MULTIPLIER | {"max_kl": 0.05}, 100),
}


def linear(inputs, num_outputs):
    """A table of states: what a one-hot observation needs."""
    return nn.Linear(N, num_outputs, bias=False)


def train(name, limits, options, num_updates):
    """Exact values of a method's policies, averaged over the last third of the updates."""
    torch.manual_seed(0)
    options = COMMON | {"cost_limit": limits if len(limits) > 1 else ONE["cost"]} | options
    trainer = METHODS[name](LinearCMDP, network=linear, **options)
    env = LinearCMDP(num_envs=400)
    trainer.build(env)
    if (multiplier := getattr(trainer, "multiplier", None)) and multiplier.optim:
        # Adam's step does not shrink near the saddle point: it would circle at full speed.
        parameters = multiplier.module.parameters()
        multiplier.optim = torch.optim.SGD(parameters, lr=trainer.options.lagrangian.lr)
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
        trainer.update(batch)
        if 3 * i >= 2 * num_updates:
            values.append(env.values(mean_action(trainer.policy)))
    return {key: sum(v[key] for v in values) / len(values) for key in values[0]}


def check(name, limits):
    values = train(name, limits, *CASES[name])
    for key, limit in limits.items():
        assert values[key] <= 1.02 * limit
    assert values["reward"] >= 0.95 * LinearCMDP(1).optimum(limits)


@pytest.mark.parametrize("name", CASES)
def test_one_constraint(name):
    check(name, ONE)


@pytest.mark.parametrize("name", ["ppo_pid", "trpo_pid", "p3o", "crpo", "pcpo"])
def test_two_constraints(name):
    check(name, TWO)
