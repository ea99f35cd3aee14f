"""Quantiles and their risks against order statistics, quadrature and brute force."""

from __future__ import annotations

from functools import partial

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import integrate, optimize, stats

from torchrl_safe.objectives.distribution import (
    calibration_scales,
    calibration_slope,
    cvar_distortion,
    draw_from_quantiles,
    project_to_quantiles,
    quantile_cvar,
    quantile_levels,
    quantile_loss,
    realised_risk,
    rescale_quantiles,
    spectral_risk,
    spectral_weights,
    stretch_quantiles,
)
from torchrl_safe.objectives.functional import gaussian_cvar

values = st.lists(st.floats(-100, 100), min_size=1, max_size=12)


def rand(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class TestQuantileLoss:
    @pytest.mark.parametrize("kappa", [0.0, 0.3, 2.0])
    @pytest.mark.parametrize("weighted", [False, True])
    def test_double_loop(self, kappa, weighted):
        quantiles, samples = rand(3, 4), rand(3, 5, seed=1)
        weights = rand(3, 5, seed=2) if weighted else None
        actual = quantile_loss(quantiles, samples, weights, kappa=kappa)
        for b in range(3):
            total = 0.0
            for i in range(4):
                for j in range(5):
                    error = (samples[b, j] - quantiles[b, i]).item()
                    slope = abs((i + 0.5) / 4 - (error < 0))
                    size = abs(error)
                    if kappa:
                        size = error**2 / 2 if size <= kappa else kappa * (size - kappa / 2)
                        size /= kappa
                    weight = weights[b, j].item() if weighted else 1 / 5
                    total += weight * slope * size / 4
            assert actual[b].item() == pytest.approx(total, rel=1e-12)

    def test_minimum_is_at_the_order_statistics(self):
        """As many samples as (odd) quantiles have cells: quantiles are samples themselves."""
        samples = rand(15, seed=3)
        quantiles = torch.zeros(5, dtype=torch.float64, requires_grad=True)
        optim = torch.optim.SGD([quantiles], lr=5.0)
        for step in range(4000):
            optim.param_groups[0]["lr"] = 5.0 * 0.998**step
            optim.zero_grad()
            quantile_loss(quantiles, samples).backward()
            optim.step()
        expected = samples.sort().values[[1, 4, 7, 10, 13]]
        torch.testing.assert_close(quantiles.detach(), expected, atol=1e-2, rtol=0)

    def test_gradient_is_that_of_the_distribution_function(self):
        """dL/dq = (F(q) - tau) / N, also for a signed measure."""
        quantiles, samples = rand(1, 6).requires_grad_(), rand(1, 9, seed=1)
        weights = rand(1, 9, seed=2)
        weights = weights - weights.mean() + 1 / 9
        quantile_loss(quantiles, samples, weights).sum().backward()
        function = ((samples[..., None, :] <= quantiles[..., None]) * weights[..., None, :]).sum(-1)
        expected = (function - quantile_levels(6, quantiles)) / 6
        torch.testing.assert_close(quantiles.grad, expected.detach())

    def test_gradcheck(self):
        assert torch.autograd.gradcheck(
            partial(quantile_loss, kappa=0.5), (rand(2, 3).requires_grad_(), rand(2, 4, seed=1))
        )

    @pytest.mark.parametrize("kappa", [-1.0, float("nan"), float("inf")])
    def test_bad_kappa(self, kappa):
        with pytest.raises(ValueError, match="kappa must be a finite number, at least 0, got"):
            quantile_loss(rand(3), rand(3), kappa=kappa)

    def test_bad_shapes(self):
        with pytest.raises(ValueError, match=r"samples must have the batch .* got \(3, 5\)"):
            quantile_loss(rand(2, 4), rand(3, 5))
        with pytest.raises(ValueError, match=r"weights must have shape \(2, 5\), that of samples"):
            quantile_loss(rand(2, 4), rand(2, 5), rand(2, 4))


class TestRisk:
    @settings(deadline=None)
    @given(values, st.floats(0.01, 1.0))
    def test_cvar_is_the_mean_of_the_worst_share(self, sample, risk_level):
        """Outcome by outcome from the worst until the share is full."""
        left, total = risk_level * len(sample), 0.0
        for value in sorted(sample, reverse=True):
            taken = min(left, 1.0)
            total, left = total + taken * value, left - taken
        actual = quantile_cvar(torch.tensor(sample, dtype=torch.float64), risk_level).item()
        assert actual == pytest.approx(total / (risk_level * len(sample)), abs=1e-6)

    @settings(deadline=None)
    @given(values, st.floats(0.01, 1.0))
    def test_cvar_is_the_optimum_of_rockafellar_and_uryasev(self, sample, risk_level):
        """A linear program whose optimum lies at an outcome."""
        outcomes = np.array(sample)
        program = min(b + np.maximum(outcomes - b, 0).mean() / risk_level for b in sample)
        actual = quantile_cvar(torch.tensor(sample, dtype=torch.float64), risk_level).item()
        assert actual == pytest.approx(program, abs=1e-6)

    def test_cvar_of_a_linear_program(self):
        """The worst density bounded by 1 / alpha, by scipy."""
        outcomes, alpha = rand(7).numpy(), 0.31
        solution = optimize.linprog(
            -outcomes / 7, A_eq=np.full((1, 7), 1 / 7), b_eq=[1.0], bounds=(0, 1 / alpha)
        )
        actual = quantile_cvar(torch.tensor(outcomes), alpha)
        assert actual.item() == pytest.approx(-solution.fun)

    @pytest.mark.parametrize("risk_level", [0.125, 0.3, 1.0])
    def test_cvar_of_many_quantiles_of_a_gaussian(self, risk_level):
        quantiles = torch.tensor(stats.norm(1, 2).ppf(quantile_levels(100_000).double()))
        exact = gaussian_cvar(torch.tensor(1.0), torch.tensor(2.0), risk_level).item()
        assert quantile_cvar(quantiles, risk_level).item() == pytest.approx(exact, rel=1e-3)

    @pytest.mark.parametrize(
        ("spectrum", "distortion"),
        [
            (lambda u: 2 * u, torch.square),
            (lambda u: 1.0, lambda u: u),
            (
                lambda u: 3 * mpmath.exp(3 * u) / mpmath.expm1(3),
                lambda u: torch.expm1(3 * u) / torch.expm1(torch.tensor(3.0).double()),
            ),
            (lambda u: 0.5 / 0.37 * (u >= 0.63) + 0.5, None),
        ],
    )
    def test_weights_are_integrals_of_the_spectrum(self, spectrum, distortion):
        if distortion is None:  # half of a mean and half of a CVaR that ends within a cell
            distortion = lambda u: (u + cvar_distortion(u, 0.37)) / 2  # noqa: E731
        weights = spectral_weights(8, distortion)
        for i, weight in enumerate(weights.tolist()):
            edges = sorted({i / 8, (i + 1) / 8, *([0.63] if i == 5 else [])})
            assert weight == pytest.approx(float(mpmath.quad(spectrum, edges)), abs=1e-12)

    def test_spectral_risk_is_quadrature_over_ranks(self):
        quantiles = rand(6)
        steps = quantiles.sort().values.numpy()
        exact, _ = integrate.quad(
            lambda u: 2 * u * steps[min(int(u * 6), 5)], 0, 1, points=np.arange(1, 6) / 6
        )
        actual = spectral_risk(quantiles, spectral_weights(6, torch.square))
        assert actual.item() == pytest.approx(exact)

    def test_crossing_quantiles_and_gradients(self):
        quantiles = rand(2, 5).requires_grad_()
        shuffled = quantiles[:, torch.tensor([3, 1, 4, 0, 2])]
        torch.testing.assert_close(quantile_cvar(shuffled, 0.3), quantile_cvar(quantiles, 0.3))
        assert torch.autograd.gradcheck(partial(quantile_cvar, risk_level=0.3), (quantiles,))

    @pytest.mark.parametrize(
        "distortion",
        [torch.sqrt, lambda u: u + 1, lambda u: u / 2, lambda u: u[:-1], lambda u: u * torch.nan],
    )
    def test_bad_distortion(self, distortion):
        with pytest.raises(ValueError, match="distortion must"):
            spectral_weights(4, distortion)

    def test_bad_arguments(self):
        with pytest.raises(ValueError, match=r"risk_level must be in \(0, 1\], got 0"):
            quantile_cvar(rand(3), 0)
        with pytest.raises(ValueError, match="num_quantiles must be an integer, at least 1, got 0"):
            spectral_weights(0, torch.square)
        with pytest.raises(ValueError, match=r"weights must have shape \(3,\), one per"):
            spectral_risk(rand(3), torch.ones(2))


class TestRealisedRisk:
    @settings(deadline=None)
    @given(values, st.floats(0.05, 1.0))
    def test_right_quantiles_give_the_risk(self, sample, risk_level):
        """Every outcome as often as predicted, one at a time."""
        quantiles = torch.tensor(sample, dtype=torch.float64)
        weights = spectral_weights(len(sample), partial(cvar_distortion, risk_level=risk_level))
        each = realised_risk(quantiles[:, None], quantiles.expand(len(sample), -1), weights)
        expected = spectral_risk(quantiles, weights)
        torch.testing.assert_close(each.mean(), expected, atol=1e-6, rtol=1e-9)

    @pytest.mark.parametrize("distortion", [torch.square, lambda u: u**5, lambda u: u])
    def test_any_spectrum(self, distortion):
        quantiles = rand(9)
        weights = spectral_weights(9, distortion)
        actual = realised_risk(quantiles, quantiles, weights)
        torch.testing.assert_close(actual, spectral_risk(quantiles, weights))

    @pytest.mark.parametrize("risk_level", [0.125, 0.25])
    def test_states_of_different_risk(self, risk_level):
        """Not the CVaR of all outcomes together, but the states' own, one outcome from each."""
        states, num_quantiles = 200_000, 64
        generator = np.random.default_rng(0)
        scale = generator.uniform(0.5, 4.0, states)
        outcome = torch.tensor(generator.exponential(scale))[:, None]
        unit = stats.expon.ppf(quantile_levels(num_quantiles).double())
        quantiles = torch.tensor(scale[:, None] * unit)
        weights = spectral_weights(num_quantiles, partial(cvar_distortion, risk_level=risk_level))
        exact = (scale * (1 - np.log(risk_level))).mean()
        actual = realised_risk(outcome, quantiles, weights).mean().item()
        assert actual == pytest.approx(exact, rel=0.02)
        pooled = quantile_cvar(outcome.squeeze(-1), risk_level).item()
        assert pooled > 1.05 * exact

    @settings(deadline=None)
    @given(values, st.lists(st.floats(-100, 100), min_size=8, max_size=8), st.floats(0.05, 1.0))
    def test_wrong_quantiles_hide_nothing(self, sample, wrong, risk_level):
        sums = torch.tensor(sample, dtype=torch.float64)
        weights = spectral_weights(8, partial(cvar_distortion, risk_level=risk_level))
        level = realised_risk(sums, torch.tensor(wrong, dtype=torch.float64), weights)
        # Of the same spectrum, a step function over eighths, on the outcomes themselves.
        fine = sums.repeat_interleave(8)
        edges = weights.repeat_interleave(len(sample)) / len(sample)
        assert level >= spectral_risk(fine, edges) - 1e-6

    def test_bad_shapes(self):
        weights = spectral_weights(4, torch.square)
        with pytest.raises(ValueError, match="sums must have the batch shape of quantiles"):
            realised_risk(rand(2, 1), rand(3, 4), weights)
        with pytest.raises(ValueError, match=r"weights must have shape \(5,\)"):
            realised_risk(rand(3, 1), rand(3, 5), weights)


class TestScales:
    """Recalibration against distributions whose scales are known, and brute force."""

    WEIGHTS = spectral_weights(64, partial(cvar_distortion, risk_level=0.125))

    def true(self):
        """States of exponential outcomes of different means: quantiles, and one outcome each."""
        quantiles = 1 + 4 * torch.rand(40_000, 1, generator=torch.Generator().manual_seed(0))
        cells = -torch.log1p(-quantile_levels(64).double())
        quantiles = quantiles.double() * cells / cells.mean()
        rank = torch.randint(64, (40_000, 1), generator=torch.Generator().manual_seed(1))
        return quantiles, quantiles.gather(1, rank)

    def test_rescaled_is_another_mean_and_spread(self):
        quantiles = rand(5, 7)
        scaled = rescale_quantiles(quantiles, 1.5, 0.25)
        torch.testing.assert_close(scaled.mean(-1), 1.5 * quantiles.mean(-1))
        torch.testing.assert_close(scaled.std(-1), 0.25 * quantiles.std(-1))
        assert scaled.argsort(-1).equal(quantiles.argsort(-1))

    @pytest.mark.parametrize(("mean", "spread"), [(1.0, 1.0), (0.8, 0.6), (1.3, 2.0), (1.0, 0.3)])
    def test_finds_what_a_critic_lacks(self, mean, spread):
        quantiles, sums = self.true()
        wrong = rescale_quantiles(quantiles, mean, spread)[:, torch.randperm(64)]
        found = calibration_scales(wrong, sums, self.WEIGHTS)
        assert found == pytest.approx((1 / mean, 1 / spread), rel=0.03)

    def test_predicted_is_realised_with_them(self):
        quantiles, sums = self.true()
        # Of another shape: no scale makes it right, and the risk is right all the same.
        wrong = rescale_quantiles(quantiles.sqrt(), 1.0, 2.0)
        right = rescale_quantiles(wrong, *calibration_scales(wrong, sums, self.WEIGHTS))
        risk = spectral_risk(right, self.WEIGHTS).mean()
        realised = realised_risk(sums, right, self.WEIGHTS).mean()
        torch.testing.assert_close(right.mean(), sums.mean())
        torch.testing.assert_close(risk, realised, rtol=1e-5, atol=0)

    def test_grid(self):
        """The spread where predicted and realised cross, of the expected larger one of two."""
        weights = spectral_weights(8, torch.square)
        quantiles, sums = rand(50, 8).exp(), rand(50, 3, seed=1).exp()
        mean, spread = calibration_scales(quantiles, sums, weights)
        gaps = []
        grid = np.geomspace(0.125, 8, 4001)
        for scale in grid:
            scaled = rescale_quantiles(quantiles, mean, scale)
            gap = spectral_risk(scaled, weights) - realised_risk(sums, scaled, weights)
            gaps.append(abs(gap.mean().item()))
        assert spread == pytest.approx(grid[int(np.argmin(gaps))], rel=2e-3)
        assert mean == pytest.approx((sums.mean() / quantiles.mean()).item())

    def test_bounds(self):
        weights = torch.tensor([0.0, 1.0])
        quantiles = torch.tensor([[1.0, 1.1]])
        found = calibration_scales(quantiles, torch.tensor([[0.0, 400.0]]), weights, high=3.0)
        assert found == pytest.approx((3.0, 3.0))
        found = calibration_scales(quantiles, torch.zeros(1, 2), weights, low=0.5)
        assert found == pytest.approx((0.5, 0.5))

    def test_nothing_to_scale(self):
        even, sums = torch.full((3, 4), 2.0), torch.full((3, 1), 3.0)
        weights = spectral_weights(4, partial(cvar_distortion, risk_level=0.25))
        assert calibration_scales(even, sums, weights) == (1.5, 1.0)
        assert calibration_scales(torch.zeros(3, 4), sums, weights) == (1.0, 1.0)
        everything = spectral_weights(4, lambda u: u)  # the mean: no spread changes it
        assert calibration_scales(rand(3, 4).exp(), sums, everything)[1] == 1.0

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"sums": torch.zeros(2, 1)}, "sums must have the batch shape"),
            ({"weights": torch.ones(3)}, "weights must have shape"),
            ({"low": 0.0}, "0 < low <= high"),
            ({"low": 2.0, "high": 1.0}, "0 < low <= high"),
            ({"quantiles": torch.zeros(0, 4), "sums": torch.zeros(0, 1)}, "at least one state"),
        ],
    )
    def test_refuses(self, change, message):
        given = {"quantiles": torch.ones(3, 4), "sums": torch.ones(3, 1), "weights": torch.ones(4)}
        with pytest.raises(ValueError, match=message):
            calibration_scales(**given | change)


