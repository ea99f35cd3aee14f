"""Watches trainings for hours: resident memory, open files, frames per second; then judges them.

    OPTIONS="collector.total_frames=100_000_000 num_threads=1"
    python examples/safetac_point.py seed=0 run_dir=runs/soak_0 $OPTIONS & FIRST=$!
    python examples/safetac_point.py seed=1 run_dir=runs/soak_1 $OPTIONS & SECOND=$!
    python benchmarks/soak_training.py runs/soak_0 runs/soak_1 --pid $FIRST $SECOND --minutes 120

The processes may have run for long already; their workers count with them. It reads a few files of
``/proc`` (Linux only) per sample, each of which is a line of the table as soon as it is taken.
Ctrl-C, or the end of a training, ends the watch early and judges what there is.

A replay buffer is allocated with the first batch, but its pages become resident as they are first
written; the first evaluation opens the files of its metrics. Memory and files are compared from the
moment on when the buffer has been filled once and an evaluation is over. Throughput is the log's,
of the updates: collecting without them, before ``collector.init_frames``, is left out.
"""

from __future__ import annotations

import argparse
import csv
import os
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from torchrl_safe.record import read_metrics

MAX_MEMORY_GROWTH = 0.02
MAX_SLOWDOWN = 0.1
GONE = (FileNotFoundError, ProcessLookupError)  # a process that ends while it is read
FRAMES_PER_SECOND = Path("log", "scalars", "time", "frames_per_second.csv")


@dataclass(frozen=True)
class Sample:
    """What a training and its workers hold at one moment."""

    minutes: float  # since the watch began
    frames: int
    processes: int
    memory_mb: float
    files: int
    cpu_seconds: float  # since the processes began


@dataclass(frozen=True)
class Row:
    """A line of the verdict."""

    quantity: str
    first: float
    last: float
    change: float
    passed: bool | None  # None where nothing is promised


def process_tree(pid: int) -> list[int]:
    """A process and all that came from it and still live."""
    tree = [pid]
    for parent in tree:
        for children in Path("/proc", str(parent), "task").glob("*/children"):
            with suppress(*GONE):
                tree += map(int, children.read_text().split())
    return tree


def is_running(pid: int) -> bool:
    """Whether a process lives and is no zombie."""
    try:
        return Path("/proc", str(pid), "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except GONE:
        return False


def take_sample(minutes: float, frames: int, pid: int) -> Sample:
    """A sample of a process tree; a worker that ends meanwhile is left out."""
    memory = ticks = files = processes = 0
    for process in process_tree(pid):
        folder = Path("/proc", str(process))
        try:
            stat = (folder / "stat").read_text().rpartition(")")[2].split()
            opened = len(os.listdir(folder / "fd"))
            pages = int((folder / "statm").read_text().split()[1])
        except GONE:
            continue
        processes, files, memory = processes + 1, files + opened, memory + pages
        ticks += int(stat[11]) + int(stat[12])
    return Sample(
        minutes=round(minutes, 3),
        frames=frames,
        processes=processes,
        memory_mb=round(memory * os.sysconf("SC_PAGE_SIZE") / 2**20, 2),
        files=files,
        cpu_seconds=ticks / os.sysconf("SC_CLK_TCK"),
    )


def logged_frames(run_dir: Path) -> int:
    """Frames of the newest whole line of a run's log, from its last bytes."""
    try:
        with (run_dir / FRAMES_PER_SECOND).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - 200))
            lines = file.read().split(b"\n")[:-1]
    except FileNotFoundError:
        return 0
    return int(lines[-1].split(b",")[0]) if lines else 0


def logged_speed(run_dir: Path, since: int) -> np.ndarray:
    """Frames per second of the updates after ``since`` frames, [M]."""
    frames, speed = read_metrics(run_dir / "log")["time/frames_per_second"]
    return speed[frames > since]


