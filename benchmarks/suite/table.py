"""Draws the table of records out of the results of run.py, beside published figures.

    python benchmarks/suite/table.py           # writes docs/records.md
    python benchmarks/suite/table.py --check   # says whether the page is that of the results

Means are over seeds, of each seed's mean over its 100 episodes; intervals are Student's t of the
seeds' means. Tails are of all episodes of all seeds together.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))
from fill import ROOT
from run import KINDS, NAMED, RESULTS
from seed_statistics import interval

from torchrl_safe.record import proportion_interval
from torchrl_safe.trainers.tasks import COST_LIMIT

Array = NDArray[np.float64]
Result = Mapping[str, Any]

PAGE = ROOT / "docs" / "records.md"
BEGIN = "<!-- From here on written by benchmarks/suite/table.py. -->\n"
END = "<!-- Up to here. -->\n"


class Published(NamedTuple):
    """A figure of OmniSafe's tables: mean return and cost of an episode at a limit of 25."""

    by: str
    reward: float
    cost: float


# The best of its tables that keep the limit, on-policy methods and off-policy ones apart where both
# are known, then what is above it and often cited.
PUBLISHED: dict[str, list[Published]] = {
    "SafetyPointGoal1": [
        Published("SAC-Lag", 21.45, 19.17),
        Published("TRPO-PID", 19.24, 21.38),
        Published("PCPO", 18.57, 22.98),
        Published("TRPO-Lag", 18.51, 22.98),
        Published("PPO-Lag", 12.96, 25.80),
        Published("CPO", 20.46, 28.84),
        Published("TD3-Lag", 25.27, 28.0),
    ],
    "SafetyCarGoal1": [
        Published("TD3-PID", 27.28, 9.5),
        Published("TRPO-EarlyTerminated", 22.09, 17.97),
    ],
    "SafetyPointGoal2": [Published("TRPO-EarlyTerminated", 8.62, 25.0)],
    "SafetyCarGoal2": [Published("TRPO-EarlyTerminated", 7.12, 23.4)],
    "SafetyPointButton1": [Published("TRPO-EarlyTerminated", 9.52, 25.0)],
    "SafetyCarButton1": [Published("PPO-EarlyTerminated", 4.47, 25.0)],
    "SafetyPointCircle1": [Published("SAC-Lag", 83.68, 12.83)],
    "SafetyCarCircle1": [Published("TD3-Lag", 34.38, 2.25)],
    "SafetyAntVelocity": [Published("PPO-Lag", 3262, 12.1)],
    "SafetyHalfCheetahVelocity": [Published("FOCOPS", 2965, 2.4)],
    "SafetyHopperVelocity": [Published("CUP", 1716, 7.5)],
    "SafetyHumanoidVelocity": [Published("PPO-Lag", 6624, 5.9)],
    "SafetySwimmerVelocity": [Published("CPPO-PID", 91, 19.1)],
    "SafetyWalker2dVelocity": [Published("TRPO-Lag", 3207, 15.0)],
}

MARKS = {"SafetyPointGoal1": [20.0]}
"""Returns, beside the published ones, that a time is told of."""


def read_results(root: Path = RESULTS) -> list[Result]:
    """All results, by task in the library's order, then by frames, method and seed."""
    results = [json.loads(path.read_text()) for path in root.rglob("seed_*.json")]
    order = {name: number for number, name in enumerate(NAMED)}
    return sorted(results, key=lambda r: (order[r["task"]], r["frames"], r["method"], r["seed"]))


def time_to(result: Result, reward: float, kind: str = "sampled") -> tuple[float, int] | None:
    """Seconds and frames until an evaluation first returned so much within the limit, if any."""
    curve = result["curve"]
    met = [
        place
        for place, (value, cost) in enumerate(
            zip(curve[kind]["return"], curve[kind]["cost"], strict=True)
        )
        if value >= reward and cost <= COST_LIMIT
    ]
    return (curve["seconds"][met[0]], curve["frames"][met[0]]) if met else None


def text(results: Sequence[Result]) -> str:
    """What is between the marks of the page."""
    by_task = {task: list(of) for task, of in groupby(results, key=lambda r: r["task"])}
    parts = []
    for task in NAMED:
        if task in by_task or task in PUBLISHED:
            parts.append("\n".join(section(task, by_task.get(task, []))))
    return "\n".join(parts) + "\n"


