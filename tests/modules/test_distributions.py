from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from scipy import stats
from torch.distributions import constraints, kl_divergence
from torchrl.modules import TanhNormal
from torchrl.modules.distributions.utils import has_analytic_entropy
from torchrl.testing import get_default_devices

from torchrl_safe.modules import TanhGaussianMixture, mixture_moments

RELAXATIONS = ("gumbel_softmax", "straight_through", "implicit")
EXACT = ("straight_through", "implicit")


def random_parameters(*batch, components=3, dim=2, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    draw = lambda *shape: torch.randn(*batch, *shape, generator=generator, dtype=dtype)  # noqa: E731
    return draw(components), draw(components, dim), (0.3 * draw(components, dim) - 0.7).exp()


def separated(dim=1, distance=1.2, dtype=torch.float64):
    """Two narrow components on either side of zero, with unequal weights."""
    loc = torch.linspace(1.0, 0.8, dim, dtype=dtype) * distance
    return (
        torch.tensor([0.4, -0.1], dtype=dtype),
        torch.stack([loc, -loc]),
        torch.stack([0.40 + 0 * loc, 0.55 + 0 * loc]),
    )


def numpy_density(u, logits, loc, scale):
    """Density before tanh at points u [N, D] of one mixture, by scipy."""
    weights = np.exp(logits - logits.max())
    weights /= weights.sum()
    parts = [
        w * np.prod(stats.norm.pdf(u, m, s), axis=-1)
        for w, m, s in zip(weights, loc, scale, strict=True)
    ]
    return np.sum(parts, axis=0)


class TestDensity:
    def test_integrates_to_one_in_one_dimension(self):
        dist = TanhGaussianMixture(*random_parameters(5, dim=1), low=-2.0, high=0.5)
        edges = torch.linspace(-2.0, 0.5, 200_001, dtype=torch.float64)
        middle = (edges[1:] + edges[:-1]) / 2
        density = dist.log_prob(middle[:, None, None].expand(-1, 5, 1)).exp()
        total = (density * (edges[1] - edges[0])).sum(0)
        torch.testing.assert_close(total, torch.ones(5).double(), rtol=0, atol=1e-6)

    def test_integrates_to_one_in_two_dimensions(self):
        low, high = torch.tensor([-1.0, 2.0]).double(), torch.tensor([3.0, 2.5]).double()
        dist = TanhGaussianMixture(*random_parameters(seed=3), low=low, high=high)
        grid = (torch.arange(1200, dtype=torch.float64) + 0.5) / 1200
        points = torch.cartesian_prod(grid, grid) * (high - low) + low
        total = dist.log_prob(points).exp().mean() * (high - low).prod()
        assert total.item() == pytest.approx(1, abs=1e-4)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_far_in_the_tail_against_mpmath(self, dtype):
        # u = 15 exactly: both means at 15 and zero noise. The action itself is lost in float32.
        logits = torch.tensor([0.3, -1.0], dtype=dtype)
        loc = torch.tensor([[15.0, -15.0], [15.0, -15.0]], dtype=dtype, requires_grad=True)
        scale = torch.tensor([[0.5, 1.0], [2.0, 0.25]], dtype=dtype, requires_grad=True)
        dist = TanhGaussianMixture(logits, loc, scale, relaxation="implicit", high=3.0)
        action, log_prob = dist.rsample_and_log_prob(noise=torch.zeros(2, dtype=dtype))
        with mpmath.workdps(60):
            weights = [mpmath.exp(x) for x in logits.tolist()]
            density = mpmath.fsum(
                w / mpmath.fsum(weights) / mpmath.fprod(mpmath.sqrt(2 * mpmath.pi) * s for s in row)
                for w, row in zip(weights, scale.tolist(), strict=True)
            )
            jacobian = (2 * (1 - mpmath.tanh(15) ** 2)) ** 2
            expected = float(mpmath.log(density / jacobian))
        assert log_prob.item() == pytest.approx(
            expected, rel=1e-6 if dtype.itemsize == 4 else 1e-13
        )
        (log_prob + action.sum()).backward()
        assert loc.grad.isfinite().all()
        assert scale.grad.isfinite().all()

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("distance", [0.0, 1.0, 1e-3, 1e-6])
    def test_score_of_an_action_against_mpmath(self, dtype, distance):
        """From the middle to one rounded onto the bound, which counts as the last value inside."""
        logits, loc, scale = random_parameters(dim=1, dtype=dtype, seed=5)
        action = torch.tensor([1.0 - distance], dtype=dtype)
        score = TanhGaussianMixture(logits, loc, scale).log_prob(action)
        with mpmath.workdps(60):
            y = min(mpmath.mpf(action.item()), 1 - mpmath.mpf(torch.finfo(dtype).eps) / 2)
            u = mpmath.atanh(y)
            weights = [mpmath.exp(x) for x in logits.tolist()]
            density = mpmath.fsum(
                w / mpmath.fsum(weights) * mpmath.npdf(u, m, s)
                for w, m, s in zip(weights, loc[:, 0].tolist(), scale[:, 0].tolist(), strict=True)
            )
            expected = float(mpmath.log(density / (1 - y**2)))
        assert score.item() == pytest.approx(expected, rel=1e-5 if dtype.itemsize == 4 else 1e-12)

    @pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32, torch.float64])
    @pytest.mark.parametrize(
        "box", [(-1, 1), (0, 1), (-2, 3), (100, 101), (288, 300), (-310, -300), (-1e-3, 1e4)]
    )
    def test_on_a_bound_the_nearest_action_inside_is_scored(self, dtype, box):
        """Against mpmath at the action that is as near as numbers, and tanh, come to the bound."""
        low, high = (torch.tensor([bound], dtype=dtype) for bound in box)
        logits, loc, scale = torch.zeros(1), torch.full((1, 1), 5.0), torch.full((1, 1), 0.5)
        parameters = [p.to(dtype) for p in (logits, loc, scale)]
        dist = TanhGaussianMixture(*parameters, low=low, high=high)
        for bound, other in ((low, high), (high, low)):
            score = dist.log_prob(bound)
            assert score == dist.log_prob(bound.nextafter(other))
            assert score == dist.log_prob(bound.nextafter(2 * bound - other))  # outside
            with mpmath.workdps(60):
                a, b = mpmath.mpf(low.item()), mpmath.mpf(high.item())
                margin = (high - low) * torch.finfo(dtype).eps / 4  # of tanh's last value
                if bound is low:
                    inside = mpmath.mpf(max(low.nextafter(high), low + margin).item())
                else:
                    inside = mpmath.mpf(min(high.nextafter(low), high - margin).item())
                u = mpmath.log((inside - a) / (b - inside)) / 2
                slope = 2 * (inside - a) * (b - inside) / (b - a)
                expected = float(mpmath.log(mpmath.npdf(u, 5, mpmath.mpf("0.5")) / slope))
            digits = {torch.bfloat16: 0.1, torch.float32: 1e-5, torch.float64: 1e-9}[dtype]
            assert score.item() == pytest.approx(expected, rel=digits)

    @pytest.mark.parametrize("box", [(-1.0, 1.0), (-2.0, 3.0), (100.0, 101.0)])
    def test_slope_of_the_score_in_the_action(self, box):
        """By central differences, also at the middle, where the value before tanh changes sign."""
        low, high = box
        dist = TanhGaussianMixture(*random_parameters(dim=1), low=low, high=high)
        fractions = torch.tensor([0.01, 0.3, 0.5, 0.7, 0.99], dtype=torch.float64)
        action = (low + (high - low) * fractions).unsqueeze(-1).requires_grad_()
        (slope,) = torch.autograd.grad(dist.log_prob(action).sum(), action)
        step = 1e-5 * (high - low)
        above, below = (dist.log_prob(action.detach() + h) for h in (step, -step))
        torch.testing.assert_close(
            slope.squeeze(-1), (above - below) / (2 * step), rtol=1e-4, atol=0
        )

    @pytest.mark.parametrize("given", ["number", "tensor"])
    @pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float32])
    def test_bounds_are_rounded_inwards(self, dtype, given):
        """Otherwise a saturated action is outside the box of the environment."""
        torch.manual_seed(0)
        low, high = -0.3, 0.1  # float32 rounds both outwards
        loc = torch.tensor([[40.0], [-40.0]], dtype=dtype)
        bounds = (low, high)
        if given == "tensor":
            bounds = [torch.tensor([bound], dtype=torch.float64) for bound in bounds]
        dist = TanhGaussianMixture(
            torch.zeros(2, dtype=dtype), loc, torch.ones_like(loc), low=bounds[0], high=bounds[1]
        )
        action = dist.sample((100,))
        assert action.dtype == dtype
        assert action.double().min() >= low
        assert action.double().max() <= high
        assert dist.log_prob(action).isfinite().all()

    def test_an_action_kept_in_fewer_digits(self):
        """The type with fewer digits rounded it: of what is stored, or of the parameters."""
        logits, loc, scale = random_parameters(dim=1)
        dist = TanhGaussianMixture(logits, loc, scale)
        last = torch.tensor([1.0]).nextafter(torch.tensor([0.0]))
        assert dist.log_prob(torch.tensor([1.0])) == dist.log_prob(last.double())
        single = TanhGaussianMixture(logits.float(), loc.float(), scale.float())
        stored = torch.tensor([1.0])
        score = single.log_prob(stored.double())
        torch.testing.assert_close(score.float(), single.log_prob(stored))

    def test_saturated_actions_are_finite_with_finite_gradients(self):
        logits, loc, scale = random_parameters(2, dtype=torch.float32)
        parameters = [p.requires_grad_() for p in (logits, loc, scale)]
        action = torch.tensor([[1.0, -1.0], [-1.0, 1.0]])
        score = TanhGaussianMixture(*parameters).log_prob(action)
        assert score.isfinite().all()
        score.sum().backward()
        assert all(p.grad.isfinite().all() for p in parameters)

    def test_extreme_parameters_stay_finite(self):
        logits = torch.tensor([0.0, -500.0, 300.0]).requires_grad_()
        loc = torch.tensor([[40.0], [-40.0], [0.0]]).requires_grad_()
        scale = torch.tensor([[0.018], [7.4], [0.018]]).requires_grad_()
        dist = TanhGaussianMixture(logits, loc, scale)
        score = dist.log_prob(torch.tensor([[-1.0], [-0.5], [0.0], [0.999], [1.0]]))
        assert score.isfinite().all()
        score.sum().backward()
        assert all(p.grad.isfinite().all() for p in (logits, loc, scale))

    def test_affine_map_shifts_the_density(self):
        parameters = random_parameters(4)
        low, high = torch.tensor([-3.0, 0.0]).double(), torch.tensor([1.0, 0.5]).double()
        unit = torch.rand(4, 2, dtype=torch.float64) * 1.9 - 0.95
        score = TanhGaussianMixture(*parameters, low=low, high=high).log_prob(
            low + (unit + 1) / 2 * (high - low)
        )
        reference = TanhGaussianMixture(*parameters).log_prob(unit)
        torch.testing.assert_close(score, reference - math.log(2.0 * 0.25))

    def test_sample_dimensions_broadcast(self):
        logits, loc, scale = random_parameters(4, 5)
        action = torch.rand(3, 4, 5, 2, dtype=torch.float64) - 0.5
        score = TanhGaussianMixture(logits, loc, scale).log_prob(action)
        assert score.shape == (3, 4, 5)
        one = TanhGaussianMixture(logits[1, 2], loc[1, 2], scale[1, 2]).log_prob(action[2, 1, 2])
        torch.testing.assert_close(score[2, 1, 2], one)

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_joint_score_is_the_score_of_the_action(self, relaxation):
        dist = TanhGaussianMixture(*random_parameters(6), relaxation=relaxation, low=-2.0)
        for action, score in (dist.rsample_and_log_prob((7,)), dist.sample_and_log_prob((7,))):
            assert action.shape == (7, 6, 2)
            torch.testing.assert_close(score, dist.log_prob(action), rtol=1e-7, atol=1e-7)


