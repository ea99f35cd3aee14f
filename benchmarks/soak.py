"""Random actions for a long time: finite, without a warning from MuJoCo, in the same memory.

``python benchmarks/soak.py jackal --steps 1000000``, or a velocity task such as ``ant``;
``--randomized`` draws every robot of ours anew.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
import torch

from torchrl_safe.envs import JACKAL_TRAINING, VELOCITY_TASKS, SafeGoalEnv, SafeVelocityEnv

NUM_ENVS = 64


def resident_megabytes() -> float:
    with open("/proc/self/statm") as statm:
        return int(statm.read().split()[1]) * resource.getpagesize() / 2**20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robot")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--randomized", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    randomization = JACKAL_TRAINING if args.randomized else None
    if args.robot in VELOCITY_TASKS:
        env = SafeVelocityEnv(args.robot, num_envs=NUM_ENVS, stagger=True)
    else:
        env = SafeGoalEnv(args.robot, num_envs=NUM_ENVS, stagger=True, randomization=randomization)
    td, generator = env.reset(), torch.Generator().manual_seed(0)
    warnings = env._core._robots.batch.warning
    rounds = max(args.steps // NUM_ENVS, 10)
    events = ("terminated", "truncated", "goal_met", "violation")
    counts = {name: 0 for name in events if name in td.keys()}
    warned, memory, start = 0, [], time.perf_counter()
    shape = (NUM_ENVS, env.action_spec.shape[-1])
    held = torch.zeros(shape)
    for t in range(rounds):
        # Half of the robots hold an action for eight steps, or the noise goes nowhere.
        fresh = torch.rand(shape, generator=generator) * 2 - 1
        if t % 8 == 0:
            held = fresh
        td["action"] = torch.where(torch.arange(NUM_ENVS)[:, None] % 2 == 0, fresh, held)
        stepped, td = env.step_and_maybe_reset(td)
        for name in ("observation", "reward", "cost"):
            if not stepped["next", name].isfinite().all():
                raise RuntimeError(f"{name} is not finite at step {t}.")
        for name in counts:
            counts[name] += int(stepped["next", name].sum())
        warned = np.maximum(warned, warnings[:, :, 1].max(0))
        if t % (rounds // 10) == 0:
            memory.append(round(resident_megabytes(), 1))
    print(f"{args.robot}: {rounds * NUM_ENVS} steps in {time.perf_counter() - start:.0f} s")
    print(f"instabilities {env.instabilities}, MuJoCo warnings by kind {warned.tolist()}")
    print(f"resident memory, MB: {memory}")
    print(counts)


if __name__ == "__main__":
    main()