class TestSlope:
    """How far apart states stand, against what they were pulled together by, and brute force."""

    WEIGHTS = TestScales.WEIGHTS

    def true(self):
        """States of exponential outcomes of means from .1 to 10: quantiles, and one outcome."""
        mean = 10 ** (2 * torch.rand(40_000, 1, generator=torch.Generator().manual_seed(0)) - 1)
        cells = -torch.log1p(-quantile_levels(64).double())
        quantiles = mean.double() * cells / cells.mean()
        rank = torch.randint(64, (40_000, 1), generator=torch.Generator().manual_seed(1))
        return quantiles, quantiles.gather(1, rank)

    def test_a_power_of_the_mean(self):
        quantiles = rand(5, 7).exp()
        stretched = stretch_quantiles(quantiles, 0.5, 3.0)
        mean = quantiles.mean(-1)
        torch.testing.assert_close(stretched.mean(-1), mean**1.5 / 3**0.5)
        torch.testing.assert_close(stretched.std(-1) / stretched.mean(-1), quantiles.std(-1) / mean)
        assert stretch_quantiles(quantiles, 0.0, 1.0).equal(quantiles)
        assert stretch_quantiles(torch.zeros(2, 3), 0.5, 1.0).equal(torch.zeros(2, 3))

    @pytest.mark.parametrize("power", [0.7, 1.0, 1.25])
    def test_finds_what_pulled_states_together(self, power):
        quantiles, sums = self.true()
        mean = quantiles.mean(-1, keepdim=True)
        pulled = quantiles / mean * mean**power
        slope, centre = calibration_slope(pulled, sums, self.WEIGHTS)
        assert slope == pytest.approx(1 / power - 1, abs=0.03)
        assert centre == pytest.approx(pulled.mean().item())

    def test_grid(self):
        """The slope at which both halves are wrong by the same share."""
        weights = spectral_weights(8, torch.square)
        quantiles, sums = rand(50, 8).exp(), rand(50, 3, seed=1).exp()
        half = quantiles.mean(-1).argsort().argsort() < 25

        def gap(slope: float) -> float:
            stretched = stretch_quantiles(quantiles, slope, quantiles.mean())
            scales = calibration_scales(stretched, sums, weights)
            right = rescale_quantiles(stretched, *scales)
            risk, realised = spectral_risk(right, weights), realised_risk(sums, right, weights)
            shares = [risk[each].mean() / realised[each].mean() for each in (half, ~half)]
            return abs((shares[0] - shares[1]).item())

        slope, _ = calibration_slope(quantiles, sums, weights)
        grid = np.linspace(-0.5, 1, 301)
        assert slope == pytest.approx(grid[int(np.argmin([gap(x) for x in grid]))], abs=0.01)

    def test_nothing_to_learn(self):
        weights = torch.tensor([0.0, 1.0])
        two = torch.tensor([[1.0, 1.0], [2.0, 2.0]])
        for quantiles, sums in (
            (torch.ones(4, 2), torch.ones(4, 1)),  # all alike
            (torch.zeros(4, 2), torch.ones(4, 1)),
            (torch.ones(1, 2), torch.ones(1, 1)),
            (two, torch.tensor([[0.0], [1.0]])),  # nothing happened to the better half
        ):
            assert calibration_slope(quantiles, sums, weights) == (0.0, 1.0)

    @pytest.mark.parametrize(
        ("change", "message"),
        [
            ({"sums": torch.zeros(2, 1)}, "sums must have the batch shape"),
            ({"weights": torch.ones(3)}, "weights must have shape"),
            ({"low": 1.0}, "low must be less than high, got 1.0 and 1.0"),
            ({"quantiles": torch.zeros(0, 4), "sums": torch.zeros(0, 1)}, "at least one state"),
        ],
    )
    def test_refuses(self, change, message):
        given = {"quantiles": torch.ones(3, 4), "sums": torch.ones(3, 1), "weights": torch.ones(4)}
        with pytest.raises(ValueError, match=message):
            calibration_slope(**given | change)


