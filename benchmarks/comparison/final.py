"""Searches each tuned method's limit, and makes the trainings that are compared.

    python benchmarks/comparison/final.py --dry-run
    python benchmarks/comparison/final.py --jobs 2
    python benchmarks/comparison/final.py --robot car --methods safetac cpo --jobs 2
    python benchmarks/comparison/final.py --frames 10_000_000 --methods safetac cpo --jobs 2

The limit that a method is given is not the cost that it comes to. So it is searched: a few
trainings with limits around the tuned one, and between them the limit at which the realised mean
discounted cost is 2, 3 or 5, or is nearest. ``frozen.json`` keeps what is found. Then the final
trainings, with new seeds, on new layouts, at these limits. ``--frames`` is of these alone: their
limits are those that were found with the plan's frames.

Only what is missing is run, as by tune.py, which comes first.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
from plan import Comparison, Training, arguments, realised, training
from scipy.optimize import isotonic_regression
from spaces import ROWS
from tune import ROBOT, again

from torchrl_safe.envs import ROBOTS

LIMIT = "loss.cost_limit"


def searched(there: Comparison, row: str) -> list[float]:
    """The limits of the search, in the order of their seeds: around the tuned one, then beyond.

    Beyond the ends once more, and again, where a target is not between what is realised there.
    """
    plan, tuned = there.plan, there.frozen[row]["drawn"][LIMIT]
    limits = [three_digits(tuned * multiple) for multiple in plan.multiples]
    for _ in range(plan.further):
        results = there.kept(search(there, row, limits))
        if results is None:
            break
        low, high = min(limits), max(limits)
        costs = [realised(each) for each in results if "diverged" not in each]
        if costs and min(plan.targets) < min(costs):
            limits.append(three_digits(low / plan.factor))
        if costs and max(plan.targets) > max(costs):
            limits.append(three_digits(high * plan.factor))
    return limits


def three_digits(limit: float) -> float:
    """As it stands in commands and names of folders."""
    return float(f"{limit:.3g}")


def search(there: Comparison, row: str, limits: Sequence[float]) -> list[Training]:
    """The trainings of a search, of a seed each."""
    plan = there.plan
    return [
        training(
            plan,
            there.args.robot,
            "search",
            row,
            f"limit_{limit:g}",
            plan.frames,
            plan.search_seed + number,
            there.frozen[row]["drawn"] | {LIMIT: limit},
        )
        for number, limit in enumerate(limits)
    ]


def realised_at(there: Comparison, row: str) -> list[tuple[float, float]] | None:
    """Limits and what was realised with each, once the search is done.

    On the robot that was tuned on, the tuned trainings count, too: they have the same options.
    """
    cells = search(there, row, searched(there, row))
    if there.args.robot == ROBOT:
        number = int(there.frozen[row]["trial"].removeprefix("trial_"))
        cells += again(there.plan, row, [number])
    results = there.kept(cells)
    if results is None:
        return None
    return [(each["options"][LIMIT], realised(each)) for each in results if "diverged" not in each]


def limit_for(points: Sequence[tuple[float, float]], target: float) -> float:
    """The limit at which a cost is realised, or is nearest of those that were tried.

    What is realised is taken to rise with the limit: it is fitted by isotonic regression of
    logarithms, which averages over trainings that say otherwise, and read off the lines between.
    Where the fit is flat, the middle of the flat part stands for it.

    Args:
        points (sequence of tuple): limits, and the realised cost of a training with each.
        target (float): the realised cost that is wanted.

    Examples:
        >>> limit_for([(2.0, 1.0), (8.0, 4.0)], 2.0)
        4.0
        >>> limit_for([(2.0, 1.0), (8.0, 4.0)], 5.0)
        8.0
    """
    tried, costs = np.log(np.maximum(np.array(points).T, 1e-6))  # of no cost at all, too
    limits, which = np.unique(tried, return_inverse=True)
    trainings = np.bincount(which)
    fit = isotonic_regression(np.bincount(which, costs) / trainings, weights=trainings).x
    levels = np.unique(fit)
    middles = [limits[fit == level].mean() for level in levels]
    return three_digits(math.exp(np.interp(math.log(target), levels, middles)))


def finals(there: Comparison, row: str, limits: dict[str, float]) -> list[Training]:
    """The trainings that are compared, seed by seed; targets with one limit share theirs."""
    return [
        training(
            there.plan,
            there.args.robot,
            "final",
            row,
            f"limit_{limit:g}",
            there.args.frames or there.plan.frames,
            seed,
            there.frozen[row]["drawn"] | {LIMIT: limit},
        )
        for seed in there.plan.final_seeds
        for limit in dict.fromkeys(limits.values())
    ]


def settle(there: Comparison, row: str) -> dict[str, float] | None:
    """The limits of a row by target, found or frozen; None while the search is not done."""
    name = f"limits_{there.args.robot}"
    if name not in there.frozen[row]:
        points = realised_at(there, row)
        if points is None:
            return None
        limits = {f"{target:g}": limit_for(points, target) for target in there.plan.targets}
        there.freeze(row, **{name: limits})
        print(f"frozen    {row}: {limits}", flush=True)
    return there.frozen[row][name]


def main(argv: Sequence[str] | None = None) -> int:
    """Search and train; the exit status is the number of trainings that failed."""
    of_robot: tuple[str, Any] = ("--robot", {"choices": ROBOTS, "default": ROBOT})
    of_frames: tuple[str, Any] = ("--frames", {"type": int, "help": "of the final trainings"})
    there = Comparison(arguments(__doc__, argv, of_robot, of_frames))
    plan = there.plan
    rows = [row for row in there.args.methods if row in there.frozen]
    if untuned := [row for row in there.args.methods if row not in rows]:
        print(f"not tuned yet: {', '.join(untuned)}")
    failed = 0
    for _ in range(1 + plan.further):  # what lies beyond is known once the ends are there
        cells = [cell for row in rows for cell in search(there, row, searched(there, row))]
        if not there.table.missing(cells):
            break
        failed += there.fill(cells)
        if there.args.dry_run:
            break
    done = {row: limits for row in rows if (limits := settle(there, row)) is not None}
    failed += there.fill([cell for row in done for cell in finals(there, row, done[row])])
    if there.args.dry_run:
        frames = there.args.frames or plan.frames
        later = []
        for row in there.args.methods:
            method = ROWS[row].method
            if row not in rows:
                later += [(method, plan.frames)] * len(plan.multiples)
            if row not in done:
                later += [(method, frames)] * (len(plan.targets) * len(plan.final_seeds))
        there.estimate(later, "of search and comparison")
    return failed


if __name__ == "__main__":
    sys.exit(main())
