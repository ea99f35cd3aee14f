"""What one does with a run: a file for each command of ``torchrl-safe`` but ``train``.

Each has ``add_arguments(parser)`` and ``main``, whose arguments they are.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

from torchrl.envs import EnvBase

from torchrl_safe.trainers.environments import imported, make_env


def add_env_arguments(parser: argparse.ArgumentParser) -> None:
    """Which environment a run is looked at in: those of :func:`env_maker`."""
    parser.add_argument(
        "--env", help="module:function that makes the environment, of a run that Python started"
    )
    parser.add_argument(
        "--trust", action="store_true", help="import the functions that the run's options name"
    )


def env_maker(env: str | None, trust: bool) -> Callable[..., EnvBase]:
    """:func:`~torchrl_safe.trainers.environments.make_env`, for a run that may be a stranger's.

    Args:
        env (str, optional): ``module:function``, in place of what the run's options name.
        trust (bool): whether functions that they name may be imported.

    Raises:
        ValueError: if there is no such function.
    """
    source = None if env is None else imported("--env", env)
    return partial(make_env, source=source, trust=trust)
