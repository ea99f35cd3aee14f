"""Steps per second of the velocity tasks beside Gymnasium's own environments: a Markdown table.

    python benchmarks/bench_velocity.py            # all six: about three minutes; or name some

N = 64 on one and on two threads, as a collector steps them: tensors and resets. The floor is the
physics alone, from the same states and under the same controls, on as many threads of MuJoCo's
pool. Gymnasium's environments are what ``gymnasium.make`` returns and 64 of them in its
``SyncVectorEnv``, both on one thread. All rows take turns, so that a busy machine slows them alike:
a figure is the median of rounds, a ratio the median of the ratios within a round. Where other work
keeps the cores, ``--processor-time`` compares what the rows on one thread use.
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable

import gymnasium
import mujoco
import torch
from floor import Clock, beside_the_floor

from torchrl_safe.envs import VELOCITY_TASKS, SafeVelocityEnv, VelocityTask

torch.set_num_threads(1)

NUM_ENVS = 64
Round = Callable[[float], dict[str, float]]


def ours(task: VelocityTask, num_threads: int, clock: Clock) -> Round:
    """Rates of the environment and of the physics that it makes."""
    env = SafeVelocityEnv(task, num_envs=NUM_ENVS, num_threads=num_threads, stagger=True)
    model = mujoco.MjModel.from_xml_path(str(task.asset_path))
    rates = beside_the_floor(env, model, task.frame_skip, num_threads, clock)
    rows = f"`SafeVelocityEnv`, {num_threads}", f"the floor, {num_threads}"
    return lambda seconds: dict(zip(rows, rates(seconds), strict=True))


def gymnasium_single(task: VelocityTask, clock: Clock) -> Round:
    env = gymnasium.make(f"{task.title}-v4")
    env.reset(seed=0)
    actions = [env.action_space.sample() for _ in range(256)]

    def measure(seconds: float) -> dict[str, float]:
        steps, start = 0, clock()
        while clock() - start < seconds:
            _, _, terminated, truncated, _ = env.step(actions[steps % 256])
            if terminated or truncated:
                env.reset()
            steps += 1
        return {"`gymnasium.make`": steps / (clock() - start)}

    return measure


def gymnasium_vector(task: VelocityTask, clock: Clock) -> Round:
    envs = gymnasium.make_vec(f"{task.title}-v4", num_envs=NUM_ENVS, vectorization_mode="sync")
    envs.reset(seed=0)
    actions = [envs.action_space.sample() for _ in range(64)]

    def measure(seconds: float) -> dict[str, float]:
        steps, start = 0, clock()
        while clock() - start < seconds:
            envs.step(actions[steps % 64])
            steps += 1
        return {"`SyncVectorEnv`": NUM_ENVS * steps / (clock() - start)}

    return measure


def measure(
    task: VelocityTask, clock: Clock, rounds: int, seconds: float
) -> list[dict[str, float]]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # there is a version 5
        rows = [ours(task, 1, clock), ours(task, 2, clock)]
        rows += [gymnasium_single(task, clock), gymnasium_vector(task, clock)]
        rates = [{k: v for row in rows for k, v in row(seconds).items()} for _ in range(rounds)]
    return rates[1:]  # the first round warms up


def ratio(rates: list[dict[str, float]], row: str, other: str) -> float:
    return statistics.median(rate[row] / rate[other] for rate in rates)


def line(task: VelocityTask, rates: list[dict[str, float]]) -> str:
    cells = [task.name]
    for threads in (1, 2):
        env, floor = f"`SafeVelocityEnv`, {threads}", f"the floor, {threads}"
        rate = statistics.median(rate[env] for rate in rates)
        cells.append(f"{rate:,.0f} ({ratio(rates, env, floor):.0%})")
    for row in ("`gymnasium.make`", "`SyncVectorEnv`"):
        cells.append(f"{statistics.median(rate[row] for rate in rates):,.0f}")
    for threads in (1, 2):
        env = f"`SafeVelocityEnv`, {threads}"
        times = (ratio(rates, env, row) for row in ("`gymnasium.make`", "`SyncVectorEnv`"))
        cells.append(" / ".join(f"{value:.1f}" for value in times))
    floors = (ratio(rates, f"the floor, {threads}", "`gymnasium.make`") for threads in (1, 2))
    cells.append(" / ".join(f"{value:.1f}" for value in floors))
    return f"| {' | '.join(cells)} |"


def reset_milliseconds(task: VelocityTask, clock: Clock, rounds: int) -> float:
    env = SafeVelocityEnv(task, num_envs=NUM_ENVS, num_threads=2)
    env.reset()
    times = []
    for _ in range(rounds):
        start = clock()
        env.reset()
        times.append(clock() - start)
    return 1e3 * statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="*", default=list(VELOCITY_TASKS), help="default: all")
    parser.add_argument("--processor-time", action="store_true")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=0.3, help="of one row in one round")
    options = parser.parse_args()
    clock = time.process_time if options.processor_time else time.perf_counter
    heads = (
        "task, steps/s at N = 64",
        "1 thread (share of the floor)",
        "2 threads (share of the floor)",
        "`gymnasium.make`",
        "`SyncVectorEnv`",
        "times, 1 thread",
        "times, 2 threads",
        "the floors, times `gymnasium.make`",
        "a reset of 64",
    )
    print(f"| {' | '.join(heads)} |\n| --- {'| ---: ' * (len(heads) - 1)}|")
    for name in options.tasks:
        task = VELOCITY_TASKS[name]
        row = line(task, measure(task, clock, options.rounds, options.seconds))
        print(f"{row} {reset_milliseconds(task, clock, 21):.1f} ms |", flush=True)


if __name__ == "__main__":
    main()
