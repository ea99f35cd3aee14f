"""Frames per second of every interface, beside the physics alone: a Markdown table a robot.

    python benchmarks/bench_interfaces.py         # all robots: at most four minutes; or name some

A frame is a step of one environment. The floor is the physics of the same compiled model on
MuJoCo's thread pool, with as many threads, and nothing else but the robot's map from actions to
actuators. All rows take turns, so that a busy machine slows them alike: a figure is the median of
rounds, a share the median of the ratios within a round. Where other work keeps the cores,
``--num-threads 1 --processor-time`` compares what the rows themselves use.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from itertools import cycle

import gymnasium
import mujoco
import numpy as np
import torch
from mujoco.batch import Batch
from torchrl.envs import DMControlWrapper, EnvBase, GymWrapper, TransformedEnv

from torchrl_safe.envs import (
    ROBOTS,
    CostToReward,
    Robot,
    SafeRobotEnv,
    cost_from_info,
    get_robot,
    suite,
)

torch.set_num_threads(1)

NUM_ENVS = [1, 16, 64, 256]
FLOOR = "`mujoco.batch`: the floor"

Stepper = Callable[[], object]


def compiled_model(robot: Robot) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_path(str(robot.asset_path))
    model.opt.timestep = robot.timestep
    return model


def random_actions(robot: Robot, num_envs: int) -> cycle[np.ndarray]:
    rng = np.random.default_rng(0)
    return cycle(rng.uniform(-1, 1, (64, num_envs, robot.action_dim)).astype(np.float32))


def identifier(robot: Robot) -> str:
    return f"torchrl_safe/{robot.name.title().replace('_', '')}Goal-v0"


def mj_step(robot: Robot, num_envs: int, num_threads: int) -> Stepper:
    """Physics in a Python loop, a simulation after the other."""
    model, actions = compiled_model(robot), random_actions(robot, num_envs)
    simulations = [mujoco.MjData(model) for _ in range(num_envs)]
    for data in simulations:
        data.qpos = robot.place(np.zeros((1, 2)), np.zeros(1))[0]

    def step() -> None:
        for data, action in zip(simulations, next(actions), strict=True):
            data.ctrl = robot.control(
                action[None], data.qpos[None], data.qvel[None], np.array([data.time])
            )[0]
            mujoco.mj_step(model, data, nstep=robot.substeps)

    return step


def batch(robot: Robot, num_envs: int, num_threads: int) -> Stepper:
    """Physics on MuJoCo's thread pool."""
    actions = random_actions(robot, num_envs)
    simulations = Batch(compiled_model(robot), num_envs, num_threads)
    qpos, qvel = simulations.bind("qpos"), simulations.bind("qvel")
    qpos[:] = robot.place(np.zeros((num_envs, 2)), np.zeros(num_envs))
    time, ctrl = simulations.bind("time"), simulations.bind("ctrl")

    def step() -> None:
        ctrl[:] = robot.control(next(actions), qpos, qvel, time)
        simulations.step(nstep=robot.substeps)

    return step


def vector(robot: Robot, num_envs: int, num_threads: int) -> Stepper:
    """It resets by itself."""
    actions = random_actions(robot, num_envs)
    envs = gymnasium.make_vec(
        identifier(robot), num_envs=num_envs, num_threads=num_threads, autoreset_mode="SameStep"
    )
    envs.reset(seed=0)
    return lambda: envs.step(next(actions))


def vector_of_singles(robot: Robot, num_envs: int, num_threads: int) -> Stepper:
    """Gymnasium's own vector environment."""
    actions = random_actions(robot, num_envs)
    envs = gymnasium.make_vec(identifier(robot), num_envs=num_envs, vectorization_mode="sync")
    envs.reset(seed=0)
    return lambda: envs.step(next(actions))


def gymnasium_make(robot: Robot, num_envs: int, num_threads: int) -> Stepper:
    actions, single = random_actions(robot, 1), gymnasium.make(identifier(robot))
    single.reset(seed=0)

    def step() -> None:
        _, _, terminated, truncated, _ = single.step(next(actions)[0])
        if terminated or truncated:
            single.reset()

    return step


def dm_control(robot: Robot, num_envs: int, num_threads: int) -> Stepper:
    actions, single = random_actions(robot, 1), suite.load(robot, random=0)
    single.reset()
    return lambda: single.step(next(actions)[0])


