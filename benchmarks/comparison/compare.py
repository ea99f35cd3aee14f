"""Draws docs/comparison.md and its picture out of what tune.py and final.py have kept.

    python benchmarks/comparison/compare.py           # writes the page and the picture
    python benchmarks/comparison/compare.py --check   # says whether the page is that of the results

A method's figure is the mean over seeds of each seed's mean over its episodes, with Student's
interval. docs/protocol.md says what is tested.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[1]))
from fill import ROOT
from plan import RESULTS, Array, Result, column, realised
from seed_statistics import (
    holm,
    improvement_interval,
    interval,
    iqm,
    performance_profile,
    permutation,
    probability_of_improvement,
    stratified_interval,
    welch,
)

PAGE = ROOT / "docs" / "comparison.md"
PICTURE = ROOT / "docs" / "images" / "comparison.png"
BEGIN = "<!-- From here on written by benchmarks/comparison/compare.py. -->\n"
END = "<!-- Up to here. -->\n"

OURS = "safetac"  # whom all others are tested against
RISK_LEVEL = 0.125  # share of the worst outcomes in the realised CVaR
NEAR = 0.15  # share of the target by which a realised cost may miss it
ENOUGH = 4  # seeds: the interquartile mean of fewer is their mean


class Group(NamedTuple):
    """The seeds of a row at a target."""

    row: str
    limit: float
    results: list[Result]

    def values(self, figure: str) -> Array:
        """A figure, one number per seed. A seed that diverged has a score of 0, and no other."""
        counted = [
            each for each in self.results if figure.startswith("score") or "diverged" not in each
        ]
        return np.array([0.0 if "diverged" in x else FIGURES[figure](x) for x in counted])

    @property
    def seeds(self) -> str:
        """How many, and how many of them diverged."""
        lost = sum("diverged" in each for each in self.results)
        return f"{len(self.results)}" + (f", {lost} diverged" if lost else "")


Place = tuple[str, int, float]  # robot, frames and target


def worst(values: Array) -> float:
    """The mean of the worst eighth: the largest ones."""
    return float(np.sort(values)[-max(1, round(RISK_LEVEL * len(values))) :].mean())


def cv_rate(kept: Result, kind: str = "sampled") -> float:
    """Violating steps per step."""
    violations, length = column(kept, "violations", kind), column(kept, "length", kind)
    return float(violations.mean() / length.mean())


FIGURES: dict[str, Callable[[Result], float]] = {
    "realised cost": realised,
    "realised CVaR": lambda kept: worst(column(kept, "outcomes")),
    "score": lambda kept: float(column(kept, "score").mean()),
    "return": lambda kept: float(column(kept, "return").mean()),
    "CV per step": cv_rate,
    "violations, 99 %": lambda kept: float(np.quantile(column(kept, "violations"), 0.99)),
    "score, det.": lambda kept: float(column(kept, "score", "deterministic").mean()),
    "in training": lambda kept: float(kept["training_violations"]),
}

SPREAD = {"realised cost", "realised CVaR", "score"}  # figures that are shown with intervals


def read(results: Path) -> dict[Place, list[Group]]:
    """All groups that have a seed, by where they are compared; rows in the order of freezing."""
    frozen: dict[str, Any] = {}
    if (results / "frozen.json").exists():
        frozen = json.loads((results / "frozen.json").read_text())
    found: dict[Place, list[Group]] = {}
    for row, entry in frozen.items():
        for name, limits in entry.items():
            if not name.startswith("limits_"):
                continue
            robot = name.removeprefix("limits_")
            for target, limit in limits.items():
                folder = results / robot / "final" / row / f"limit_{limit:g}"
                for of_frames in sorted(folder.glob("*")):
                    seeds = [json.loads(p.read_text()) for p in sorted(of_frames.glob("*.json"))]
                    place = (robot, int(of_frames.name), float(target))
                    found.setdefault(place, []).append(Group(row, limit, seeds))
    return dict(sorted(found.items()))


def text(found: Mapping[Place, Sequence[Group]], picture: bool = True) -> str:
    """What is between the marks of the page."""
    if not found:
        return "No training is finished yet.\n"
    parts = []
    if picture:
        parts.append(f"![Score beside realised cost](images/{PICTURE.name})\n")
    for place, groups in found.items():
        parts.append("\n".join(section(place, groups)))
    return "\n".join(parts)


def section(place: Place, groups: Sequence[Group]) -> Iterator[str]:
    """The table of a target, best score first."""
    robot, frames, target = place
    yield f"## {robot.capitalize()}, {frames:,} frames, realised cost {target:g}\n"
    head = [
        "method",
        "limit",
        "seeds",
        *FIGURES,
        "IQM of scores",
        f"{OURS} above it",
        "p, Welch (Holm)",
    ]
    head.append("p, permutation")
    yield "| " + " | ".join(head) + " |"
    yield "|---" + "|---:" * (len(head) - 1) + "|"
    groups = sorted(groups, key=lambda group: -group.values("score").mean())
    ours = next((group for group in groups if group.row == OURS), None)
    tests = {group.row: tested(ours, group) for group in groups if ours not in (None, group)}
    adjusted = holm([each["welch"] for each in tests.values()])
    for row, p in zip(tests, adjusted, strict=True):
        tests[row]["welch"] = p
    for group in groups:
        cells = [group.row, f"{group.limit:g}", group.seeds]
        cells += [mean(group.values(figure), figure in SPREAD) for figure in FIGURES]
        costs = group.values("realised cost")
        if len(costs) and abs(costs.mean() / target - 1) > NEAR:
            cells[3] += " (*)"
        yield "| " + " | ".join([*cells, robust(group), *shown(tests.get(group.row))]) + " |"
    yield ""


def mean(values: Array, spread: bool) -> str:
    """A mean, and its interval if that is wanted and there is one."""
    if not len(values):
        return ""
    low, high = interval(values)
    between = f" ({low:.3g} to {high:.3g})" if spread and not np.isnan(low) else ""
    return f"{values.mean():.4g}{between}"


def robust(group: Group) -> str:
    """The interquartile mean of the scores of enough seeds."""
    scores = group.values("score")
    if len(scores) < ENOUGH:
        return ""
    low, high = stratified_interval([scores], iqm)
    return f"{iqm(scores):.3g} ({low:.3g} to {high:.3g})"


def tested(ours: Group | None, other: Group) -> dict[str, float]:
    """Our scores against another row's: how often above, its interval, and two tests."""
    assert ours is not None
    pair = ours.values("score"), other.values("score")
    low, high = improvement_interval(*pair)
    return {
        "above": probability_of_improvement(*pair),
        "low": low,
        "high": high,
        "welch": welch(*pair),
        "permutation": permutation(*pair),
    }


