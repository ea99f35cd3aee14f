from __future__ import annotations

import math

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from scipy.stats import norm

from torchrl_safe.record import calibrate, discounted_sums, plot_calibration

GAMMA = 0.9


def test_discounted_sums_are_the_definition():
    values = torch.rand(2, 3, 7, generator=torch.Generator().manual_seed(0))
    sums = discounted_sums(values, GAMMA)
    for t in range(7):
        expected = sum(GAMMA ** (k - t) * values[..., k].double() for k in range(t, 7))
        torch.testing.assert_close(sums[..., t], expected)
    assert discounted_sums(values, 0.0).allclose(values.double())


class TestKnownDistribution:
    """Independent Gaussian costs: their discounted sum is a Gaussian of known moments."""

    risk_level = 0.125

    @pytest.fixture
    def truth(self):
        generator = torch.Generator().manual_seed(0)
        rate = torch.linspace(1, 3, 400)[:, None].expand(400, 140)  # of an episode's cost
        cost = rate + 0.5 * torch.randn(400, 140, generator=generator)
        mean = rate.double() / (1 - GAMMA)
        std = 0.5 / math.sqrt(1 - GAMMA**2)
        factor = norm.pdf(norm.ppf(0.125)) / 0.125
        return cost, mean, mean + factor * std

    @pytest.fixture
    def bins(self, truth):
        cost, mean, cvar = truth
        return calibrate(
            mean, cvar, cost, gamma=GAMMA, risk_level=self.risk_level, num_bins=20, tail=1e-3
        )

    def test_mean(self, bins):
        # About 70 independent sums to a bin, with a deviation of 1.15.
        np.testing.assert_allclose(bins["realised_mean"], bins["predicted_mean"], atol=0.5)

    def test_cvar(self, bins):
        np.testing.assert_allclose(bins["realised_cvar"], bins["predicted_cvar"], atol=0.8)
        assert (bins["realised_cvar"] - bins["predicted_cvar"]).mean().abs() < 0.2

    def test_interval_holds_the_truth(self, bins):
        low, high = bins["realised_mean_low"], bins["realised_mean_high"]
        inside = (low <= bins["predicted_mean"]) & (bins["predicted_mean"] <= high)
        assert inside.sum() >= 17  # of 20 at 95 %
        assert (low < high).all()

    def test_a_wrong_critic_is_found_out(self, truth):
        cost, mean, cvar = truth
        bins = calibrate(
            0.5 * mean, cvar - 2, cost, gamma=GAMMA, risk_level=self.risk_level, tail=1e-3
        )
        assert (bins["realised_mean_low"] > bins["predicted_mean"]).all()
        assert (bins["realised_cvar_low"] > bins["predicted_cvar"]).all()

    def test_bins_are_equal_and_rise(self, bins, truth):
        assert bins.batch_size == (20,)
        assert (bins["predicted_mean"].diff() > 0).all()
        # Together they hold every step that counts: the mean over bins is that of the steps.
        torch.testing.assert_close(bins["predicted_mean"].mean(), truth[1].mean())


def test_the_end_of_an_episode_does_not_count():
    cost = torch.zeros(5, 60)
    cost[:, :30] = 1.0
    mean = discounted_sums(cost, GAMMA)
    bins = calibrate(mean, mean, cost, gamma=GAMMA, risk_level=0.5, num_bins=1, tail=0.05)
    steps = [t for t in range(60) if GAMMA ** (60 - t) <= 0.05]
    assert steps[-1] == 31
    torch.testing.assert_close(bins["realised_mean"][0], mean[0, steps].mean())


def test_cvar_is_the_mean_of_the_worst_share():
    cost = torch.rand(7, 50, generator=torch.Generator().manual_seed(1))
    predicted = torch.rand(7, 50, generator=torch.Generator().manual_seed(2))
    bins = calibrate(predicted, predicted, cost, gamma=GAMMA, risk_level=0.5, num_bins=1, tail=0.5)
    known = [t for t in range(50) if GAMMA ** (50 - t) <= 0.5]
    outcomes = np.sort(discounted_sums(cost, GAMMA)[:, known].numpy().ravel())
    half = len(outcomes) // 2
    worst = outcomes[::-1]
    expected = (worst[:half].sum() + worst[half] * (len(outcomes) / 2 - half)) / (len(outcomes) / 2)
    assert bins["realised_cvar"][0].item() == pytest.approx(expected)


def test_plot(tmp_path):
    cost = torch.rand(6, 100, generator=torch.Generator().manual_seed(0))
    mean = discounted_sums(cost, GAMMA)
    bins = calibrate(mean, mean + 1, cost, gamma=GAMMA, risk_level=0.2)
    path = plot_calibration(bins, tmp_path / "new" / "calibration.png")
    picture = imageio.imread(path)
    assert picture.shape[0] > 400
    assert picture[..., :3].std() > 5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cost": torch.ones(4, 99)}, r"one shape \[N, T\]"),
        ({"gamma": 1.0}, r"gamma must be in \[0, 1\), got 1.0"),
        ({"risk_level": 0.0}, r"risk_level must be in \(0, 1\], got 0.0"),
        ({"num_bins": 0}, "num_bins must be at least 1, got 0"),
        ({"tail": 1.0}, r"tail must be in \(0, 1\), got 1.0"),
        ({"gamma": 0.99}, "100 steps per episode"),
    ],
)
def test_misuse(changes, message):
    one = torch.ones(4, 100)
    arguments = {"mean": one, "cvar": one, "cost": one, "gamma": 0.9, "risk_level": 0.5}
    with pytest.raises(ValueError, match=message):
        calibrate(**arguments | changes)


def test_discount_out_of_range():
    with pytest.raises(ValueError, match="gamma must be"):
        discounted_sums(torch.ones(3), 1.5)
