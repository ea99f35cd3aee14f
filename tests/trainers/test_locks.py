"""One process has a folder, until it ends however it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from torchrl_safe.trainers import locks
from torchrl_safe.trainers.locks import LOCK, FolderLock

HOLD = "import sys, pathlib, locks; lock = locks.FolderLock(pathlib.Path(sys.argv[1])); "


def hold(folder: Path, more: str = "print('held', flush=True); sys.stdin.read()"):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD + more, folder],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=Path(locks.__file__).parent,
    )
    assert process.stdout.readline() == "held\n"
    return process


def test_in_one_process(tmp_path):
    lock = FolderLock(tmp_path)
    with pytest.raises(FileExistsError, match=f"run_dir={tmp_path} is taken.*{os.getpid()}"):
        FolderLock(tmp_path)
    lock.close()
    lock.close()
    FolderLock(tmp_path).close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_killed_process_lets_go(tmp_path, number):
    process = hold(tmp_path)
    for _ in range(2):  # the one that was refused leaves the name of the other in place
        with pytest.raises(FileExistsError, match=f"of 'process {process.pid} on "):
            FolderLock(tmp_path)
    process.send_signal(number)
    process.communicate()
    FolderLock(tmp_path).close()


def test_a_forked_child_does_not_keep_it(tmp_path):
    """Workers of a process that was killed live on for a while."""
    # The child says so: what a fork does to it is then done.
    child = "(print('held', flush=True), time.sleep(60))"
    process = hold(tmp_path, f"import os, time; os.fork() or {child}; sys.stdin.read()")
    process.kill()
    process.wait()
    FolderLock(tmp_path).close()
    process.stdin.close()
    process.stdout.close()


def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "precious").write_text("text")
    (tmp_path / LOCK).symlink_to(tmp_path / "precious")
    with pytest.raises(OSError, match=LOCK):
        FolderLock(tmp_path)
    assert (tmp_path / "precious").read_text() == "text"
