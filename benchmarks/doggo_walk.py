"""How fast ``doggo`` walks in every direction, and how many robots tip over.

``python benchmarks/doggo_walk.py``; ``--weights`` measures what a run of doggo_controller.py
exported: ``legs.safetensors``, or ``gait.safetensors`` before PPO.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_safe.envs import GoalTask, Robot, SafeGoalEnv, get_robot
from torchrl_safe.envs.robots import to_robot_frame

STEP = 0.1  # seconds
TIPPED = 0.3  # the vertical in the trunk's frame: 1 on its legs, -1 on its back


def walk(
    robot: Robot, num_robots: int, num_steps: int, length: float | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Each robot is told to go one way of the world, spread evenly around where it faces at first.

    Without a length the commands are random instead, another one at every step.

    Returns:
        tuple of arrays, [N] each: metres per second along the way, the turn at the start included;
        whether the robot ever tipped over; whether it has at the end.
    """
    env = SafeGoalEnv(robot, num_envs=num_robots, task=GoalTask(num_hazards=0))
    env.reset()
    qpos = env._core._robots.batch.bind("qpos")
    rng = np.random.default_rng(0)

    def where() -> tuple[np.ndarray, np.ndarray]:
        layouts = [env.layout(i) for i in range(num_robots)]
        position, heading = ([each[key] for each in layouts] for key in ("robot", "heading"))
        return np.stack(position), np.stack(heading)

    start, heading = where()
    turn = 2 * np.pi * np.arange(num_robots) / num_robots
    angle = np.arctan2(heading[:, 1], heading[:, 0]) + turn
    way = np.stack((np.cos(angle), np.sin(angle)), 1)
    ever = np.zeros(num_robots, bool)
    for _ in range(num_steps):
        if length is None:
            command = rng.uniform(-1, 1, (num_robots, 2))
        else:
            command = length * to_robot_frame(way, heading)
        env.step(TensorDict({"action": torch.from_numpy(command).float()}, [num_robots]))
        position, heading = where()
        tipped = 1 - 2 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2) < TIPPED
        ever |= tipped
    return ((position - start) * way).sum(1) / (num_steps * STEP), ever, tipped


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=192)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--weights", type=Path)
    args = parser.parse_args()
    robot = get_robot("doggo")
    if args.weights is not None:
        robot = replace(robot, control=partial(robot.control.func, weights=args.weights))
    print("| Command | Mean | Slowest direction | Tipped over | of these, for good |")
    print("|---|---:|---:|---:|---:|")
    for length in (1.0, 0.5, None):
        speed, ever, tipped = walk(robot, args.robots, args.steps, length)
        name = "random at every step" if length is None else f"one way, length {length}"
        numbers = "| |" if length is None else f"{speed.mean():.2f} m/s | {speed.min():.2f} m/s |"
        print(f"| {name} | {numbers} {ever.sum()} of {args.robots} | {tipped.sum()} |", flush=True)


if __name__ == "__main__":
    main()
