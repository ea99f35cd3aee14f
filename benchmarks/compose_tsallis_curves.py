"""Learning curves of ``examples/compose_tsallis.py`` for entropic indices 1, 1.4 and 2.

    python benchmarks/compose_tsallis_curves.py  # about 5 minutes on one idle core

Writes ``benchmarks/results/compose/tsallis_pendulum.csv`` and the picture beside it. ``--plot``
only draws what is there.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

from compose_tsallis import train

INDICES, SEEDS, FRAMES = (1.0, 1.4, 2.0), (0,), 5_000
TABLE = Path(__file__).parent / "results" / "compose" / "tsallis_pendulum.csv"


def measure() -> None:
    """Train every index and seed."""
    TABLE.parent.mkdir(parents=True, exist_ok=True)
    with TABLE.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("entropic_index", "seed", "frames", "return"))
        for seed, index in itertools.product(SEEDS, INDICES):
            for frames, episode_return in train(index, seed, FRAMES):
                writer.writerow((index, seed, frames, f"{episode_return:.5g}"))
            file.flush()


def plot() -> None:
    """Mean over seeds, and their range; each point averages five episodes of each seed."""
    curves = defaultdict(lambda: defaultdict(list))
    with TABLE.open() as file:
        for row in csv.DictReader(file):
            curves[row["entropic_index"]][row["seed"]].append(float(row["return"]))
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    colours = ("#0072B2", "#D55E00", "#009E73")
    for (index, seeds), colour in zip(sorted(curves.items()), colours, strict=False):
        returns = np.array(list(seeds.values())).reshape(len(seeds), -1, 5).mean(-1)
        frames = 1_000 * np.arange(1, returns.shape[1] + 1)
        axes.plot(frames, returns.mean(0), color=colour, label=f"q = {float(index):g}")
        axes.fill_between(frames, returns.min(0), returns.max(0), color=colour, alpha=0.15, lw=0)
    axes.set(xlabel="environment steps", ylabel="return, sampled action", title="Pendulum-v1")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    figure.savefig(TABLE.with_suffix(".png"), dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plot", action="store_true", help="only draw the table there is")
    if not parser.parse_args().plot:
        measure()
    plot()
