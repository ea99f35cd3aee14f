"""A folder that one process has, until it lets go of it or dies."""

from __future__ import annotations

import contextlib
import os
import platform
import sys
from pathlib import Path

LOCK = ".lock"


class FolderLock:
    """Taken at once or not at all, and released by the system when a process is killed.

    The lock is the system's, on a file in the folder, which stays there; what the file says is who
    took it last. It holds on one machine, and across machines where the file system locks for all
    of them (NFS since version 4).

    Args:
        folder (path): an existing one.

    Raises:
        FileExistsError: if another run has it, with the folder, the process and the machine.
    """

    def __init__(self, folder: Path) -> None:
        path = folder / LOCK
        flags = os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0)
        self._descriptor: int | None = os.open(path, flags, 0o644)
        try:
            _lock(self._descriptor)
        except BlockingIOError:
            holder = os.pread(self._descriptor, 200, 0) if hasattr(os, "pread") else b""
            os.close(self._descriptor)
            name = holder.decode(errors="replace") if holder else "another process"
            raise FileExistsError(
                f"run_dir={folder} is taken: a run lives in it, of {name!r}. Wait for it, stop it, "
                "or choose another run_dir; in a sweep, run_dir must name all that is varied."
            ) from None
        except BaseException:
            os.close(self._descriptor)
            raise
        # A forked child would keep it for a parent that was killed.
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self.close)
        os.ftruncate(self._descriptor, 0)
        os.write(self._descriptor, f"process {os.getpid()} on {platform.node()}".encode())

    def close(self) -> None:
        """Let go of it."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.close(self._descriptor)
            self._descriptor = None


if sys.platform == "win32":
    import msvcrt

    def _lock(descriptor: int) -> None:
        os.lseek(descriptor, 2**20, os.SEEK_SET)  # a byte that is not read: locks bind readers here
        try:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
        except OSError as error:
            raise BlockingIOError(*error.args) from error
        os.lseek(descriptor, 0, os.SEEK_SET)

else:
    import fcntl

    def _lock(descriptor: int) -> None:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
