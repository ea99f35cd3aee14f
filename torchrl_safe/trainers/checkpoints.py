"""Checkpoints that are whole or refused, and that never run code.

TorchRL writes a checkpoint beside the last one and renames it when it is complete. Here every
component has digests of its files, and the manifest has the digests' own. They are checked before
anything is loaded. A component is JSON and memory-mapped tensors alone: none of the kinds of file
that Python executes when it reads them, and metadata cannot ask for one.
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import re
import shutil
import warnings
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor
from torch.utils._pytree import tree_leaves
from torchrl.checkpoint import (
    Checkpoint,
    CheckpointAdapter,
    CheckpointError,
    CheckpointLoadResult,
    CheckpointOptions,
    CheckpointRotation,
    DumpLoadCheckpointAdapter,
    StateDictCheckpointAdapter,
)
from torchrl.data import ReplayBuffer

from torchrl_safe._files import (
    DRAFT,
    JSON_LIMIT,
    FileRefusedError,
    check_folder,
    open_regular,
    printable,
    read_bytes,
    read_json,
    regular_files,
    sync_file,
    sync_folder,
    write_atomically,
)

MANIFEST = "manifest.json"
DIGESTS = "digests.json"
SUFFIXES = (".json", ".memmap")
SPARE = 2**20  # bytes: what is written besides tensors


class SealedCheckpoint(Checkpoint):
    """TorchRL's checkpoint with sealed components.

    Each component has a file of digests; those files' own digests are in the manifest's metadata.
    """

    def __init__(self, **components: Any) -> None:
        self._digests: dict[str, str] = {}
        super().__init__(**components)

    def register(
        self,
        name: str,
        component: Any,
        *,
        adapter: CheckpointAdapter | None = None,
        options: CheckpointOptions | None = None,
    ) -> Checkpoint:
        """Register a component, by default with the adapter that seals its kind."""
        if adapter is None:
            kind = BufferAdapter if isinstance(component, ReplayBuffer) else StateAdapter
            adapter = kind(name, self._digests)
        return super().register(name, component, adapter=adapter, options=options)

    def save(
        self, path: str | Path, *, metadata: Mapping[str, Any] | None = None, **options: Any
    ) -> Path:
        """Write the components, then the manifest with what they are sealed by.

        Raises:
            OSError: if there is no space; the last checkpoint stays as it is.
        """
        self._digests.clear()
        # Adapters fill in the digests before TorchRL writes the manifest.
        sealed = {**(metadata or {}), "digests": self._digests}
        destination = super().save(path, metadata=sealed, **options)
        sync_file(destination / MANIFEST)
        sync_folder(destination.parent)
        return destination

    def load(
        self,
        path: str | Path,
        *,
        components: Collection[str] | None = None,
        fixed_size: bool = False,
        **options: Any,
    ) -> CheckpointLoadResult:
        """Load components if all of them are what was written; else none is touched.

        Args:
            path (path): the checkpoint.

        Keyword Args:
            components (collection of str, optional): their names. Defaults to all.
            fixed_size (bool): whether they have as many numbers as was saved of them, so that more
                is refused before it is read. Optimizers and buffers have not. Defaults to False.
            **options: as TorchRL's.

        Raises:
            CheckpointError: if a file is missing, changed, added, or could do anything but be read.
        """
        path = Path(path)
        manifest = read_manifest(path)
        for name in self.components if components is None else components:
            if name in manifest["components"]:
                state = self.components[name].state_dict() if fixed_size else None
                most_bytes = _nbytes(state) + SPARE if fixed_size else math.inf
                check_component(path, manifest, name, most_bytes)
        return super().load(path, components=components, **options)


class StateAdapter(StateDictCheckpointAdapter):
    """TorchRL's adapter of a ``state_dict``, sealed, and read without pickle.

    Args:
        name (str): the component's.
        digests (dict): where the digest of its seal goes.
    """

    def __init__(self, name: str, digests: dict[str, str]) -> None:
        super().__init__()
        self.name = name
        self.digests = digests

    def save(self, component: Any, path: Path, **options: Any) -> Any:
        """Write the state, then the digests.

        Raises:
            TypeError: if the state holds what :meth:`load` would refuse.
        """
        require_space(path, component.state_dict())
        state = super().save(component, path, **options)
        if unknown := set(_kinds(read_json(path / self.schema_filename))) - KINDS:
            raise TypeError(f"the state of {self.name} holds what is not saved: {unknown}.")
        self.digests[self.name] = seal(path)
        return state

    def load(self, component: Any, path: Path, *, map_location: Any = None, **_: Any) -> None:
        """Read a state that was checked."""
        tensors = TensorDict.load_memmap(path / self.state_directory, allow_pickle=False)
        schema = read_json(path / self.schema_filename)
        component.load_state_dict(_decode(schema, tensors, map_location))


class BufferAdapter(DumpLoadCheckpointAdapter):
    """A replay buffer's parts, sealed; its own ``dump`` and ``load`` use a pickle besides.

    Args:
        name (str): the component's.
        digests (dict): where the digest of its seal goes.
    """

    parts = ("storage", "sampler", "writer")

    def __init__(self, name: str, digests: dict[str, str]) -> None:
        self.name = name
        self.digests = digests

    def save(self, component: ReplayBuffer, path: Path, **_: Any) -> None:
        """Write the parts, then the digests."""
        require_space(path, component.storage.state_dict())
        path.mkdir(parents=True)
        for part in self.parts:
            getattr(component, part).dumps(path / part)
        self.digests[self.name] = seal(path)

    def load(self, component: ReplayBuffer, path: Path, **_: Any) -> None:
        """Read parts that were checked.

        Raises:
            CheckpointError: if they are not those of a buffer of tensordicts: others name files.
        """
        if read_json(path / "storage" / "storage_metadata.json").get("is_pytree") is not False:
            raise CheckpointError(f"{printable(path)} holds no tensordicts.")
        with _pickling_off():
            for part in self.parts:
                getattr(component, part).loads(path / part)


class Rotation(CheckpointRotation):
    """TorchRL's rotation of a run's own checkpoints; a copy under another name is nobody's rival.

    Args:
        run_dir (Path): the run's folder.
        keep_last (int): how many are kept.
    """

    def __init__(self, run_dir: Path, keep_last: int) -> None:
        super().__init__(run_dir / "checkpoints", keep_last=keep_last)

    def checkpoints(self) -> tuple[Path, ...]:
        """The checkpoints, oldest first."""
        return tuple(_own_names(self.directory))

    def prune(self) -> tuple[Path, ...]:
        """Delete all but the newest. Each loses its name first: nobody finds half of one."""
        old = self.checkpoints()[: -self.keep_last]
        for path in old:
            gone = path.with_name(f".{path.name}.delete")
            _remove(gone)
            path.rename(gone)
            _remove(gone)
        return old


def latest(run_dir: Path) -> Path | None:
    """The newest checkpoint of a run, none if there is none yet.

    Only the names that a run gives count. A folder beside them, ``checkpoint-best`` or the like, is
    left alone.

    Raises:
        CheckpointError: if it cannot be read: going on from an older one, or from nothing, would
            lose work in silence.
    """
    while True:
        try:
            found = _own_names(run_dir / "checkpoints")
        except FileRefusedError as error:
            raise CheckpointError(str(error)) from None
        if not found:
            return None
        try:
            read_manifest(found[-1])
        except CheckpointError as error:
            if not os.path.lexists(found[-1]):
                continue  # a run that trains has replaced it
            raise CheckpointError(
                f"{error} Delete this folder to go on from the checkpoint before it."
            ) from None
        return found[-1]


def load_components(checkpoint: Path, **components: Any) -> None:
    """Load components of one checkpoint to look at them, on the CPU.

    Raises:
        CheckpointError: if one is missing, not what was written, or of other shapes.
    """
    SealedCheckpoint(**components).load(checkpoint, fixed_size=True, map_location="cpu")


def remove_leftovers(run_dir: Path) -> None:
    """Delete what a kill left of files and checkpoints half written or half deleted.

    Raises:
        FileRefusedError: if the folder of the checkpoints is a link.
    """
    folder = run_dir / "checkpoints"
    if os.path.lexists(folder):
        check_folder(folder)
    for path in (*folder.glob(".checkpoint-*"), *run_dir.glob(f"{DRAFT}*")):
        _remove(path)


def require_space(path: Path, state: Any) -> None:
    """Fail before the disk is full: a write to a memory-mapped file would kill the process.

    Raises:
        OSError: if there is less space than the tensors of ``state`` need.
    """
    folder = next(parent for parent in path.parents if parent.exists())
    needed = _nbytes(state) + SPARE
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise OSError(
            errno.ENOSPC,
            f"{os.strerror(errno.ENOSPC)}: a checkpoint needs {needed} bytes for {path.name}, "
            f"there are {free}. The last checkpoint is whole; free some space and resume",
            str(folder),
        )


def read_manifest(checkpoint: Path) -> dict[str, Any]:
    """A checkpoint's manifest, of a form that can be worked with.

    Raises:
        CheckpointError: if it cannot be read or has no digests.
    """
    try:
        check_folder(checkpoint)
        read_json(checkpoint / MANIFEST)
        manifest = Checkpoint.manifest(checkpoint)
    except (CheckpointError, OSError, ValueError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"the manifest of {printable(checkpoint)} cannot be read: {printable(error)}"
        ) from None
    metadata = manifest.get("metadata")
    digests = metadata.get("digests") if isinstance(metadata, dict) else None
    if not _are_digests(digests):
        raise CheckpointError(
            f"the manifest of {printable(checkpoint)} has no digests of its components. If it was "
            "written by an older version, read it with that one, or train again."
        )
    return manifest


def check_checkpoint(checkpoint: Path) -> None:
    """Compare all components of a checkpoint with their digests.

    Raises:
        CheckpointError: as :func:`check_component`.
    """
    manifest = read_manifest(checkpoint)
    for name in manifest["components"]:
        check_component(checkpoint, manifest, name)


def check_component(
    checkpoint: Path, manifest: Mapping[str, Any], name: str, most_bytes: float = math.inf
) -> None:
    """Compare a component with its digests, and look that nothing in it can do more than be read.

    Args:
        checkpoint (Path): the checkpoint.
        manifest (mapping): its manifest.
        name (str): the component.
        most_bytes (float): how large it can be.

    Raises:
        CheckpointError: if a file is missing, changed, added, of a kind that may run code, larger
            than it can be, or not what its metadata says.
    """
    path = manifest["components"][name]["path"]
    if not re.fullmatch(r"components/[\w.-]*\w", path, re.ASCII):
        raise CheckpointError(f"component {name!r} of {printable(checkpoint)} lies at {path!r}.")
    folder = checkpoint / path
    try:
        check_folder(folder.parent)
        files = regular_files(folder)
        _check_files(folder, files, manifest["metadata"]["digests"].get(name), most_bytes)
        for relative, file in files.items():
            if file.suffix == ".json" and relative != DIGESTS:
                content = read_json(file)
                if file.name == "meta.json":
                    _check_tensors(file, content)
    except (OSError, FileRefusedError) as error:
        raise CheckpointError(printable(error)) from None


def seal(path: Path) -> str:
    """Write the digest of every file, with everything on the disk before the checkpoint counts.

    Returns:
        str: the digest of the digests.
    """
    files = {name: file for name, file in regular_files(path).items() if name != DIGESTS}
    digests = {}
    for name, file in files.items():
        sync_file(file)
        digests[name] = digest(file)
    write_atomically(path / DIGESTS, json.dumps(digests, indent=2) + "\n")
    return digest(path / DIGESTS)


def digest(path: Path) -> str:
    """SHA-256 of a regular file."""
    result = hashlib.sha256()
    with open_regular(path) as file:
        while block := file.read(2**20):
            result.update(block)
    return result.hexdigest()


def _check_files(
    folder: Path, files: Mapping[str, Path], expected_seal: str | None, most_bytes: float
) -> None:
    for file in files.values():
        if file.suffix not in SUFFIXES:
            raise CheckpointError(
                f"{printable(file)} may run code when it is read and is refused: a checkpoint "
                f"holds {' and '.join(SUFFIXES)} files alone. Delete it if you trust the others."
            )
    if DIGESTS not in files:
        raise CheckpointError(
            f"{printable(folder / DIGESTS)} is missing: nothing shows that the others are what was "
            "written."
        )
    content = read_bytes(files[DIGESTS], JSON_LIMIT)
    if hashlib.sha256(content).hexdigest() != expected_seal:
        raise CheckpointError(f"{printable(folder / DIGESTS)} is not what was written.")
    expected = read_json(files[DIGESTS])
    if not _are_digests(expected):
        raise CheckpointError(f"{printable(folder / DIGESTS)} holds no digests.")
    # Nothing is read in full before it is known to be small enough.
    size = sum(file.lstat().st_size for file in files.values())
    if size > most_bytes:
        raise CheckpointError(
            f"{printable(folder)} holds {size:,} bytes, where {most_bytes:,} are the most that "
            "there can be."
        )
    found = files.keys() - {DIGESTS}
    for name in sorted(expected.keys() | found):
        if name not in found or name not in expected or digest(files[name]) != expected[name]:
            raise CheckpointError(f"{printable(folder / name)} is not what was written.")


def _check_tensors(meta: Path, content: Any) -> None:
    """Memory is mapped as metadata says: a shape too large would lengthen the file."""
    if not isinstance(content, dict) or content.pop("_type", None) != str(TensorDict):
        raise CheckpointError(f"{printable(meta)} may run code when it is read: no TensorDict.")
    if content.pop("device", "cpu") not in ("cpu", "None") or not _is_shape(
        content.pop("shape", [])
    ):
        raise CheckpointError(f"{printable(meta)} has an impossible device or shape.")
    for key, entry in content.items():
        if not re.fullmatch(r"\w+", key, re.ASCII):
            raise CheckpointError(f"{printable(meta)} has an impossible key {key!a}.")
        if entry == {"type": "TensorDict"}:
            check_folder(meta.parent / key)
            if not (meta.parent / key / meta.name).exists():
                raise CheckpointError(f"{printable(meta.parent / key / meta.name)} is missing.")
            continue
        keys = {"device", "shape", "dtype", "is_nested"}
        name = entry.get("dtype") if isinstance(entry, dict) and entry.keys() <= keys else None
        dtype = getattr(torch, name.removeprefix("torch."), None) if isinstance(name, str) else None
        if (
            not isinstance(dtype, torch.dtype)
            or not _is_shape(entry.get("shape"))
            or entry.get("is_nested", False) is not False
        ):
            raise CheckpointError(f"{printable(meta)} does not say what {key!a} is.")
        file = meta.with_name(f"{key}.memmap")
        needed = math.prod(entry["shape"]) * dtype.itemsize
        size = file.lstat().st_size if needed or os.path.lexists(file) else 0
        if size != needed:
            raise CheckpointError(
                f"{printable(file)} has {size:,} bytes, {printable(meta)} wants {needed:,}."
            )


def _is_shape(shape: Any) -> bool:
    return (
        isinstance(shape, list)
        and len(shape) <= 16
        and all(type(size) is int and 0 <= size < 2**48 for size in shape)
    )


def _are_digests(digests: Any) -> bool:
    return isinstance(digests, dict) and all(
        isinstance(value, str) and re.fullmatch("[0-9a-f]{64}", value) for value in digests.values()
    )


def _decode(value: Any, tensors: TensorDict, device: Any) -> Any:
    """What TorchRL wrote of a state, of the kinds that states of runs have.

    Raises:
        CheckpointError: if there is another kind, which TorchRL might make more of than data.
    """
    match value:
        case {"kind": "value", "value": None | bool() | int() | float() | str() as plain}:
            return plain
        case {"kind": "tensor", "key": str(key), "device": str(saved)} if key in tensors.keys():
            return tensors[key].to(device or saved, copy=True)
        case {"kind": "numpy", "key": str(key), "dtype": str(dtype)} if (
            key in tensors.keys() and dtype == tensors[key].numpy().dtype.str
        ):
            return np.array(tensors[key].numpy())
        case {"kind": "torch_size", "items": list(items)} if _is_shape(items):
            return torch.Size(items)
        case {"kind": "list", "items": list(items)}:
            return [_decode(item, tensors, device) for item in items]
        case {"kind": "tuple", "items": list(items)}:
            return tuple(_decode(item, tensors, device) for item in items)
        case {"kind": "dict" | "ordered_dict" as kind, "items": list(items)}:
            entries: dict[Any, Any] = OrderedDict() if kind == "ordered_dict" else {}
            for key, item in items:
                name = _decode(key, tensors, device)
                if not isinstance(name, str | int) or printable(name) != str(name):
                    raise CheckpointError(f"a state has an impossible key {name!a}.")
                entries[name] = _decode(item, tensors, device)
            if value.get("metadata") is not None:  # of a module's state
                entries._metadata = _decode(value["metadata"], tensors, device)  # type: ignore[attr-defined]
            return entries
    kind = value.get("kind") if isinstance(value, dict) else value
    raise CheckpointError(f"a state has an entry that cannot be read: {kind!a:.80}.")


KINDS = {"value", "tensor", "numpy", "torch_size", "list", "tuple", "dict", "ordered_dict"}


def _kinds(value: Any) -> Iterator[str]:
    """Every kind in what TorchRL wrote of a state."""
    if isinstance(value, dict):
        yield value["kind"]
        value = value.get("items", [])
    if isinstance(value, list):
        for item in value:
            yield from _kinds(item)


@contextmanager
def _pickling_off() -> Iterator[None]:
    """No pickle for loaders that cannot say so: tensordict warns before it unpickles unasked."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", FutureWarning)
        yield


def _own_names(folder: Path) -> list[Path]:
    """Checkpoints of a run in its folder of checkpoints, by the frames in their names."""
    if not os.path.lexists(folder):
        return []
    check_folder(folder)
    steps = {
        int(found[1]): path
        for path in folder.iterdir()
        if (found := re.fullmatch(r"checkpoint-([0-9]{12,18})", path.name))
        and path.name == f"checkpoint-{int(found[1]):012d}"
    }
    return [steps[step] for step in sorted(steps)]


def _nbytes(state: Any) -> int:
    return sum(leaf.nbytes for leaf in tree_leaves(state) if isinstance(leaf, Tensor))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
