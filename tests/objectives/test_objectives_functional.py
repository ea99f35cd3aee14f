from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy import optimize, stats
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torch.distributions import Categorical, kl_divergence
from torchrl.modules import ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from torchrl_safe.modules import divergences
from torchrl_safe.objectives import functional, value
from torchrl_safe.objectives.functional import (
    clipped_surrogate,
    cup_loss,
    cvar_factor,
    discounted_cost_limit,
    focops_loss,
    gaussian_cvar,
    q_logarithm,
    surrogate_change,
    uniform_tsallis_entropy,
)


def exact_q_logarithm(log_prob: float, entropic_index: float) -> float:
    with mpmath.workdps(60):
        density, order = mpmath.exp(mpmath.mpf(log_prob)), mpmath.mpf(entropic_index) - 1
        return float(mpmath.log(density) if order == 0 else (density**order - 1) / order)


class TestQLogarithm:
    @pytest.mark.parametrize(
        "entropic_index", [0.3, 0.9, 1 - 1e-9, 1.0, 1 + 1e-12, 1 + 1e-6, 1.2, 1.4, 2.0, 3.0]
    )
    def test_arbitrary_precision(self, entropic_index):
        log_prob = [-14.0, -7.3, -1.0, -1e-8, 0.0, 1e-3, 1.7, 4.9]
        expected = [exact_q_logarithm(x, entropic_index) for x in log_prob]
        actual = q_logarithm(torch.tensor(log_prob, dtype=torch.float64), entropic_index)
        torch.testing.assert_close(
            actual, torch.tensor(expected, dtype=torch.float64), rtol=1e-12, atol=1e-15
        )

    @pytest.mark.parametrize("entropic_index", [0.5, 1.0, 1.4, 2.0])
    def test_derivative_is_a_power_of_the_density(self, entropic_index):
        log_prob = torch.linspace(-5, 4, 31, dtype=torch.float64, requires_grad=True)
        (grad,) = torch.autograd.grad(q_logarithm(log_prob, entropic_index).sum(), log_prob)
        # d ln_q(x) / d log(x) = x^(q-1)
        torch.testing.assert_close(grad, log_prob.exp().pow(entropic_index - 1).detach())

    def test_bounded_and_increasing_at_huge_densities(self):
        log_prob = torch.tensor([9.0, 11.0, 100.0, 1e6], requires_grad=True)
        value = q_logarithm(log_prob, 2.0)
        (grad,) = torch.autograd.grad(value.sum(), log_prob)
        assert value.isfinite().all()
        assert (value.diff() > 0).all()
        assert grad.max() <= math.exp(10) * (1 + 1e-6)
        assert grad.min() > 0

    @pytest.mark.parametrize("entropic_index", [0.3, 0.9, 1.2, 2.0, 7.0])
    def test_limits(self, entropic_index):
        """Densities of 0 and infinity, and those on the way there, have finite gradients."""
        order = entropic_index - 1
        limits = [-1 / order, math.inf] if order > 0 else [-math.inf, -1 / order]
        log_prob = torch.tensor([-math.inf, -1e30, -300.0, 300.0, 1e30, math.inf]).double()
        log_prob.requires_grad_()
        value = q_logarithm(log_prob, entropic_index)
        (grad,) = torch.autograd.grad(value.sum(), log_prob)
        assert [value[0].item(), value[-1].item()] == pytest.approx(limits)
        assert not value.isnan().any()
        assert grad.isfinite().all()
        assert grad.min() >= 0
        bounded = 2 if order > 0 else 3  # exact where the tangent is not reached
        expected = exact_q_logarithm(log_prob[bounded].item(), entropic_index)
        assert value[bounded].item() == pytest.approx(expected, rel=1e-12)

    def test_gradient_where_the_tangent_begins(self):
        log_prob = torch.tensor(10.0, requires_grad=True)
        q_logarithm(log_prob, 2.0).backward()
        assert log_prob.grad.item() == pytest.approx(math.exp(10), rel=1e-6)

    @pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
    @pytest.mark.parametrize("entropic_index", [0.5, 1.0, 1.2, 2.0])
    def test_half_precision(self, entropic_index, dtype):
        """As exact as the log-density that is given, also beyond the range of half precision."""
        log_prob = torch.tensor([-20.0, -3.3, -0.01, 0.01, 2.7, 9.5, 30.0], dtype=dtype)
        log_prob.requires_grad_()
        value = q_logarithm(log_prob, entropic_index)
        reachable = (entropic_index - 1) * log_prob.detach().double() <= 10
        expected = torch.tensor([exact_q_logarithm(x, entropic_index) for x in log_prob.tolist()])
        torch.testing.assert_close(
            value.detach()[reachable], expected[reachable], rtol=1e-5, atol=0
        )
        value.sum().backward()
        assert value.isfinite().all()
        assert log_prob.grad.isfinite().all()

    @pytest.mark.parametrize(
        "entropic_index", [0.0, -1.0, math.nan, math.inf, True, torch.ones(())]
    )
    def test_bad_index(self, entropic_index):
        with pytest.raises(ValueError, match=r"entropic_index must be .* got"):
            q_logarithm(torch.zeros(1), entropic_index)

    def test_tsallis_entropy_of_a_uniform_density(self):
        # Density 1/4 on a volume of 4: S_2 = -E[1/4 - 1].
        assert uniform_tsallis_entropy(math.log(4), 2.0) == pytest.approx(0.75)
        assert uniform_tsallis_entropy(-3.0, 1.0) == -3.0
        expected = -exact_q_logarithm(-1.7, 1.4)
        assert uniform_tsallis_entropy(1.7, 1.4) == pytest.approx(expected, rel=1e-13)


