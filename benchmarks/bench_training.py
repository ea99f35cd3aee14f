"""Frames per second of the whole training loop, and where the time goes: a Markdown table.

python benchmarks/bench_training.py num_threads=1  # any option of the example; about a minute
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import SafeTAC, cli

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "safetac_point.py"
NUM_UPDATES = 8
PAPER_FRAMES = 10_000_000
# What a measured run does not need.
SILENT = [
    *("eval.interval=1_000_000_000", "checkpoint.interval=1_000_000_000"),
    *("eval.num_episodes=1", "eval.final_episodes=2", "eval.num_steps=10", "video.num_steps=0"),
]

# OmniSafe 0.5's CPO on PointGoal1 with its defaults: steps per second of the whole training loop,
# one thread of a comparable two-core machine. Recorded, because OmniSafe cannot be installed beside
# numpy 2 on Python 3.11.
OMNISAFE_CPO = 129


def compose(overrides: list[str]) -> SafeTAC.Options:
    """The example's options."""
    return cli.compose("safetac", overrides)


def warm_up_updates(options: SafeTAC.Options) -> int:
    """Updates up to the first one that learns, which warms up."""
    return max(1, -(-options.collector.init_frames // options.collector.frames_per_batch))


def main(overrides: list[str]) -> None:
    """Train for a few updates and print the table."""
    options = compose(overrides)
    per_batch = options.collector.frames_per_batch
    updates = warm_up_updates(options) + NUM_UPDATES
    with tempfile.TemporaryDirectory() as run_dir:
        training = [*SILENT, f"collector.total_frames={updates * per_batch}", f"run_dir={run_dir}"]
        command = [sys.executable, EXAMPLE, *overrides, *training]
        subprocess.run(command, check=True, stdout=sys.stderr)
        metrics = read_metrics(Path(run_dir, "log"))

    seconds = (per_batch / metrics["time/frames_per_second"][1])[-NUM_UPDATES:]
    parts = {name: metrics[f"time/{name}"][1] for name in ("targets", "critics", "policy")}
    parts = {name: part[-NUM_UPDATES:] for name, part in parts.items()}
    parts["other (collection, replay, logging)"] = seconds - sum(parts.values())
    speed = per_batch / np.median(seconds)
    print(f"| median of {NUM_UPDATES} updates | |")
    print("|---|---:|")
    print(f"| frames/s | {speed:,.0f} |")
    print(f"| hours of {PAPER_FRAMES:,} frames | {PAPER_FRAMES / speed / 3600:.2f} |")
    print(f"| frames/s, CPO of OmniSafe 0.5 (recorded elsewhere) | {OMNISAFE_CPO} |")
    print(f"| ratio | {speed / OMNISAFE_CPO:.1f} |")
    for name, part in parts.items():
        print(f"| share of time: {name} | {part.sum() / seconds.sum():.0%} |")


if __name__ == "__main__":
    main(sys.argv[1:])
