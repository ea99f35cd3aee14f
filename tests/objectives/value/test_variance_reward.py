"""The reward whose Retrace targets are the variance of the cost sum, on a solved MDP."""

from __future__ import annotations

import math

import pytest
import torch
from test_retrace_functional import RandomMDP
from torch import Tensor

from torchrl_safe.objectives.value import retrace_variance_reward, squared_td_error

REWARDS = pytest.mark.parametrize("reward", [retrace_variance_reward, squared_td_error])


def variance_reward(mdp: RandomMDP, mean: Tensor, reward=retrace_variance_reward) -> Tensor:
    return reward(
        mdp.gamma,
        mdp.stored_cost(),
        mean[mdp.state, mdp.action],
        mean[mdp.successor, mdp.bootstrap],
        mdp.successor == mdp.num_states,
    )


@pytest.fixture(scope="module", params=[0, 1])
def mdp(request: pytest.FixtureRequest) -> RandomMDP:
    mdp = RandomMDP(request.param)
    assert mdp.probability.sum().item() == pytest.approx(mdp.num_states * mdp.num_actions)
    assert mdp.variance[:-1].min() > 0.01
    return mdp


@REWARDS
@pytest.mark.parametrize("lmbda", [0.0, 0.7, 1.0])
def test_mdp_fixed_point(mdp: RandomMDP, lmbda: float, reward) -> None:
    """Off-policy, the exact mean and variance of the cost sum are their own expected targets."""
    garbage = 1e3
    mean = mdp._with_terminal(mdp.mean[:-1], garbage)
    variance = mdp._with_terminal(mdp.variance[:-1], garbage)
    target = mdp.expected_target(mdp.gamma, lmbda, mean, mdp.stored_cost())
    torch.testing.assert_close(target, mdp.mean[:-1].flatten())
    target = mdp.expected_target(mdp.gamma**2, lmbda, variance, variance_reward(mdp, mean, reward))
    torch.testing.assert_close(target, mdp.variance[:-1].flatten())


@pytest.mark.parametrize("lmbda", [0.0, 0.97])
def test_mdp_convergence(mdp: RandomMDP, lmbda: float) -> None:
    mean, variance = torch.zeros_like(mdp.mean), torch.zeros_like(mdp.mean)
    for _ in range(60):
        new_mean = mdp.expected_target(mdp.gamma, lmbda, mean, mdp.stored_cost())
        variance = mdp._with_terminal(
            mdp.expected_target(mdp.gamma**2, lmbda, variance, variance_reward(mdp, mean))
        )
        mean = mdp._with_terminal(new_mean)
    torch.testing.assert_close(mean, mdp.mean, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(variance, mdp.variance, rtol=1e-3, atol=1e-3)


def test_mean_over_next_actions_underestimates_the_variance(mdp: RandomMDP) -> None:
    state_value = (mdp.pi * mdp.mean).sum(-1, keepdim=True)
    between_actions = (mdp.pi * (mdp.mean - state_value).square()).sum(-1)
    reward = retrace_variance_reward(
        mdp.gamma,
        mdp.stored_cost(),
        mdp.mean[mdp.state, mdp.action],
        state_value.expand_as(mdp.mean)[mdp.successor, mdp.bootstrap],
        mdp.successor == mdp.num_states,
    )
    target = mdp.expected_target(mdp.gamma**2, 0.0, mdp.variance, reward)
    missing = mdp.gamma**2 * (mdp.transition[:-1] * between_actions).sum(-1)
    assert missing.min() > 1e-4
    torch.testing.assert_close(mdp.variance[:-1].flatten() - target, missing.flatten())


def test_variance_reward_masks_the_bootstrap() -> None:
    cost, value = torch.tensor([[3.0], [3.0]]), torch.tensor([[2.0], [2.0]])
    next_value = torch.tensor([[math.nan], [4.0]])
    terminated = torch.tensor([[True], [False]])
    reward = retrace_variance_reward(0.5, cost, value, next_value, terminated)
    assert reward.squeeze(-1).tolist() == [9 - 4, 25 - 4]
    reward = squared_td_error(0.5, cost, value, next_value, terminated)
    assert reward.squeeze(-1).tolist() == [(3 - 2) ** 2, (3 + 2 - 2) ** 2]


@REWARDS
def test_discount_per_step(reward) -> None:
    mean, next_mean, cost = torch.rand(3, 2, 4, 1, dtype=torch.float64)
    gamma, end = torch.rand(2, 4, 1, dtype=torch.float64), torch.rand(2, 4, 1) > 0.5
    rows = zip(*(x.flatten() for x in (gamma, cost, mean, next_mean, end)), strict=True)
    expected = torch.cat([reward(row[0].item(), *(x[None, None] for x in row[1:])) for row in rows])
    actual = reward(gamma, cost, mean, next_mean, end)
    torch.testing.assert_close(actual.flatten(), expected.flatten())


@REWARDS
@pytest.mark.parametrize("name", ["action_value", "next_action_value", "terminated"])
def test_variance_reward_checks(name: str, reward) -> None:
    inputs = {
        "cost": torch.ones(3, 1),
        "action_value": torch.ones(3, 1),
        "next_action_value": torch.ones(3, 1),
        "terminated": torch.zeros(3, 1, dtype=torch.bool),
    }
    with pytest.raises(ValueError, match=rf"^{name} must have shape \(3, 1\), that of cost, got"):
        reward(0.9, **{**inputs, name: inputs[name][:2]})
    with pytest.raises(ValueError, match="gamma must be in"):
        reward(1.5, **inputs)
    with pytest.raises(TypeError, match="terminated must be boolean"):
        reward(0.9, **{**inputs, "terminated": inputs["cost"]})
