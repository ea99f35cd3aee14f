r"""Steps per second of Safety-Gymnasium's tasks beside Safety-Gymnasium itself: a Markdown table.

    python benchmarks/bench_safety_tasks.py SafetyPointGoal1 SafetyCarGoal1 \
        --safety-gymnasium PATH/bin/python   # of an environment as in suite/README.md

N = 64 on two threads, as a collector steps them: tensors and resets. The floor is the physics
alone, from the same states and under the same controls, on as many threads of MuJoCo's pool.
Safety-Gymnasium is one environment in a process of its own, and only its steps count, not its
resets. All rows take turns, so that a busy machine slows them alike: a figure is the median of
rounds, a ratio the median of the ratios within a round. The velocity tasks have
``bench_velocity.py``.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import time
from collections.abc import Callable

import numpy as np
import torch
from floor import beside_the_floor

from torchrl_safe.envs import SafeRobotEnv
from torchrl_safe.envs._model import compile_model
from torchrl_safe.envs.tasks import SAFETY_TASKS, get_task

torch.set_num_threads(1)

NUM_ENVS, NUM_THREADS = 64, 2
ENV, FLOOR, THEIRS = "env", "floor", "Safety-Gymnasium"
Round = Callable[[float], dict[str, float]]

# Answers each number of seconds on its input with a rate.
THEIR_PROGRAM = """
import sys, time, warnings
warnings.simplefilter("ignore")
import safety_gymnasium
env = safety_gymnasium.make(sys.argv[1] + "-v0")
env.reset(seed=0)
for line in sys.stdin:
    steps, spent = 0, 0.0
    while spent < float(line):
        action = env.action_space.sample()
        start = time.perf_counter()
        *_, terminated, truncated, _ = env.step(action)
        spent += time.perf_counter() - start
        steps += 1
        if terminated or truncated:
            env.reset()
    print("rate", steps / spent, flush=True)
"""


def ours(name: str) -> Round:
    """Rates of the environment and of the physics that it makes."""
    robot, task = get_task(name)
    env = SafeRobotEnv(
        robot,
        task=task,
        num_envs=NUM_ENVS,
        num_threads=NUM_THREADS,
        episode_length=task.episode_length,
        stagger=True,
    )
    model = compile_model(robot, task.bodies)
    rates = beside_the_floor(env, model, robot.substeps, NUM_THREADS)
    return lambda seconds: dict(zip((ENV, FLOOR), rates(seconds), strict=True))


def theirs(name: str, python: str) -> Round:
    """The rate of Safety-Gymnasium's environment in a Python that has it."""
    process = subprocess.Popen(
        [python, "-c", THEIR_PROGRAM, name],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    asked, answers = process.stdin, process.stdout

    def measure(seconds: float) -> dict[str, float]:
        print(seconds, file=asked, flush=True)
        for line in answers:
            if line.startswith("rate "):  # it prints other things as well
                return {THEIRS: float(line.split()[1])}
        raise RuntimeError(f"{python} runs no {name}: see suite/README.md for what it needs.")

    return measure


def reset_milliseconds(name: str, rounds: int) -> float:
    robot, task = get_task(name)
    env = SafeRobotEnv(robot, task=task, num_envs=NUM_ENVS, num_threads=NUM_THREADS)
    times = []
    for _ in range(rounds + 1):
        start = time.perf_counter()
        env.reset()
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times[1:])


def line(name: str, python: str | None, rounds: int, seconds: float) -> str:
    rows = [ours(name)] + ([] if python is None else [theirs(name, python)])
    rates = [{k: v for row in rows for k, v in row(seconds).items()} for _ in range(rounds + 1)]
    rates = rates[1:]  # the first round warms up

    def ratio(row: str, other: str) -> float:
        return float(np.median([rate[row] / rate[other] for rate in rates]))

    rate = statistics.median(rate[ENV] for rate in rates)
    cells = [name, f"{rate:,.0f} ({ratio(ENV, FLOOR):.0%})"]
    if python is not None:
        cells.append(f"{statistics.median(rate[THEIRS] for rate in rates):,.0f}")
        cells += [f"{ratio(row, THEIRS):.0f}" for row in (ENV, FLOOR)]
    return " | ".join([*cells, f"{reset_milliseconds(name, 2 * rounds):.1f} ms"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="*", default=list(SAFETY_TASKS), help="default: all")
    parser.add_argument("--safety-gymnasium", metavar="PYTHON", help="compare with what it runs")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=0.5, help="of one row in one round")
    options = parser.parse_args()
    heads = ["task, steps/s at N = 64", "2 threads (share of the floor)"]
    if options.safety_gymnasium is not None:
        heads += [THEIRS, "times", "the floor, times"]
    heads.append("a reset of 64")
    print(f"| {' | '.join(heads)} |\n| --- {'| ---: ' * (len(heads) - 1)}|")
    for name in options.tasks:
        row = line(name, options.safety_gymnasium, options.rounds, options.seconds)
        print(f"| {row} |", flush=True)


if __name__ == "__main__":
    main()
