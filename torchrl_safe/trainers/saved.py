"""A run's folder for those who look at it: its configuration and its newest checkpoint."""

from __future__ import annotations

import hashlib
import itertools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import yaml
from torchrl.checkpoint import CheckpointError

from torchrl_safe._files import (
    FileRefusedError,
    expand,
    open_regular,
    printable,
    read_bytes,
    write_atomically,
)
from torchrl_safe.trainers.checkpoints import latest, load_components
from torchrl_safe.trainers.options import Options, flat

CONFIG = "config.yaml"
HISTORY = "history.jsonl"
RESULTS = "results.json"
RESULTS_LIMIT = 2**28  # bytes
CONFIG_LIMIT = 2**14  # bytes; brackets in brackets take the parser a while for each
SEAL = b"# SHA-256 of the lines above: "

# What a look at a run may cost, whatever its configuration asks for.
MOST = {"eval.num_steps": 1_000_000, "policy.num_components": 1_000}
MOST_WEIGHTS = 2**28  # of one network
ENDS = 1_000  # inputs and outputs for one component that no robot exceeds

T = TypeVar("T")


class Configuration:
    """The options as a component of each checkpoint.

    Whoever goes on with a run keeps its own; those of the checkpoint are in :attr:`saved`.

    Args:
        options (Options, optional): the run's.
    """

    def __init__(self, options: Options | None = None) -> None:
        self.options = options
        self.saved: dict[str, Any] = {}

    def state_dict(self) -> dict[str, Any]:
        """The options."""
        return {} if self.options is None else self.options.settings()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Keep the options of a checkpoint."""
        self.saved = dict(state)


def write_config(path: Path, options: Options) -> None:
    """Write all options, sealed by the last line."""
    text = yaml.safe_dump(options.settings(), sort_keys=False)
    seal = hashlib.sha256(text.encode()).hexdigest()
    write_atomically(path, f"{text}{SEAL.decode()}{seal}\n")


def read_config(path: Path) -> dict[str, Any]:
    """The settings that :func:`write_config` wrote.

    Raises:
        FileNotFoundError: if there is none.
        CheckpointError: if it was changed, or is more than plain YAML.
    """
    try:
        content = read_bytes(path, CONFIG_LIMIT)
    except FileRefusedError as error:
        raise CheckpointError(str(error)) from None
    sealed, _, seal = content.rpartition(SEAL)
    if seal.decode(errors="replace").rstrip() != hashlib.sha256(sealed).hexdigest():
        raise CheckpointError(
            f"{printable(path)} is not what was written. Options are changed on the command line; "
            "a run of an older version is read with that one."
        )
    try:
        options = yaml.load(sealed.decode(), _PlainLoader)
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise CheckpointError(f"{printable(path)} is no plain YAML: {printable(error)}") from None
    return _plain_settings(path, options)


def load_run(run_dir: str | os.PathLike[str]) -> tuple[Options, Path]:
    """The options in a run's newest checkpoint, and the checkpoint's path.

    A run is looked at on the CPU, wherever it was trained. While it trains, the checkpoint may be
    gone when it is read: see :func:`from_newest`.

    Raises:
        FileNotFoundError: if the folder holds no run, or one without a checkpoint.
        CheckpointError: if the newest checkpoint cannot be read.
    """
    path = expand(run_dir)
    try:
        open_regular(path / CONFIG).close()
    except FileNotFoundError:
        raise FileNotFoundError(
            f"run_dir={printable(run_dir)} holds no run: it has no {CONFIG}."
        ) from None
    except FileRefusedError as error:
        raise CheckpointError(str(error)) from None
    checkpoint = latest(path)
    if checkpoint is None:
        raise FileNotFoundError(f"run_dir={printable(run_dir)} has no checkpoint yet.")
    config = Configuration()
    load_components(checkpoint, config=config)
    return options_to_look(checkpoint, config.saved), checkpoint


def from_newest(run_dir: str | os.PathLike[str], read: Callable[[Any, Path], T]) -> T:
    """What ``read`` makes of a run's options and newest checkpoint.

    A run that trains deletes a checkpoint when it has written the next; then the next is read. All
    that ``read`` returns is of one.

    Args:
        run_dir (path): the run's folder.
        read (callable): loads what is wanted; it may be called again.

    Raises:
        FileNotFoundError: as :func:`load_run`.
        CheckpointError: if the newest checkpoint cannot be read, and stays the newest.
    """
    while True:
        checkpoint = latest(expand(run_dir))
        try:
            return read(*load_run(run_dir))
        except (CheckpointError, OSError):
            if checkpoint is None or os.path.lexists(checkpoint):
                raise


def options_to_look(path: Path, settings: Any) -> Any:
    """Options of a file that anybody may have written, which a look at it can afford.

    Args:
        path (Path): the file or folder that they are from.
        settings: as :meth:`~torchrl_safe.trainers.options.Options.settings` wrote them.

    Raises:
        CheckpointError: if they are none, or ask for too much.
    """
    settings = _plain_settings(path, settings)
    try:
        num_threads = settings.get("num_threads")
        if num_threads is not None:
            num_threads = min(num_threads, os.cpu_count() or 1)
        options = Options.from_settings({**settings, "device": "cpu", "num_threads": num_threads})
        _check_cost(options)
    except (ValueError, TypeError) as error:
        raise CheckpointError(
            f"the configuration in {printable(path)} is none: {printable(error)}"
        ) from None
    return options


def _plain_settings(path: Path, settings: Any) -> dict[str, Any]:
    """Settings under names."""
    if not isinstance(settings, dict) or not all(isinstance(name, str) for name in settings):
        raise CheckpointError(f"{printable(path)} holds no options.")
    return settings


def _check_cost(options: Options) -> None:
    values = dict(flat(options))
    for name, most in MOST.items():
        if values.get(name, 0) > most:
            raise ValueError(f"{name} must be at most {most:,} to look at a run.")
    outputs = ENDS * values.get("policy.num_components", 1)
    for name in ("policy.num_cells", "critic.num_cells", "network.num_cells"):
        sizes = [ENDS, *values.get(name, []), outputs]
        if sum(a * b for a, b in itertools.pairwise(sizes)) > MOST_WEIGHTS:
            raise ValueError(f"{name} must be of at most {MOST_WEIGHTS:,} weights.")


class _PlainLoader(yaml.SafeLoader):
    """YAML without aliases, which multiply, without tags, and with every key once."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent) or event.anchor or getattr(event, "tag", None):
            raise yaml.YAMLError("it has an alias, anchor or tag.")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        mapping = super().construct_mapping(node, deep)
        if len(mapping) < len(node.value):
            raise yaml.YAMLError("a key is there twice.")
        return mapping