def section(task: str, results: Sequence[Result]) -> Iterator[str]:
    """A task's tables."""
    yield f"## {task}\n"
    groups = [list(of) for _, of in groupby(results, key=lambda r: (r["frames"], r["method"]))]
    yield from table(
        ["method", "frames", "seeds", "reward, sampled", "cost", "reward, det.", "cost"],
        [returns(group) for group in groups]
        + [
            [f"{each.by}, OmniSafe", "", "", f"{each.reward:g}", f"{each.cost:g}", "", ""]
            for each in PUBLISHED.get(task, [])
        ],
    )
    if not groups:
        return
    yield from table(
        ["cost of an episode", "actions", "median", "95 %", "99 %", "most", "above 25"],
        [tails(group, kind) for group in groups for kind in KINDS],
    )
    marks = sorted({*MARKS.get(task, []), *(each.reward for each in PUBLISHED.get(task, []))})
    yield from table(
        ["until the return is, at a cost of at most 25", *(f"{mark:g}" for mark in marks)],
        [times(group, marks) for group in groups],
    )
    yield from table(
        ["made by", "minutes", "on", "commit", "command, of the first seed"],
        [origin(group) for group in groups],
    )


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Markdown, and an empty line."""
    for row in (head, ["---"] * len(head), *rows):
        yield "| " + " | ".join(row) + " |"
    yield ""


def name_of(group: Sequence[Result]) -> str:
    """A row's first cell."""
    return f"{group[0]['method']}, {group[0]['frames']:,}"


def returns(group: Sequence[Result]) -> list[str]:
    """Returns and costs of a method's seeds, with intervals."""
    cells = [group[0]["method"], f"{group[0]['frames']:,}", str(len(group))]
    for kind in ("sampled", "deterministic"):
        for name in ("return", "cost"):
            means = np.array([np.mean(result["episodes"][kind][name]) for result in group])
            low, high = interval(means)
            spread = "" if np.isnan(low) else f" ({low:.4g} to {high:.4g})"
            cells.append(f"**{means.mean():.4g}**{spread}")
    return cells


def tails(group: Sequence[Result], kind: str) -> list[str]:
    """How costs of single episodes are spread, of all seeds."""
    costs = np.concatenate([result["episodes"][kind]["cost"] for result in group])
    above, total = int((costs > COST_LIMIT).sum()), len(costs)
    low, high = (100 * share for share in proportion_interval(above, total))
    return [
        name_of(group),
        kind,
        *(f"{value:.4g}" for value in np.quantile(costs, [0.5, 0.95, 0.99, 1.0])),
        f"{100 * above / total:.3g} % of {total} ({low:.2g} to {high:.2g})",
    ]


def times(group: Sequence[Result], marks: Sequence[float]) -> list[str]:
    """When marks were reached: the median of the seeds that did."""
    cells = [name_of(group)]
    for mark in marks:
        reached = [found for result in group if (found := time_to(result, mark)) is not None]
        if not reached:
            cells.append("never")
            continue
        seconds, frames = np.median(np.array(reached, float), axis=0)
        seeds = "" if len(reached) == len(group) else f", {len(reached)} of {len(group)} seeds"
        cells.append(f"{seconds / 60:.3g} min, {frames:,.0f} frames{seeds}")
    return cells


def origin(group: Sequence[Result]) -> list[str]:
    """How long a row took, on what, of which commit, by which command."""
    minutes = np.array([result["seconds"] / 60 for result in group])
    launches = [launch for result in group for launch in result["launches"]]
    machines = dict.fromkeys(
        f"{launch['cpu']}, {launch['cores']} cores, {launch['jobs']} at a time of "
        f"{launch['threads']} threads"
        for launch in launches
    )
    commits = dict.fromkeys(launch["commit"] for launch in launches)
    return [
        name_of(group),
        f"{minutes.mean():.3g} each",
        "; ".join(machines),
        ", ".join(f"`{commit[:10]}{'*' * commit.endswith('-dirty')}`" for commit in commits),
        f"`{group[0]['command']}`",
    ]


def page(results: Sequence[Result]) -> str:
    """The page of now, with the tables of these results."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    return f"{before}{BEGIN}\n{text(results)}{END}{after}"


def main(argv: Sequence[str] | None = None) -> int:
    """Write or check the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing")
    args = parser.parse_args(argv)
    wanted = page(read_results())
    if args.check:
        return int(wanted != PAGE.read_text())
    PAGE.write_text(wanted)
    return 0


if __name__ == "__main__":
    sys.exit(main())
