"""Where the time of an update goes: a Markdown table of its parts.

    pip install -e ".[bench]"
    python benchmarks/profile_training.py                      # defaults of the example, one thread
    python benchmarks/profile_training.py policy.num_components=5  # any option of it

The example runs as it is, and py-spy looks at its stack 25 times a second, at Python's and
at the native one. Of each part the table says how often torch was at work (its native code, or its
Python: modules, optimizers), MuJoCo, or neither: tensordict, TorchRL, NumPy, this library.

Nothing is added to the example but these breaks: a profiler that notes every
operation makes short ones longer, by an amount that is as large as what the table is to show.
py-spy needs Linux, and the right to look at a process of the same user.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import redirect_stdout
from pathlib import Path

from bench_training import SILENT, compose, warm_up_updates

from torchrl_safe.trainers import SafeTAC
from torchrl_safe.trainers.run import Run

NUM_UPDATES = 16  # after the warm-up
RATE = 25  # looks per second: each stops the example for milliseconds
# Functions whose time is a part's, the innermost first to be looked at.
PARTS = {
    "collect: policy, environment, tensordicts": ["Collector.rollout"],
    "replay: store and sample slices": ["ReplayBuffer.extend", "ReplayBuffer.sample"],
    "targets: networks and Retrace": ["CriticFit.__init__.<locals>.add_targets"],
    "critics: gradient steps": ["CriticFit.__init__.<locals>.descend"],
    "policy: trust-region step": ["SafeTAC._step", "SafeTAC._ascend"],
    "logging and what is left": ["Trainer._loop"],
}
PART_OF = {function: part for part, functions in PARTS.items() for function in functions}
# Whose work it is, by the file it is in. One that is nobody's, such as the C library, works for
# its caller. torch.compile names its files by a hash.
OWNERS = {
    "torch, native": r"lib(torch|c10|gomp|cu[a-z]+)\w*[.-].*so|\w+\.main\.cpp$",
    "torch, Python": r"torch/|c\w{51}\.py$",
    "MuJoCo": r"mujoco/",
    "neither": r".*\.py$|numpy/|tensordict/|<",
}
FRAME = re.compile(r"(?P<function>.*) \((?P<file>[^()]*?)(:\d+)?\)$")
PR_SET_PTRACER, PR_SET_PTRACER_ANY = 0x59616D61, ctypes.c_ulong(-1)


def record(overrides: list[str]) -> list[str]:
    """Run the example under py-spy's eyes.

    Returns:
        list: a line per stack, outermost frame first, with the number of times it was seen.
    """
    options = compose(["num_threads=1", *overrides, *SILENT])
    first = warm_up_updates(options)
    last = first + NUM_UPDATES
    options.collector.total_frames = last * options.collector.frames_per_batch
    # Where a process may look at its children alone, it has to be allowed to look at its parent.
    ctypes.CDLL(None).prctl(PR_SET_PTRACER, PR_SET_PTRACER_ANY, 0, 0, 0)
    log, updates = Run.log, 0
    sampler: subprocess.Popen[str]

    def log_and_watch(run: Run, metrics: dict[str, float]) -> None:
        nonlocal sampler, updates
        log(run, metrics)  # the last thing an update does
        updates += 1
        if updates == first:
            sampler = start_sampler(stacks)
        elif updates == last:
            sampler.send_signal(signal.SIGINT)
            sampler.communicate()

    Run.log = log_and_watch
    with tempfile.TemporaryDirectory() as run_dir:
        options.run_dir, stacks = run_dir, Path(run_dir, "stacks")
        with redirect_stdout(sys.stderr):
            SafeTAC(options=options).train()
        return stacks.read_text().splitlines()


def start_sampler(stacks: Path) -> subprocess.Popen[str]:
    """Returns once it has begun.

    Raises:
        RuntimeError: if it has ended before, with what it said.
    """
    command = ["py-spy", "record", "--native", "--idle", "--threads", "--format", "raw"]
    command += ["--rate", str(RATE), "--pid", str(os.getpid()), "--output", str(stacks)]
    sampler = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    said = []
    assert sampler.stdout is not None
    for line in sampler.stdout:
        said.append(line)
        if "Sampling process" in line:
            return sampler
    with sampler:
        raise RuntimeError("".join(said))


def attribute(stacks: Iterable[str]) -> dict[str, Counter[str]]:
    """How often each part was seen, by whose work it was. Threads but the main one do not count.

    Args:
        stacks (iterable of str): py-spy's raw format.
    """
    seen: dict[str, Counter[str]] = {part: Counter() for part in PARTS}
    for line in stacks:
        stack, _, count = line.rpartition(" ")
        frames = stack.split(";")
        if "MainThread" in frames[0]:
            inwards = [match for match in map(FRAME.match, reversed(frames)) if match]
            seen[part_of(inwards)][owner_of(inwards)] += int(count)
    return seen


def part_of(inwards: Iterable[re.Match[str]]) -> str:
    functions = (frame["function"] for frame in inwards)
    return next((PART_OF[f] for f in functions if f in PART_OF), list(PARTS)[-1])


def owner_of(inwards: Iterable[re.Match[str]]) -> str:
    def owners() -> Iterator[str]:
        for frame in inwards:
            yield from (name for name, at in OWNERS.items() if re.match(at, frame["file"]))

    return next(owners(), "neither")


def main(overrides: list[str]) -> None:
    """Watch some updates and print the table."""
    seen = attribute(record(overrides))
    total = sum(counter.total() for counter in seen.values())
    print("| part of an update | share | " + " | ".join(OWNERS) + " |")
    print("|---|" + "---:|" * (1 + len(OWNERS)))
    for part, counter in {**seen, "**whole update**": sum(seen.values(), Counter())}.items():
        counts = (counter.total(), *(counter[owner] for owner in OWNERS))
        print(f"| {part} | " + " | ".join(f"{count / total:.1%}" for count in counts) + " |")
    print()
    print(f"Shares are of {total:,} looks at {NUM_UPDATES} updates.")


if __name__ == "__main__":
    main(sys.argv[1:])
