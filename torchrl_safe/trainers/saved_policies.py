"""Trained policies: of a run, or out of a file of their own.

A trained policy, in two lines::

    from torchrl_safe.trainers import load_policy
    policy = load_policy("runs/safetac_point/seed_0")

Nothing is unpickled: weights are read as tensors, everything else as JSON.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torchrl.checkpoint import CheckpointError
from torchrl.envs import EnvBase
from torchrl.modules import ProbabilisticActor

from torchrl_safe import GMMTanhPolicy
from torchrl_safe._files import printable, read_bytes, replacing
from torchrl_safe.trainers.checkpoints import load_components
from torchrl_safe.trainers.environments import MakeEnv, make_env, source_of
from torchrl_safe.trainers.networks import make_policy
from torchrl_safe.trainers.options import MethodOptions
from torchrl_safe.trainers.saved import from_newest, options_to_look

LIMIT = 2**24  # bytes of a policy's file
Policy: TypeAlias = "GMMTanhPolicy | ProbabilisticActor"


def load_policy(
    run_dir: str | os.PathLike[str],
    env: EnvBase | MakeEnv | None = None,
    *,
    trust: bool = False,
    **networks: Any,
) -> Policy:
    """The policy of a run, as its newest checkpoint has it.

    Args:
        run_dir (path): the run's folder.
        env (EnvBase or callable, optional): what it was trained in, where that was made in Python.

    Keyword Args:
        trust (bool): whether functions that the run's options name may be imported. Defaults to
            False.
        **networks: of :func:`~torchrl_safe.trainers.networks.make_policy`, as they were trained.

    Raises:
        FileNotFoundError: if it holds no run, or one without a checkpoint.
        CheckpointError: if the checkpoint is not what was written, or could run code.
        UntrustedError: if its options name code that is not trusted.
    """
    make = partial(make_env, source=None if env is None else source_of(env)[0], trust=trust)
    return from_newest(run_dir, partial(saved_policy, make=make, **networks))


def saved_policy(
    options: MethodOptions,
    checkpoint: Path,
    make: Callable[..., EnvBase],
    **networks: Any,
) -> Policy:
    """The policy of a checkpoint.

    Args:
        options (MethodOptions): its run's.
        checkpoint (Path): where it is.
        make (callable): :func:`~torchrl_safe.trainers.environments.make_env`, which the options
            are a stranger's for: with ``trust=False``, unless somebody has said otherwise.
        **networks: of :func:`~torchrl_safe.trainers.networks.make_policy`.

    Raises:
        CheckpointError: if it is not what was written, or not finite.
        UntrustedError: if the options name code that is not trusted.
    """
    policy = make_policy(options, make(options, num_envs=1, seed=0), **networks)
    load_components(checkpoint, policy=policy)
    return _to_act(policy, checkpoint)


class SavedPolicy(NamedTuple):
    """A policy out of a file of its own.

    Attributes:
        policy: in ``eval`` mode, without gradients.
        options: those of its run.
        about: what else is known of it, by names such as ``command``, ``commit``, ``figures``.
    """

    policy: Policy
    options: MethodOptions
    about: dict[str, Any]


def write_policy(path: Path, saved: SavedPolicy) -> None:
    """Write a policy as one safetensors file, with its options and what is known of it."""
    tensors = {name: value.contiguous() for name, value in saved.policy.state_dict().items()}
    metadata = {
        "settings": json.dumps(saved.options.settings()),
        "about": json.dumps(saved.about, allow_nan=False),
    }
    with replacing(path) as draft:
        draft.write_bytes(save_tensors(tensors, metadata))


def read_policy(path: Path) -> SavedPolicy:
    """A policy as :func:`write_policy` wrote it.

    Raises:
        FileNotFoundError: if there is no such file.
        CheckpointError: if it is no policy's, or not finite.
        UntrustedError: if its options name code.
    """
    try:
        content = read_bytes(path, LIMIT)
        tensors = load_tensors(content)  # which checks the header that is read below
        end = 8 + int.from_bytes(content[:8], "little")
        metadata = json.loads(content[8:end])["__metadata__"]
        settings, about = (json.loads(metadata[name]) for name in ("settings", "about"))
        options = options_to_look(path, settings)
    except (SafetensorError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise CheckpointError(f"{printable(path)} holds no policy: {printable(error)}") from None
    policy = make_policy(options, make_env(options, num_envs=1, seed=0, trust=False))
    try:
        policy.load_state_dict(tensors)
    except RuntimeError as error:  # other names or shapes
        raise CheckpointError(
            f"the weights in {printable(path)} are not its options': {printable(error)}"
        ) from None
    return SavedPolicy(_to_act(policy, path), options, dict(about))


def _to_act(policy: Policy, path: Path) -> Policy:
    for name, weight in policy.named_parameters():
        if not weight.isfinite().all():
            raise CheckpointError(f"{name} of the policy in {printable(path)} is not finite.")
    return policy.eval().requires_grad_(False)
