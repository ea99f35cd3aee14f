"""Turns finished cells into tables, learning curves and the frontier of score and violations.

    python benchmarks/paper/make_table.py runs/paper/point benchmarks/results/paper/point

reads ``<method>/seed_<n>`` below the first folder, which is named after the robot, and writes into
the second: ``table.md`` with the paper's figures beside; ``claims.md``, the paper's claims about
its figures, with the same differences here; ``table_1.png`` and ``table_3.png``, learning curves;
``frontier.png``; and each run's curves, configuration and commit (keep_run.py).
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, NullLocator
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))
from keep_run import keep_run
from run_table import TABLES
from seed_statistics import interval, permutation, stratified_interval, welch

from torchrl_safe.record import read_metrics

Array = NDArray[np.float64]

# Score and CV per step of Tables I and III.
PAPER: dict[str, dict[str, tuple[float, float]]] = {
    "point": {
        "safetac_q14": (8.4, 0.009),
        "safetac_q12": (10.4, 0.007),
        "safetac_q10": (10.1, 0.008),
        "trc": (13.0, 0.003),
        "wcsac": (-0.2, 0.015),
        "cpo": (8.0, 0.021),
        "safetac_k3": (10.57, 0.002),
        "safetac_k5": (11.78, 0.005),
        "safetac_lmbda0": (-0.02, 0.026),
        "safetac_lagrangian": (-0.15, 0.007),
    },
    "car": {
        "safetac_q14": (14.5, 0.005),
        "safetac_q12": (18.2, 0.002),
        "safetac_q10": (18.7, 0.002),
        "trc": (15.9, 0.002),
        "wcsac": (5.4, 0.003),
        "cpo": (12.5, 0.011),
    },
    "doggo": {
        "safetac_q14": (13.9, 0.001),
        "safetac_q12": (13.6, 0.002),
        "safetac_q10": (13.1, 0.002),
        "trc": (11.0, 0.004),
        "wcsac": (10.5, 0.001),
        "cpo": (6.0, 0.020),
    },
    "jackal": {
        "safetac_q14": (8.02, 0.040),
        "safetac_q12": (8.22, 0.022),
        "safetac_q10": (4.49, 0.066),
        "trc": (9.24, 0.007),
        "wcsac": (2.86, 0.004),
        "cpo": (6.81, 0.072),
    },
}
SCORE, CV = "eval/score", "eval/cv_rate"
DEFAULT_LIMIT = "5"  # of a cell without one in its name
CLAIMS = [  # of the paper: the first has more of the quantity than the second
    ("{} scores more than {}", SCORE, ("SafeTAC", "safetac_q12"), ("CPO", "cpo")),
    ("{} scores more than {}", SCORE, ("SafeTAC", "safetac_q12"), ("WCSAC", "wcsac")),
    ("{} scores more than {}", SCORE, ("TRC", "trc"), ("SafeTAC", "safetac_q12")),
    ("{} violates more than {}", CV, ("CPO", "cpo"), ("SafeTAC", "safetac_q12")),
    ("{} scores more than {}", SCORE, ("K = 5", "safetac_k5"), ("K = 1", "safetac_q12")),
    ("{} violates more than {}", CV, ("K = 1", "safetac_q12"), ("K = 5", "safetac_k5")),
    ("{} scores more than {}", SCORE, ("q = 1.2", "safetac_q12"), ("q = 1.4", "safetac_q14")),
    ("{} scores more than {}", SCORE, ("q = 1.2", "safetac_q12"), ("q = 1", "safetac_q10")),
    ("{} scores more than {}", SCORE, ("lambda = .97", "safetac_q10"), ("0", "safetac_lmbda0")),
    (
        "{} scores more than {}",
        SCORE,
        ("the trust region", "safetac_q10"),
        ("Lagrange", "safetac_lagrangian"),
    ),
]
"""On Point; on a robot where the paper's figures say the opposite, that is the claim."""
COLUMNS = {
    "score": "eval/score",
    "score, det.": "eval/det/score",
    "CV": "eval/cv_rate",
    "CV, det.": "eval/det/cv_rate",
    "return": "eval/return",
    "total CVs": "total_cvs",
}


def read_results(root: Path) -> dict[str, list[dict[str, float]]]:
    """Results of each method's finished runs, seed by seed."""
    out: dict[str, list[dict[str, float]]] = {}
    for path in sorted(root.glob("*/seed_*/results.json")):
        out.setdefault(path.parts[-3], []).append(json.loads(path.read_text()))
    return out