class TestOneComponent:
    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_equals_tanh_normal(self, relaxation):
        logits, loc, scale = random_parameters(9, components=1)
        bounds = {
            "low": torch.tensor([-2.0, 0.0]).double(),
            "high": torch.tensor([2.0, 3.0]).double(),
        }
        dist = TanhGaussianMixture(logits, loc, scale, relaxation=relaxation, **bounds)
        normal = TanhNormal(loc[:, 0], scale[:, 0], **bounds)
        noise = dist.draw_noise()
        latent = loc[:, 0] + scale[:, 0] * noise[..., :2]
        expected = normal.transforms[0](latent)
        action, score = dist.rsample_and_log_prob(noise=noise)
        torch.testing.assert_close(action, expected, rtol=0, atol=1e-14)
        torch.testing.assert_close(score, normal.log_prob(expected), rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(dist.log_prob(expected), normal.log_prob(expected))
        torch.testing.assert_close(dist.deterministic_sample, normal.deterministic_sample)


def chi_square(draws, parameters, edges):
    """Statistic and bound of draws before tanh [N, D] against exact bin probabilities."""
    logits, loc, scale = (p.numpy() for p in parameters)
    weights = np.exp(logits) / np.exp(logits).sum()
    probability = 0
    for w, m, s in zip(weights, loc, scale, strict=True):
        part = w
        for d in range(loc.shape[-1]):
            inner = np.diff(stats.norm.cdf(np.r_[-np.inf, edges, np.inf], m[d], s[d]))
            part = np.multiply.outer(part, inner)
        probability = probability + part
    bins = [np.r_[-np.inf, edges, np.inf]] * loc.shape[-1]
    counts, _ = np.histogramdd(draws, bins)
    kept = probability * len(draws) > 5
    expected = probability[kept] * len(draws)
    statistic = ((counts[kept] - expected) ** 2 / expected).sum()
    return statistic, stats.chi2.ppf(1 - 1e-6, kept.sum())


class TestDraws:
    @pytest.mark.parametrize("dim", [1, 2])
    @pytest.mark.parametrize("method", ["sample", "straight_through", "implicit"])
    def test_histogram_is_the_mixture(self, method, dim):
        torch.manual_seed(0)
        parameters = random_parameters(dim=dim, seed=7)
        relaxation = "gumbel_softmax" if method == "sample" else method
        dist = TanhGaussianMixture(*parameters, relaxation=relaxation)
        draw = dist.sample if method == "sample" else dist.rsample
        statistic, bound = chi_square(
            draw((60_000,)).atanh().numpy(), parameters, np.linspace(-3, 3, 25)
        )
        assert statistic < bound

    def test_soft_draws_are_not_the_mixture(self):
        torch.manual_seed(0)
        parameters = separated()
        soft = TanhGaussianMixture(*parameters, relaxation="gumbel_softmax")
        draws = soft.rsample((60_000,)).atanh().numpy()
        statistic, bound = chi_square(draws, parameters, np.linspace(-3, 3, 25))
        assert statistic > 10 * bound

    def test_joint_draws_are_exact_whatever_the_relaxation(self):
        torch.manual_seed(0)
        parameters = separated()
        action, score = TanhGaussianMixture(*parameters).sample_and_log_prob((60_000,))
        statistic, bound = chi_square(action.atanh().numpy(), parameters, np.linspace(-3, 3, 25))
        assert statistic < bound
        assert not action.requires_grad
        assert score.shape == (60_000,)

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_actions_stay_in_the_box(self, relaxation):
        torch.manual_seed(0)
        low, high = -torch.rand(500, 3) - 1e-3, torch.rand(500, 3) * 3 + 1e-3
        loc = torch.randn(500, 2, 3) * 20
        dist = TanhGaussianMixture(
            torch.zeros(500, 2),
            loc,
            torch.ones_like(loc),
            low=low,
            high=high,
            relaxation=relaxation,
        )
        for action in (dist.sample(), dist.rsample(), dist.deterministic_sample):
            assert dist.support.check(action).all()
            assert (action == low).any()
            assert (action == high).any()

    def test_actions_can_be_viewed(self):
        dist = TanhGaussianMixture(*random_parameters(4))
        for action in (dist.sample(), dist.rsample(), dist.deterministic_sample):
            assert action.is_contiguous()

    def test_deterministic_sample_is_a_component(self):
        logits = torch.tensor([[0.0, 2.0, 1.0], [3.0, 2.0, 1.0]])
        loc = torch.tensor([[-1.0], [0.5], [2.0]]).expand(2, 3, 1)
        dist = TanhGaussianMixture(logits, loc, torch.ones_like(loc), low=0.0, high=2.0)
        expected = 1 + torch.tensor([[0.5], [-1.0]]).tanh()
        torch.testing.assert_close(dist.deterministic_sample, expected)


class TestMoments:
    def test_brute_force(self):
        logits, loc, scale = random_parameters(3, 2, components=4, dim=3)
        mean, cov = TanhGaussianMixture(logits, loc, scale).moments
        assert mean.shape == (3, 2, 3)
        assert cov.shape == (3, 2, 3, 3)
        for b in np.ndindex(3, 2):
            w = np.exp(logits[b].numpy())
            w /= w.sum()
            m = sum(w[k] * loc[b][k].numpy() for k in range(4))
            c = sum(
                w[k]
                * (
                    np.diag(scale[b][k].numpy() ** 2)
                    + np.outer(loc[b][k].numpy() - m, loc[b][k].numpy() - m)
                )
                for k in range(4)
            )
            np.testing.assert_allclose(mean[b], m, rtol=1e-12)
            np.testing.assert_allclose(cov[b], c, rtol=1e-12)

    def test_draws(self):
        torch.manual_seed(0)
        dist = TanhGaussianMixture(*random_parameters(seed=2))
        draws = dist.sample((200_000,)).atanh()
        mean, cov = dist.moments
        error = cov.diagonal().sqrt() / math.sqrt(len(draws))
        assert ((draws.mean(0) - mean).abs() < 5 * error).all()
        torch.testing.assert_close(draws.T.cov(), cov, rtol=0.02, atol=0.02)


def objective(action, library):
    """A function of the action without symmetry, coupling its dimensions."""
    total = library.sin(2 * action[..., 0]) + 0.5 * action[..., 0] ** 2
    if action.shape[-1] > 1:
        total = total + library.cos(action[..., 0] - 2 * action[..., 1])
    return total


def quadrature_gradient(logits, loc, scale):
    """Central differences of E[f(tanh u)], computed by numpy and scipy on a grid."""
    axis = np.linspace(-6, 6, 1201)[:, None]
    if loc.shape[-1] == 2:
        axis = np.linspace(-6, 6, 241)
        axis = np.stack(np.meshgrid(axis, axis, indexing="ij"), -1).reshape(-1, 2)
    values = objective(np.tanh(axis), np)

    def expectation(flat):
        k, d = loc.shape
        density = numpy_density(
            axis, flat[:k], flat[k : k + k * d].reshape(k, d), flat[k + k * d :].reshape(k, d)
        )
        return (density * values).sum() / density.sum()

    flat = np.concatenate([p.numpy().ravel() for p in (logits, loc, scale)])
    steps = 1e-5 * np.eye(len(flat))
    return np.array([(expectation(flat + h) - expectation(flat - h)) / 2e-5 for h in steps])


def sampled_gradient(parameters, relaxation, draws=200_000):
    """Mean and standard error of the gradient, one draw of its own per row."""
    torch.manual_seed(1)
    rows = [p.expand(draws, *p.shape).clone().requires_grad_() for p in parameters]
    action = TanhGaussianMixture(*rows, relaxation=relaxation).rsample()
    gradients = torch.autograd.grad(objective(action, torch).sum(), rows)
    flat = torch.cat([g.flatten(1) for g in gradients], 1)
    return flat.mean(0).numpy(), (flat.std(0) / math.sqrt(draws)).numpy()


class TestGradient:
    @pytest.mark.parametrize("dim", [1, 2])
    def test_implicit_is_unbiased(self, dim):
        parameters = separated(dim)
        mean, error = sampled_gradient(parameters, "implicit")
        expected = quadrature_gradient(*parameters)
        assert (np.abs(mean - expected) < 5 * error + 1e-6).all()
        # The test has the power to see a bias of the size the relaxations have.
        assert np.linalg.norm(error) < 0.02 * np.linalg.norm(expected)

    @pytest.mark.parametrize("relaxation", ["gumbel_softmax", "straight_through"])
    def test_relaxations_are_biased(self, relaxation):
        parameters = separated(distance=1.5)
        mean, error = sampled_gradient(parameters, relaxation)
        expected = quadrature_gradient(*parameters)
        deviation = np.abs(mean - expected)
        assert (deviation > 10 * error).any()
        assert np.linalg.norm(deviation) > 0.1 * np.linalg.norm(expected)

    @pytest.mark.parametrize("components", [1, 3])
    @pytest.mark.parametrize("relaxation", ["gumbel_softmax", "implicit"])
    def test_differentiates_its_own_values(self, relaxation, components):
        """With the noise held, the gradient is that of the map the line search evaluates."""
        parameters = random_parameters(4, components=components, dim=3, seed=4)
        torch.manual_seed(0)
        noise = TanhGaussianMixture(*parameters, relaxation=relaxation).draw_noise((2,))

        def act(*parameters):
            dist = TanhGaussianMixture(*parameters, relaxation=relaxation)
            return dist.rsample_and_log_prob(noise=noise)

        inputs = [p.clone().requires_grad_() for p in parameters]
        assert torch.autograd.gradcheck(act, inputs, eps=1e-6, atol=1e-5, rtol=1e-5)

    @pytest.mark.parametrize(
        ("relaxation", "right"),
        [("gumbel_softmax", False), ("straight_through", True), ("implicit", True)],
    )
    def test_scale_and_entropy(self, relaxation, right):
        """The entropy of distant components is ``log K + D log scale + ...``: its slope is D.

        Soft draws between them are the less probable the smaller the scale, so that the slope that
        they give has the wrong sign: going up it shrinks the components.
        """
        torch.manual_seed(0)
        log_scale = torch.tensor(0.05).log().requires_grad_()
        loc = torch.tensor([-1.0, 1.0])[:, None].expand(20_000, 2, 2)
        dist = TanhGaussianMixture(
            torch.zeros(20_000, 2), loc, log_scale.exp().expand_as(loc), relaxation=relaxation
        )
        _, log_prob = dist.rsample_and_log_prob()
        (slope,) = torch.autograd.grad(-log_prob.mean(), log_scale)
        if right:
            assert slope.item() == pytest.approx(2.0, abs=0.05)
        else:
            assert slope < -50

    def test_straight_through_has_the_gradient_of_the_soft_weights(self):
        logits, loc, scale = (p.requires_grad_() for p in random_parameters(5))
        dist = TanhGaussianMixture(
            logits, loc, scale, relaxation="straight_through", temperature=0.7
        )
        noise = dist.draw_noise()
        latent = dist.rsample(noise=noise).atanh()
        candidates = loc + scale * noise[:, None, :2]
        chosen = (logits + noise[:, 2:]).argmax(-1)
        torch.testing.assert_close(latent, candidates[torch.arange(5), chosen])
        soft = ((logits + noise[:, 2:]) / 0.7).softmax(-1)
        jacobian = ((torch.diag_embed(soft) - soft[:, :, None] * soft[:, None]) / 0.7) @ candidates
        (gradient,) = torch.autograd.grad(latent.sum(), logits)
        torch.testing.assert_close(gradient, jacobian.sum(-1))

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_held_noise_is_deterministic_and_follows_the_parameters(self, relaxation):
        logits, loc, scale = random_parameters(50)
        make = lambda loc: TanhGaussianMixture(logits, loc, scale, relaxation=relaxation)  # noqa: E731
        noise = make(loc).draw_noise()
        first = make(loc).rsample_and_log_prob(noise=noise)
        torch.rand(3)
        second = make(loc).rsample_and_log_prob(noise=noise)
        assert torch.equal(first[0], second[0])
        assert torch.equal(first[1], second[1])
        # Translating every component translates every draw.
        moved = make(loc + 0.1).rsample(noise=noise)
        torch.testing.assert_close(moved.atanh(), first[0].atanh() + 0.1)
        # Held noise may be indexed along the batch.
        part = TanhGaussianMixture(logits[:7], loc[:7], scale[:7], relaxation=relaxation).rsample(
            noise=noise[:7]
        )
        torch.testing.assert_close(part, first[0][:7])

    def test_implicit_inverts_the_distribution_function(self):
        """Against scipy, over scales from e^-4 to e^2 and far noise, in float64 and float32."""
        generator = torch.Generator().manual_seed(0)
        logits = torch.randn(200, 4, generator=generator).double()
        loc = 4 * torch.randn(200, 4, 1, generator=generator).double()
        scale = (6 * torch.rand(200, 4, 1, generator=generator).double() - 4).exp()
        noise = 2 * torch.randn(200, 1, generator=generator).double()
        weights = logits.softmax(-1).numpy()

        def quantile_error(dtype):
            p = [x.to(dtype) for x in (logits, loc, scale)]
            dist = TanhGaussianMixture(*p, relaxation="implicit")
            latent = dist._reparameterize((), noise.to(dtype))[0].double().numpy()
            score = (latent[:, None] - loc[..., 0].numpy()) / scale[..., 0].numpy()
            return np.abs((weights * stats.norm.cdf(score)).sum(-1) - stats.norm.cdf(noise[:, 0]))

        assert quantile_error(torch.float64).max() < 1e-9
        assert quantile_error(torch.float32).max() < 1e-4

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_float32_is_safe_in_degenerate_mixtures(self, relaxation):
        torch.manual_seed(0)
        rows = 20_000
        logits = (torch.randn(rows, 3) * 60).requires_grad_()
        loc = (torch.randn(rows, 3, 2) * 15).requires_grad_()
        log_scale = (torch.rand(rows, 3, 2) * 6 - 4).requires_grad_()
        dist = TanhGaussianMixture(logits, loc, log_scale.exp(), relaxation=relaxation)
        noise = dist.draw_noise()
        noise[: rows // 2, :2] *= 3
        action, score = dist.rsample_and_log_prob(noise=noise)
        assert action.isfinite().all()
        assert score.isfinite().all()
        # Scoring a soft draw far from every component is steep, the draw itself is not.
        for gradient in torch.autograd.grad((action.sum() + score.sum()), [logits, loc, log_scale]):
            assert gradient.isfinite().all()


class TestTransforms:
    # Raised by torch itself, the first time forward mode is used.
    @pytest.mark.parametrize("relaxation", ["gumbel_softmax", "implicit"])
    def test_forward_mode_agrees_with_differences(self, relaxation):
        parameters = random_parameters(3)
        tangents = random_parameters(3, seed=9)
        noise = TanhGaussianMixture(*parameters, relaxation=relaxation).draw_noise()
        action = TanhGaussianMixture(*parameters).sample()

        def outputs(*parameters):
            dist = TanhGaussianMixture(*parameters, relaxation=relaxation)
            return (
                dist.log_prob(action),
                *dist.moments,
                *dist.rsample_and_log_prob(noise=noise),
            )

        _, forward = torch.func.jvp(outputs, parameters, tangents)
        shifted = lambda h: outputs(  # noqa: E731
            *(p + h * t for p, t in zip(parameters, tangents, strict=True))
        )
        for derivative, above, below in zip(forward, shifted(1e-6), shifted(-1e-6), strict=True):
            torch.testing.assert_close(derivative, (above - below) / 2e-6, rtol=1e-5, atol=1e-5)

    def test_vmap_over_rows(self):
        logits, loc, scale = random_parameters(6)
        action = torch.rand(6, 2, dtype=torch.float64) - 0.5

        def outputs(logits, loc, scale, action):
            dist = TanhGaussianMixture(logits, loc, scale)
            return dist.log_prob(action), *dist.moments

        mapped = torch.vmap(outputs)(logits, loc, scale, action)
        for one, other in zip(mapped, outputs(logits, loc, scale, action), strict=True):
            torch.testing.assert_close(one, other)

    def test_second_derivative_of_moments(self):
        parameters = [p.requires_grad_() for p in random_parameters(2)]
        assert torch.autograd.gradgradcheck(mixture_moments, parameters)


class TestInterface:
    @pytest.mark.parametrize("device", get_default_devices())
    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    @pytest.mark.parametrize("sample_shape", [(), (5,), (5, 2)])
    @pytest.mark.parametrize("batch", [(), (3,), (3, 4)])
    def test_shapes(self, batch, sample_shape, relaxation, dtype, device):
        """Every draw and score has TorchRL's shapes, type and device, and scores itself."""
        parameters = [p.to(device) for p in random_parameters(*batch, dtype=dtype)]
        dist = TanhGaussianMixture(*parameters, relaxation=relaxation, low=-2.0, high=0.5)
        assert (dist.batch_shape, dist.event_shape) == (batch, (2,))
        draws = [dist.sample_and_log_prob(sample_shape), dist.rsample_and_log_prob(sample_shape)]
        for action in (dist.sample(sample_shape), dist.rsample(sample_shape)):
            draws.append((action, dist.log_prob(action)))
        draws.append((dist.deterministic_sample, dist.log_prob(dist.deterministic_sample)))
        for action, score in draws:
            assert action.dtype == score.dtype == dtype
            assert action.device.type == score.device.type == torch.device(device).type
            assert dist.support.check(action).all()
            torch.testing.assert_close(score, dist.log_prob(action), rtol=2e-3, atol=2e-3)
        for action, score in draws[:-1]:
            assert action.shape == (*sample_shape, *batch, 2)
            assert score.shape == (*sample_shape, *batch)
        assert draws[-1][0].shape == (*batch, 2)

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_compiles_without_a_break(self, relaxation):
        parameters = random_parameters(4)

        def draw(noise, logits, loc, scale):
            dist = TanhGaussianMixture(logits, loc, scale, relaxation=relaxation)
            return dist.rsample_and_log_prob(noise=noise)

        noise = TanhGaussianMixture(*parameters, relaxation=relaxation).draw_noise()
        expected = draw(noise, *parameters)
        compiled = torch.compile(draw, backend="eager", fullgraph=True)(noise, *parameters)
        torch.testing.assert_close(compiled, expected)

    def test_draws_compile_without_a_break(self):
        @torch.compile(backend="eager", fullgraph=True)
        def draw(logits, loc, scale):
            dist = TanhGaussianMixture(logits, loc, scale)
            return *dist.sample_and_log_prob(), dist.log_prob(dist.sample())

        action, score, _ = draw(*random_parameters(4))
        dist = TanhGaussianMixture(*random_parameters(4))
        torch.testing.assert_close(score, dist.log_prob(action))

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_vmap_draws_apart(self, relaxation):
        """Over an ensemble, with other noise for each member or the same, as vmap is told."""
        parameters = random_parameters(3, dtype=torch.float64)

        def draw(logits, loc, scale):
            dist = TanhGaussianMixture(logits, loc, scale, relaxation=relaxation)
            return dist.rsample_and_log_prob()

        same = [p[:1].expand_as(p) for p in parameters]
        for randomness in ("same", "different"):
            action, score = torch.vmap(draw, randomness=randomness)(*same)
            dist = TanhGaussianMixture(*same)
            torch.testing.assert_close(score, dist.log_prob(action))
            assert torch.equal(action[0], action[1]) is (randomness == "same")

    def test_expand(self):
        low = torch.tensor([-2.0, -1.0]).double()
        dist = TanhGaussianMixture(
            *random_parameters(3), low=low, relaxation="implicit", temperature=0.2
        )
        wide = dist.expand((4, 3))
        assert wide.batch_shape == (4, 3)
        assert wide.event_shape == (2,)
        assert (wide.relaxation, wide.temperature) == ("implicit", 0.2)
        action, score = wide.sample_and_log_prob((2,))
        assert action.shape == (2, 4, 3, 2)
        torch.testing.assert_close(score, dist.log_prob(action))
        noise = wide.draw_noise()
        torch.testing.assert_close(wide.rsample(noise=noise), dist.rsample(noise=noise))

    def test_support(self):
        low, high = torch.tensor([-1.0, 0.0]), torch.tensor([1.0, 2.0])
        dist = TanhGaussianMixture(
            torch.zeros(2), torch.zeros(2, 2), torch.ones(2, 2), low=low, high=high
        )
        inside = torch.tensor([[0.0, 1.0], [-1.0, 2.0]])
        outside = torch.tensor([[0.0, -0.1], [1.1, 1.0], [math.nan, 1.0]])
        assert dist.support.check(inside).all()
        assert not dist.support.check(outside).any()
        assert dist.support.event_dim == 1
        assert isinstance(TanhGaussianMixture.support, constraints.Constraint)

    def test_bounds_are_tensors_of_the_parameters_kind(self):
        dist = TanhGaussianMixture(*random_parameters(3), low=-2.0, high=torch.tensor(3.0))
        for bound, value in ((dist.low, -2.0), (dist.high, 3.0)):
            assert bound.dtype == torch.float64
            assert bound.tolist() == [value, value]

    def test_only_honest_attributes(self):
        dist = TanhGaussianMixture(*random_parameters(3))
        assert TanhGaussianMixture.num_params == 3
        assert not has_analytic_entropy(dist)
        for name in ("mean", "mode", "variance"):
            with pytest.raises(NotImplementedError):
                getattr(dist, name)
        with pytest.raises(NotImplementedError):
            dist.entropy()

    @pytest.mark.parametrize("relaxation", RELAXATIONS)
    def test_has_rsample(self, relaxation):
        dist = TanhGaussianMixture(*random_parameters(3), relaxation=relaxation)
        assert dist.has_rsample == (relaxation in EXACT)
        with torch.no_grad():
            assert not dist.has_rsample

    @pytest.mark.parametrize(
        ("shapes", "kwargs", "message"),
        [
            (((4, 3), (4, 2, 2), (4, 2, 2)), {}, "logits"),
            (((4, 3), (4, 3, 2), (4, 3)), {}, "scale"),
            (((), (2,), (2,)), {}, "loc"),
            (None, {"relaxation": "gumbel"}, "relaxation .* 'gumbel'"),
            (None, {"temperature": 0.0}, "temperature .* 0.0"),
            (None, {"temperature": math.nan}, "temperature"),
            (None, {"low": 1.0}, "low=1.0"),
            (None, {"high": math.inf}, "high .* inf"),
            (None, {"low": math.nan}, "low .* nan"),
            (None, {"low": torch.zeros(3)}, r"low .*\(3,\)"),
            (None, {"low": torch.ones(2), "validate_args": True}, "low"),
        ],
    )
    def test_bad_construction(self, shapes, kwargs, message):
        shapes = shapes or ((4, 3), (4, 3, 2), (4, 3, 2))
        with pytest.raises(ValueError, match=message):
            TanhGaussianMixture(*(torch.ones(s) for s in shapes), **kwargs)

    def test_values_are_checked_on_request(self):
        logits, loc, scale = random_parameters(3)
        with pytest.raises(ValueError, match="scale"):
            TanhGaussianMixture(logits, loc, -scale, validate_args=True)
        with pytest.raises(ValueError, match="loc"):
            TanhGaussianMixture(logits, loc * math.nan, scale, validate_args=True)
        dist = TanhGaussianMixture(logits, loc, scale, validate_args=True)
        with pytest.raises(ValueError, match="support"):
            dist.log_prob(torch.full((3, 2), 1.5).double())

    def test_bad_action_and_noise(self):
        dist = TanhGaussianMixture(*random_parameters(4), relaxation="gumbel_softmax")
        with pytest.raises(ValueError, match=r"value .*\(4, 1\)"):
            dist.log_prob(torch.zeros(4, 1))
        noise = dist.draw_noise()
        assert noise.shape == (4, 5)
        for bad in (noise[:, :2], noise[:3]):
            with pytest.raises(ValueError, match="noise"):
                dist.rsample(noise=bad)
        with pytest.raises(ValueError, match="sample_shape"):
            dist.rsample((4,), noise=noise)


class TestKL:
    def test_one_component_is_exact(self):
        """By quadrature over the actions."""
        first, second = (random_parameters(components=1, dim=1, seed=seed) for seed in (1, 2))
        p, q = (TanhGaussianMixture(*part, low=-2.0, high=0.5) for part in (first, second))
        edges = torch.linspace(-2.0, 0.5, 400_001, dtype=torch.float64)
        action = ((edges[1:] + edges[:-1]) / 2).unsqueeze(-1)
        density, other = p.log_prob(action), q.log_prob(action)
        expected = (density.exp() * (density - other)).sum() * (edges[1] - edges[0])
        assert kl_divergence(p, q).item() == pytest.approx(expected.item(), rel=1e-6)

    @pytest.mark.parametrize("dim", [1, 3])
    def test_is_not_below_that_of_draws(self, dim):
        torch.manual_seed(0)
        p, q = (TanhGaussianMixture(*random_parameters(5, dim=dim, seed=seed)) for seed in (1, 2))
        bound = kl_divergence(p, q)
        action = p.sample((20_000,))
        gap = p.log_prob(action) - q.log_prob(action)
        error = gap.std(0) / math.sqrt(len(action))
        assert bound.shape == (5,)
        assert (bound > gap.mean(0) - 4 * error).all()
        assert torch.equal(kl_divergence(p, p), torch.zeros(5).double())

    def test_boxes_and_components_must_agree(self):
        p = TanhGaussianMixture(*random_parameters())
        with pytest.raises(ValueError, match=r"one box.*low=\[-1.*low=\[-2"):
            kl_divergence(p, TanhGaussianMixture(*random_parameters(), low=-2.0))
        with pytest.raises(ValueError, match=r"\(3, 2\) and \(4, 2\)"):
            kl_divergence(p, TanhGaussianMixture(*random_parameters(components=4)))
