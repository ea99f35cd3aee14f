"""Draws how high each cost of a kept run stands, beside its limit.

python benchmarks/plot_two_costs.py [PICTURE]
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "benchmarks/results/own_environments/two_costs"
COLOURS = {"collision_cost": "#0072B2", "speed_cost": "#D55E00"}


def plot(path: Path) -> None:
    """A line for each level and each limit of ``curves.csv``."""
    with (FOLDER / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(6.5, 3.8), layout="constrained")
    axes = figure.subplots()
    for cost, colour in COLOURS.items():
        for kind, style in (("level", "-"), ("limit", "--")):
            name = f"update/cost_{kind}/{cost}"
            points = [(int(row["frames"]), float(row[name])) for row in rows if row[name]]
            label = f"{cost}, {kind}"
            axes.plot(*zip(*points, strict=True), color=colour, ls=style, label=label)
    axes.set(xlabel="environment steps", ylabel="CVaR of the discounted cost", ylim=(0, None))
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=150)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    picture = ROOT / "docs/images/two_costs.png"
    parser.add_argument("picture", type=Path, nargs="?", default=picture)
    plot(parser.parse_args().picture)