def table(
    results: Mapping[str, Sequence[Mapping[str, float]]],
    paper: Mapping[str, tuple[float, float]],
) -> str:
    """A row per method, each cell a mean over seeds with Student's interval."""
    head = ["method", "seeds", "frames", *COLUMNS, "paper: score / CV"]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for method, runs in results.items():
        cells = [method, str(len(runs)), f"{min(run['frames'] for run in runs):,}"]
        for key in COLUMNS.values():
            values = np.array([run[key] for run in runs], dtype=float)
            low, high = interval(values)
            spread = "" if np.isnan(low) else f" ({low:.4g} to {high:.4g})"
            cells.append(f"{values.mean():.4g}{spread}")
        cells.append("{:.4g} / {:.3f}".format(*paper[method]) if method in paper else "-")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def claims(
    results: Mapping[str, Sequence[Mapping[str, float]]],
    paper: Mapping[str, tuple[float, float]],
) -> str:
    """A row per claim: the paper's difference of means and the one here with its interval.

    A claim holds or fails if Welch's test tells the means apart at .05, and is open otherwise. The
    permutation test supposes less, and of three seeds against three its p cannot be below .10.
    """
    lines = ["| claim | paper | here (95 %) | p, Welch | p, permutation | |", "|---" * 6 + "|"]
    for text, key, *names in CLAIMS:
        if not {name for _, name in names} <= results.keys() & paper.keys():
            continue
        published = np.subtract(*(paper[name][key == CV] for _, name in names))
        if published < 0:
            published, names = -published, names[::-1]
        pair = [np.array([run[key] for run in results[name]], float) for _, name in names]
        split = len(pair[0])

        def difference(values: np.ndarray, split: int = split) -> float:
            return float(values[:split].mean() - values[split:].mean())

        here = difference(np.concatenate(pair))
        low, high = stratified_interval(pair, difference)
        p = welch(*pair)
        verdict = "open" if not p < 0.05 else "holds" if here > 0 else "fails"
        spread, tests = "one seed", ["", ""]
        if min(map(len, pair)) > 1:
            spread, tests = f"{low:+.3g} to {high:+.3g}", [f"{p:.2g}", f"{permutation(*pair):.2g}"]
        cells = [text.format(*(name for name, _ in names)), f"{published:+.3g}"]
        lines.append("| " + " | ".join([*cells, f"{here:+.3g} ({spread})", *tests, verdict]) + " |")
    return "\n".join(lines) + "\n"


def plot_curves(root: Path, methods: Sequence[str], path: Path) -> None:
    """Training return and violations, a colour per method: means over seeds, and their range."""
    panels = {
        "train/reward_per_1000": "return of 1,000 steps",
        "train/cv_rate": "violations per step",
        "train/total_cvs": "violations so far",
    }
    figure = Figure(figsize=(13, 4), layout="constrained")
    axes = figure.subplots(1, len(panels))
    for number, method in enumerate(methods):
        runs = [
            read_metrics(results.with_name("log"))
            for results in sorted(root.glob(f"{method}/seed_*/results.json"))
        ]
        for axis, (name, label) in zip(axes, panels.items(), strict=True):
            curves = [run[name] for run in runs if name in run]
            axis.set(xlabel="frames", ylabel=label)
            if not curves:
                continue
            frames = curves[0][0]
            values = [np.interp(frames, *curve) for curve in curves]
            smooth = np.stack([smoothed(value) for value in values])
            color = f"C{number % 10}"
            axis.plot(frames, smooth.mean(0), color=color, lw=1.5, label=method)
            axis.fill_between(frames, smooth.min(0), smooth.max(0), color=color, alpha=0.15, lw=0)
    axes[0].legend(fontsize=7)
    figure.savefig(path, dpi=120)


def smoothed(values: np.ndarray, width: int = 9) -> np.ndarray:
    """Running means over ``width`` points, fewer at the ends."""
    kernel = np.ones(min(width, len(values)))
    total = np.convolve(values, kernel, "same")
    return total / np.convolve(np.ones_like(values), kernel, "same")


def plot_frontier(
    results: Mapping[str, Sequence[Mapping[str, float]]],
    paper: Mapping[str, tuple[float, float]],
    path: Path,
) -> None:
    """Score against violations: a line per method through its cost limits, the paper's points.

    Seeds are small dots, their mean a large one with its cost limit beside it.
    """
    methods = [*TABLES["table_1"], "safetac_k5"]
    points: dict[str, list[tuple[str, Array, Array]]] = {}
    for name, runs in results.items():
        method, _, limit = name.partition("_limit")
        if method in methods:
            violations, scores = (
                np.array([run[key] for run in runs], float) for key in (CV, SCORE)
            )
            points.setdefault(method, []).append((limit or DEFAULT_LIMIT, violations, scores))
    figure = Figure(figsize=(9, 6), layout="constrained")
    axis = figure.subplots()
    for number, (method, cells) in enumerate(points.items()):
        cells.sort(key=lambda cell: float(cell[0]))
        means = np.array([(violations.mean(), scores.mean()) for _, violations, scores in cells])
        (line,) = axis.plot(*means.T, "o-", color=f"C{number}", label=method)
        for (limit, *seeds), mean in zip(cells, means, strict=True):
            axis.plot(*seeds, ".", color=line.get_color(), alpha=0.5)
            axis.annotate(limit, mean, (5, 4), textcoords="offset points", fontsize=7)
    for name in points:
        if name in paper:
            score, violations = paper[name]
            axis.plot(violations, score, "kx")
            axis.annotate(
                f"{name} (paper)",
                (violations, score),
                (5, -3),
                textcoords="offset points",
                fontsize=7,
            )
    axis.set(xlabel="violations per step", ylabel="score")
    # Logarithmic, with a place for those that do not violate at all.
    axis.set_xscale("symlog", linthresh=1e-3, linscale=0.5)
    axis.xaxis.set_major_locator(FixedLocator((0, 5e-4, 1e-3, 2e-3, 5e-3, 0.01, 0.02, 0.05, 0.1)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_locator(NullLocator())
    axis.legend(fontsize=8)
    figure.savefig(path, dpi=120)


def main(argv: Sequence[str] | None = None) -> None:
    """Write tables, pictures and curves."""
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
    paper = PAPER.get(args.root.resolve().name, {})
    texts = {"table": table(results, paper), "claims": claims(results, paper)}
    for name, text in texts.items():
        (args.out / f"{name}.md").write_text(text)
    for name in ("table_1", "table_3"):
        methods = [method for method in TABLES[name] if method in results]
        if methods:
            plot_curves(args.root, methods, args.out / f"{name}.png")
    plot_frontier(results, paper, args.out / "frontier.png")
    print(*texts.values(), sep="\n")


if __name__ == "__main__":
    main()
