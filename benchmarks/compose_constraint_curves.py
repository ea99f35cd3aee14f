"""Learning curves of ``examples/compose_constraint.py``.

    python examples/compose_constraint.py  # about 3 minutes on one idle core
    python benchmarks/compose_constraint_curves.py runs/compose_constraint

Writes ``benchmarks/results/compose/constraint_pendulum.csv`` and the picture beside it.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from matplotlib.figure import Figure

from torchrl_safe.record import read_metrics

TABLE = Path(__file__).parent / "results" / "compose" / "constraint_pendulum.csv"
LIMIT = 0.1
COLUMNS = {"cost": "train/cost", "reward": "train/reward", "kl": "update/kl"}


def tabulate(run_dir: Path) -> None:
    """Write the metrics of every batch to one table."""
    metrics = read_metrics(run_dir / "log")
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("frames", *COLUMNS))
        steps = metrics["train/cost"][0]
        values = [metrics[name][1] for name in COLUMNS.values()]
        for frames, *row in zip(steps, *values, strict=True):
            writer.writerow((frames, *(f"{value:.4g}" for value in row)))


def plot() -> None:
    """Cost and reward per step over frames, beside the limit."""
    with TABLE.open() as file:
        rows = [{name: float(x) for name, x in row.items()} for row in csv.DictReader(file)]
    frames = [row["frames"] for row in rows]
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    for axes, name, title in zip(
        figure.subplots(1, 2),
        ("cost", "reward"),
        ("Steps above 4 rad/s", "Reward per step"),
        strict=True,
    ):
        axes.plot(frames, [row[name] for row in rows], color="#0072B2")
        axes.set(title=title, xlabel="environment steps")
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(alpha=0.25)
        if name == "cost":
            axes.axhline(LIMIT, color="black", ls="--", label="limit")
            axes.set(ylim=(0, None))
            axes.legend(frameon=False)
    figure.savefig(TABLE.with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    tabulate(parser.parse_args().run_dir)
    plot()
