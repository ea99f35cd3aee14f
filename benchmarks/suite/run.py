"""Fills the table of records: trains the cells that have no result yet, some at a time.

    python benchmarks/suite/run.py --dry-run                         # what is missing
    python benchmarks/suite/run.py --jobs 2                          # all of the plan
    python benchmarks/suite/run.py --tasks SafetyPointGoal1 --methods safetac cpo --seeds 0 1 2

A cell is a task, a method, a number of frames and a seed. Its result is a file of some kilobytes,
``benchmarks/results/suite/TASK/METHOD/FRAMES/seed_SEED.json``, which belongs into the repository.
Cells with a result are skipped, and interrupted ones go on from their checkpoint: the same command
can be given again after any stop. Ctrl-C saves all cells that are running.

Run it on a quiet machine: a result says how long it took.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from fill import ROOT, Table, add_arguments, facts, learning_seconds

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import METHODS
from torchrl_safe.trainers.tasks import NAMES, RUNNERS, follows

RESULTS = ROOT / "benchmarks" / "results" / "suite"

VARIANTS: dict[str, tuple[str, ...]] = {
    "safetac_k1": ("safetac", "policy.num_components=1"),
    "safetac_tail": ("safetac", "loss.risk_level=0.125"),
}
"""Method and overrides of what is no method by itself."""

KNOWN = {**{name: (name,) for name in METHODS}, **VARIANTS}
NAMED = [name for name in NAMES if follows(name)]

EVALUATIONS = 20  # during training: where a mark is reached is known to a twentieth of the run
KINDS = {"deterministic": "eval/det/", "sampled": "eval/"}


class Cell(NamedTuple):
    """A run of the table."""

    task: str
    method: str
    frames: int
    seed: int

    @property
    def path(self) -> Path:
        """Of its result, without the suffix."""
        return Path(self.task, self.method, f"{self.frames}", f"seed_{self.seed}")

    @property
    def words(self) -> list[str]:
        """What follows ``torchrl-safe train``."""
        method, *overrides = KNOWN[self.method]
        return [
            method,
            f"env.task={self.task}",
            *overrides,
            f"collector.total_frames={self.frames}",
            f"eval.interval={max(1, self.frames // EVALUATIONS)}",
            "video.num_steps=0",
            f"seed={self.seed}",
        ]


def cells(
    tasks: Iterable[str], methods: Iterable[str], frames: Iterable[int], seeds: Iterable[int]
) -> list[Cell]:
    """All of them, seed by seed: with few seeds, the table is complete as early as it can."""
    return [Cell(*rest, seed) for seed, *rest in product(seeds, tasks, methods, frames)]


PLAN = [
    *cells(["SafetyPointGoal1"], ["safetac"], [1_000_000], range(5)),
    *cells(
        ["SafetyPointGoal2", "SafetyPointButton1", "SafetyPointCircle1", *RUNNERS],
        ["safetac", "cpo", "sac_lagrangian"],
        [3_000_000],
        range(3),
    ),
    *cells(["SafetyPointGoal1", "SafetyCarGoal1"], ["safetac"], [10_000_000], range(5)),
]
"""What the table is to show; cells beyond it are added by --tasks."""


def result(cell: Cell, run_dir: Path) -> dict[str, Any]:
    """What is kept of a finished run: no mean without the episodes that it is of.

    Raises:
        ValueError: if the run has other options than the cell's command.
    """
    metrics = read_metrics(run_dir / "log")
    finished = json.loads((run_dir / "results.json").read_text())
    learning, _ = learning_seconds(metrics)
    points = metrics["eval/return"][0]
    rows = np.searchsorted(metrics["time/seconds"][0], points)
    return {
        **cell._asdict(),
        **facts(cell, run_dir),
        "episodes": {
            kind: {
                name: [round(episode[name], 3) for episode in finished["episodes"][prefix]]
                for name in ("return", "cost", "length")
            }
            for kind, prefix in KINDS.items()
        },
        "curve": {
            "frames": points.tolist(),
            "seconds": learning[rows].round(1).tolist(),
            **{
                kind: {
                    name: metrics[f"{prefix}{name}"][1].round(3).tolist()
                    for name in ("return", "cost")
                }
                for kind, prefix in KINDS.items()
            },
        },
    }


def table_of(results: Path, runs: Path, threads: int = 1) -> Table[Cell]:
    """How the table's cells are run and kept."""
    train = [sys.executable, "-m", "torchrl_safe.trainers.cli", "train"]
    return Table(
        results, runs, lambda cell: [*train, *cell.words, f"num_threads={threads}"], result
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the missing cells; the exit status is the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=NAMED, help="in place of the plan")
    parser.add_argument("--methods", nargs="+", choices=KNOWN, default=["safetac"])
    parser.add_argument("--frames", nargs="+", type=int, default=[1_000_000])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    add_arguments(parser, RESULTS, ROOT / "runs" / "suite")
    args = parser.parse_args(argv)
    wanted = PLAN
    if args.tasks is not None:
        wanted = cells(args.tasks, args.methods, args.frames, args.seeds)
    table = table_of(args.results, args.runs, args.threads)
    return table.fill(wanted, args.jobs, args.threads, args.dry_run)


if __name__ == "__main__":
    sys.exit(main())
