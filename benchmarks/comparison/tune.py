"""Tunes every method alike: random trials, the best of them again, and what is best is frozen.

    python benchmarks/comparison/tune.py --dry-run
    python benchmarks/comparison/tune.py --jobs 2
    python benchmarks/comparison/tune.py --methods safetac cpo --jobs 2

Only what is missing is run, and an interrupted training goes on: the same command can be given
again after any stop. Ctrl-C saves all that are running. Results are small files in
``benchmarks/results/comparison/point/tuning``; what is found is in ``frozen.json`` beside them,
where an entry is never changed. docs/protocol.md has the rules.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from itertools import groupby

import numpy as np
from plan import Comparison, Plan, Training, arguments, merit, training
from spaces import ROWS

ROBOT = "point"


def trial(plan: Plan, row: str, number: int, frames: int, seed: int) -> Training:
    """A training of what a trial's number draws."""
    drawn = ROWS[row].draw(number)
    return training(plan, ROBOT, "tuning", row, f"trial_{number:02d}", frames, seed, drawn)


def trials(plan: Plan, row: str) -> list[Training]:
    """The random trials of a row."""
    return [
        trial(plan, row, number, plan.trial_frames, plan.trial_seed + number)
        for number in range(plan.trials)
    ]


def best_trials(there: Comparison, row: str) -> list[int] | None:
    """Numbers of the best trials, best first, once all are there."""
    results = there.kept(trials(there.plan, row))
    if results is None:
        return None
    merits = [merit(each, there.plan.tuning_target) for each in results]
    return [int(number) for number in np.argsort(merits)[::-1][: there.plan.best]]


def again(plan: Plan, row: str, numbers: Sequence[int]) -> list[Training]:
    """Trials once more, longer and with more seeds."""
    return [
        trial(plan, row, number, plan.frames, seed)
        for number in numbers
        for seed in plan.best_seeds
    ]


def freeze(there: Comparison, row: str, numbers: Sequence[int]) -> None:
    """Write down the one that is best on average, once all are there."""
    cells = again(there.plan, row, numbers)
    results = there.kept(cells)
    if results is None:
        return
    merits = {
        name: float(np.mean([merit(each, there.plan.tuning_target) for each in of]))
        for name, of in groupby(results, key=lambda each: each["name"])
    }
    winner = max(merits, key=lambda name: merits[name])
    drawn = ROWS[row].draw(int(winner.removeprefix("trial_")))
    there.freeze(row, trial=winner, merits=rounded(merits), drawn=drawn)
    print(f"frozen    {row}: {winner}, {merits[winner]:.3g}", flush=True)


def rounded(merits: dict[str, float]) -> dict[str, float | None]:
    """To four digits; JSON has no number for the merit of what diverged."""
    return {n: float(f"{x:.4g}") if np.isfinite(x) else None for n, x in merits.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Tune; the exit status is the number of trainings that failed."""
    there = Comparison(arguments(__doc__, argv))
    plan, rows = there.plan, there.args.methods
    failed = there.fill([cell for row in rows for cell in trials(plan, row)])
    best = {row: numbers for row in rows if (numbers := best_trials(there, row)) is not None}
    failed += there.fill([cell for row in best for cell in again(plan, row, best[row])])
    if there.args.dry_run:
        later = [ROWS[row].method for row in rows if row not in best]
        runs = [
            (method, plan.frames)
            for method in later
            for _ in range(plan.best * len(plan.best_seeds))
        ]
        there.estimate(runs, "of the best trials again")
        return 0
    for row, numbers in best.items():
        freeze(there, row, numbers)
    return failed


if __name__ == "__main__":
    sys.exit(main())
