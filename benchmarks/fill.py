"""Tables are filled cell by cell: how missing cells are run, what they cost, what is kept of them.

A cell is a training, and what is kept of it is a file of some kilobytes that belongs into the
repository. The programs that fill a table say which cells it has and what is kept of each.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import os
import platform
import shlex
import statistics
import subprocess
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from side_by_side import Job, run_jobs

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import cli
from torchrl_safe.trainers.saved import CONFIG, read_config

ROOT = Path(__file__).parents[1]

OF_A_RUN = {"run_dir", "resume", "num_threads"}  # and not of what it shows


class Cell(Protocol):
    """A training of a table."""

    @property
    def path(self) -> Path:
        """Of its result below the folder of results, without the suffix."""

    @property
    def words(self) -> list[str]:
        """What follows ``torchrl-safe train``."""

    @property
    def frames(self) -> int:
        """How many it takes."""


C = TypeVar("C", bound=Cell)


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


def facts(cell: Cell, run_dir: Path) -> dict[str, Any]:
    """What every result says of its run: command, starts, times.

    Raises:
        ValueError: if the run has other options than the cell's command.
    """
    settings = read_config(run_dir / CONFIG)
    method, *overrides = cell.words
    wanted = cli.compose(method, overrides).settings()
    other = [name for name in wanted.keys() - OF_A_RUN if wanted[name] != settings.get(name)]
    if other:
        raise ValueError(f"{run_dir} is a run of other options than {cell.path}: {other}.")
    metrics = read_metrics(run_dir / "log")
    learning, evaluating = learning_seconds(metrics)
    return {
        "command": shlex.join(["torchrl-safe", "train", *cell.words]),
        "launches": [json.loads(line) for line in launches_of(run_dir).read_text().splitlines()],
        "seconds": round(float(learning[-1]), 1),
        "evaluation_seconds": round(evaluating, 1),
        "training_violations": int(metrics["train/total_cvs"][1][-1]),
    }


def learning_seconds(metrics: Mapping[str, Any]) -> tuple[NDArray[np.float64], float]:
    """Seconds of collecting and learning until each update, and those of all evaluations.

    Evaluations are no part of learning. Each belongs to the update that it came after.
    """
    at, seconds = metrics["time/seconds"]
    evaluated, evaluations = metrics.get("time/eval", (at[:0], seconds[:0]))
    spent = np.zeros(len(at))
    spent[np.searchsorted(at, evaluated)] = evaluations
    return seconds - np.cumsum(spent), float(spent.sum())


def write(path: Path, result: Mapping[str, Any]) -> Path:
    """A result as a file with a line for each entry: a change of one is a change of few lines."""
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = [
        f"  {json.dumps(name)}: {json.dumps(value, separators=(',', ':'))}"
        for name, value in result.items()
    ]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    return path


def add_arguments(parser: argparse.ArgumentParser, results: Path, runs: Path) -> None:
    """Those of every program that fills a table."""
    parser.add_argument("--jobs", type=int, default=1, help="cells at a time")
    parser.add_argument("--threads", type=int, default=1, help="of each cell")
    parser.add_argument("--runs", type=Path, default=runs)
    parser.add_argument("--results", type=Path, default=results)
    parser.add_argument("--dry-run", action="store_true", help="print the commands and the hours")


@dataclass(frozen=True)
class Table(Generic[C]):
    """How the cells of a table are run and kept.

    Attributes:
        results: the folder of what is kept.
        runs: the folder of the trainings.
        command: what runs a cell; ``run_dir`` and ``resume`` are added.
        result: what is kept of a cell, from the folder of its run.
        product: the file in that folder that is there when it is finished.
        here: runs a command's line in this process, one after the other, in place of processes: for
            cells of a second, which take longer to start than to train.
    """

    results: Path
    runs: Path
    command: Callable[[C], Sequence[str]]
    result: Callable[[C, Path], Mapping[str, Any]]
    product: str = "results.json"
    here: Callable[[Sequence[str]], None] | None = None

    def file(self, cell: C) -> Path:
        """Where the result of a cell is."""
        return self.results / cell.path.with_suffix(".json")

    def missing(self, cells: Sequence[C]) -> list[C]:
        """Those without a result, in their order, each once."""
        return [cell for cell in dict.fromkeys(cells) if not self.file(cell).exists()]

    def fill(self, cells: Sequence[C], jobs: int, threads: int, dry_run: bool = False) -> int:
        """Run the missing cells, some at a time; the number of those that failed."""
        missing = self.missing(cells)
        number = len(set(cells))
        print(f"{number - len(missing)} of {number} cells have a result", flush=True)
        todo = {
            Job(
                str(cell.path), self.runs / cell.path, tuple(self.command(cell)), self.product
            ): cell
            for cell in missing
        }
        if dry_run:
            for job in todo:
                print(shlex.join(job.line()))
            hours = self.core_hours((cell.words[0], cell.frames) for cell in missing)
            print(f"about {hours:.3g} core-hours")
            return 0
        how = {**machine(), "threads": threads, "jobs": jobs}

        def remember(job: Job) -> None:
            now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
            with launches_of(job.run_dir).open("a") as file:
                file.write(json.dumps({"time": now, "commit": commit(), **how}) + "\n")

        refused = []

        def keep(job: Job) -> None:
            cell = todo[job]
            try:
                path = write(self.file(cell), self.result(cell, job.run_dir))
            except ValueError as error:  # the others go on
                print(f"refused   {error}", flush=True)
                refused.append(job)
            else:
                print(f"kept      {path}", flush=True)

        if self.here is None:
            failed = run_jobs(list(todo), jobs, threads, remember, keep)
            return failed + len(refused)
        for job in todo:
            if not job.finished:
                job.run_dir.parent.mkdir(parents=True, exist_ok=True)
                remember(job)
                self.here(job.line())
            keep(job)
        return len(refused)

    def core_hours(self, trainings: Iterable[tuple[str, int]]) -> float:
        """What trainings will cost, at the median speed of what is kept of the same method.

        Args:
            trainings (iterable of tuple): of each its method and frames. A method of which nothing
                is recorded is taken to be as slow as the slowest.
        """
        known: dict[str, list[float]] = {}
        for path in self.results.rglob("seed_*.json"):
            kept = json.loads(path.read_text())
            if "seconds" not in kept:  # it diverged
                continue
            seconds = kept["seconds"] + kept["evaluation_seconds"]
            known.setdefault(kept["command"].split()[2], []).append(kept["frames"] / seconds)
        speeds = recorded_speeds() | {name: statistics.median(all_) for name, all_ in known.items()}
        slowest = min(speeds.values())
        return sum(frames / speeds.get(method, slowest) for method, frames in trainings) / 3600


def recorded_speeds(root: Path = ROOT / "benchmarks" / "results") -> dict[str, float]:
    """Frames per second of a thread, by method: the median of the paper's tables on Point."""
    speeds: dict[str, list[float]] = {}
    for path in root.glob("paper/point/*/seed_*/results.json"):
        name = path.parts[-3].partition("_limit")[0]
        method = "safetac" if name.startswith("safetac") else name
        speeds.setdefault(method, []).append(json.loads(path.read_text())["frames_per_second"])
    return {name: statistics.median(each) for name, each in speeds.items()}
