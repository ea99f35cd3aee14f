r"""Drives a policy in Safety-Gymnasium itself and in ours, and prints what both say of it.

    python benchmarks/suite/drive_original.py runs/safetac/SafetyPointGoal1/seed_0 \
        --python safety-gymnasium/bin/python

The task is that of the run. The policy sees the same numbers in both. Layouts are drawn by each for
itself, so returns and costs of episodes agree in their distribution, and not one by one. The
original steps some hundred times a second: twenty episodes of 1,000 steps are a minute or two.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from scipy.stats import mannwhitneyu
from tensordict import TensorDictBase
from torchrl.envs import SerialEnv
from torchrl.envs.utils import ExplorationType

from torchrl_safe.envs import SafetyGymnasiumBridge
from torchrl_safe.record import bootstrap_interval, evaluate, format_table
from torchrl_safe.trainers.commands.play import load
from torchrl_safe.trainers.environments import make_env
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.tasks import RUNNERS, follows

AT_ONCE = 5  # processes of the original
VALUES = {"return": "episode_return", "cost": "cost"}


def played_there(task: str, python: Path, episodes: int, policy: Any, **how: Any) -> TensorDictBase:
    """Episodes in the original, [episodes], some at a time."""
    make = partial(SafetyGymnasiumBridge, f"{task}-v{int(task in RUNNERS)}", python=python)
    parts = []
    for first in range(0, episodes, AT_ONCE):
        env = SerialEnv(min(AT_ONCE, episodes - first), make)
        seed = stream_seed("evaluate.py", first) % 2**31
        parts.append(evaluate(env, policy, seed=seed, **how))
        env.close()
    return torch.cat(parts)


def compared(there: TensorDictBase, here: TensorDictBase) -> dict[str, str]:
    """Means of both with 95 % intervals, and whether the difference could be chance."""
    rows = {}
    for name, key in VALUES.items():
        for place, episodes in (("in the original", there), ("here", here)):
            low, high = bootstrap_interval(episodes[key])
            rows[f"{name} {place}"] = f"{episodes[key].mean():.2f} ({low:.2f} to {high:.2f})"
        p = mannwhitneyu(there[key].numpy(), here[key].numpy()).pvalue
        rows[f"{name}, Mann-Whitney test"] = f"p = {p:.2g}"
    return rows


def main(argv: Sequence[str] | None = None) -> None:
    """Play in both, and print.

    Raises:
        ValueError: if the policy was trained on no task of Safety-Gymnasium's.
    """
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="a run's folder, or the name of a policy that comes along")
    parser.add_argument("--python", type=Path, required=True, help="one with Safety-Gymnasium")
    parser.add_argument("--episodes", type=int, default=20, help="in the original")
    parser.add_argument("--episodes-here", type=int, default=100)
    parser.add_argument("--sampled", action="store_true", help="in place of deterministic actions")
    args = parser.parse_args(argv)
    policy, options, _ = load(args.policy, partial(make_env, trust=False))
    task = options.env.task
    if not follows(task):
        raise ValueError(f"{args.policy} must be of a task of Safety-Gymnasium's, got {task!r}.")
    num_steps = follows(task)["eval.num_steps"]
    kind = ExplorationType.RANDOM if args.sampled else ExplorationType.DETERMINISTIC
    how = {"num_steps": num_steps, "exploration_type": kind}
    there = played_there(task, args.python, args.episodes, policy, **how)
    seed = stream_seed("evaluate.py", 0)
    env = make_env(options, args.episodes_here, seed, episode_length=num_steps)
    here = evaluate(env, policy, seed=seed, **how)
    env.close()
    print(f"{task}, {args.episodes} episodes in the original, {args.episodes_here} here")
    print(format_table(compared(there, here)))


if __name__ == "__main__":
    main()