def tenths(values: Iterable[float]) -> tuple[float, float]:
    """Medians of the first and of the last tenth."""
    array = np.asarray(list(values), dtype=float)
    part = max(1, len(array) // 10)
    return float(np.median(array[:part])), float(np.median(array[-part:]))


def judge(samples: Sequence[Sample], speed: np.ndarray, *, settled_at: int) -> list[Row]:
    """The last tenth of a training beside the first.

    Args:
        samples (sequence of Sample): in order of time.
        speed (np.ndarray): frames per second of its updates, [M].

    Keyword Args:
        settled_at (int): frames from which on the replay buffer's memory is resident and all files
            of the log are open.

    Returns:
        list of Row: memory and open files from ``settled_at`` on, throughput, and the processor's
        time per frame, which tells a training that slowed down from a machine that had other work.

    Raises:
        ValueError: if there are fewer than ten samples after ``settled_at``, or ten updates.
    """
    settled = [sample for sample in samples if sample.frames >= settled_at]
    if min(len(settled), len(speed)) < 10:
        raise ValueError(
            f"a verdict needs 10 samples from {settled_at} frames on and 10 updates, got "
            f"{len(settled)} of {len(samples)} samples and {len(speed)} updates: watch longer."
        )

    def row(name: str, first: float, last: float, passes: Callable[[float], bool] | None) -> Row:
        change = last / first - 1
        return Row(name, first, last, change, passes and passes(change))

    part = max(1, len(settled) // 10)
    first_cost, last_cost = (
        1e3 * (end.cpu_seconds - start.cpu_seconds) / max(1, end.frames - start.frames)
        for start, end in ((settled[0], settled[part]), (settled[-1 - part], settled[-1]))
    )
    return [
        row(
            "resident memory, MB",
            *tenths(sample.memory_mb for sample in settled),
            lambda change: change <= MAX_MEMORY_GROWTH,
        ),
        row(
            "open files",
            min(sample.files for sample in settled[:part]),
            min(sample.files for sample in settled[-part:]),
            lambda change: change <= 0,
        ),
        row("frames/s", *tenths(speed), lambda change: change >= -MAX_SLOWDOWN),
        row("processor seconds per 1000 frames", first_cost, last_cost, None),
    ]


def watch(runs: dict[Path, int], minutes: float, every: float, out: Path) -> dict[Path, list]:
    """Take samples of every run until the time is over or one of them ends."""
    samples: dict[Path, list[Sample]] = {run_dir: [] for run_dir in runs}
    started = time.monotonic()
    with out.open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["run", *(field.name for field in fields(Sample))])
        try:
            while (elapsed := (time.monotonic() - started) / 60) < minutes:
                for run_dir, pid in runs.items():
                    if not is_running(pid):
                        print(f"{run_dir}: process {pid} ended after {elapsed:.1f} minutes.")
                        return samples
                    sample = take_sample(elapsed, logged_frames(run_dir), pid)
                    samples[run_dir].append(sample)
                    table.writerow([run_dir, *astuple(sample)])
                file.flush()
                time.sleep(every)
        except KeyboardInterrupt:
            print()
    return samples


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run_dir", type=Path, nargs="+")
    parser.add_argument("--pid", type=int, nargs="+", required=True, help="one for each run")
    parser.add_argument("--minutes", type=float, default=120.0)
    parser.add_argument("--every", type=float, default=10.0, help="seconds between samples")
    parser.add_argument("--out", type=Path, default=Path("soak.csv"))
    args = parser.parse_args()
    if len(args.pid) != len(args.run_dir):
        parser.error(f"{len(args.run_dir)} runs need as many --pid, got {len(args.pid)}.")
    begun = {run_dir: logged_frames(run_dir) for run_dir in args.run_dir}
    runs = dict(zip(args.run_dir, args.pid, strict=True))
    failed = False
    for run_dir, samples in watch(runs, args.minutes, args.every, args.out).items():
        cfg = OmegaConf.load(run_dir / "config.yaml")
        speed = logged_speed(run_dir, max(begun[run_dir], cfg.collector.init_frames))
        full_at = cfg.get("replay_buffer", {}).get("size", cfg.collector.frames_per_batch)
        settled_at = max(full_at, cfg.eval.interval + cfg.collector.frames_per_batch)
        print(f"{run_dir}: {len(samples)} samples, {len(speed)} updates")
        try:
            rows = judge(samples, speed, settled_at=settled_at)
        except ValueError as error:
            failed = True
            print(f"  no verdict: {error}")
            continue
        for row in rows:
            verdict = {True: "passed", False: "FAILED", None: ""}[row.passed]
            print(
                f"  {row.quantity:35}{row.first:10.2f} to {row.last:10.2f}{row.change:+8.1%}"
                f"  {verdict}"
            )
            failed |= row.passed is False
    raise SystemExit(failed)


if __name__ == "__main__":
    main()
