"""Keeps what a finished run showed: its curves as one small table, its configuration, its results.

    python benchmarks/keep_run.py runs/safetac_point/seed_0 benchmarks/results/point/seed_0

The table has a row per logged frame count; a metric that was not logged there is left empty.
"""

from __future__ import annotations

import argparse
import csv
import json
import shutil
from pathlib import Path

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers.saved import HISTORY

KEPT = ("train/", "eval/", "update/", "time/frames_per_second")


def keep_run(run_dir: Path, out_dir: Path) -> None:
    """Copy the evidence of a run."""
    curves = {
        name: dict(zip(steps.tolist(), values.tolist(), strict=True))
        for name, (steps, values) in sorted(read_metrics(run_dir / "log").items())
        if name.startswith(KEPT)
    }
    out_dir.mkdir(parents=True, exist_ok=True)
    with (out_dir / "curves.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frames", *curves])
        for frames in sorted({step for curve in curves.values() for step in curve}):
            row = [curve.get(frames) for curve in curves.values()]
            writer.writerow([int(frames), *("" if v is None else f"{v:.5g}" for v in row)])
    for name in ("config.yaml", "results.json"):
        if (run_dir / name).exists():
            shutil.copy(run_dir / name, out_dir / name)
    (out_dir / "commit.txt").write_text(f"{trained_at(run_dir)}\n")


def trained_at(run_dir: Path) -> str:
    """The commit that a run was last started from, which its history knows if it has one."""
    if not (run_dir / HISTORY).exists():
        return "unknown"
    last = (run_dir / HISTORY).read_text().splitlines()[-1]
    return json.loads(last)["surroundings"]["commit"] or "unknown"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("out_dir", type=Path)
    arguments = parser.parse_args()
    keep_run(arguments.run_dir, arguments.out_dir)
