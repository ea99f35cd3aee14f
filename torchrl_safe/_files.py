"""Files of a folder that a stranger may have made, or that somebody else writes meanwhile.

What is read is a regular file in real folders, of a size that was asked for. What is written
appears under its name whole and on the disk, and never through a link that lies there.
"""

from __future__ import annotations

import errno
import json
import os
import secrets
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

DRAFT = ".draft-"  # begins the names of what is not yet whole
JSON_LIMIT = 2**22  # bytes
MAX_ENTRIES = 100_000

# Systems that lack a flag lack what it prevents, too.
_READ = os.O_RDONLY | sum(
    getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_CLOEXEC", "O_BINARY")
)
_CREATE = os.O_WRONLY | os.O_CREAT | os.O_EXCL


class FileRefusedError(ValueError):
    """A file or folder that is not what may be read or written there; the message names it."""


def expand(path: str | os.PathLike[str]) -> Path:
    """A path as it was given, with ``~`` for the home."""
    return Path(path).expanduser()


def printable(text: object) -> str:
    r"""Text that a terminal shows instead of obeying: what is no plain character is escaped.

    Examples:
        >>> print(printable("Läufe/\x1b[2Jrun"))
        Läufe/\x1b[2Jrun
    """
    return "".join(c if c.isprintable() else ascii(c)[1:-1] for c in str(text))


def check_folder(path: Path) -> None:
    """Raises if a path is no real folder.

    Raises:
        FileNotFoundError: if there is nothing.
        FileRefusedError: if it is a link or no folder.
    """
    _check_kind(path, path.lstat().st_mode, stat.S_ISDIR, "a folder")


def make_folder(path: Path) -> None:
    """Makes a folder to write into, with its parents, or takes one that is there and no link.

    Raises:
        FileRefusedError: if it is a link or no folder.
    """
    if not os.path.lexists(path):
        path.mkdir(parents=True, exist_ok=True)
    check_folder(path)


def regular_files(folder: Path) -> dict[str, Path]:
    """Every file below a folder, by its relative name with ``/``.

    Raises:
        FileNotFoundError: if there is no such folder.
        FileRefusedError: if anything below is neither a regular file nor a real folder that can be
            listed, or there is too much of it.
    """
    check_folder(folder)
    files: dict[str, Path] = {}
    pending, count = [folder], 0
    while pending:
        current = pending.pop()
        try:
            with os.scandir(current) as entries:
                for entry in entries:
                    path, mode = Path(entry.path), entry.stat(follow_symlinks=False).st_mode
                    count += 1
                    if count > MAX_ENTRIES:
                        raise FileRefusedError(
                            f"{printable(folder)} holds more than {MAX_ENTRIES:,} files."
                        )
                    if stat.S_ISDIR(mode):
                        pending.append(path)
                    else:
                        _check_kind(path, mode, stat.S_ISREG, "a regular file")
                        files[path.relative_to(folder).as_posix()] = path
        except OSError as error:
            raise FileRefusedError(
                f"{printable(current)} cannot be listed: {error.strerror}."
            ) from error
    return dict(sorted(files.items()))


def open_regular(path: Path) -> BinaryIO:
    """A regular file to read; no link is followed, no pipe waited for.

    Raises:
        FileNotFoundError: if there is no such file.
        FileRefusedError: if it is anything else.
    """
    _check_kind(path, path.lstat().st_mode, stat.S_ISREG, "a regular file")
    file = os.fdopen(os.open(path, _READ), "rb")
    try:  # what was opened, if another took its place
        _check_kind(path, os.fstat(file.fileno()).st_mode, stat.S_ISREG, "a regular file")
    except FileRefusedError:
        file.close()
        raise
    return file


def read_bytes(path: Path, limit: int) -> bytes:
    """The content of a regular file of at most ``limit`` bytes.

    Raises:
        FileNotFoundError: if there is no such file.
        FileRefusedError: if it is no regular file, or larger.
    """
    with open_regular(path) as file:
        content = file.read(limit + 1) if os.fstat(file.fileno()).st_size <= limit else None
    if content is None or len(content) > limit:
        raise FileRefusedError(f"{printable(path)} is larger than {limit:,} bytes.")
    return content


def read_json(path: Path, limit: int = JSON_LIMIT) -> Any:
    """What a JSON file says.

    Raises:
        FileNotFoundError: if there is no such file.
        FileRefusedError: if it is no regular file, too large, too deep, no JSON, or has a key
            twice.
    """
    try:
        return json.loads(read_bytes(path, limit).decode(), object_pairs_hook=_unique)
    except FileRefusedError:
        raise
    except RecursionError:
        raise FileRefusedError(f"{printable(path)} is nested too deep.") from None
    except ValueError as error:
        raise FileRefusedError(f"{printable(path)} is no JSON: {printable(error)}.") from None


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A new, empty file to write instead of ``path``, whose name it takes when the block is left.

    It lies in the same folder with the same suffix, so that whoever reads ``path`` sees the old
    content or the new. If the block raises, nothing has happened.
    """
    draft = path.with_name(f"{DRAFT}{secrets.token_hex(8)}-{path.name}")
    os.close(os.open(draft, _CREATE, 0o666))
    try:
        yield draft
        sync_file(draft)
        os.replace(draft, path)
    finally:
        draft.unlink(missing_ok=True)
    sync_folder(path.parent)


def write_atomically(path: Path, text: str) -> None:
    """Replaces a file's content by UTF-8: whoever reads it sees the old or the new."""
    with replacing(path) as draft:
        draft.write_bytes(text.encode())


def sync_file(path: Path) -> None:
    """Waits until a file's content is on the disk."""
    with open(path, "r+b") as file:  # Windows syncs what may be written alone
        os.fsync(file.fileno())


def sync_folder(path: Path) -> None:
    """Waits until the names in a folder are on the disk, on systems that can be asked to."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
    except PermissionError:  # Windows opens no folders
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EBADF, errno.EINVAL, errno.ENOTSUP):
            raise
    finally:
        os.close(descriptor)


def _check_kind(path: Path, mode: int, is_wanted: Any, wanted: str) -> None:
    if not is_wanted(mode):
        kinds = {
            stat.S_IFLNK: "a link",
            stat.S_IFDIR: "a folder",
            stat.S_IFREG: "a file",
            stat.S_IFIFO: "a pipe",
            stat.S_IFSOCK: "a socket",
        }
        kind = kinds.get(stat.S_IFMT(mode), "a device")
        raise FileRefusedError(f"{printable(path)} must be {wanted}, and is {kind}.")


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    entries = dict(pairs)
    if len(entries) < len(pairs):
        raise ValueError("a key is there twice")
    return entries
