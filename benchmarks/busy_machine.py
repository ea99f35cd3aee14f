"""What a training gets of a processor that others use too: a Markdown table.

    python benchmarks/busy_machine.py                             # about ten minutes
    python benchmarks/busy_machine.py --spin-counts 0 1000  # rows of threads that spin for less

Trainings with the example's defaults and busy loops of the same priority are all started at once,
stopped, and continued in turns: one training beside 0 to 4 loops for some seconds, then the next.
What others do on the machine meanwhile thus slows all alike. A figure is the median of rounds.

The fair share of a training beside n loops, on c cores, is c / (c + n) of the frames per second of
the fastest training without them: what c threads get of c + n of the same weight. All processes
share one session, between which Linux divides the processor before it looks at threads. Others'
sessions still lower all figures, and those of several threads the most.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from bench_training import SILENT

# An update of a quarter of the frames, with a quarter of the work: a window of seconds has several.
OPTIONS = [
    *("collector.frames_per_batch=2000", "optim.critic_rounds=4", "optim.policy_frames=1000"),
    *("collector.total_frames=1_000_000_000", "collector.init_frames=8000", *SILENT),
]
SPIN_COUNT = "GOMP_SPINCOUNT"
WAITING = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", SPIN_COUNT)  # the caller's do not count
LOOP = "while True: pass"


def train(progress: Path, overrides: list[str]) -> None:
    """Train, and keep the number of frames that were learned from in a file."""
    from torch.optim import Adam, Optimizer
    from torch.optim.optimizer import register_optimizer_step_post_hook

    from torchrl_safe.trainers import SafeTAC, cli

    options = cli.compose("safetac", overrides)
    optim = options.optim
    steps = optim.critic_rounds * -(-optim.critic_frames // optim.minibatch_size)
    learned = np.memmap(progress, np.float64, shape=())
    frames_per_step = options.collector.frames_per_batch / steps

    def count(optimizer: Optimizer, args: object, kwargs: object) -> None:
        if isinstance(optimizer, Adam):
            learned[...] += frames_per_step

    register_optimizer_step_post_hook(count)
    SafeTAC(options=options).train()


class Training:
    """A training in a process of its own.

    Args:
        folder (Path): of its own.
        variables (dict): of its environment.
        overrides (list of str): options.
    """

    def __init__(self, folder: Path, variables: dict[str, str], overrides: list[str]) -> None:
        folder.mkdir()
        file = folder / "frames"
        self.frames = np.memmap(file, np.float64, "w+", shape=())
        inherited = {k: v for k, v in os.environ.items() if k not in WAITING}
        run_dir = f"run_dir={folder / 'run'}"
        with (folder / "output").open("w") as output:
            self.process = subprocess.Popen(
                [sys.executable, __file__, "--train", file, *OPTIONS, *overrides, run_dir],
                env=inherited | variables,
                stdout=output,
                stderr=output,
            )
        while not self.frames:  # the first gradient steps
            if self.process.poll() is not None:
                raise RuntimeError((folder / "output").read_text())
            time.sleep(0.1)
        stop(self.process)

    def speed(self, seconds: float) -> float:
        """Frames per second of a while."""
        before, start = float(self.frames), time.perf_counter()
        self.process.send_signal(signal.SIGCONT)
        time.sleep(seconds)
        stop(self.process)
        return (float(self.frames) - before) / (time.perf_counter() - start)


def stop(process: subprocess.Popen[bytes]) -> None:
    """Returns once it stands still."""
    process.send_signal(signal.SIGSTOP)
    os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)


def end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def measure(
    trainings: dict[str, Training], loops: int, rounds: int, seconds: float
) -> dict[tuple[str, int], list[float]]:
    """Frames per second of each training beside each number of loops, in each round."""
    rates: dict[tuple[str, int], list[float]] = {}
    with ExitStack() as ends:
        others = [subprocess.Popen([sys.executable, "-c", LOOP]) for _ in range(loops)]
        for other in others:
            ends.callback(end, other)
            stop(other)
        for turn in range(rounds):
            for count in range(loops + 1):
                for other in others[:count]:
                    other.send_signal(signal.SIGCONT)
                for name, training in trainings.items():
                    rates.setdefault((name, count), []).append(training.speed(seconds))
                for other in others[:count]:
                    stop(other)
            print(f"round {turn + 1} of {rounds}", file=sys.stderr)
    return rates


def table(rates: dict[tuple[str, int], list[float]], cores: int) -> str:
    """A row per training: medians, and which part of the fair share they are."""
    names = list(dict.fromkeys(name for name, _ in rates))
    counts = sorted({count for _, count in rates})
    medians = {cell: statistics.median(each) for cell, each in rates.items()}
    best = max(medians[name, 0] for name in names)

    def text(name: str, count: int) -> str:
        fair = best * cores / (cores + count) if count else best
        return f"{medians[name, count]:,.0f} ({medians[name, count] / fair:.0%})"

    lines = [
        ["frames/s (of the fair share) beside", *(f"{count} loops" for count in counts)],
        ["---", *("---:" for _ in counts)],
        *([name, *(text(name, count) for count in counts)] for name in names),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--loops", type=int, default=4, help="the most busy loops")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=6.0, help="of one figure in one round")
    parser.add_argument("--spin-counts", type=int, nargs="*", default=[], help="more rows")
    arguments = parser.parse_args()
    settings: dict[str, tuple[dict[str, str], list[str]]] = {
        "the default": ({}, []),
        "`num_threads=2`, the default before": ({}, ["num_threads=2"]),
        "`num_threads=1`": ({}, ["num_threads=1"]),
        **{
            f"`num_threads=2`, `{SPIN_COUNT}={n}`": ({SPIN_COUNT: str(n)}, ["num_threads=2"])
            for n in arguments.spin_counts
        },
    }
    cores = len(os.sched_getaffinity(0))
    print(f"Load average before: {os.getloadavg()[0]:.1f}; {cores} cores.\n", flush=True)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as ends:
        trainings = {}
        for number, (name, (variables, overrides)) in enumerate(settings.items()):
            trainings[name] = Training(Path(folder, str(number)), variables, overrides)
            ends.callback(end, trainings[name].process)
        rates = measure(trainings, arguments.loops, arguments.rounds, arguments.seconds)
    print(table(rates, cores))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--train"]:
        train(Path(sys.argv[2]), sys.argv[3:])
    else:
        main()
