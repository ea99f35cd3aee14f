"""Turns finished cells into a table, learning curves and the frontier of score and violations.

    python benchmarks/paper/make_table.py runs/paper/point benchmarks/results/paper/point

reads ``<method>/seed_<n>`` below the first folder and writes into the second: ``table.md``,
``curves.png``, ``frontier.png``, and each run's curves, configuration and commit (keep_run.py).

The interquartile mean and the stratified bootstrap are those of Agarwal et al. 2021
(https://arxiv.org/abs/2108.13264).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.stats import trim_mean

sys.path.insert(0, str(Path(__file__).parents[1]))
from keep_run import keep_run

from torchrl_safe.record import read_metrics

PAPER = {  # Table I on Point: score, CV per step
    "SafeTAC q=1.4": (8.4, 0.009),
    "SafeTAC q=1.2": (10.4, 0.007),
    "SafeTAC q=1.0": (10.1, 0.008),
    "TRC": (13.0, 0.003),
    "WCSAC": (-0.2, 0.015),
    "CPO": (8.0, 0.021),
}
COLUMNS = {
    "score": "eval/score",
    "score, det.": "eval/det/score",
    "CV": "eval/cv_rate",
    "CV, det.": "eval/det/cv_rate",
    "return": "eval/return",
    "total CVs": "total_cvs",
}


def iqm(values: np.ndarray) -> float:
    """Interquartile mean: of the middle half of all runs, whatever their task."""
    return float(trim_mean(np.ravel(values), 0.25))


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


def read_results(root: Path) -> dict[str, list[dict[str, float]]]:
    """Results of each method's finished runs, seed by seed."""
    out: dict[str, list[dict[str, float]]] = {}
    for path in sorted(root.glob("*/seed_*/results.json")):
        out.setdefault(path.parts[-3], []).append(json.loads(path.read_text()))
    return out


def table(results: Mapping[str, Sequence[Mapping[str, float]]]) -> str:
    """A row per method, each cell mean and IQM over seeds with the interval of the IQM."""
    lines = [
        "| method | seeds | frames | " + " | ".join(COLUMNS) + " |",
        "|---" * (3 + len(COLUMNS)) + "|",
    ]
    for method, runs in results.items():
        cells = [method, str(len(runs)), f"{min(run['frames'] for run in runs):,}"]
        for key in COLUMNS.values():
            values = np.array([run[key] for run in runs], dtype=float)
            low, high = stratified_interval([values], iqm)
            spread = "" if np.isnan(low) else f", IQM {iqm(values):.4g} ({low:.4g} to {high:.4g})"
            cells.append(f"{values.mean():.4g}{spread}")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def plot_curves(root: Path, path: Path) -> None:
    """Training return, violations and cost of every run, a colour per method."""
    panels = {
        "train/reward_per_1000": "return of 1,000 steps",
        "train/cv_rate": "violations per step",
        "train/total_cvs": "violations so far",
    }
    figure = Figure(figsize=(13, 4), layout="constrained")
    axes = figure.subplots(1, len(panels))
    for number, method in enumerate(sorted(read_results(root))):
        for seed, results in enumerate(sorted(root.glob(f"{method}/seed_*/results.json"))):
            metrics = read_metrics(results.with_name("log"))
            for axis, (name, label) in zip(axes, panels.items(), strict=True):
                if name in metrics:
                    axis.plot(
                        *metrics[name],
                        color=f"C{number % 10}",
                        ls=("-", "--")[number // 10],
                        lw=1,
                        label=None if seed else method,
                    )
                axis.set(xlabel="frames", ylabel=label)
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=120)


def plot_frontier(results: Mapping[str, Sequence[Mapping[str, float]]], path: Path) -> None:
    """Score against violations: a line per method through its cost limits, the paper's points."""
    lines: dict[str, list[tuple[float, float]]] = {}
    for name, runs in results.items():
        point = tuple(np.mean([run[key] for run in runs]) for key in ("eval/cv_rate", "eval/score"))
        lines.setdefault(name.split("_limit")[0], []).append(point)
    figure = Figure(figsize=(7, 5), layout="constrained")
    axis = figure.subplots()
    for name, points in lines.items():
        axis.plot(*zip(*sorted(points), strict=True), "o-", label=name)
    for name, (value, cv) in PAPER.items():
        axis.plot(cv, value, "kx")
        axis.annotate(f"{name} (paper)", (cv, value), fontsize=7)
    axis.set(xlabel="violations per step", ylabel="score")
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main(argv: Sequence[str] | None = None) -> None:
    """Write table, pictures and curves."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args(argv)
    results = read_results(args.root)
    if not results:
        parser.error(f"root={args.root} has no <method>/seed_<n>/results.json.")
    args.out.mkdir(parents=True, exist_ok=True)
    for path in sorted(args.root.glob("*/seed_*/results.json")):
        keep_run(path.parent, args.out / path.parts[-3] / path.parts[-2])
    (args.out / "table.md").write_text(table(results))
    plot_curves(args.root, args.out / "curves.png")
    plot_frontier(results, args.out / "frontier.png")
    print(table(results))


if __name__ == "__main__":
    main()
