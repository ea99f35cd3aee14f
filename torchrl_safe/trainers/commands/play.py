"""A trained policy at work: a film, and what it scored.

    torchrl-safe play safetac-point             # one of torchrl_safe.policies.names()
    torchrl-safe play runs/trc/point/seed_0     # a run's policy

Writes ``<name>.mp4`` where it is started and prints a table. Of a folder that is called after its
seed alone, the name is those of the folders above it, too: ``trc_point_seed_0.mp4``.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_safe import policies
from torchrl_safe._files import expand, printable
from torchrl_safe.record import evaluate, format_table, record_video, summarize
from torchrl_safe.trainers.commands import add_env_arguments, env_maker
from torchrl_safe.trainers.options import MethodOptions
from torchrl_safe.trainers.run import cost_gamma
from torchrl_safe.trainers.saved import from_newest
from torchrl_safe.trainers.saved_policies import SavedPolicy, saved_policy
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.terminal import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of :func:`main`."""
    parser.add_argument(
        "name", help=f"a run's folder, or one of {', '.join(policies.names()) or 'none so far'}"
    )
    parser.add_argument("--episodes", type=int, default=4, help="shown side by side")
    parser.add_argument("--steps", type=int, help="per episode; those of an evaluation by default")
    parser.add_argument("--seed", type=int, default=0, help="of the layouts")
    parser.add_argument("--out", type=Path, help="the .mp4 to write")
    add_env_arguments(parser)


def main(
    name: str,
    episodes: int = 4,
    steps: int | None = None,
    seed: int = 0,
    out: Path | None = None,
    env: str | None = None,
    trust: bool = False,
) -> dict[str, float]:
    """Play, film, and return the means over the episodes.

    Args:
        name (str): of a policy of :mod:`torchrl_safe.policies`, or a run's folder.
        episodes (int): how many, with deterministic actions.
        steps (int, optional): per episode. Defaults to the run's ``eval.num_steps``.
        seed (int): of the layouts.
        out (path, optional): the film. Defaults to :func:`film_of` the name.
        env (str, optional): ``module:function`` that makes the environment.
        trust (bool): whether functions that a run's options name may be imported.

    Raises:
        FileNotFoundError: if there is neither such a policy nor such a folder.
    """
    make = env_maker(env, trust)
    policy, options, about = load(name, make)
    if "command" in about:
        say(f"{name}: {about['command']}, commit {about.get('commit', 'unknown')}")
    steps = options.eval.num_steps if steps is None else steps
    seed = stream_seed("evaluate.py", seed)
    envs = make(options, episodes, seed, episode_length=steps)
    played = evaluate(
        envs,
        policy,
        num_steps=steps,
        exploration_type=ExplorationType.DETERMINISTIC,
        seed=seed,
        cost_gamma=cost_gamma(options),
    )
    metrics = summarize(played, "")
    say(format_table(metrics))
    try:
        path = record_video(
            envs,
            policy,
            out or film_of(name),
            num_steps=steps,
            width=320,
            height=240,
            index=range(episodes),
            seed=seed,
        )
        say(f"video: {printable(path)}")
    except (RuntimeError, AttributeError) as error:
        say(f"no video: {error}")
    envs.close()
    return metrics


def film_of(name: str) -> Path:
    """The file of a film, where it is started.

    Examples:
        >>> str(film_of("safetac-point")), str(film_of("runs/mine"))
        ('safetac-point.mp4', 'mine.mp4')
        >>> str(film_of("runs/trc/point/seed_0")), str(film_of("runs/safetac_point/seed_1"))
        ('trc_point_seed_0.mp4', 'safetac_point_seed_1.mp4')
    """
    *above, last = expand(name).absolute().parts
    if last.startswith("seed_"):
        last = "_".join([*(part for part in above[-2:] if part != "runs"), last])
    return Path(f"{last}.mp4")


def load(name: str, make: Callable[..., EnvBase]) -> SavedPolicy:
    """A policy of the library's by its name, or a run's by its folder."""
    if name in policies.names():
        return policies.load(name)
    if not expand(name).is_dir():
        raise FileNotFoundError(
            f"name must be a run's folder or one of {', '.join(policies.names())}, "
            f"got {printable(name)!r}."
        )

    def read(options: MethodOptions, checkpoint: Path) -> SavedPolicy:
        return SavedPolicy(saved_policy(options, checkpoint, make), options, {})

    return from_newest(name, read)
