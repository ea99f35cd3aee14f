"""Frames per second of the whole training loop, and where the time goes.

python benchmarks/bench_training.py                # defaults of the example
python benchmarks/bench_training.py num_threads=1  # any option of it
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import hydra
import numpy as np

from torchrl_safe.record import format_table, read_metrics

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "safetac_point.py"
NUM_UPDATES = 15

# OmniSafe 0.5's CPO on PointGoal1 with its defaults: steps per second of the whole training loop,
# one thread of a comparable two-core machine. Recorded, because OmniSafe cannot be installed beside
# numpy 2 on Python 3.11.
OMNISAFE_CPO = 129


def main(overrides: list[str]) -> None:
    """Train for a few updates and print the table."""
    with hydra.initialize_config_dir(str(EXAMPLE.parent), version_base="1.3"):
        cfg = hydra.compose(EXAMPLE.stem, overrides)
    per_batch, warm_up = cfg.collector.frames_per_batch, cfg.collector.init_frames
    total = (-(-warm_up // per_batch) - 1 + NUM_UPDATES) * per_batch
    with tempfile.TemporaryDirectory() as run_dir:
        training = [
            *("eval.interval=1_000_000_000", "checkpoint.interval=1_000_000_000"),
            *("eval.final_episodes=2", "eval.num_steps=10", "video.num_steps=0"),
            *(f"collector.total_frames={total}", f"run_dir={run_dir}"),
        ]
        subprocess.run([sys.executable, EXAMPLE, *overrides, *training], check=True)
        metrics = read_metrics(Path(run_dir, "log"))

    frames, speed = metrics["time/frames_per_second"]
    seconds = (per_batch / speed)[frames >= warm_up]
    parts = {name: metrics[f"time/{name}"][1] for name in ("targets", "critics", "policy")}
    parts["other (collection, replay, logging)"] = seconds - sum(parts.values())
    speed = per_batch / np.median(seconds)
    rows: dict[str, float | str] = {
        f"frames/s, median of {len(seconds)} updates": f"{speed:.0f}",
        "frames/s, CPO of OmniSafe 0.5 (recorded)": str(OMNISAFE_CPO),
        "ratio": f"{speed / OMNISAFE_CPO:.1f}",
    }
    for name, part in parts.items():
        rows[f"share of time: {name}"] = f"{part.sum() / seconds.sum():.0%}"
    print(format_table(rows))


if __name__ == "__main__":
    main(sys.argv[1:])
