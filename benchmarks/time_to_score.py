"""How long training takes to an agent of a given score and safety: wall-clock, frames, violations.

    python benchmarks/time_to_score.py safetac cpo --seeds 0 1 2 3 4      # 11.78 at .005, on Point
    python benchmarks/time_to_score.py safetac --name jackal --seeds 0 1 2 --set env.robot=jackal
    python benchmarks/time_to_score.py safetac --name goal1 --criteria return=20 cost=25 --set ...

A training is at its end when two evaluations in a row have met all criteria, with sampled and with
deterministic actions, on 200 layouts that training never sees. ``score`` and ``return`` are at
least what is said, ``cv_rate`` (per step) and ``cost`` at most, all means of episodes.
The time is that of the second of the two, without what evaluations took. It is read off the log: a
command of torchrl-safe trains, and is interrupted when it is there.

Writes ``results/time_to_score/NAME.csv``, a row per evaluation, and ``NAME.json``, what came of it,
with the hardware. Runs that are done are skipped, and those that were interrupted go on. Give it
the machine for itself.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import platform
import signal
import statistics
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from bench_training import SILENT

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import METHODS
from torchrl_safe.trainers.surroundings import commit

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "time_to_score"
TRAIN = "from torchrl_safe.trainers.cli import main; main()"
AT_LEAST, AT_MOST = ("score", "return"), ("cv_rate", "cost")
KINDS = ("eval/", "eval/det/")  # sampled and deterministic actions
EVALUATION = [f"{kind}{name}" for kind in KINDS for name in (*AT_LEAST, *AT_MOST)]
COLUMNS = ["method", "seed", "frames", "seconds", "violations", *EVALUATION]
# An evaluation costs seconds, which do not count, so that it can be had often.
DEFAULTS = [
    *(option for option in SILENT if not option.startswith(("eval.", "checkpoint."))),
    *("eval.num_episodes=200", "eval.final_episodes=2", "eval.interval=40_000"),
    *("checkpoint.interval=200_000", "collector.total_frames=3_000_000"),
]

Row = dict[str, Any]


def evaluations(log: Path) -> list[Row]:
    """The evaluations of a run so far: frames, seconds and violations until then, and figures."""
    try:
        metrics = {name: dict(zip(*pair, strict=True)) for name, pair in read_metrics(log).items()}
    except (FileNotFoundError, ValueError):  # nothing is logged yet
        return []
    rows, before, seconds = [], 0, 0.0
    for frames, rate in sorted(metrics.get("time/frames_per_second", {}).items()):
        seconds += (frames - before) / rate - metrics.get("time/eval", {}).get(frames, 0.0)
        before = frames
        figures = {name: metrics.get(name, {}).get(frames) for name in EVALUATION}
        if figures["eval/return"] is not None:
            violations = metrics["train/total_cvs"][frames]
            rows.append({"frames": frames, "seconds": seconds, "violations": violations, **figures})
    return [{name: float(value) for name, value in row.items()} for row in rows]


def passes(row: Row, criteria: dict[str, float]) -> bool:
    """Whether an evaluation meets all criteria, with both kinds of actions."""
    return all(
        row[kind + name] >= bound if name in AT_LEAST else row[kind + name] <= bound
        for kind in KINDS
        for name, bound in criteria.items()
    )


def there(rows: list[Row], criteria: dict[str, float]) -> Row | None:
    """The second of the first two evaluations in a row that passed."""
    good = [passes(row, criteria) for row in rows]
    return next((rows[i] for i in range(1, len(rows)) if good[i - 1] and good[i]), None)


def train(method: str, seed: int, folder: Path, options: list[str], criteria: dict) -> list[Row]:
    """Train until the agent is there, or the frames are spent; its evaluations."""
    run_dir = folder / method / f"seed_{seed}"
    resume = [f"resume={'true' if (run_dir / 'checkpoints').exists() else 'false'}"]
    if run_dir.exists() and resume == ["resume=false"]:
        raise SystemExit(f"{run_dir} was cut off before its first checkpoint: remove it.")
    command = [sys.executable, "-c", TRAIN, "train", method, f"seed={seed}", *DEFAULTS, *options]
    with subprocess.Popen([*command, *resume, f"run_dir={run_dir}"], cwd=ROOT) as process:
        try:
            while process.poll() is None and not there(evaluations(run_dir / "log"), criteria):
                time.sleep(2)
        finally:
            if process.poll() is None:
                process.send_signal(signal.SIGINT)  # it saves, and ends
            process.wait()
    if process.returncode:
        raise SystemExit(f"{run_dir} ended with {process.returncode}.")
    rows = evaluations(run_dir / "log")
    end = there(rows, criteria)
    return rows if end is None else rows[: rows.index(end) + 1]


def read(path: Path) -> list[Row]:
    if not path.exists():
        return []
    with path.open() as file:
        return [
            {n: v if n == "method" else float(v) for n, v in row.items()}
            for row in csv.DictReader(file)
        ]


def write(path: Path, rows: list[Row]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for row in rows:
            writer.writerow({n: v if n == "method" else f"{v:.9g}" for n, v in row.items()})


def summary(rows: list[Row], criteria: dict[str, float]) -> dict[str, Any]:
    """Of each method, how many seeds got there, and median and range of what it took.

    A seed that did not get there took longer than any: with most of them, there is no median.
    """
    out: dict[str, Any] = {}
    for method in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == method]
        seeds = sorted({row["seed"] for row in mine})
        ends = [there([r for r in mine if r["seed"] == seed], criteria) for seed in seeds]
        out[method] = {"seeds": len(seeds), "there": sum(end is not None for end in ends)}
        for name in ("seconds", "frames", "violations"):
            took = sorted(np.inf if end is None else end[name] for end in ends)
            middle = statistics.median(took)
            out[method][name] = [None if x == np.inf else x for x in (middle, took[0], took[-1])]
    return out


def hardware() -> dict[str, Any]:
    lines = Path("/proc/cpuinfo").read_text().splitlines() if os.name == "posix" else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "load_average_before": os.getloadavg()[0],
        "python": platform.python_version(),
        "torch": version("torch"),
        "commit": commit(),
    }


def table(found: dict[str, Any]) -> str:
    def text(figures: list[float | None], scale: float, digits: int) -> str:
        middle, low, high = ("never" if x is None else f"{x / scale:,.{digits}f}" for x in figures)
        return f"{middle} ({low} to {high})"

    lines = [
        "| median (range) over seeds | got there | minutes | frames | violations |",
        "|---|---:|---:|---:|---:|",
    ]
    for method, one in found.items():
        cells = [f"{one['there']} of {one['seeds']}", text(one["seconds"], 60, 1)]
        cells += [text(one[name], 1, 0) for name in ("frames", "violations")]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return "\n".join(lines)


def criterion(word: str) -> tuple[str, float]:
    name, _, bound = word.partition("=")
    if name not in (*AT_LEAST, *AT_MOST):
        known = ", ".join((*AT_LEAST, *AT_MOST))
        raise argparse.ArgumentTypeError(f"{name} must be one of {known}")
    return name, float(bound)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("methods", nargs="+", choices=METHODS)
    parser.add_argument("--name", default="point", help="of the two files")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument(
        "--criteria",
        type=criterion,
        nargs="+",
        default=[("score", 11.78), ("cv_rate", 0.005)],
        metavar="NAME=BOUND",
    )
    parser.add_argument("--set", nargs="*", default=[], metavar="OPTION=VALUE", help="of training")
    parser.add_argument("--runs", type=Path, default=ROOT / "runs" / "time_to_score")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    criteria, path = dict(arguments.criteria), arguments.results / arguments.name
    report = {"criteria": criteria, "options": [*DEFAULTS, *arguments.set], **hardware()}
    rows = read(path.with_suffix(".csv"))
    for seed in arguments.seeds:
        for method in arguments.methods:
            if any(row["method"] == method and row["seed"] == seed for row in rows):
                continue
            new = train(method, seed, arguments.runs / arguments.name, arguments.set, criteria)
            rows += [{"method": method, "seed": seed, **row} for row in new]
            write(path.with_suffix(".csv"), rows)
    found = summary(rows, criteria)
    path.with_suffix(".json").write_text(json.dumps({**report, "methods": found}, indent=2) + "\n")
    print(table(found))


if __name__ == "__main__":
    main()
