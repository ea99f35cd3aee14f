"""How fast ``doggo`` walks in every direction, and how many robots end on their backs.

``python benchmarks/doggo_walk.py --robots 64 --steps 1000``
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from tensordict import TensorDict

from torchrl_safe.envs import GoalTask, SafeGoalEnv
from torchrl_safe.envs.robots import to_robot_frame

STEP = 0.1  # seconds
TIPPED = 0.3  # the vertical in the trunk's frame: 1 on its legs, -1 on its back


def walk(num_robots: int, num_steps: int, length: float, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Each robot is told to go one way of the world, spread evenly around where it faces at first.

    Returns:
        tuple of arrays: [N] metres per second along the command, the whole way; [N] the same over the
        first 10 s; [N] whether it ever tipped over.
    """
    env = SafeGoalEnv("doggo", num_envs=num_robots, task=GoalTask(num_hazards=0), seed=seed)
    env.reset()
    qpos = env._core._robots.batch.bind("qpos")

    def where() -> tuple[np.ndarray, np.ndarray]:
        layouts = [env.layout(i) for i in range(num_robots)]
        return tuple(np.stack([each[key] for each in layouts]) for key in ("robot", "heading"))

    start, heading = where()
    angle = (
        np.arctan2(heading[:, 1], heading[:, 0]) + 2 * np.pi * np.arange(num_robots) / num_robots
    )
    way = np.stack((np.cos(angle), np.sin(angle)), 1)
    tipped, early = np.zeros(num_robots, bool), np.zeros(num_robots)
    position = start
    for step in range(1, num_steps + 1):
        command = torch.from_numpy(length * to_robot_frame(way, heading))
        env.step(TensorDict({"action": command.float()}, [num_robots]))
        position, heading = where()
        tipped |= 1 - 2 * (qpos[:, 4] ** 2 + qpos[:, 5] ** 2) < TIPPED
        if step * STEP == 10.0:
            early = ((position - start) * way).sum(1) / 10.0
    return ((position - start) * way).sum(1) / (num_steps * STEP), early, tipped


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=64)
    parser.add_argument("--steps", type=int, default=1000)
    args = parser.parse_args()
    print(
        "| Command | Speed, mean | slowest direction | over the first 10 s, mean | slowest | Tipped |"
    )
    print("|---|---:|---:|---:|---:|---:|")
    for length in (1.0, 0.5):
        speed, early, tipped = walk(args.robots, args.steps, length)
        numbers = [f"{f(v):.2f} m/s" for v in (speed, early) for f in (np.mean, np.min)]
        print(f"| {length} | {' | '.join(numbers)} | {tipped.sum()} of {args.robots} |")


if __name__ == "__main__":
    main()
