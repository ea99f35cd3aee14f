"""Surrogates against exact returns: finite differences on an enumerated MDP, and a bandit."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import ValueEstimators

from torchrl_safe import RetraceEstimator
from torchrl_safe.objectives import CostMoments, CVaRSurrogateLoss, ReturnSurrogateLoss
from torchrl_safe.objectives.functional import cvar_factor, gaussian_cvar, surrogate_change

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
        with pytest.raises(ValueError, match=r"advantage must have shape \(3,\)"):
            surrogate_change(x, x, x, x[:2], 0.9)
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\), got 1"):
            surrogate_change(x, x, x, x, 1)


class TestUnderflow:
    """Ratios far below what single precision holds, against 60 digits."""

    def exact(self, log_prob, log_pi, log_mu, advantage, gamma):
        with mpmath.workdps(60):
            weights = [
                min(mpmath.mpf(1), mpmath.exp(mpmath.mpf(pi) - mpmath.mpf(mu)))
                for pi, mu in zip(log_pi.tolist(), log_mu.tolist(), strict=True)
            ]
            values = advantage.tolist()
            mean = sum(w * a for w, a in zip(weights, values, strict=True)) / sum(weights)
            moved = (
                (mpmath.exp(mpmath.mpf(new) - mpmath.mpf(pi)) - 1) * w * (a - mean)
                for new, pi, w, a in zip(
                    log_prob.tolist(), log_pi.tolist(), weights, values, strict=True
                )
            )
            return float(sum(moved) / len(values) / (1 - gamma))

    @pytest.mark.parametrize("shift", [0.0, -20.0, -60.0, -200.0, -1e5])
    @pytest.mark.parametrize("step", [0.0, 0.1, 3.0])
    def test_change(self, shift, step):
        rng = torch.Generator().manual_seed(0)
        log_pi, log_mu, noise, advantage = torch.randn(4, 50, generator=rng)
        log_pi = log_pi + shift
        log_prob = (log_pi + step * noise).requires_grad_()
        change = surrogate_change(log_prob, log_pi, log_mu, advantage, 0.9)
        expected = self.exact(log_prob, log_pi, log_mu, advantage, 0.9)
        assert change.item() == pytest.approx(expected, rel=1e-3, abs=1e-30)
        change.backward()
        assert log_prob.grad.isfinite().all()

    def test_a_policy_that_returns_to_its_data(self):
        """The ratio to the policy overflows, the ratio to the sampler is one."""
        log_mu, advantage = torch.zeros(3), torch.tensor([1.0, 2.0, 6.0])
        log_pi = torch.tensor([-150.0, 0.0, 0.0])
        change = surrogate_change(log_mu, log_pi, log_mu, advantage, 0.0)
        # Only the first action is more probable than before, by its whole density.
        assert change.item() == pytest.approx((1.0 - 4.0) / 3)


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
    moments = loss.measure(data)
    data = loss.compute_advantage(data)
    new = torch.tensor([[0.6, 0.4], [0.1, 0.9]], dtype=torch.float64)
    constraint = loss.constraint(data, new[states, actions].log()[:, None], moments)
    mean = (new * cost).sum(1).mean()
    std = ((new * cost.square()).sum(1).mean() - mean.square()).sqrt()
    torch.testing.assert_close(constraint, gaussian_cvar(mean, std, risk_level) - 0.7)


@pytest.mark.parametrize("risk_level", [1.0, 0.25])
def test_advantage_has_the_gradient_of_the_cvar(risk_level):
    """That of the bandit is known: its moments are sums over contexts and actions."""
    loss, data, cost, (states, actions) = bandit(risk_level)
    moments = loss.measure(data)
    advantage = loss.advantage(loss.compute_advantage(data), moments)
    policy = torch.tensor([[0.25, 0.75], [0.5, 0.5]], dtype=torch.float64)
    logits = policy.log().requires_grad_()
    new = logits.softmax(1)
    mean = (new * cost).sum(1).mean()
    std = ((new * cost.square()).sum(1).mean() - mean.square()).sqrt()
    exact = gaussian_cvar(mean, std, risk_level)
    torch.testing.assert_close(loss.level(moments), exact.detach())
    (expected,) = torch.autograd.grad(exact, logits)
    ratio = logits.softmax(1)[states, actions] / policy[states, actions]
    (actual,) = torch.autograd.grad((ratio * advantage.squeeze(-1)).mean(), logits)
    torch.testing.assert_close(actual, expected)


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
            torch.tensor(chain.start @ mean),
            torch.tensor(chain.variance(chain.logits)),
            torch.tensor(1 / (1 - chain.GAMMA)),
            torch.tensor(1 / (1 - chain.GAMMA**2)),
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
    data["next", "terminated"].zero_()
    assert loss.measure(data).mean.item() == pytest.approx(5.0)


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


def make_losses(**options):
    """Both losses, with critics that are functions of a state."""
    torch.manual_seed(0)

    def critic(key, *last):
        return ValueOperator(MLP(3, 1, num_cells=[8]).extend(last), out_keys=[key]).double()

    losses = (
        ReturnSurrogateLoss(critic("state_value")),
        CVaRSurrogateLoss(
            critic("cost_value"),
            critic("cost_variance", nn.Softplus()),
            cost_limit=0.5,
            risk_level=0.5,
        ),
    )
    for loss in losses:
        loss.make_value_estimator(gamma=0.9, lmbda=0.8)
    return losses


def make_steps(batch=(4, 6)):
    """Off-policy trajectories that end here and there, most of them by truncation."""
    rng = torch.Generator().manual_seed(1)

    def rand(*shape):
        return torch.randn(*batch, *shape, generator=rng, dtype=torch.float64)

    done = rand(1) > 0.8
    return TensorDict(
        {
            "observation": rand(3),
            "action_log_prob": rand(),
            "next": {
                "observation": rand(3),
                "reward": rand(1),
                "cost": rand(1).sigmoid(),
                "done": done,
                "terminated": done & (rand(1) > 0.5),
            },
        },
        batch,
    )


def all_advantages(data):
    """Advantages and targets of both losses."""
    for loss in make_losses():
        data = loss.compute_advantage(data, policy_log_prob=data["action_log_prob"] - 0.3)
    names = ("advantage", "cost_advantage", "square_advantage")
    return data.select(*names, "value_target", "cost_target", "variance_target")


class TestData:
    """The right number, or an error that says what to do."""

    def test_time_first(self):
        data = make_steps()
        data.names = [None, "time"]
        turned = data.transpose(0, 1).contiguous()
        expected = all_advantages(data)
        torch.testing.assert_close(
            all_advantages(turned).transpose(0, 1).contiguous().to_dict(), expected.to_dict()
        )
        _, loss = make_losses()
        torch.testing.assert_close(loss.measure(turned), loss.measure(data))

    @pytest.mark.parametrize("dtype", [torch.int64, torch.bool])
    def test_rewards_and_costs_that_are_counted(self, dtype):
        data = make_steps()
        for key in ("reward", "cost"):
            data["next", key] = (data["next", key] > 0.5).double()
        counted = data.clone()
        for key in ("reward", "cost"):
            counted["next", key] = data["next", key].to(dtype)
        torch.testing.assert_close(
            all_advantages(counted).to_dict(), all_advantages(data).to_dict()
        )
        _, loss = make_losses()
        for one, other in zip(loss.measure(counted), loss.measure(data), strict=True):
            torch.testing.assert_close(one, other, check_dtype=False)

    def test_a_next_state_that_is_missing_at_an_end(self):
        data = make_steps()
        ends = data["next", "done"].expand(-1, -1, 3)
        there = data.clone()
        there["next", "observation"] = torch.where(
            ends, data["observation"], data["next", "observation"]
        )
        data["next", "observation"] = torch.where(ends, torch.nan, data["next", "observation"])
        torch.testing.assert_close(all_advantages(data).to_dict(), all_advantages(there).to_dict())

    def test_n_steps(self):
        """Without a trace: both moments bootstrap at gamma ** n."""
        reward_loss, loss = make_losses()
        for each in (reward_loss, loss):
            each.make_value_estimator(gamma=0.9, lmbda=0.0)
        data = make_steps()
        steps = torch.randint(1, 6, (4, 6, 1))
        data["steps_to_next_obs"] = steps
        alive = 1 - data["next", "terminated"].double()

        def value(name, states):
            with getattr(loss, f"{name}_params").to_module(getattr(loss, name)):
                return getattr(loss, name).module(states).detach()

        mean, following = (
            value("cost_network", x) for x in (data["observation"], data["next", "observation"])
        )
        spread, next_spread = (
            value("variance_network", x) for x in (data["observation"], data["next", "observation"])
        )
        backup = data["next", "cost"] + 0.9**steps * alive * following
        out = loss.compute_advantage(reward_loss.compute_advantage(data))
        torch.testing.assert_close(out["cost_advantage"], backup - mean)
        second = backup**2 - mean**2 + 0.81**steps * alive * next_spread - spread
        torch.testing.assert_close(out["square_advantage"], second)
        with pytest.raises(ValueError, match="'steps_to_next_obs' must be 1 everywhere"):
            loss.measure(data)

    def test_agents(self):
        """Agents that share a critic are as many trajectories of one agent each."""
        alone = make_steps((4, 3, 6))
        together = TensorDict(alone.transpose(1, 2).to_dict(), [4, 6])
        expected = all_advantages(alone)
        for key, value in all_advantages(together).items():
            torch.testing.assert_close(value, expected[key].transpose(1, 2))
        reward_loss, loss = make_losses()
        results = []
        for td in (alone, together):
            td["next", "terminated"].zero_()
            data = loss.compute_advantage(reward_loss.compute_advantage(td))
            log_prob = 1.1 * data["action_log_prob"]
            results.append(
                [
                    reward_loss.objective(data, log_prob),
                    loss.constraint(data, log_prob, loss.measure(td)),
                    reward_loss(data)["loss_value"],
                ]
            )
        torch.testing.assert_close(*results)

    def test_padding(self):
        """Trajectories of 6 and 2 steps, padded with NaN, against the steps alone."""
        data = make_steps((2, 6))
        data["next", "done"].zero_()
        data["next", "terminated"].zero_()
        data["next", "done"][:, -1] = data["next", "done"][1, 1] = True
        mask = torch.ones(2, 6, 1, dtype=torch.bool)
        mask[1, 2:] = False
        real = data[mask.squeeze(-1)]
        data["next", "done"][1, 1] = False  # that padding begins is an end, too
        for key in (("next", "cost"), ("next", "reward"), ("next", "observation"), "observation"):
            data[key][~mask.squeeze(-1)] = torch.nan
        data["collector", "mask"] = mask
        results = []
        for td in (data, real):
            reward_loss, loss = make_losses()
            out = loss.compute_advantage(reward_loss.compute_advantage(td))
            log_prob = 0.9 * td["action_log_prob"]
            measured = loss.measure(td)
            results.append(
                [
                    *measured,
                    loss.constraint(out, log_prob, measured),
                    reward_loss.objective(out, log_prob),
                    *loss(out).values(),
                    *reward_loss(out).values(),
                ]
            )
        torch.testing.assert_close(*results)

    @pytest.mark.parametrize(
        "key",
        ["action_log_prob", "observation", ("next", "observation"), ("next", "done"), "next"],
    )
    @pytest.mark.parametrize("index", [0, 1])
    def test_a_missing_entry_is_named(self, key, index):
        name = key if isinstance(key, str) else key[-1]
        with pytest.raises(KeyError, match=f"'{name}'.*is not in the tensordict"):
            make_losses()[index].compute_advantage(make_steps().exclude(key))

    @pytest.mark.parametrize(("index", "key"), [(0, "value_target"), (1, "cost_target")])
    def test_targets_are_missing_or_of_somebody_else(self, index, key):
        loss, data = make_losses()[index], make_steps()
        with pytest.raises(KeyError, match=f"{key}.*is missing: pass what compute_advantage"):
            loss(data)
        data[key] = torch.zeros(4, 6, dtype=torch.float64)
        with pytest.raises(ValueError, match=rf"'{key}' must have shape \(4, 6, 1\), .*\(4, 6\)"):
            loss(data)


def test_episodes_that_terminate():
    """Ten steps of cost 1: level and gradient are of what is left of them, not of 1 / (1 - g)."""
    _, loss = make_losses()
    loss.make_value_estimator(gamma=0.99)
    data = make_steps((5, 10))
    data["next", "cost"].fill_(1)
    data["next", "done"].zero_()
    data["next", "done"][:, -1] = True
    data["next", "terminated"] = data["next", "done"]
    measured = loss.measure(data)
    left = sum((1 - 0.99**k) / 0.01 for k in range(1, 11)) / 10
    assert measured.mean.item() == pytest.approx(left)
    assert measured.horizon.item() == pytest.approx(left)
    left_of_squares = sum((1 - 0.9801**k) / (1 - 0.9801) for k in range(1, 11)) / 10
    assert measured.square_horizon.item() == pytest.approx(left_of_squares)


class TestMeasurement:
    def test_it_cannot_be_left_out(self):
        _, loss = make_losses()
        data = loss.compute_advantage(make_steps())
        with pytest.raises(TypeError, match="measured"):
            loss.constraint(data, data["action_log_prob"])
        with pytest.raises(
            TypeError, match=r"measured must be what measure\(...\) returned, got T"
        ):
            loss.constraint(data, data["action_log_prob"], torch.tensor(3.0))

    def test_limits_may_be_changed_and_loaded(self):
        _, loss = make_losses()
        data = make_steps()
        measured, out = loss.measure(data), loss.compute_advantage(data)
        before = loss.constraint(out, data["action_log_prob"], measured)
        now = loss.constraint(out, data["action_log_prob"], measured, cost_limit=3.0)
        torch.testing.assert_close(now, before - 2.5)  # of now: the loss's own stays
        with pytest.raises(ValueError, match=r"cost_limit must be .* at least 0, got -1"):
            loss.constraint(out, data["action_log_prob"], measured, cost_limit=-1.0)
        loss.cost_limit = 2.0
        torch.testing.assert_close(
            loss.constraint(out, data["action_log_prob"], measured), before - 1.5
        )
        loss.risk_level = 1.0
        _, other = make_losses()
        other.load_state_dict(loss.state_dict())
        assert (other.cost_limit, other.risk_level) == (2.0, 1.0)
        with pytest.raises(
            ValueError, match="cost_limit must be a finite number, at least 0, got -1"
        ):
            loss.cost_limit = -1
        with pytest.raises(ValueError, match=r"risk_level must be in \(0, 1\], got 0"):
            loss.risk_level = 0


class TestMisuse:
    def test_limits(self):
        critics = (ValueOperator(nn.Linear(2, 1), out_keys=["cost_value"]),) * 2
        with pytest.raises(
            ValueError, match="cost_limit must be a finite number, at least 0, got -1"
        ):
            CVaRSurrogateLoss(*critics, cost_limit=-1)
        with pytest.raises(ValueError, match="risk_level"):
            CVaRSurrogateLoss(*critics, cost_limit=1, risk_level=0)

    def test_advantages_are_missing(self):
        loss, data, *_ = bandit(1.0)
        with pytest.raises(KeyError, match="pass what compute_advantage returned"):
            loss.constraint(data, data["action_log_prob"], loss.measure(data))

    @pytest.mark.parametrize("value_type", ["td0", ValueEstimators.GAE, RetraceEstimator])
    def test_estimators(self, value_type):
        loss, *_ = bandit(1.0)
        if value_type is RetraceEstimator:
            value_type = RetraceEstimator(gamma=0.9, lmbda=0.9)
        loss.make_value_estimator("retrace", gamma=0.9)
        with pytest.raises(ValueError, match="value_type must be 'retrace', RetraceEstimator or"):
            loss.make_value_estimator(value_type)

    def test_keys_that_forward_reads(self):
        loss, *_ = bandit(1.0)
        loss.set_keys(cost_target="mine")
        assert loss.in_keys == ["observation", "mine", "variance_target"]

    def test_discount(self):
        loss, *_ = bandit(1.0)
        with pytest.raises(ValueError, match=r"gamma must be in \[0, 1\), got 1"):
            loss.make_value_estimator(gamma=1)
