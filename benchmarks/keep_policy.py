"""Puts a run's policy among those that come with the library, with what it does beside it.

    python benchmarks/keep_policy.py runs/safetac_point/seed_0 safetac-point

Writes ``torchrl_safe/policies/<name>.safetensors``: weights, the run's options, the command and
commit, and the mean and 95 % interval of return, costs, violations and score of 100 episodes with
deterministic actions on layouts that neither training nor its evaluations saw.
"""

from __future__ import annotations

import argparse
import json
from functools import partial
from pathlib import Path

from keep_run import trained_at
from torchrl.envs.utils import ExplorationType

from torchrl_safe import policies
from torchrl_safe.record import bootstrap_interval, evaluate
from torchrl_safe.trainers.environments import cost_names, make_env
from torchrl_safe.trainers.options import MethodOptions, flat
from torchrl_safe.trainers.run import cost_gamma
from torchrl_safe.trainers.saved import from_newest
from torchrl_safe.trainers.saved_policies import SavedPolicy, saved_policy, write_policy
from torchrl_safe.trainers.streams import stream_seed

LARGEST = 100_000  # bytes
NUM_EPISODES = 100
OF_THE_MACHINE = ("run_dir", "resume", "num_threads", "device")


def command(options: MethodOptions) -> str:
    """What trains such a policy."""
    defaults = dict(flat(type(options)()))
    words = [
        f"{name}={value if isinstance(value, str) else json.dumps(value, separators=(',', ':'))}"
        for name, value in flat(options)
        if name not in OF_THE_MACHINE and value != defaults[name]
    ]
    return " ".join(["torchrl-safe", "train", options.method, *words])


def figures(saved: SavedPolicy, num_episodes: int, seed: int) -> dict[str, list[float]]:
    """Mean, and lower and upper end of its interval, of what an episode is judged by."""
    options = saved.options
    num_steps = options.eval.num_steps
    seed = stream_seed("evaluate.py", seed)
    env = make_env(options, num_episodes, seed, episode_length=num_steps)
    played = evaluate(
        env,
        saved.policy,
        num_steps=num_steps,
        exploration_type=ExplorationType.DETERMINISTIC,
        seed=seed,
        cost_gamma=cost_gamma(options),
    )
    env.close()
    names = ("episode_return", *cost_names(options), "violations", "score")
    return {name: [played[name].mean().item(), *bootstrap_interval(played[name])] for name in names}


def keep_policy(run_dir: Path, path: Path, num_episodes: int = NUM_EPISODES) -> SavedPolicy:
    """Measure a run's policy, and write it.

    Raises:
        ValueError: if the file would be too large.
    """
    make = partial(make_env, trust=False)
    policy, options = from_newest(
        run_dir, lambda options, checkpoint: (saved_policy(options, checkpoint, make), options)
    )
    about = {"command": command(options), "commit": trained_at(run_dir)}
    saved = SavedPolicy(policy, options, about)
    saved.about["figures"] = figures(saved, num_episodes, seed=0)
    write_policy(path, saved)
    if (size := path.stat().st_size) > LARGEST:
        path.unlink()
        raise ValueError(f"{path.name} must be at most {LARGEST:,} bytes, got {size:,}.")
    return saved


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("name", help="of the policy")
    args = parser.parse_args()
    print(keep_policy(args.run_dir, policies.FOLDER / f"{args.name}.safetensors").about)
