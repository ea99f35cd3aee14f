"""Surrogates against exact returns: finite differences on an enumerated MDP, and a bandit."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import ValueOperator

from torchrl_safe.objectives import CVaRSurrogateLoss, ReturnSurrogateLoss
from torchrl_safe.objectives.functional import cvar_factor, gaussian_cvar, surrogate_change
from torchrl_safe.objectives.surrogate import CostMoments

GAMMA = 0.8
STATES, ACTIONS = 3, 2


class MDP:
    """Three states, two actions, everything known."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        self.transition = rng.dirichlet(np.ones(STATES), (STATES, ACTIONS))
        self.reward = rng.normal(size=(STATES, ACTIONS))
        self.start = rng.dirichlet(np.ones(STATES))

    def solve(self, policy: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Return, occupancy of the states, advantages."""
        moves = np.einsum("sa,sat->st", policy, self.transition)
        inverse = np.linalg.inv(np.eye(STATES) - GAMMA * moves)
        value = inverse @ (policy * self.reward).sum(1)
        advantage = self.reward + GAMMA * self.transition @ value - value[:, None]
        return self.start @ value, (1 - GAMMA) * self.start @ inverse, advantage


def softmax(logits: np.ndarray) -> np.ndarray:
    return np.exp(logits) / np.exp(logits).sum(1, keepdims=True)


class TestChange:
    @pytest.mark.parametrize("off_policy", [False, True])
    def test_gradient_is_that_of_the_return(self, off_policy):
        """In the unit of the return; ratios to the sampler above one are cut to one."""
        mdp, rng = MDP(), np.random.default_rng(1)
        logits = rng.normal(size=(STATES, ACTIONS))
        policy = softmax(logits)
        _, occupancy, advantage = mdp.solve(policy)
        states = rng.choice(STATES, 400_000, p=occupancy)
        actions = (rng.random(len(states)) < policy[states, 1]).astype(int)
        log_mu = np.log(policy[states, actions])
        if off_policy:  # as if a sampler of half the density had taken them: every ratio is 2
            log_mu = log_mu + np.log(0.5)
        theta = torch.tensor(logits, requires_grad=True)
        log_prob = theta.log_softmax(1)[states, actions]
        change = surrogate_change(
            log_prob,
            log_prob.detach(),
            torch.tensor(log_mu),
            torch.tensor(advantage[states, actions]),
            GAMMA,
        )
        assert change.item() == 0
        change.backward()
        expected, eps = np.zeros_like(logits), 1e-5
        for index in np.ndindex(*logits.shape):
            step = np.zeros_like(logits)
            step[index] = eps
            up, down = (mdp.solve(softmax(logits + sign * step))[0] for sign in (1, -1))
            expected[index] = (up - down) / (2 * eps)
        np.testing.assert_allclose(theta.grad.numpy(), expected, atol=0.03 * np.abs(expected).max())

    def test_misuse(self):
        x = torch.zeros(3)
        with pytest.raises(ValueError, match="same shape"):
            surrogate_change(x, x, x, x[:2], 0.9)
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\), got 1"):
            surrogate_change(x, x, x, x, 1)


class Table(nn.Module):
    """A value per one-hot state."""

    def __init__(self, values: torch.Tensor) -> None:
        super().__init__()
        self.values = nn.Parameter(values)

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        return (observation @ self.values)[..., None]


def bandit(risk_level: float) -> tuple[CVaRSurrogateLoss, TensorDict, torch.Tensor, torch.Tensor]:
    """Two contexts, two actions taken at 1 : 3 and 1 : 1, exact critics, one step an episode."""
    cost = torch.tensor([[1.0, 3.0], [0.5, 2.0]], dtype=torch.float64)
    policy = torch.tensor([[0.25, 0.75], [0.5, 0.5]], dtype=torch.float64)
    states = torch.tensor([0, 0, 0, 0, 1, 1, 1, 1])
    actions = torch.tensor([0, 1, 1, 1, 0, 0, 1, 1])
    mean = (policy * cost).sum(1)
    variance = (policy * cost.square()).sum(1) - mean.square()
    data = TensorDict(
        {
            "observation": nn.functional.one_hot(states, 2).double()[:, None],
            "action_log_prob": policy[states, actions].log()[:, None],
            "next": {
                "observation": torch.zeros(8, 1, 2, dtype=torch.float64),
                "cost": cost[states, actions][:, None, None],
                "done": torch.ones(8, 1, 1, dtype=torch.bool),
                "terminated": torch.ones(8, 1, 1, dtype=torch.bool),
            },
        },
        [8, 1],
    )
    loss = CVaRSurrogateLoss(
        ValueOperator(Table(mean), out_keys=["cost_value"]),
        ValueOperator(Table(variance), out_keys=["cost_variance"]),
        cost_limit=0.7,
        risk_level=risk_level,
    )
    loss.make_value_estimator(gamma=0.0, lmbda=0.9)
    return loss, data, cost, torch.stack([states, actions])


@pytest.mark.parametrize("risk_level", [1.0, 0.25])
def test_a_bandits_cvar_is_followed_exactly(risk_level):
    """With one step an episode the surrogate is no approximation, however far the policy moves."""
    loss, data, cost, (states, actions) = bandit(risk_level)
    moments = loss.on_policy_moments(data)
    data = loss.compute_advantage(data)
    new = torch.tensor([[0.6, 0.4], [0.1, 0.9]], dtype=torch.float64)
    constraint = loss.constraint(data, new[states, actions].log()[:, None], moments)
    mean = (new * cost).sum(1).mean()
    std = ((new * cost.square()).sum(1).mean() - mean.square()).sqrt()
    torch.testing.assert_close(constraint, gaussian_cvar(mean, std, risk_level) - 0.7)


class CostChain(MDP):
    """Costs in place of rewards; six states, few successors each, and the moments of their sum."""

    GAMMA = 0.95

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.transition = rng.dirichlet(np.full(6, 0.3), (6, 2))
        self.cost = rng.random((6, 2)) + 1.0
        self.logits = rng.normal(size=(6, 2))
        moves = np.einsum("sa,sat->st", softmax(self.logits), self.transition)
        self.start = np.linalg.matrix_power(moves, 2000)[0]  # where the policy is

    def moments(self, logits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First two moments of the discounted cost sum, per state, by linear equations."""
        policy, gamma = softmax(logits), self.GAMMA
        moves = np.einsum("sa,sat->st", policy, self.transition)
        mean = np.linalg.solve(np.eye(6) - gamma * moves, (policy * self.cost).sum(1))
        squares = self.cost**2 + 2 * gamma * self.cost * (self.transition @ mean)
        return mean, np.linalg.solve(np.eye(6) - gamma**2 * moves, (policy * squares).sum(1))

    def variance(self, logits: np.ndarray) -> float:
        """Of the sum from a start in ``start``."""
        mean, square = self.moments(logits)
        return self.start @ square - (self.start @ mean) ** 2


def test_variance_falls_where_that_of_the_mdp_does():
    """Its gradient against finite differences: of the same size, and the same way but for noise.

    The surrogate leaves out that states visited later differ, so that single chains may disagree.
    """
    cosines, sizes = [], []
    for seed in range(20):
        chain = CostChain(seed)
        mean, square = chain.moments(chain.logits)
        states, actions, following = (x.ravel() for x in np.indices((6, 2, 6)))
        steps = TensorDict(
            {
                "observation": torch.eye(6, dtype=torch.float64)[states][:, None],
                "action_log_prob": torch.tensor(
                    np.log(softmax(chain.logits))[states, actions][:, None]
                ),
                "next": {
                    "observation": torch.eye(6, dtype=torch.float64)[following][:, None],
                    "cost": torch.tensor(chain.cost[states, actions])[:, None, None],
                    "done": torch.zeros(len(states), 1, 1, dtype=torch.bool),
                },
            },
            [len(states), 1],
        )
        loss = CVaRSurrogateLoss(
            ValueOperator(Table(torch.tensor(mean)), out_keys=["cost_value"]),
            ValueOperator(Table(torch.tensor(square - mean**2)), out_keys=["cost_variance"]),
            cost_limit=0.0,
            risk_level=0.25,
        )
        loss.make_value_estimator(gamma=chain.GAMMA, lmbda=0.0)
        weight = (
            chain.start[:, None, None] * softmax(chain.logits)[..., None] * chain.transition
        ).ravel()
        drawn = np.random.default_rng(seed).choice(len(states), 20_000, p=weight)
        data = loss.compute_advantage(steps)[drawn]
        moments = CostMoments(
            torch.tensor(chain.start @ mean), torch.tensor(chain.variance(chain.logits))
        )
        logits = torch.tensor(chain.logits, requires_grad=True)
        log_prob = logits.log_softmax(1)[states[drawn], actions[drawn]][:, None]
        cvar = loss.constraint(data, log_prob, moments)
        loss.risk_level = 1.0
        deviation = (cvar - loss.constraint(data, log_prob, moments)) / cvar_factor(0.25)
        assert deviation.item() == pytest.approx(moments.variance.sqrt().item(), rel=1e-9)
        (deviation.square()).backward()
        expected, eps = np.zeros((6, 2)), 1e-5
        for index in np.ndindex(6, 2):
            step = np.zeros((6, 2))
            step[index] = eps
            up, down = (chain.variance(chain.logits + sign * step) for sign in (1, -1))
            expected[index] = (up - down) / (2 * eps)
        actual = logits.grad.numpy()
        norms = np.linalg.norm(actual), np.linalg.norm(expected)
        cosines.append((actual * expected).sum() / np.prod(norms))
        sizes.append(norms[0] / norms[1])
    assert np.median(cosines) > 0.8
    assert 0.5 < np.median(sizes) < 2


def test_level_is_the_discounted_sum():
    """A constant cost of c per step is ``c / (1 - gamma)``, the unit of ``cost_limit``."""
    loss, data, *_ = bandit(1.0)
    loss.make_value_estimator(gamma=0.99)
    data["next", "cost"].fill_(0.05)
    assert loss.on_policy_moments(data).mean.item() == pytest.approx(5.0)


def test_critics_learn_their_targets():
    loss, data, *_ = bandit(0.25)
    out = loss(loss.compute_advantage(data))
    (out["loss_cost_value"] + out["loss_cost_variance"]).backward()
    # Exact critics: the mean residual of the mean critic vanishes, state by state.
    grad = loss.cost_network_params.get(("module", "values")).grad
    torch.testing.assert_close(grad, torch.zeros_like(grad), atol=1e-12, rtol=0)


def test_return_surrogate_shares_the_change():
    loss = ReturnSurrogateLoss(ValueOperator(Table(torch.zeros(2, dtype=torch.float64))))
    loss.make_value_estimator(gamma=0.0, lmbda=0.9)
    _, data, cost, (states, actions) = bandit(1.0)
    data["next", "reward"] = data["next", "cost"]
    data = loss.compute_advantage(data)
    old = data["action_log_prob"]
    new = torch.tensor([[0.6, 0.4], [0.1, 0.9]], dtype=torch.float64)
    change = loss.objective(data, new[states, actions].log()[:, None])
    weights = torch.tensor([[0.25, 0.75], [0.5, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(change, ((new - weights) * cost).sum(1).mean())
    assert loss.objective(data, old).item() == 0


class TestMisuse:
    def test_limits(self):
        critics = (ValueOperator(nn.Linear(2, 1), out_keys=["cost_value"]),) * 2
        with pytest.raises(ValueError, match="cost_limit must be finite and at least 0, got -1"):
            CVaRSurrogateLoss(*critics, cost_limit=-1)
        with pytest.raises(ValueError, match="risk_level"):
            CVaRSurrogateLoss(*critics, cost_limit=1, risk_level=0)

    def test_advantages_are_missing(self):
        loss, data, *_ = bandit(1.0)
        with pytest.raises(KeyError, match="pass what compute_advantage returned"):
            loss.constraint(data, data["action_log_prob"], loss.on_policy_moments(data))

    def test_discount(self):
        loss, *_ = bandit(1.0)
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\), got 1"):
            loss.make_value_estimator(gamma=1)
