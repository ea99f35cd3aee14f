"""Trains a cell of the comparison, or goes on with it, and plays its policy on the stage's layouts.

    python benchmarks/comparison/cell.py tuning 200 cpo env.robot=point seed=1000 run_dir=runs/a

tune.py and final.py start it. Writes ``played.json`` into the run's folder: all episodes, columns
of rounded numbers; or, of a training that stopped because its numbers were not finite, why. Of its
checkpoints, whose replay takes hundreds of megabytes, only the policy is left.
"""

from __future__ import annotations

import json
import shlex
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType

from torchrl_safe.record import describe, evaluate
from torchrl_safe.trainers import METHODS, cli, load_policy
from torchrl_safe.trainers.environments import make_env
from torchrl_safe.trainers.run import cost_gamma
from torchrl_safe.trainers.saved import RESULTS
from torchrl_safe.trainers.saved_policies import Policy, SavedPolicy, write_policy
from torchrl_safe.trainers.streams import stream_seed

PLAYED = "played.json"
POLICY = "policy.safetensors"
KINDS = {"sampled": ExplorationType.RANDOM, "deterministic": ExplorationType.DETERMINISTIC}
STARTS = (0.0, 0.25, 0.5)  # of an episode: where discounted costs are counted from


class Costs(Transform):
    """Remembers the cost of every step, and which environments were still in their episode."""

    def __init__(self) -> None:
        super().__init__()
        self.clear()

    def clear(self) -> None:
        """Forget all."""
        self.costs: list[Tensor] = []
        self.running: list[Tensor] = []

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        before = self.running[-1] & ~self.done if self.running else None
        self.running.append(torch.ones(self.parent.batch_size).bool() if before is None else before)
        self.costs.append(next_tensordict["cost"].squeeze(-1).double())
        self.done = next_tensordict["done"].squeeze(-1).clone()
        return next_tensordict


def outcomes(costs: Tensor, running: Tensor, gamma: float) -> list[list[float | None]]:
    """Discounted costs from a quarter and half of an episode and from its start.

    What follows is at least half of the episode: of 1,000 steps at a discount of .99, all but
    .7 % of what an episode without an end would add up to.

    Args:
        costs (Tensor): of every step, ``[T, N]``.
        running (Tensor): whether a step belongs to the environment's first episode, ``[T, N]``.
        gamma (float): discount per step.

    Returns:
        list: for each start, the episodes' discounted costs; ``None`` of one that was over by then.
    """
    rows = []
    for share in STARTS:
        start = int(share * len(costs))
        weights = gamma ** torch.arange(len(costs) - start, dtype=torch.float64)
        sums = (weights[:, None] * costs[start:].where(running[start:], 0.0)).sum(0).tolist()
        there = running[start].tolist()
        rows.append([round(x, 2) if on else None for x, on in zip(sums, there, strict=True)])
    return rows


def play(options: Any, policy: Policy, stage: str, episodes: int) -> dict[str, Any]:
    """Play a trained policy on layouts that no training and no other stage saw.

    Args:
        options (MethodOptions): the run's.
        policy (callable): what it learned.
        stage (str): whose layouts: the same for all methods and seeds.
        episodes (int): how many, with sampled and with deterministic actions.

    Returns:
        dict: ``seconds``; ``episodes``, by kind of action the columns ``return``, ``violations``,
        ``cost`` and ``length``, one number where all have the same, and, of sampled actions,
        ``discounted`` as of :func:`outcomes`.
    """
    begun = time.perf_counter()
    seed = stream_seed(f"comparison {stage}")
    gamma = cost_gamma(options)
    kept: dict[str, Any] = {}
    for kind, exploration in KINDS.items():
        recorder = Costs()
        env = TransformedEnv(make_env(options, episodes, seed), recorder)
        rows = describe(
            evaluate(
                env,
                policy,
                num_steps=options.eval.num_steps,
                exploration_type=exploration,
                seed=seed,
                cost_gamma=gamma,
            )
        )
        lengths = [row["length"] for row in rows]
        kept[kind] = {
            "return": [round(row["return"], 2) for row in rows],
            "violations": [row["violations"] for row in rows],
            "cost": [round(row["cost"], 1) for row in rows],
            "length": lengths[0] if len(set(lengths)) == 1 else lengths,
        }
        if kind == "sampled":
            costs, running = torch.stack(recorder.costs), torch.stack(recorder.running)
            kept[kind]["discounted"] = outcomes(costs, running, gamma)
        env.close()
    return {"seconds": round(time.perf_counter() - begun, 1), "episodes": kept}


def main(argv: Sequence[str] | None = None) -> None:
    """Train, and play what is trained."""
    stage, episodes, method, *words = sys.argv[1:] if argv is None else argv
    options = cli.compose(method, words)
    run_dir = Path(options.folder)
    try:
        METHODS[method](options=options).train()
    except FloatingPointError as error:
        played: dict[str, Any] = {"diverged": str(error)}
    else:
        if not (run_dir / RESULTS).exists():  # it was stopped on the way
            return
        policy = load_policy(run_dir)
        about = {"command": shlex.join(["torchrl-safe", "train", method, *words])}
        write_policy(run_dir / POLICY, SavedPolicy(policy, options, about))
        played = play(options, policy, stage, int(episodes))
    draft = run_dir / f"{PLAYED}.draft"
    draft.write_text(json.dumps(played))
    draft.replace(run_dir / PLAYED)
    shutil.rmtree(run_dir / "checkpoints", ignore_errors=True)


if __name__ == "__main__":
    main()
