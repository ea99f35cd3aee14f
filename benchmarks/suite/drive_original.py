r"""Drives a policy in Safety-Gymnasium itself and in ours, and prints what both say of it.

    python benchmarks/suite/drive_original.py runs/safetac/SafetyPointGoal1/seed_0 \
        --python safety-gymnasium/bin/python --episodes 20

The task is that of the run. Policies see the same numbers in both; layouts are other ones, drawn by
each for itself, so returns and costs agree in their distribution and not one by one. Safety-
Gymnasium steps some hundred times a second: ``--jobs`` episodes are played at a time.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.stats import mannwhitneyu
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_safe.envs import SafetyGymnasiumBridge
from torchrl_safe.record import bootstrap_interval, evaluate, format_table
from torchrl_safe.trainers.commands.play import load
from torchrl_safe.trainers.environments import make_env
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.tasks import RUNNERS, follows

Policy = Callable[[TensorDictBase], TensorDictBase]
VALUES = {"return": "episode_return", "cost": "cost"}


def play(
    envs: Sequence[EnvBase],
    policy: Policy,
    episodes: int,
    num_steps: int,
    kind: ExplorationType,
    seed: int,
) -> TensorDictBase:
    """Episodes in environments without a batch, one after the other in each, ``[episodes]``."""

    def of_one(first: int) -> list[TensorDictBase]:
        numbers = range(first, episodes, len(envs))
        return [
            evaluate(
                envs[first],
                policy,
                num_steps=num_steps,
                exploration_type=kind,
                seed=(seed + number) % 2**31,
            )
            for number in numbers
        ]

    played = [episode for first in range(len(envs)) for episode in of_one(first)]
    return torch.stack(played)


def rows(there: TensorDictBase, here: TensorDictBase) -> dict[str, str]:
    """Means with intervals of both, and how likely as large a difference is by chance."""
    out = {}
    for name, key in VALUES.items():
        values = [played[key] for played in (there, here)]
        for place, each in zip(("Safety-Gymnasium", "here"), values, strict=True):
            low, high = bootstrap_interval(each)
            out[f"{name}, {place}"] = f"{each.mean():.2f} ({low:.2f} to {high:.2f})"
        p = mannwhitneyu(*(np.asarray(each) for each in values)).pvalue
        out[f"{name}, Mann-Whitney test"] = f"p = {p:.2g}"
    return out


def main(argv: Sequence[str] | None = None) -> None:
    """Play in both, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", help="a run's folder, or the name of a policy that comes along")
    parser.add_argument("--python", type=Path, required=True, help="that has Safety-Gymnasium")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--sampled", action="store_true", help="in place of deterministic actions")
    parser.add_argument("--seed", type=int, default=0, help="of the layouts")
    args = parser.parse_args(argv)
