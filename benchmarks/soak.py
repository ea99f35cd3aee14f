"""Random actions for a long time: finite, without a warning from MuJoCo, in the same memory.

``python benchmarks/soak.py jackal --steps 1000000``, or velocity tasks such as ``ant``, or
Safety-Gymnasium's such as ``SafetyPointGoal1``, or ``all`` of these. ``--csv`` adds a row for each
to a file and leaves out what is in it. ``--randomized`` draws every robot of ours anew.
"""

from __future__ import annotations

import argparse
import csv
import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from torchrl_safe.envs import JACKAL_TRAINING, VELOCITY_TASKS, SafeRobotEnv, SafeVelocityEnv
from torchrl_safe.envs.tasks import SAFETY_TASKS, get_task

NUM_ENVS = 64
EVENTS = ("terminated", "truncated", "goal_met", "violation")


def resident_megabytes() -> float:
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * resource.getpagesize() / 2**20


def make(name: str, randomized: bool) -> SafeRobotEnv | SafeVelocityEnv:
    how: dict[str, Any] = {"num_envs": NUM_ENVS, "stagger": True}
    if name in VELOCITY_TASKS:
        return SafeVelocityEnv(name, **how)
    if name in SAFETY_TASKS:
        robot, task = get_task(name)
        return SafeRobotEnv(robot, task=task, episode_length=task.episode_length, **how)
    return SafeRobotEnv(name, randomization=JACKAL_TRAINING if randomized else None, **how)


def soak(name: str, steps: int, randomized: bool) -> dict[str, Any]:
    """What happened, by the columns of the file."""
    env = make(name, randomized)
    td, generator = env.reset(), torch.Generator().manual_seed(0)
    warnings = env._core._robots.batch.warning
    rounds = max(steps // NUM_ENVS, 10)
    counts = {event: 0 for event in EVENTS if event in td.keys()}
    low, high = env.action_spec.space.low, env.action_spec.space.high
    held = torch.zeros(env.action_spec.shape)
    warned, memory, start = 0, [], time.perf_counter()
    for t in range(rounds):
        # Half of the robots hold an action for eight steps, or the noise goes nowhere.
        fresh = low + (high - low) * torch.rand(held.shape, generator=generator)
        if t % 8 == 0:
            held = fresh
        td["action"] = torch.where(torch.arange(NUM_ENVS)[:, None] % 2 == 0, fresh, held)
        stepped, td = env.step_and_maybe_reset(td)
        for entry in ("observation", "reward", "cost"):
            if not stepped["next", entry].isfinite().all():
                raise RuntimeError(f"{entry} of {name} is not finite at step {t}.")
        for event in counts:
            counts[event] += int(stepped["next", event].sum())
        warned = np.maximum(warned, warnings[:, :, 1].max(0))
        if t % (rounds // 10) == 0:
            memory.append(resident_megabytes())
    diverged = env.instabilities
    env.close()
    return {
        "task": name,
        "steps": rounds * NUM_ENVS,
        "seconds": round(time.perf_counter() - start),
        "diverged": diverged,
        "warnings": int(np.sum(warned)),
        "memory_first": round(memory[0], 1),
        "memory_least": round(min(memory[1:]), 1),
        "memory_most": round(max(memory[1:]), 1),
        **{event: counts.get(event, 0) for event in EVENTS},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="+")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--randomized", action="store_true")
    parser.add_argument("--csv", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    names = list(SAFETY_TASKS) if args.names == ["all"] else args.names
    done = set()
    if args.csv is not None and args.csv.exists():
        with args.csv.open() as file:
            done = {row["task"] for row in csv.DictReader(file)}
    for name in names:
        if name in done:
            continue
        row = soak(name, args.steps, args.randomized)
        print(row, flush=True)
        if args.csv is not None:
            new = not args.csv.exists()
            with args.csv.open("a", newline="") as file:
                writer = csv.DictWriter(file, list(row), lineterminator="\n")
                if new:
                    writer.writeheader()
                writer.writerow(row)


if __name__ == "__main__":
    main()
