"""How far the trust region's linear model of the constraint was off, from the curves of kept runs.

    python benchmarks/paper/prediction_error.py benchmarks/results/paper/jackal/safetac_*/seed_0

A row a run: the median over its updates of ``|predicted - real| / max(|real|, 0.05)``, where both
are the change of the constraint by a step; and the least entropy of the run. A large error means
that the distance of the trust region did not hold the policy.
"""

from __future__ import annotations

import argparse
import csv
import statistics
from pathlib import Path

SMALLEST_CHANGE = 0.05  # in units of the discounted cost; what is less counts as this much
COLUMNS = ("update/constraint_predicted", "update/constraint_change", "train/entropy")


def prediction_error(run: Path) -> tuple[float, float]:
    """Median relative error of the predicted change, and the least entropy.

    Args:
        run (path): the ``curves.csv`` of ``benchmarks/keep_run.py``.

    Raises:
        ValueError: if the run has no step of a trust region with a constraint.
    """
    with run.open(newline="") as file:
        rows = [[row.get(name) or "nan" for name in COLUMNS] for row in csv.DictReader(file)]
    numbers = [tuple(map(float, row)) for row in rows]
    errors = [
        abs(predicted - real) / max(abs(real), SMALLEST_CHANGE)
        for predicted, real, _ in numbers
        if predicted == predicted and real == real  # not NaN: an update that was logged
    ]
    if not errors:
        raise ValueError(f"{run} has no {COLUMNS[0]} and {COLUMNS[1]}: it is no trust region's.")
    return statistics.median(errors), min(e for *_, e in numbers if e == e)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    print("| run | error of the prediction | least entropy |\n|---|---:|---:|")
    for run in parser.parse_args().runs:
        error, entropy = prediction_error(run / "curves.csv")
        print(f"| {'/'.join(run.parts[-3:])} | {error:.0%} | {entropy:.1f} |")


if __name__ == "__main__":
    main()
