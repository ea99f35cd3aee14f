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
import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
import sys
import time
from collections.abc import Iterable, Sequence
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))
from side_by_side import Job, run_jobs

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import METHODS, cli
from torchrl_safe.trainers.saved import CONFIG, read_config
from torchrl_safe.trainers.tasks import NAMES, RUNNERS, follows

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results" / "suite"

VARIANTS: dict[str, tuple[str, ...]] = {
    "safetac_k1": ("safetac", "policy.num_components=1"),
    "safetac_tail": ("safetac", "loss.risk_level=0.125"),
}
"""Method and overrides of what is no method by itself."""

KNOWN = {**{name: (name,) for name in METHODS}, **VARIANTS}
NAMED = [name for name in NAMES if follows(name)]

OF_A_RUN = {"run_dir", "resume", "num_threads"}  # and not of what it shows
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


def machine() -> dict[str, Any]:
    """What the cells are run on."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    models = {line.partition(":")[2].strip() for line in lines if line.startswith("model name")}
    gpus = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return {
        "cpu": ", ".join(sorted(models)) or platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "gpu": gpus,
        "system": platform.system(),
        "python": platform.python_version(),
        **{name: importlib.metadata.version(name) for name in ("torch", "torchrl", "mujoco")},
    }


def commit() -> str:
    """The commit of the library, and whether somebody has changed it since."""

    def git(*words: str) -> str:
        line = ["git", "-C", str(ROOT), *words]
        return subprocess.run(line, capture_output=True, text=True, check=True).stdout.strip()

    return git("rev-parse", "HEAD") + ("-dirty" if git("status", "-s", "torchrl_safe") else "")


def launches_of(run_dir: Path) -> Path:
    """The file that remembers each start of a run: when, on what, of which commit."""
    return run_dir.with_name(f"{run_dir.name}.launches.jsonl")


def result(cell: Cell, run_dir: Path) -> dict[str, Any]:
    """What is kept of a finished run: no mean without the episodes that it is of.

    Raises:
        ValueError: if the run has other options than the cell's command.
    """
    metrics = read_metrics(run_dir / "log")
    settings = read_config(run_dir / CONFIG)
    method, *overrides = cell.words
    wanted = cli.compose(method, overrides).settings()
    other = [name for name in wanted.keys() - OF_A_RUN if wanted[name] != settings[name]]
    if other:
        raise ValueError(f"{run_dir} is a run of other options than {cell.path}: {other}.")
    finished = json.loads((run_dir / "results.json").read_text())
    launches = [json.loads(line) for line in launches_of(run_dir).read_text().splitlines()]
    at, seconds = metrics["time/seconds"]
    evaluated, evaluations = metrics.get("time/eval", (at[:0], seconds[:0]))
    # Evaluations are no part of learning. Each belongs to the update that it came after.
    spent = np.zeros(len(at))
    spent[np.searchsorted(at, evaluated)] = evaluations
    learning = seconds - np.cumsum(spent)
    points = metrics["eval/return"][0]
    rows = np.searchsorted(at, points)
    return {
        **cell._asdict(),
        "command": shlex.join(["torchrl-safe", "train", *cell.words]),
        "launches": launches,
        "seconds": round(float(learning[-1]), 1),
        "evaluation_seconds": round(float(spent.sum()), 1),
        "training_violations": finished["total_cvs"],
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


def keep(cell: Cell, run_dir: Path, results: Path) -> Path:
    """Write the result of a finished run."""
    path = results / cell.path.with_suffix(".json")
    path.parent.mkdir(parents=True, exist_ok=True)
    # A line for each entry: a change of one cell is a change of few lines.
    lines = [f"  {json.dumps(name)}: {json.dumps(x)}" for name, x in result(cell, run_dir).items()]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    return path


def main(argv: Sequence[str] | None = None) -> int:
    """Run the missing cells; the exit status is the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tasks", nargs="+", choices=NAMED, help="in place of the plan")
    parser.add_argument("--methods", nargs="+", choices=KNOWN, default=["safetac"])
    parser.add_argument("--frames", nargs="+", type=int, default=[1_000_000])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time")
    parser.add_argument("--threads", type=int, default=1, help="of each cell")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "suite")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--dry-run", action="store_true", help="print the commands")
    args = parser.parse_args(argv)
    wanted = PLAN
    if args.tasks is not None:
        wanted = cells(args.tasks, args.methods, args.frames, args.seeds)
    missing = [
        cell for cell in wanted if not (args.results / cell.path.with_suffix(".json")).exists()
    ]
    print(f"{len(wanted) - len(missing)} of {len(wanted)} cells have a result")
    train = [sys.executable, "-m", "torchrl_safe.trainers.cli", "train"]
    jobs = {
        Job(
            str(cell.path),
            args.runs / cell.path,
            (*train, *cell.words, f"num_threads={args.threads}"),
        ): cell
        for cell in missing
    }
    if args.dry_run:
        for job in jobs:
            print(shlex.join(job.line()))
        return 0
    how = {**machine(), "threads": args.threads, "jobs": args.jobs}

    def remember(job: Job) -> None:
        now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
        with launches_of(job.run_dir).open("a") as file:
            file.write(json.dumps({"time": now, "commit": commit(), **how}) + "\n")

    def finish(job: Job) -> None:
        print(f"kept      {keep(jobs[job], job.run_dir, args.results)}", flush=True)

    return run_jobs(list(jobs), args.jobs, args.threads, remember, finish)


if __name__ == "__main__":
    sys.exit(main())