def shown(test: Mapping[str, float] | None) -> list[str]:
    """Cells of :func:`tested`."""
    if test is None:
        return ["", "", ""]
    spread = "" if np.isnan(test["low"]) else f" ({test['low']:.2g} to {test['high']:.2g})"
    tests = ["" if np.isnan(test[k]) else f"{test[k]:.2g}" for k in ("welch", "permutation")]
    return [f"{test['above']:.2g}{spread}", *tests]


def draw(found: Mapping[Place, Sequence[Group]], path: Path) -> None:
    """Score beside realised cost, and how many seeds have more than a score: first robot, frames.

    Bars are intervals of Student's; the profiles are of the target in the middle.
    """
    first = next(iter(found))[:2]
    targets = {place[2]: groups for place, groups in found.items() if place[:2] == first}
    middle = list(targets)[len(targets) // 2]
    rows = list(dict.fromkeys(group.row for groups in targets.values() for group in groups))
    scores = np.concatenate([group.values("score") for group in targets[middle]])
    levels = np.linspace(scores.min() - 0.05 * np.ptp(scores), scores.max(), 1_000)
    figure = Figure(figsize=(13, 5.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for number, row in enumerate(rows):
        style = {"color": f"C{number % 10}", "ls": "-" if number < 10 else "--"}
        style["lw"] = 2.5 if row == OURS else 1.2
        groups = [group for each in targets.values() for group in each if group.row == row]
        frontier(left, groups, row, style)
        for group in targets[middle]:
            if group.row == row:
                right.plot(levels, performance_profile(group.values("score"), levels), **style)
    robot, frames = first
    for target in targets:
        left.axvline(target, color="#999999", lw=0.8, ls=":")
    left.set(xlabel="realised mean discounted cost", ylabel="score")
    left.set_title(f"{robot.capitalize()}, {frames:,} frames, new layouts", fontsize=10)
    figure.legend(
        *left.get_legend_handles_labels(), loc="outside lower center", ncols=8, fontsize=7
    )
    right.set(xlabel="score", ylabel="share of seeds above it", ylim=(0, 1.02))
    right.set_title(f"realised cost {middle:g}", fontsize=10)
    for axes in (left, right):
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=130)


def frontier(axes: Axes, groups: Sequence[Group], row: str, style: Mapping[str, Any]) -> None:
    """A row's line through its targets, with bars where there are several seeds."""
    pairs = [(group.values("realised cost"), group.values("score")) for group in groups]
    points = [pair for pair in pairs if len(pair[0])]
    if not points:
        return
    centres = np.array([[each.mean() for each in pair] for pair in points])
    halves = np.array([[np.ptp(interval(each)) / 2 for each in pair] for pair in points])
    axes.errorbar(
        *centres.T, *np.nan_to_num(halves).T[::-1], label=row, marker="o", ms=4, capsize=2, **style
    )


def page(path: Path, found: Mapping[Place, Sequence[Group]]) -> str:
    """The page of now, with the tables of these results."""
    before, _, rest = path.read_text().partition(BEGIN)
    return f"{before}{BEGIN}\n{text(found)}\n{END}{rest.partition(END)[2]}"


def main(argv: Sequence[str] | None = None) -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--page", type=Path, default=PAGE)
    parser.add_argument("--picture", type=Path, default=PICTURE)
    args = parser.parse_args(argv)
    found = read(args.results)
    wanted = page(args.page, found)
    if args.check:
        return int(wanted != args.page.read_text())
    args.page.write_text(wanted)
    if found:
        draw(found, args.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
