"""A run survives whatever stops it: a signal at any moment, a full disk, a file that changed."""

from __future__ import annotations

import errno
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import tiny
from torchrl.checkpoint import CheckpointError

from torchrl_safe import record
from torchrl_safe.trainers import checkpoints


def frames_saved(run_dir: Path) -> list[str]:
    return sorted(path.name for path in (run_dir / "checkpoints").iterdir())


@pytest.mark.parametrize("kills", [4, pytest.param(100, marks=pytest.mark.long)])
def test_kills(kills):
    result = subprocess.run(
        [sys.executable, Path(__file__).with_name("interruption.py"), "--kills", str(kills)],
        capture_output=True,
        text=True,
        timeout=60 + 60 * kills,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert report["kills"] == kills
    assert report["SIGKILL"] >= kills // 4


class TestFullDisk:
    """Nothing of the failed checkpoint is left, and the last one loads."""

    def fails(self, run_dir, match):
        with pytest.raises(OSError, match=match) as caught:
            tiny.launch(
                run_dir, "resume=true", "collector.total_frames=300", "checkpoint.interval=100"
            )
        assert frames_saved(run_dir) == ["checkpoint-000000000100"]
        return caught.value

    @pytest.fixture
    def run_dir(self, tmp_path):
        tiny.launch(tmp_path / "run", "collector.total_frames=100")
        return tmp_path / "run"

    def resumes(self, run_dir):
        tiny.launch(run_dir, "resume=true", "collector.total_frames=300")
        steps, _ = record.read_metrics(run_dir / "log")["train/total_cvs"]
        assert steps.tolist() == [100, 200, 300]

    def test_no_space(self, run_dir, monkeypatch):
        """Seen before anything is written: memory-mapped files kill a process on a full disk."""
        with monkeypatch.context() as patch:
            usage = shutil.disk_usage(run_dir)._replace(free=2**20)
            patch.setattr(shutil, "disk_usage", lambda _: usage)
            error = self.fails(
                run_dir, "a checkpoint needs .* bytes.* The last checkpoint is whole"
            )
        assert error.errno == errno.ENOSPC
        self.resumes(run_dir)

    @pytest.mark.parametrize("after", [0, 5])
    def test_disk_fills_while_writing(self, run_dir, monkeypatch, after):
        """The digests' flush meets an error, at the first file or a later one."""
        with monkeypatch.context() as patch:
            calls = iter(range(10_000))

            def fsync(descriptor):
                if next(calls) >= after + 2:  # the first are those of config.yaml and its folder
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

            patch.setattr(os, "fsync", fsync)
            self.fails(run_dir, "No space left on device")
        self.resumes(run_dir)

    def test_small_disk(self, tmp_path):
        """A real one, where the system lets us make it."""
        disk = tmp_path / "disk"
        disk.mkdir()
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", disk],
            capture_output=True,
            check=False,
        )
        if mounted.returncode:
            pytest.skip("no right to mount a file system")
        try:
            tiny.launch(disk / "run", "collector.total_frames=100", "logger.backend=''")
            filler = disk / "filler"
            filler.write_bytes(bytes(shutil.disk_usage(disk).free - 2**18))
            error = self.fails(disk / "run", "The last checkpoint is whole")
            assert error.errno == errno.ENOSPC
            filler.unlink()
            tiny.launch(
                disk / "run", "collector.total_frames=200", "resume=true", "logger.backend=''"
            )
        finally:
            subprocess.run(["umount", "--lazy", disk], check=True)


def test_changed_checkpoint_is_refused(tmp_path):
    """A flipped bit, a missing or shortened file: the message names it, and no frame is run."""
    run_dir = tmp_path / "run"
    tiny.launch(run_dir, "collector.total_frames=100")
    files = sorted(file for file in (run_dir / "checkpoints").rglob("*.memmap"))
    log = (run_dir / "log" / "scalars" / "train" / "total_cvs.csv").read_text()
    for file, kind in ((files[0], "flipped"), (files[len(files) // 2], "short"), (files[-1], "")):
        whole = file.read_bytes()
        file.unlink()
        if kind:
            file.write_bytes(whole[:-1] if kind == "short" else bytes([whole[0] ^ 1]) + whole[1:])
        with pytest.raises(CheckpointError, match=f"{file} is not what was written"):
            tiny.launch(run_dir, "resume=true", "collector.total_frames=200")
        file.write_bytes(whole)
    assert (run_dir / "log" / "scalars" / "train" / "total_cvs.csv").read_text() == log
    tiny.launch(run_dir, "resume=true", "collector.total_frames=200")


def test_before_the_first_checkpoint(tmp_path):
    """A run killed that early begins again; with a checkpoint gone bad it does not."""
    run_dir = tmp_path / "run"
    tiny.launch(run_dir, "collector.total_frames=100")
    (run_dir / "results.json").unlink()
    newest = checkpoints.latest(run_dir)
    (newest / "manifest.json").write_text("{")
    with pytest.raises(CheckpointError, match=f"the manifest of {newest} cannot be read"):
        tiny.launch(run_dir, "resume=true", "collector.total_frames=200")
    shutil.rmtree(run_dir / "checkpoints")
    tiny.launch(run_dir, "resume=true", "collector.total_frames=200")
    steps, _ = record.read_metrics(run_dir / "log")["train/total_cvs"]
    assert steps.tolist() == [100, 200]


def test_killed_in_the_final_evaluation(tmp_path):
    """All frames, no results: the evaluation is done again, on the same layouts."""
    run_dir = tmp_path / "run"
    tiny.launch(run_dir, "collector.total_frames=100")
    first = json.loads((run_dir / "results.json").read_text())
    (run_dir / "results.json").unlink()
    for backend in ("single", "multi_sync"):
        tiny.launch(
            run_dir,
            "resume=true",
            "collector.total_frames=100",
            f"collector.backend={backend}",
            "collector.num_workers=2",
        )
        again = json.loads((run_dir / "results.json").read_text())
        assert again["eval/det/return"] == first["eval/det/return"]
        assert again["frames"] == 100
        (run_dir / "results.json").unlink()
