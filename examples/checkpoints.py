"""Checkpoints that are whole or refused, and that never run code.

TorchRL writes a checkpoint beside the last one and renames it when it is complete. Here every
component gets a digest of its files, checked before the component is loaded, and holds JSON and
memory-mapped tensors alone: none of the kinds of file that Python executes when it reads them.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor
from torch.utils._pytree import tree_leaves
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    DumpLoadCheckpointAdapter,
    StateDictCheckpointAdapter,
)
from torchrl.data import ReplayBuffer

DIGESTS = "digests.json"
SUFFIXES = (".json", ".memmap")
SPARE = 2**20  # bytes: what is written besides tensors


class StateAdapter(StateDictCheckpointAdapter):
    """TorchRL's adapter of a ``state_dict``, sealed."""

    def save(self, component: Any, path: Path, **options: Any) -> Any:
        """Write the state, then the digests."""
        require_space(path, component.state_dict())
        state = super().save(component, path, **options)
        seal(path)
        return state

    def load(self, component: Any, path: Path, **options: Any) -> None:
        """Read the state if it is what was written."""
        check_seal(path)
        super().load(component, path, **options)


class BufferAdapter(DumpLoadCheckpointAdapter):
    """A replay buffer's parts, sealed; its own ``dump`` and ``load`` use a pickle besides."""

    parts = ("storage", "sampler", "writer")

    def save(self, component: ReplayBuffer, path: Path, **_: Any) -> None:
        """Write the parts, then the digests."""
        require_space(path, component.storage.state_dict())
        path.mkdir(parents=True)
        for part in self.parts:
            getattr(component, part).dumps(path / part)
        seal(path)

    def load(self, component: ReplayBuffer, path: Path, **_: Any) -> None:
        """Read the parts if they are what was written."""
        check_seal(path)
        for part in self.parts:
            getattr(component, part).loads(path / part)


def adapter_of(component: Any) -> CheckpointAdapter:
    """How a component is written."""
    return BufferAdapter() if isinstance(component, ReplayBuffer) else StateAdapter()


def latest(run_dir: Path) -> Path | None:
    """The newest checkpoint of a run, none if there is none yet.

    Raises:
        CheckpointError: if it cannot be read: going on from an older one, or from nothing, would
            lose work in silence.
    """
    found = sorted((run_dir / "checkpoints").glob("checkpoint-*"))
    if not found:
        return None
    try:
        Checkpoint.manifest(found[-1])
    except (CheckpointError, OSError, ValueError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"the manifest of {found[-1]} cannot be read: {error}. Delete this folder to go on "
            "from the checkpoint before it."
        ) from error
    return found[-1]


def load_component(checkpoint: Path, name: str, component: Any) -> None:
    """Load one component of a checkpoint."""
    Checkpoint().register(name, component, adapter=adapter_of(component)).load(checkpoint)


def remove_leftovers(run_dir: Path) -> None:
    """Delete what a kill left of a checkpoint half written or half deleted."""
    for path in (run_dir / "checkpoints").glob(".checkpoint-*"):
        shutil.rmtree(path)


def require_space(path: Path, state: Any) -> None:
    """Fail before the disk is full: a write to a memory-mapped file would kill the process.

    Raises:
        OSError: if there is less space than the tensors of ``state`` need.
    """
    folder = next(parent for parent in path.parents if parent.exists())
    leaves = (leaf for leaf in tree_leaves(state) if isinstance(leaf, Tensor))
    needed = sum(leaf.nbytes for leaf in leaves) + SPARE
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"{os.strerror(errno.ENOSPC)}: a checkpoint needs {needed} bytes for {path.name}, "
            f"there are {free}. The last checkpoint is whole; free some space and resume",
            str(folder),
        )


def seal(path: Path) -> None:
    """Write the digest of every file, with everything on the disk before the checkpoint counts."""
    digests = {name: digest(file, flush=True) for name, file in _files(path).items()}
    write_atomically(path / DIGESTS, json.dumps(digests, indent=2) + "\n")


def check_seal(path: Path) -> None:
    """Compare a component with its digests.

    Raises:
        CheckpointError: if a file is missing, changed, added, or of a kind that may run code.
    """
    files = _files(path)
    for file in files.values():
        if file.is_symlink() or file.suffix not in SUFFIXES:
            raise CheckpointError(
                f"{file} may run code when it is read and is refused: a checkpoint holds "
                f"{' and '.join(SUFFIXES)} files alone. Delete it if you trust the others."
            )
    if not (path / DIGESTS).exists():
        return  # written before there were digests; a kill leaves no component without
    expected: Mapping[str, str] = json.loads((path / DIGESTS).read_text())
    for name in sorted(expected.keys() | files.keys()):
        if name not in files or name not in expected or digest(files[name]) != expected[name]:
            raise CheckpointError(f"{path / name} is not what was written.")


def write_atomically(path: Path, text: str) -> None:
    """Replace a file's content: whoever reads it sees the old text or the new, never a part."""
    draft = path.with_name(f".{path.name}.draft")
    with open(draft, "w") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())
    os.replace(draft, path)


def digest(path: Path, *, flush: bool = False) -> str:
    """SHA-256 of a file; ``flush`` waits until it is on the disk."""
    result = hashlib.sha256()
    with open(path, "rb") as file:
        if flush:
            os.fsync(file.fileno())
        while block := file.read(2**20):
            result.update(block)
    return result.hexdigest()


def _files(path: Path) -> dict[str, Path]:
    """Files below a folder but the digests, by relative name; links count as files."""
    found = (file for file in sorted(path.rglob("*")) if file.is_symlink() or not file.is_dir())
    return {file.relative_to(path).as_posix(): file for file in found if file.name != DIGESTS}
