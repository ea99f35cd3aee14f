"""Frames per second of every face beside the physics floor of the same model: a Markdown table.

    python benchmarks/bench_faces.py point        # about a minute a robot

Each figure is the median of rounds in which all rows take turns, so that a busy machine slows them
alike. A frame is a step of one environment.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import gymnasium
import torch
from bench_env import NUM_ENVS, batch, env, mj_step, random_actions
from torchrl.envs import DMControlWrapper, EnvBase, GymWrapper, TransformedEnv

from torchrl_safe.envs import ROBOTS, CostToReward, Robot, cost_from_info, get_robot, suite

torch.set_num_threads(1)


def identifier(robot: Robot) -> str:
    return f"torchrl_safe/{robot.name.capitalize()}Goal-v0"


def vector(robot: Robot, num_envs: int, **options: Any) -> Callable[[], object]:
    """A gymnasium.vector environment; what is over it resets by itself."""
    actions = random_actions(robot, num_envs)
    envs = gymnasium.make_vec(identifier(robot), num_envs=num_envs, **options)
    envs.reset(seed=0)
    return lambda: envs.step(next(actions))


def gymnasium_make(robot: Robot, num_envs: int) -> Callable[[], object]:
    actions, single = random_actions(robot, 1), gymnasium.make(identifier(robot))
    single.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = single.step(next(actions)[0])
        if terminated or truncated:
            single.reset()

    return step


def dm_control(robot: Robot, num_envs: int) -> Callable[[], object]:
    actions, single = random_actions(robot, 1), suite.load(robot, random=0)
    single.reset()
    return lambda: single.step(next(actions)[0])


def torchrl(make: Callable[[Robot, int], EnvBase], robot: Robot, num_envs: int):
    """As a collector steps it."""
    wrapped = make(robot, num_envs)
    actions = random_actions(robot, num_envs)
    action_spec = wrapped.action_spec
    state = wrapped.reset()

    def step() -> None:
        nonlocal state
        action = next(actions).reshape(action_spec.shape)
        state["action"] = torch.from_numpy(action).to(action_spec.dtype)
        _, state = wrapped.step_and_maybe_reset(state)

    return step


def wrapped_gymnasium(robot: Robot, num_envs: int) -> EnvBase:
    if num_envs == 1:
        return cost_from_info(GymWrapper(gymnasium.make(identifier(robot))))
    envs = gymnasium.make_vec(identifier(robot), num_envs=num_envs, autoreset_mode="Disabled")
    return cost_from_info(GymWrapper(envs))


def wrapped_dm_control(robot: Robot, num_envs: int) -> EnvBase:
    wrapper = DMControlWrapper(suite.load(robot, random=0))
    return TransformedEnv(wrapper, CostToReward(violation_key=None))


ROWS: dict[str, tuple[Callable[[Robot, int], Callable[[], object]], list[int]]] = {
    "`mj_step` in a loop, 1 thread": (partial(mj_step, num_threads=1), NUM_ENVS),
    "`mujoco.batch`, 2 threads": (partial(batch, num_threads=2), NUM_ENVS),
    "`SafeGoalEnv`, 2 threads": (partial(env, num_threads=2), NUM_ENVS),
    "`gymnasium.make_vec`, 2 threads": (partial(vector, autoreset_mode="SameStep"), NUM_ENVS),
    "the same in TorchRL's `GymWrapper`": (partial(torchrl, wrapped_gymnasium), NUM_ENVS),
    '`make_vec(..., vectorization_mode="sync")`': (
        partial(vector, vectorization_mode="sync"),
        [16, 64],
    ),
    "`gymnasium.make`": (gymnasium_make, [1]),
    "`suite.load`": (dm_control, [1]),
    "the same in TorchRL's `DMControlWrapper`": (partial(torchrl, wrapped_dm_control), [1]),
}


def measure(robot: Robot, rounds: int, seconds: float) -> dict[tuple[str, int], float]:
    """Frames per second."""
    steppers = {
        (row, num_envs): make(robot, num_envs)
        for row, (make, sizes) in ROWS.items()
        for num_envs in sizes
    }
    rates: dict[tuple[str, int], list[float]] = {cell: [] for cell in steppers}
    for number in range(rounds + 1):
        for cell, step in steppers.items():
            count, start = 0, time.perf_counter()
            while time.perf_counter() - start < seconds:
                step()
                count += 1
            if number:  # the first round warms up
                rates[cell].append(cell[1] * count / (time.perf_counter() - start))
    return {cell: statistics.median(values) for cell, values in rates.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*", default=list(ROBOTS), help="default: all")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=0.25, help="of one row in one round")
    options = parser.parse_args()
    for name in options.robots:
        rates = measure(get_robot(name), options.rounds, options.seconds)
        print(f"| {name}, frames/s | " + " | ".join(f"N = {n}" for n in NUM_ENVS) + " |")
        print("|---|" + "---:|" * len(NUM_ENVS))
        for row in ROWS:
            cells = (f"{rates[row, n]:,.0f}" if (row, n) in rates else "" for n in NUM_ENVS)
            print(f"| {row} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
