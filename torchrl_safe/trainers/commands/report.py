"""A run, or several side by side, as one page that opens in any browser.

    torchrl-safe report runs/safetac/point/seed_0
    torchrl-safe report runs/safetac/point runs/cpo/point --out point.html

Every training writes ``report.html`` into its folder at the end; after ``torchrl-safe evaluate``
this command puts trajectories and calibration on it. Runs that differ only in their seed are shown
as one, with mean and interval. Folders are searched for runs.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from torchrl_safe._files import expand, printable
from torchrl_safe.trainers.report import write_report
from torchrl_safe.trainers.terminal import say

NAME = "report.html"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of :func:`main`."""
    parser.add_argument("run_dirs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument(
        "--out", type=Path, help=f"the page; {NAME} in RUN, or here if there are several"
    )


def main(run_dirs: Sequence[Path], out: Path | None = None) -> Path:
    """Write the page.

    Args:
        run_dirs (sequence of path): runs, or folders with runs below them.
        out (path, optional): the page. By default ``report.html``, in the folder if there is one,
            and else where one is.

    Returns:
        Path: the page.

    Raises:
        FileNotFoundError: if there is no run.
    """
    if out is None:
        out = expand(run_dirs[0]) / NAME if len(run_dirs) == 1 else Path(NAME)
    path = write_report(run_dirs, out)
    say(f"written to {printable(path)}")
    return path
