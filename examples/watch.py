"""A run seen from another terminal: draws its curves again and again, and prints where it stands.

    python examples/watch.py runs/safetac_point/seed_0            # until Ctrl-C
    python examples/watch.py runs/safetac_point/seed_0 --once

The picture is ``curves.png`` in the run's folder; most viewers and editors follow the file. It
reads the csv log; other backends have viewers of their own (``tensorboard --logdir``, ``wandb
sync``).
"""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path

from omegaconf import OmegaConf

from torchrl_safe.record import format_table, plot_learning_curves, read_metrics


def look(run_dir: Path) -> str:
    """Draw the curves, and say what the log says last."""
    cfg = OmegaConf.load(run_dir / "config.yaml")
    log = run_dir / "log"
    curves = read_metrics(log)
    if not curves:
        return "nothing logged yet"
    plot_learning_curves(log, run_dir / "curves.png")
    frames = int(max(steps[-1] for steps, _ in curves.values()))
    speed = curves["time/frames_per_second"][1][-1]
    total = cfg.collector.total_frames
    left = max(total - frames, 0) / speed
    rows: dict[str, float | str] = {
        "frames": f"{frames:,} of {total:,}",
        "time left": f"{left // 3600:.0f} h {left % 3600 // 60:.0f} min",
    }
    rows |= {name: float(values[-1]) for name, (_, values) in curves.items()}
    return format_table(rows)


def main(run_dir: Path, every: float, once: bool) -> None:
    """Look until interrupted."""
    run_dir = run_dir.expanduser()
    config = run_dir / "config.yaml"
    if not config.exists() or OmegaConf.load(config).logger.backend != "csv":
        raise FileNotFoundError(
            f"run_dir={run_dir} has no csv log: it is no run, or was started with another "
            "logger.backend."
        )
    while True:
        print(f"{look(run_dir)}\n{run_dir / 'curves.png'} drawn at {time.strftime('%H:%M:%S')}\n")
        if once:
            return
        time.sleep(every)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--every", type=float, default=30.0, help="seconds between two pictures")
    parser.add_argument("--once", action="store_true")
    with contextlib.suppress(KeyboardInterrupt):
        main(**vars(parser.parse_args()))
