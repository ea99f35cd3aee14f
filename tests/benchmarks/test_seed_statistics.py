"""Statistics of seeds, beside rliable, scipy's other ways, and enumeration."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
import seed_statistics as statistics
from scipy.stats import mannwhitneyu, trim_mean
from scipy.stats import t as student

FIVE = np.array([3.12573022, 2.86789514, 3.64042265, 3.10490012, 2.46433063])
OTHER = np.array([2.86159505, 3.80400005, 3.44708096, 1.79626476, 1.23457853])


class TestIntervals:
    def test_iqm(self):
        assert statistics.iqm(np.array([-100.0, 1.0, 2.0, 100.0])) == 1.5
        for seeds in range(1, 12):
            values = np.random.default_rng(seeds).normal(size=seeds)
            assert statistics.iqm(values) == pytest.approx(trim_mean(values, 0.25))

    @pytest.mark.parametrize(
        ("shape", "expected"),
        [
            ((5, 4), (2.82631519, 2.48603393, 3.16570731)),
            ((3, 1), (3.19091138, 2.33480533, 4.36646347)),
            ((10, 6), (3.17447445, 2.92109017, 3.4581457)),
        ],
    )
    def test_rliable(self, shape, expected):
        """rliable 1.2.0 on the same numbers; it cannot be imported with pandas 3."""
        generator = np.random.default_rng(0)
        for size in ((5, 4), (3, 1), (10, 6)):  # drawn one after the other
            values = generator.normal(3, 1, size)
            if size == shape:
                break
        low, high = statistics.stratified_interval(list(values.T), statistics.iqm, 20_000)
        assert statistics.iqm(values) == pytest.approx(expected[0], abs=1e-7)
        assert (low, high) == pytest.approx(expected[1:], abs=0.02)

    def test_interval_covers_the_mean(self):
        """Of 200 samples of a known mean, about 95 % of the intervals hold it."""
        rng = np.random.default_rng(1)
        samples = rng.normal(3.0, 1.0, (200, 2, 20))
        hits = 0
        for tasks in samples:
            low, high = statistics.stratified_interval(tasks, np.mean, num_resamples=200)
            hits += low <= 3.0 <= high
        assert 0.88 <= hits / 200 <= 0.99

    def test_strata_are_kept(self):
        """Seeds that agree within their task leave nothing to chance, however tasks differ."""
        low, high = statistics.stratified_interval([np.zeros(3), np.ones(3)], np.mean)
        assert low == high == 0.5

    def test_one_seed_has_no_interval(self):
        assert np.isnan(statistics.stratified_interval([np.ones(1)], statistics.iqm)).all()
        assert np.isnan(statistics.interval(np.ones(1))).all()

    def test_interval_is_students(self):
        """Of Student's own sleep data, first drug; R's t.test gives these bounds."""
        extra = np.array([0.7, -1.6, -0.2, -1.2, -0.1, 3.4, 3.7, 0.8, 0.0, 2.0])
        assert statistics.interval(extra) == pytest.approx((-0.5297804, 2.0297804), abs=1e-6)


class TestTests:
    def test_welch_by_its_formula(self):
        """Welch 1947, with Satterthwaite's degrees of freedom."""
        a, b = (x.var(ddof=1) / len(x) for x in (FIVE, OTHER))
        degrees = (a + b) ** 2 / (a**2 / 4 + b**2 / 4)
        t = abs(FIVE.mean() - OTHER.mean()) / np.sqrt(a + b)
        assert statistics.welch(FIVE, OTHER) == pytest.approx(2 * student.sf(t, degrees))

    def test_welch_needs_a_spread(self):
        assert np.isnan(statistics.welch(FIVE, np.ones(1)))
        assert np.isnan(statistics.welch(np.ones(3), np.ones(2)))

    def test_permutation_by_enumeration(self):
        values = np.concatenate([FIVE, OTHER])

        def difference(rows):
            chosen = np.isin(np.arange(10), rows)
            return abs(values[chosen].mean() - values[~chosen].mean())

        found = difference(range(5))
        shares = [difference(rows) >= found - 1e-12 for rows in combinations(range(10), 5)]
        assert statistics.permutation(FIVE, OTHER) == pytest.approx(np.mean(shares))

    @pytest.mark.parametrize(("seeds", "least"), [(3, 0.1), (5, 2 / 252)])
    def test_permutation_of_few_seeds_cannot_be_small(self, seeds, least):
        values = np.arange(seeds, dtype=float)
        assert statistics.permutation(values, values + 100) == pytest.approx(least)

    def test_holm(self):
        """R: p.adjust(c(.01, .02, .03, .005), "holm"); what is not a test is not counted."""
        values = [0.01, 0.02, float("nan"), 0.03, 0.005]
        adjusted = statistics.holm(values)
        assert adjusted[:2] + adjusted[3:] == pytest.approx([0.03, 0.04, 0.04, 0.02])
        assert np.isnan(adjusted[2])
        assert statistics.holm([0.9, 0.8]) == [1.0, 1.0]


class TestRliable:
    def test_probability_of_improvement(self):
        """rliable 1.2.0: .6, and by 20,000 resamples .2 to 1."""
        assert statistics.probability_of_improvement(FIVE, OTHER) == pytest.approx(0.6)
        low, high = statistics.improvement_interval(FIVE, OTHER)
        assert (low, high) == pytest.approx((0.2, 1.0), abs=0.05)

    def test_probability_of_improvement_is_mann_and_whitneys(self):
        first, second = np.array([1.0, 2.0, 2.0]), np.array([2.0, 0.0])
        expected = mannwhitneyu(first, second).statistic / 6
        assert statistics.probability_of_improvement(first, second) == pytest.approx(expected)

    def test_performance_profile(self):
        """rliable 1.2.0, at the levels 0, 1, ... 5."""
        profile = statistics.performance_profile(FIVE, np.arange(6.0))
        assert profile == pytest.approx([1, 1, 1, 0.6, 0, 0])