class TestProjection:
    @pytest.mark.parametrize(("count", "num_quantiles"), [(15, 5), (7, 7), (12, 6), (3, 8)])
    def test_equal_weights(self, count, num_quantiles):
        samples = rand(4, count)
        levels = quantile_levels(num_quantiles, samples).numpy() - 1e-9
        expected = np.quantile(samples.numpy(), levels, axis=-1, method="inverted_cdf")
        actual = project_to_quantiles(samples, num_quantiles)
        torch.testing.assert_close(actual, torch.tensor(expected).T)

    @settings(deadline=None)
    @given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-1, 1)), min_size=1, max_size=9))
    def test_signed_weights_by_their_definition(self, pairs):
        """The smallest outcome whose distribution function reaches the level."""
        samples, weights = (torch.tensor(x, dtype=torch.float64) for x in zip(*pairs, strict=True))
        weights[0] += 1 - weights.sum()
        actual = project_to_quantiles(samples, 3, weights)
        for value, level in zip(actual.tolist(), quantile_levels(3, samples).tolist(), strict=True):
            reached = [
                z for z in samples.tolist() if weights[samples <= z].sum().item() >= level - 1e-6
            ]
            assert value == min(reached)

    def test_it_minimises_the_regression(self):
        samples, weights = rand(20), rand(20, seed=1).softmax(-1)
        best = project_to_quantiles(samples, 4, weights)
        loss = quantile_loss(best, samples, weights)
        for seed in range(50):
            other = best + 0.1 * rand(4, seed=seed)
            assert quantile_loss(other, samples, weights) >= loss

    def test_bad_shapes(self):
        with pytest.raises(ValueError, match=r"weights must have shape \(2, 4\), that of samples"):
            project_to_quantiles(rand(2, 4), 3, rand(4))


class TestDraws:
    def test_each_is_drawn_as_often(self):
        quantiles = torch.tensor([3.0, 0.0, 2.0, 1.0, 4.0])
        generator = torch.Generator().manual_seed(0)
        draws = draw_from_quantiles(quantiles.expand(50_000, 5), 3, generator=generator)
        assert draws.shape == (50_000, 3)
        assert (draws.diff() >= 0).all()
        share = torch.bincount(draws.long().flatten(), minlength=5) / draws.numel()
        torch.testing.assert_close(share, torch.full((5,), 0.2), atol=0.005, rtol=0)

    def test_bad_number(self):
        with pytest.raises(ValueError, match="num_samples must be an integer, at least 1, got 0"):
            draw_from_quantiles(rand(3), 0)
