"""Learning curves of ``examples/compose_tsallis.py`` for entropic indices 1, 1.4 and 2.

    python benchmarks/compose_tsallis_curves.py  # about 15 minutes on one idle core

Writes ``benchmarks/results/compose/tsallis_pendulum.csv`` and the picture beside it. What the table
has already is not trained again; delete it to start afresh.
"""

from __future__ import annotations

import csv
import itertools
import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from compose_tsallis import train

INDICES, SEEDS, FRAMES = (1.0, 1.4, 2.0), (0, 1, 2), 5_000
TABLE = Path(__file__).parent / "results" / "compose" / "tsallis_pendulum.csv"
Curves = dict[tuple[float, int], list[float]]


def read() -> Curves:
    """Returns of the episodes of every index and seed that the table holds."""
    curves: Curves = {}
    if TABLE.exists():
        with TABLE.open() as file:
            for row in csv.DictReader(file):
                key = float(row["entropic_index"]), int(row["seed"])
                curves.setdefault(key, []).append(float(row["return"]))
    return curves


def measure() -> None:
    """Train what is missing; a line appears when its run is over."""
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    done = read()
    with TABLE.open("a", newline="") as file:
        writer = csv.writer(file)
        if not done:
            writer.writerow(("entropic_index", "seed", "frames", "return"))
        for seed, index in itertools.product(SEEDS, INDICES):
            if (index, seed) in done:
                continue
            for frames, episode_return in train(index, seed, FRAMES):
                writer.writerow((index, seed, frames, f"{episode_return:.5g}"))
            file.flush()


def plot() -> None:
    """Mean over seeds, and their range; each point averages five episodes of each seed."""
    curves = read()
    seeds = {seed for _, seed in curves}
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for index, colour in zip(INDICES, ("#0072B2", "#D55E00", "#009E73"), strict=True):
        runs = [returns for (q, _), returns in curves.items() if q == index]
        returns = np.array(runs).reshape(len(runs), -1, 5).mean(-1)
        frames = 1_000 * np.arange(1, returns.shape[1] + 1)
        axes.plot(frames, returns.mean(0), color=colour, label=f"q = {index:g}")
        axes.fill_between(frames, returns.min(0), returns.max(0), color=colour, alpha=0.15, lw=0)
    title = f"Pendulum-v1: mean and range of {len(seeds)} seed" + "s" * (len(seeds) > 1)
    axes.set(xlabel="environment steps", ylabel="return, sampled action", title=title)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    figure.savefig(TABLE.with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    measure()
    plot()
