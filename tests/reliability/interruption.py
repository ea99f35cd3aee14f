"""Kills a training run again and again, and checks that nothing but time is lost.

    python tests/reliability/interruption.py --kills 100

Every kill is a SIGINT, SIGTERM, SIGHUP or SIGKILL at a random moment between the start of a process
and its end, half of them while a checkpoint is being written. After each one every checkpoint must
be whole, no more than one interval may be lost, and a resumed process must go on and finish. In the
end, the log of the run must be that of a run that nobody killed, to the last bit.

Processes are forked from one that has done the imports, which take longer than the run.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import numpy as np
import tiny

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import checkpoints

INTERVAL = 2 * tiny.FRAMES
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)
PATIENCE = 120.0  # seconds until a process counts as hung


class Process:
    """A run in a forked process."""

    def __init__(self, run_dir: Path, total_frames: int, *overrides: str) -> None:
        self.output = run_dir.with_suffix(".txt")
        self.started = time.monotonic()
        self.pid = os.fork()
        if self.pid == 0:
            code = 1
            try:
                with open(self.output, "w") as file:
                    os.dup2(file.fileno(), 1)
                    os.dup2(file.fileno(), 2)
                tiny.launch(
                    run_dir,
                    f"collector.total_frames={total_frames}",
                    f"checkpoint.interval={INTERVAL}",
                    f"resume={str((run_dir / 'config.yaml').exists()).lower()}",
                    *overrides,
                )
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                os._exit(code)

    def poll(self) -> int | None:
        """The exit code, negative for a signal; None while it runs."""
        pid, status = os.waitpid(self.pid, os.WNOHANG)
        return os.waitstatus_to_exitcode(status) if pid else None

    def wait(self) -> int:
        while (code := self.poll()) is None:
            if time.monotonic() - self.started > PATIENCE:
                os.kill(self.pid, signal.SIGKILL)
                os.waitpid(self.pid, 0)
                raise AssertionError(f"hung: {self.output.read_text()}")
            time.sleep(0.002)
        return code


def saved_frames(run_dir: Path) -> int:
    """Frames of the newest checkpoint, of which every file is what was written."""
    newest = checkpoints.latest(run_dir)
    for checkpoint in (run_dir / "checkpoints").glob("checkpoint-*"):
        checkpoints.check_checkpoint(checkpoint)
    return int(newest.name.split("-")[1]) if newest else 0


def logged_frames(run_dir: Path) -> int:
    if not (run_dir / "log").exists():
        return 0
    metrics = read_metrics(run_dir / "log")
    return int(metrics["train/total_cvs"][0][-1]) if "train/total_cvs" in metrics else 0


def being_written(run_dir: Path) -> bool:
    return any((run_dir / "checkpoints").glob(".checkpoint-*"))


def attack(kills: int, seed: int, folder: Path) -> dict[str, object]:
    """Kill one run so many times; returns what happened."""
    rng, run_dir = random.Random(seed), folder / "run"
    counts: Counter[str] = Counter()
    lost: list[int] = []
    duration, writing = 3.0, 0.1  # seconds, of a process and of a write; measured as we go
    frames = done = 0
    while done < kills:
        number, aimed = SIGNALS[done % 4], rng.random() < 0.5
        process = Process(run_dir, frames + 2 * INTERVAL)
        deadline = process.started + rng.uniform(0, duration)
        writes = rng.randint(1, 2)  # which of the process's checkpoints to hit
        code, was_writing = None, False
        while code is None:
            is_writing = being_written(run_dir)
            if aimed:
                writes -= is_writing and not was_writing
                if is_writing and not was_writing and writes == 0:
                    time.sleep(rng.uniform(0, writing))
                    break
            elif time.monotonic() >= deadline:
                break
            was_writing = is_writing
            time.sleep(0.001)
            code = process.poll()
        if code is not None:  # it was faster
            assert code == 0, process.output.read_text()
            duration = time.monotonic() - process.started
        else:
            before = logged_frames(run_dir)
            hit = being_written(run_dir)
            os.kill(process.pid, number)
            process.wait()
            done += 1
            counts[number.name] += 1
            counts["while a checkpoint was written"] += hit
            counts["before the first update"] += before <= frames
            saved = saved_frames(run_dir)
            lost.append(max(0, before - saved))
            assert lost[-1] <= INTERVAL, (before, saved)
        frames = saved_frames(run_dir)
        # It goes on, to the end, whatever results it had before.
        resumed = Process(run_dir, frames + INTERVAL)
        assert resumed.wait() == 0, resumed.output.read_text()
        assert json.loads((run_dir / "results.json").read_text())["frames"] == frames + INTERVAL
        duration = 0.5 * duration + 0.75 * (time.monotonic() - resumed.started)
        frames = saved_frames(run_dir)
        assert len(list((run_dir / "checkpoints").iterdir())) == 1  # nothing is left behind
    whole = Process(folder / "whole", frames)
    whole.started += 3600  # as long as it takes
    assert whole.wait() == 0, whole.output.read_text()
    compare(folder / "whole", run_dir)
    return {
        "kills": done,
        **counts,
        "lost frames, of at most": (max(lost), INTERVAL),
        "kills that lost frames": sum(frame > 0 for frame in lost),
        "frames": frames,
    }


def compare(whole: Path, parts: Path) -> None:
    """Every metric but times and the final ones, of which a finished run has only its own."""
    expected, got = read_metrics(whole / "log"), read_metrics(parts / "log")
    names = [name for name in expected if name.startswith(("train/", "update/"))]
    assert len(names) > 10
    for name in names:
        for one, other in zip(expected[name], got[name], strict=True):
            np.testing.assert_array_equal(other, one, err_msg=name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        started = time.monotonic()
        report = attack(args.kills, args.seed, Path(folder))
        report["seconds"] = round(time.monotonic() - started)
    sys.stdout.write(json.dumps(report) + "\n")


if __name__ == "__main__":
    main()
