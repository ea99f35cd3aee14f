"""Statistics of a few seeds: intervals, tests, and what rliable has, in plain numpy and scipy.

IQM, stratified bootstrap, probability of improvement and performance profile are those of "Deep
Reinforcement Learning at the Edge of the Statistical Precipice" (Agarwal et al. 2021,
https://arxiv.org/abs/2108.13264). Its package, ``rliable``, asks for ``arch`` and ``seaborn``, and
cannot be imported with pandas 3; tests compare with what it gave.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.stats import permutation_test, ttest_ind
from scipy.stats import t as student

Array = NDArray[np.float64]


def interval(values: Array) -> tuple[float, float]:
    """95 % interval of the mean of seeds, Student's t; NaN of a single one."""
    if len(values) < 2:
        return float("nan"), float("nan")
    half = student.ppf(0.975, len(values) - 1) * values.std(ddof=1) / np.sqrt(len(values))
    return float(values.mean() - half), float(values.mean() + half)


def iqm(values: np.ndarray) -> float:
    """Interquartile mean: of the middle half of all runs, whatever their task."""
    ordered = np.sort(np.ravel(values))
    cut = len(ordered) // 4
    return float(ordered[cut : len(ordered) - cut].mean())


def stratified_interval(
    tasks: Sequence[np.ndarray],
    statistic: Callable[[np.ndarray], float],
    num_resamples: int = 2_000,
) -> tuple[float, float]:
    """95 % bootstrap interval of a statistic of all runs; seeds are resampled within each task.

    Args:
        tasks (sequence of numpy.ndarray): one value per seed, ``[num_seeds]``, for each task.
        statistic (callable): of the values of all tasks in one array.
        num_resamples (int): Defaults to 2,000.

    Returns:
        tuple of float: lower and upper bound; NaN where no task has two seeds.
    """
    if max(map(len, tasks)) < 2:
        return float("nan"), float("nan")
    rng = np.random.default_rng(0)
    draws = [
        statistic(np.concatenate([rng.choice(values, len(values)) for values in tasks]))
        for _ in range(num_resamples)
    ]
    low, high = np.quantile(draws, [0.025, 0.975])
    return float(low), float(high)


def welch(first: Array, second: Array) -> float:
    """Two-sided p of Welch's test that two methods have the same mean; NaN with a single seed."""
    if min(len(first), len(second)) < 2 or np.ptp(first) == np.ptp(second) == 0:
        return float("nan")
    return float(ttest_ind(first, second, equal_var=False).pvalue)


def permutation(first: Array, second: Array) -> float:
    """Two-sided p of the exact permutation test of the difference of two methods' means.

    Of n against n seeds it cannot be below 2 / (2n choose n): .1 for three, .0079 for five.
    """
    return float(
        permutation_test(
            (first, second),
            lambda x, y, axis: x.mean(axis) - y.mean(axis),
            vectorized=True,
            n_resamples=100_000,  # from ten against ten seeds on, a sample of the permutations
            rng=np.random.default_rng(0),
        ).pvalue
    )


def holm(values: Sequence[float]) -> list[float]:
    """P values of several tests, such that the smallest is as if it had been the only one.

    Holm, Scandinavian Journal of Statistics 1979. NaN is no test, and stays.

    Examples:
        >>> [round(p, 3) for p in holm([0.01, 0.04, 0.03])]
        [0.03, 0.06, 0.06]
    """
    out = np.array(values, float)
    order = [number for number in np.argsort(out) if not np.isnan(out[number])]
    least = 0.0
    for place, number in enumerate(order):
        least = max(least, min(1.0, (len(order) - place) * out[number]))
        out[number] = least
    return [float(value) for value in out]


def probability_of_improvement(first: Array, second: Array) -> float:
    """How often a seed of the first method is above one of the second; ties count half.

    Examples:
        >>> probability_of_improvement(np.array([2.0, 4.0]), np.array([1.0, 3.0]))
        0.75
    """
    return float((0.5 * (1 + np.sign(first[:, None] - second))).mean())


def improvement_interval(first: Array, second: Array) -> tuple[float, float]:
    """95 % bootstrap interval of :func:`probability_of_improvement`, by seeds of both methods."""
    split = len(first)
    return stratified_interval(
        [first, second],
        lambda values: probability_of_improvement(values[:split], values[split:]),
    )


def performance_profile(values: Array, levels: Array) -> Array:
    """The share of seeds above each level.

    Args:
        values (numpy.ndarray): one per seed, ``[N]``.
        levels (numpy.ndarray): ``[L]``.

    Returns:
        numpy.ndarray: ``[L]``, falling from 1 to 0.

    Examples:
        >>> performance_profile(np.array([1.0, 3.0]), np.array([0.0, 1.0, 2.0, 3.0]))
        array([1. , 0.5, 0.5, 0. ])
    """
    return (values[:, None] > levels).mean(0)
