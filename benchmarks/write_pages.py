"""Write the figures of README and docs, from the results that are kept.

    python benchmarks/write_pages.py

Where a page says ``<!-- generated: NAME -->``, what follows up to ``<!-- end -->`` is the part NAME
of this file. The pictures are drawn anew when their curves have changed. A test holds pages and
pictures equal to the results, so run this after adding some.
"""

from __future__ import annotations

import csv
import hashlib
import re
import statistics
import sys
import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
sys.path[:0] = [str(ROOT / "benchmarks" / folder) for folder in ("paper", "suite", ".")]
from experiment_tables import PARTS as EXPERIMENT_PARTS  # noqa: E402
from result_tables import PARTS as RESULT_PARTS  # noqa: E402
from seed_statistics import interval, permutation  # noqa: E402
from table import PUBLISHED, read_results  # noqa: E402

PAGES = (
    "README.md",
    "docs/results.md",
    "docs/safety_number.md",
    "docs/experiments.md",
    "docs/blocks/baselines.md",
    "docs/upstream.md",
    "docs/records.md",
)
MARKED = re.compile(r"(<!-- generated: ([\w ]+) -->\n).*?(\n<!-- end -->)", re.DOTALL)
LIMIT, FRAMES = 5, 1_000_000
WORDS = {4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine", 10: "ten"}
LEARNING = ROOT / "docs" / "images" / "learning.png"

Row = dict[str, str]


def safety_rows(kind: str) -> list[Row]:
    """The measured runs on Point with one kind of safety critic: the table's limit and frames."""
    with (RESULTS / "safety_number" / "runs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    found = [
        row
        for row in rows
        if row["run"].startswith(f"point {kind} ")
        and float(row["limit"]) == LIMIT
        and float(row["frames"]) == FRAMES
    ]
    return sorted(found, key=lambda row: row["run"])


QUANTITIES = {
    "score, sampled actions": ("score", ".1f"),
    "violations in training": ("total_cvs", ",.0f"),
    f"CVaR at the end of training, limit {LIMIT}": ("level", ".2f"),
    "predicted / realised CVaR": ("ratio", ".2f"),
}


def with_interval(values: Sequence[float], digits: str) -> str:
    """``14.7 (12.4 to 17.0)``."""
    low, high = interval(np.array(values))
    return f"{statistics.fmean(values):{digits}} ({low:{digits}} to {high:{digits}})"


def safety_table(with_p: bool) -> str:
    """The default beside the paper's critic: means over seeds, with intervals."""
    critics = [safety_rows("quantiles"), safety_rows("gaussian")]
    head = ["", "the default", "the paper's critic", *(["p"] if with_p else [])]
    lines = [f"| {' | '.join(head)} |", "|---" + "|---:" * (len(head) - 1) + "|"]
    quantities = QUANTITIES | (
        {"violations of an episode, p99": ("p99", ".0f"), "CV per step": ("cv", ".4f")}
        if with_p
        else {}
    )
    for label, (name, digits) in quantities.items():
        values = [[float(row[name]) for row in rows] for rows in critics]
        cells = [with_interval(column, digits) for column in values]
        if with_p:
            cells.append(f"{permutation(*map(np.array, values)):.3f}")
        lines.append(f"| {label} | {' | '.join(cells)} |")
    return "\n".join(lines)


def readme_results() -> str:
    """What the table of the README is of."""
    runs = [safety_rows(kind) for kind in ("quantiles", "gaussian")]
    seeds = [WORDS.get(len(rows), str(len(rows))) for rows in runs]
    counts = f"{seeds[0]} seeds each" if seeds[0] == seeds[1] else f"{' and '.join(seeds)} seeds"
    return wrap(
        "SafeTAC on Point, as it is by default and with the paper's safety critic: "
        f"{counts}, {FRAMES:,} frames, new layouts. "
        "Means, with 95 % intervals over seeds."
    )


def readme_record() -> str:
    """The field's own task, beside the best of the published agents that keep its limit."""
    task, best, share = "SafetyPointGoal1", "SAC-Lag", "three"
    group = [
        result["episodes"]["sampled"]
        for result in read_results()
        if (result["task"], result["method"], result["frames"]) == (task, "safetac", FRAMES)
    ]
    means = {name: [statistics.fmean(each[name]) for each in group] for name in ("return", "cost")}
    published = next(each for each in PUBLISHED[task] if each.by == best)
    returned, cost = (f"{statistics.fmean(values):.1f}" for values in means.values())
    seeds = WORDS.get(len(group), str(len(group)))
    cheaper = "lower" if published.cost < statistics.fmean(means["cost"]) else "higher"
    return wrap(
        f"On Safety-Gymnasium's {task}, {seeds} seeds return {returned} "
        f"at a cost of {cost}, after the same number of frames. The best published agent that "
        f"keeps the field's limit, OmniSafe's {best}, returns {published.reward} at a {cheaper} "
        f"cost, after {share} times the frames. [Records](docs/records.md) has the intervals."
    )


def in_the_original() -> str:
    """What ``benchmarks/suite/drive_original.py`` printed."""
    texts = [path.read_text().strip() for path in sorted((RESULTS / "in_the_original").iterdir())]
    return "```text\n" + "\n\n".join(texts) + "\n```"


def pythons() -> str:
    """The Pythons of the package's classifiers."""
    project = (ROOT / "pyproject.toml").read_text()
    found = re.findall(r'"Programming Language :: Python :: (3\.\d+)"', project)
    return wrap(
        f"Python {found[0]} to {found[-1]}; no GPU, no display, no account. In a new virtual "
        "environment, from a clone of this repository:"
    )


def wrap(text: str) -> str:
    """Lines of at most 100 characters."""
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


PARTS: dict[str, Callable[[], str]] = {
    "pythons": pythons,
    "readme results": readme_results,
    "readme table": lambda: safety_table(with_p=False),
    "readme record": readme_record,
    "in the original": in_the_original,
    "safety table": lambda: safety_table(with_p=True),
    **RESULT_PARTS,
    **EXPERIMENT_PARTS,
}


def rewritten(text: str) -> str:
    """A page with its parts as they are now."""
    return MARKED.sub(lambda match: f"{match[1]}\n{PARTS[match[2]]()}\n{match[3]}", text)


def learning_curves() -> list[Path]:
    """The files that the picture of the README is drawn from: the table's runs that are kept."""
    seeds = [row["run"].rpartition(" ")[2] for row in safety_rows("quantiles")]
    paths = [RESULTS / "safety_number" / f"point_{seed}" / "curves.csv" for seed in seeds]
    return [path for path in paths if path.exists()]


def digest(paths: Sequence[Path]) -> str:
    """Of what a picture shows; it is kept in the picture."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in paths)).hexdigest()


def drawn_from(picture: Path) -> str | None:
    """The digest that a picture holds."""
    with Image.open(picture) as image:
        return image.info.get("Description")


def draw_learning() -> None:
    """Return of 1,000 steps, and the CVaR beside its limit: mean and range of the seeds."""
    panels = {
        "train/reward_per_1000": "return of 1,000 steps",
        "update/cost_level": "CVaR of the cost",
    }
    runs = []
    for path in learning_curves():
        with path.open(newline="") as file:
            runs.append(list(csv.DictReader(file)))
    figure = Figure(figsize=(5.2, 4.2), layout="constrained")
    for axes, (name, label) in zip(figure.subplots(2, 1, sharex=True), panels.items(), strict=True):
        frames = np.array([float(row["frames"]) for row in runs[0] if row[name]])
        values = np.array(
            [
                np.interp(
                    frames,
                    *np.array([(row["frames"], row[name]) for row in run if row[name]], float).T,
                )
                for run in runs
            ]
        )
        axes.fill_between(frames / 1e6, values.min(0), values.max(0), color="#0072B2", alpha=0.2)
        axes.plot(frames / 1e6, values.mean(0), color="#0072B2")
        axes.set(ylabel=label, ylim=(0, None), xlim=(0, frames[-1] / 1e6))
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    axes.axhline(LIMIT, color="#D55E00", ls="--", lw=1)
    axes.text(0.99, LIMIT + 1.5, "limit", color="#D55E00", ha="right")
    axes.set_xlabel("million frames")
    figure.savefig(LEARNING, dpi=100, metadata={"Description": digest(learning_curves())})


def main() -> None:
    """Write all pages."""
    for name in PAGES:
        path = ROOT / name
        path.write_text(rewritten(path.read_text()))
    if not LEARNING.exists() or drawn_from(LEARNING) != digest(learning_curves()):
        draw_learning()


if __name__ == "__main__":
    main()