def torchrl(make: Callable[..., EnvBase], robot: Robot, num_envs: int, num_threads: int) -> Stepper:
    """As a collector steps it: tensors and resets."""
    env = make(robot, num_envs=num_envs, num_threads=num_threads)
    action_spec = env.action_spec
    actions = cycle(
        [
            torch.from_numpy(action).reshape(action_spec.shape).to(action_spec.dtype)
            for _, action in zip(range(64), random_actions(robot, num_envs), strict=False)
        ]
    )
    state = env.reset()

    def step() -> None:
        nonlocal state
        state["action"] = next(actions)
        _, state = env.step_and_maybe_reset(state)

    return step


def wrapped_gymnasium(robot: Robot, num_envs: int, num_threads: int) -> EnvBase:
    if num_envs == 1:
        return cost_from_info(GymWrapper(gymnasium.make(identifier(robot))))
    envs = gymnasium.make_vec(
        identifier(robot), num_envs=num_envs, num_threads=num_threads, autoreset_mode="Disabled"
    )
    return cost_from_info(GymWrapper(envs))


def wrapped_dm_control(robot: Robot, num_envs: int, num_threads: int) -> EnvBase:
    wrapper = DMControlWrapper(suite.load(robot, random=0))
    return TransformedEnv(wrapper, CostToReward(violation_key=None))


ROWS: dict[str, tuple[Callable[..., Stepper], list[int]]] = {
    "`mj_step` in a loop, 1 thread": (mj_step, NUM_ENVS),
    FLOOR: (batch, NUM_ENVS),
    "`SafeRobotEnv`": (partial(torchrl, partial(SafeRobotEnv, stagger=True)), NUM_ENVS),
    "`gymnasium.make_vec`": (vector, NUM_ENVS),
    "the same in TorchRL's `GymWrapper`": (partial(torchrl, wrapped_gymnasium), NUM_ENVS),
    '`make_vec(..., vectorization_mode="sync")`, 1 thread': (vector_of_singles, [16]),
    "`gymnasium.make`": (gymnasium_make, [1]),
    "`suite.load`": (dm_control, [1]),
    "the same in TorchRL's `DMControlWrapper`": (partial(torchrl, wrapped_dm_control), [1]),
}

Cell = tuple[str, int]


def measure(
    steppers: dict[Cell, Stepper], clock: Callable[[], float], rounds: int, seconds: float
) -> dict[Cell, list[float]]:
    """Frames per second in each round."""
    rates: dict[Cell, list[float]] = {cell: [] for cell in steppers}
    for number in range(rounds + 1):
        for cell, step in steppers.items():
            count, start = 0, clock()
            while clock() - start < seconds:
                step()
                count += 1
            if number:  # the first round warms up
                rates[cell].append(cell[1] * count / (clock() - start))
    return rates


def table(name: str, rates: dict[Cell, list[float]]) -> str:
    def text(row: str, num_envs: int) -> str:
        if (row, num_envs) not in rates:
            return ""
        pairs = zip(rates[row, num_envs], rates[FLOOR, num_envs], strict=True)
        share = "" if row == FLOOR else f" ({statistics.median(x / y for x, y in pairs):.0%})"
        return f"{statistics.median(rates[row, num_envs]):,.0f}{share}"

    lines = [
        [f"{name}, frames/s (share of the floor)", *(f"N = {n}" for n in NUM_ENVS)],
        ["---", *("---:" for _ in NUM_ENVS)],
        *([row, *(text(row, n) for n in NUM_ENVS)] for row in ROWS),
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("robots", nargs="*", default=list(ROBOTS), help="default: all")
    parser.add_argument("--num-threads", type=int, default=2)
    parser.add_argument("--processor-time", action="store_true")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=0.12, help="of one row in one round")
    options = parser.parse_args()
    clock = time.process_time if options.processor_time else time.perf_counter
    for name in options.robots:
        robot = get_robot(name)
        steppers = {
            (row, num_envs): make(robot, num_envs, options.num_threads)
            for num_envs in NUM_ENVS  # rows of one size follow each other
            for row, (make, sizes) in ROWS.items()
            if num_envs in sizes
        }
        print(table(name, measure(steppers, clock, options.rounds, options.seconds)))
        env = SafeRobotEnv(robot, num_envs=64, num_threads=options.num_threads)
        resets: dict[Cell, Stepper] = {("reset", 64): env.reset}
        (rates,) = measure(resets, clock, options.rounds, options.seconds).values()
        print(f"\nA reset of 64: {1e3 * 64 / statistics.median(rates):.1f} ms\n", flush=True)


if __name__ == "__main__":
    main()