class TestCVaR:
    @pytest.mark.parametrize(
        ("risk_level", "expected"), [(0.125, 1.6468), (0.25, 1.2711), (0.5, 0.7979), (1.0, 0.0)]
    )
    def test_factor_of_the_paper(self, risk_level, expected):
        assert cvar_factor(risk_level) == pytest.approx(expected, abs=5e-5)

    @pytest.mark.parametrize("risk_level", [0.01, 0.125, 0.7, 0.999])
    def test_factor_by_quadrature(self, risk_level):
        threshold = stats.norm.ppf(1 - risk_level)
        tail = stats.norm.expect(lambda x: x, lb=threshold) / risk_level
        assert cvar_factor(risk_level) == pytest.approx(tail, rel=1e-6)

    def test_mean_of_the_worst_samples(self):
        torch.manual_seed(0)
        draws = (3.0 + 2.0 * torch.randn(2_000_000, dtype=torch.float64)).sort(descending=True)[0]
        worst = draws[: len(draws) // 8].mean()
        actual = gaussian_cvar(torch.tensor(3.0), torch.tensor(2.0), risk_level=0.125)
        assert actual.item() == pytest.approx(worst.item(), rel=2e-3)

    @pytest.mark.parametrize("risk_level", [0.0, -0.1, 1.01, math.nan])
    def test_bad_risk_level(self, risk_level):
        with pytest.raises(ValueError, match=r"risk_level must be in \(0, 1\], got"):
            gaussian_cvar(torch.zeros(1), torch.ones(1), risk_level)


class TestUnits:
    def test_limit_is_the_discounted_sum_of_a_constant_cost(self):
        gamma, rate = 0.97, 0.04
        total = sum(rate * gamma**t for t in range(3_000))
        assert discounted_cost_limit(rate, gamma) == pytest.approx(total)
        assert discounted_cost_limit(rate, 0.0) == rate
        assert discounted_cost_limit(0.0, gamma) == 0

    @pytest.mark.parametrize(
        ("rate", "gamma"), [(-1.0, 0.9), (math.nan, 0.9), (1.0, 1.0), (1.0, -0.1)]
    )
    def test_bad_arguments(self, rate, gamma):
        with pytest.raises(ValueError, match="must be"):
            discounted_cost_limit(rate, gamma)


class TestSurrogateChange:
    """Against sums over the actions of a bandit, which has no state to come."""

    @staticmethod
    def example():
        rng = np.random.default_rng(0)
        new, old, sampler = rng.dirichlet(np.ones(4), 3)
        advantage = rng.normal(size=4)
        counts = np.round(sampler * 40_000).astype(int)  # every action as often as it is drawn
        actions = np.arange(4).repeat(counts)
        args = [torch.tensor(np.log(p)[actions]) for p in (new, old, sampler)]
        return new, old, counts / counts.sum(), advantage, actions, args, sampler

    @pytest.mark.parametrize("gamma", [0.0, 0.8])
    def test_off_policy(self, gamma):
        new, old, visits, advantage, actions, args, sampler = self.example()
        weight = np.minimum(1, old / sampler)
        assert (weight < 1).any()
        assert (weight == 1).any()
        centred = advantage - (visits * weight * advantage).sum() / (visits * weight).sum()
        expected = (visits * (new / old - 1) * weight * centred).sum() / (1 - gamma)
        actual = surrogate_change(*args, torch.tensor(advantage[actions]), gamma)
        assert actual.item() == pytest.approx(expected, rel=1e-9)

    def test_on_policy_it_is_the_change_of_the_mean(self):
        new, old, _, advantage, _, _, _ = self.example()
        counts = np.round(old * 40_000).astype(int)
        old = counts / counts.sum()
        actions = np.arange(4).repeat(counts)
        log_new, log_old = (torch.tensor(np.log(p)[actions]) for p in (new, old))
        value = torch.tensor(advantage[actions])
        actual = surrogate_change(log_new, log_old, log_old, value, 0.9)
        assert actual.item() == pytest.approx(10 * (new - old) @ advantage, rel=1e-9)

    def test_misuse(self):
        x = torch.zeros(3)
        for position, name in enumerate(("log_pi", "log_pi", "log_mu", "advantage")):
            args = [x] * 4
            args[position] = x[:2]
            with pytest.raises(
                ValueError, match=rf"{name} must have shape \([23],\), that of log_"
            ):
                surrogate_change(*args, 0.9)
        for gamma in (-0.1, 1.0, math.nan):
            with pytest.raises(ValueError, match=rf"gamma must be in \[0, 1\), got {gamma}"):
                surrogate_change(x, x, x, x, gamma)


class TestClippedSurrogate:
    def test_equals_that_of_torchrl(self):
        torch.manual_seed(0)
        logits = TensorDictModule(nn.Linear(3, 4), ["observation"], ["logits"])
        actor = ProbabilisticActor(logits, in_keys=["logits"], distribution_class=Categorical)
        action, log_pi = torch.randint(4, (200,)), 0.5 * torch.randn(200) - 1.4
        data = TensorDict(
            {
                "observation": torch.randn(200, 3),
                "action": action,
                "action_log_prob": log_pi,
                "advantage": torch.randn(200, 1),
            },
            [200],
        )
        loss = ClipPPOLoss(actor, clip_epsilon=0.3, entropy_bonus=False)(data)["loss_objective"]
        log_prob = actor.get_dist(data).log_prob(action)
        ratio = (log_prob - log_pi).exp()
        assert ((ratio < 0.7) | (ratio > 1.3)).float().mean() > 0.2
        own = clipped_surrogate(log_prob, log_pi, data["advantage"].squeeze(-1), 0.3)
        torch.testing.assert_close(own, -loss)
        weights = list(logits.parameters())
        expected, actual = (torch.autograd.grad(value, weights) for value in (-loss, own))
        torch.testing.assert_close(actual, expected)

    def test_misuse(self):
        x = torch.zeros(3)
        with pytest.raises(ValueError, match=r"log_pi must have shape \(3,\), that of log_prob"):
            clipped_surrogate(x, x[:2], x, 0.2)
        with pytest.raises(ValueError, match=r"clip_epsilon must be in \(0, 1\), got nan"):
            clipped_surrogate(x, x, x, math.nan)


class TestCUP:
    def test_is_least_at_the_projection(self):
        """Over all policies of one state, where the optimum follows from one equation."""
        counts, half = (2, 3, 5), np.array([0.1, 0.4, 0.5])  # tenths of the old policy; pi_1/2
        old, gamma, lmbda = np.array(counts) / 10, 0.9, 0.8
        advantage = np.array([[1.0, 0.2], [-1.0, 0.3], [0.5, -0.4]])
        multiplier = np.array([0.2, 0.1])
        slope = advantage @ multiplier * (1 - gamma * lmbda) / (1 - gamma)
        # The slope of -half log(new) + new slope is the same for each action.
        shift = optimize.brentq(
            lambda x: (half / (slope + x)).sum() - 1, -slope.min() + 1e-9, 1e3, xtol=1e-14
        )
        best = half / (slope + shift)
        action = torch.arange(3).repeat_interleave(torch.tensor(counts))

        def loss(logits):
            new = Categorical(logits=logits)
            return cup_loss(
                new.logits[action],
                torch.tensor(np.log(old))[action],
                kl_divergence(Categorical(torch.tensor(half)), new).expand(10),
                torch.tensor(advantage)[action],
                torch.tensor(multiplier),
                gamma=gamma,
                lmbda=lmbda,
            )

        logits = torch.tensor(np.log(best), requires_grad=True)
        value = loss(logits)
        expected = (half * np.log(half / best)).sum() + best @ slope
        assert value.item() == pytest.approx(expected, rel=1e-9)
        (grad,) = torch.autograd.grad(value, logits)
        torch.testing.assert_close(grad, torch.zeros_like(grad))
        for other in 0.3 * np.random.default_rng(0).normal(size=(20, 3)):
            assert loss(logits.detach() + torch.tensor(other)) > value

    def test_no_gradient_reaches_the_multiplier(self):
        x, multiplier = torch.zeros(3, requires_grad=True), torch.ones(1, requires_grad=True)
        cup_loss(x, x, x, torch.ones(3, 1), multiplier, gamma=0.9, lmbda=0.9).backward()
        assert multiplier.grad is None

    def test_misuse(self):
        x, costs, prices = torch.zeros(3), torch.zeros(3, 2), torch.zeros(2)
        for name, args in {
            "log_pi": (x, x[:2], x, costs, prices),
            "divergence": (x, x, x[:2], costs, prices),
            "advantage": (x, x, x, costs, prices[:1]),
        }.items():
            with pytest.raises(ValueError, match=rf"{name} must have shape \(3,"):
                cup_loss(*args, gamma=0.9, lmbda=0.9)
        for name, wrong in (("gamma", 1.0), ("lmbda", math.nan)):
            with pytest.raises(ValueError, match=rf"{name} must be in .*, got {wrong}"):
                cup_loss(x, x, x, costs, prices, **{"gamma": 0.9, "lmbda": 0.9, name: wrong})


class TestFOCOPS:
    OLD = ((2, 3, 5), (6, 3, 1))  # tenths, by state
    ADVANTAGE = torch.tensor([[1.0, -2.0, 0.8], [-0.5, 0.5, 1.5]], dtype=torch.float64)
    WEIGHT = 1.5

    def policies(self):
        """The old one, and a new one by its logits."""
        old = torch.tensor(self.OLD, dtype=torch.float64) / 10
        logits = torch.tensor([[0.1, 0.2, 0.4], [1.5, 0.0, -0.9]], dtype=torch.float64)
        return Categorical(old), logits.requires_grad_()

    def loss(self, old, logits, max_kl):
        """On a batch that has every action as often as the old policy takes it."""
        new, state = Categorical(logits=logits), torch.arange(2).repeat_interleave(10)
        action = torch.cat([torch.arange(3).repeat_interleave(torch.tensor(n)) for n in self.OLD])
        return focops_loss(
            new.logits[state, action],
            old.logits[state, action],
            kl_divergence(new, old)[state],
            self.ADVANTAGE[state, action],
            kl_weight=self.WEIGHT,
            max_kl=max_kl,
        )

    def expected(self, old, logits):
        """Divergence, by state, from what solves the trust-region problem over all policies."""
        best = old.probs * (self.ADVANTAGE / self.WEIGHT).exp()
        return kl_divergence(Categorical(logits=logits), Categorical(best))

    def test_gradient_is_that_of_the_divergence_from_the_best_policy(self):
        old, logits = self.policies()
        (actual,) = torch.autograd.grad(self.loss(old, logits, max_kl=10.0), logits)
        (expected,) = torch.autograd.grad(self.expected(old, logits).mean(), logits)
        torch.testing.assert_close(actual, expected)

    def test_a_state_outside_the_region_adds_nothing(self):
        old, logits = self.policies()
        near, far = kl_divergence(Categorical(logits=logits), old).tolist()
        assert near < far
        loss = self.loss(old, logits, max_kl=(near + far) / 2)
        (actual,) = torch.autograd.grad(loss, logits)
        (expected,) = torch.autograd.grad(self.expected(old, logits)[0] / 2, logits)
        torch.testing.assert_close(actual, expected)
        assert (actual[0] != 0).all()
        assert (actual[1] == 0).all()

    def test_misuse(self):
        x = torch.zeros(3)
        for position, name in enumerate(("log_pi", "divergence", "advantage"), 1):
            args = [x] * 4
            args[position] = x[:2]
            with pytest.raises(ValueError, match=rf"{name} must have shape \(3,\), that of log_"):
                focops_loss(*args, kl_weight=1.0, max_kl=0.1)
        for name in ("kl_weight", "max_kl"):
            numbers = {"kl_weight": 1.0, "max_kl": 0.1, name: 0.0}
            with pytest.raises(ValueError, match=rf"{name} must be .*, got 0"):
                focops_loss(x, x, x, x, **numbers)


@pytest.mark.parametrize(
    ("room", "name", "home", "new"),
    [
        (functional, "matched_bound_kl", divergences, "matched_bound_kl"),
        (functional, "moment_matched_kl", divergences, "moment_matched_kl"),
        (value, "retrace_lambda_return_estimate", value, "trace_lambda_return_estimate"),
    ],
)
def test_names_of_before(room, name, home, new):
    with pytest.warns(DeprecationWarning, match=rf"{name} is deprecated: it is {home.__name__}.*"):
        function = getattr(room, name)
    assert function is getattr(home, new)
    with pytest.raises(AttributeError, match=f"{name}_"):
        getattr(room, f"{name}_")
