"""A run seen from another terminal: its curves, there and as a picture, and where it stands.

    torchrl-safe watch runs/safetac_point/seed_0            # until Ctrl-C
    torchrl-safe watch runs/safetac_point/seed_0 --once

Curves are drawn below the newest metrics, and as ``curves.png`` in the run's folder; most viewers
and editors follow the file. It reads the csv log; other backends have viewers of their own
(``tensorboard --logdir``, ``wandb sync``).
"""

from __future__ import annotations

import argparse
import contextlib
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from torchrl_safe._files import check_folder, expand, printable
from torchrl_safe.record import (
    format_table,
    plot_learning_curves,
    read_metrics,
    terminal_curves,
)
from torchrl_safe.trainers.saved import CONFIG, read_config
from torchrl_safe.trainers.terminal import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of :func:`main`."""
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--every", type=float, default=30.0, help="seconds between two pictures")
    parser.add_argument("--once", action="store_true", help="look once, and end")


def main(run_dir: Path, every: float = 30.0, once: bool = False) -> None:
    """Look until interrupted.

    Args:
        run_dir (path): the run's folder.
        every (float): seconds between two looks.
        once (bool): whether to look only once.

    Raises:
        FileNotFoundError: if it has no csv log.
    """
    run_dir = expand(run_dir)
    try:
        backend = read_config(run_dir / CONFIG)["logger"]["backend"]
    except FileNotFoundError:
        backend = None
    if backend != "csv":
        raise FileNotFoundError(
            f"run_dir={printable(run_dir)} has no csv log: it is no run, or was started with "
            "another logger.backend."
        )
    picture = printable(run_dir / "curves.png")
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            say(f"{look(run_dir)}\n{picture} drawn at {time.strftime('%H:%M:%S')}\n")
            if once:
                return
            time.sleep(every)


def look(run_dir: Path) -> str:
    """Draw the curves, and say what the log says last, with curves as wide as the terminal."""
    run_dir = expand(run_dir)
    settings = read_config(run_dir / CONFIG)
    log = run_dir / "log"
    check_folder(log)
    curves = read_metrics(log)
    if not curves:
        return "nothing logged yet"
    plot_learning_curves(log, run_dir / "curves.png")
    frames = int(max(steps[-1] for steps, _ in curves.values()))
    total = settings["collector"]["total_frames"]
    rows: dict[str, float | str] = {"frames": f"{frames:,} of {total:,}"}
    _, speeds = curves.get("time/frames_per_second", (None, [0.0]))
    if speeds[-1] > 0:
        left = max(total - frames, 0) / speeds[-1]
        rows["time left"] = f"{left // 3600:.0f} h {left % 3600 // 60:.0f} min"
    metrics = {name: float(values[-1]) for name, (_, values) in curves.items()}
    table = format_table(rows | metrics | rows)  # no metric passes for them
    width = min(shutil.get_terminal_size().columns, 120)
    return f"{table}\n\n{terminal_curves(curves, width)}" if shows_dots(sys.stdout) else table


def shows_dots(stream: Any) -> bool:
    """Whether a stream's encoding has the characters that curves are drawn with."""
    try:
        "\u28ff".encode(getattr(stream, "encoding", None) or "ascii")
    except UnicodeEncodeError:
        return False
    return True
