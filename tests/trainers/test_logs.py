"""A log that goes on as if nobody had stopped."""

from __future__ import annotations

import errno
import time

import pytest

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers.logs import Log, cut_csv
from torchrl_safe.trainers.options import Logger

FRAMES = [100, 200, 300, 400]


def config(backend):
    return Logger(backend=backend, project_name="tests")


def write(path, frames, backend="csv", after=0):
    """A part of a run that goes on from frame ``after``; the value is the frame."""
    log = Log(config(backend), path, after, finishing=False)
    for frame in frames:
        log.write({"train/cost": frame, "eval/det/score": -frame}, frame)
    log.close()


class TestCsv:
    def lines(self, path):
        return (path / "log/scalars/train/cost.csv").read_bytes()

    def test_beyond_the_checkpoint(self, tmp_path):
        """Killed at 300, gone on from the checkpoint of 200: every frame is there once."""
        write(tmp_path, FRAMES[:3])
        write(tmp_path, FRAMES[2:], after=200)
        assert self.lines(tmp_path) == b"100,100.0\n200,200.0\n300,300.0\n400,400.0\n"
        for steps, values in read_metrics(tmp_path / "log").values():
            assert steps.tolist() == FRAMES
            assert abs(values).tolist() == FRAMES

    @pytest.mark.parametrize("torn", [b"3", b"300", b"300,", b"300,30", b"200,2", b"\xff\x00"])
    def test_torn_line(self, tmp_path, torn):
        """The next line would be glued to it, and lost with it."""
        write(tmp_path, FRAMES[:2])
        file = tmp_path / "log/scalars/train/cost.csv"
        file.write_bytes(file.read_bytes() + torn)
        write(tmp_path, FRAMES[2:], after=200)
        assert read_metrics(tmp_path / "log")["train/cost"][0].tolist() == FRAMES

    def test_a_bad_byte_stays_and_costs_its_line_alone(self, tmp_path):
        write(tmp_path, FRAMES)
        file = tmp_path / "log/scalars/train/cost.csv"
        content = bytearray(file.read_bytes())
        content[content.index(b"200,200") + 5] ^= 0x80
        file.write_bytes(content)
        cut_csv(tmp_path / "log", 400)
        assert file.read_bytes() == content
        assert read_metrics(tmp_path / "log")["train/cost"][0].tolist() == [100, 300, 400]

    def test_final_evaluation_that_is_done_again(self, tmp_path):
        for frame in (200, 400):
            log = Log(config("csv"), tmp_path, frame, finishing=False)
            log.write({"final/score": frame, "train/cost": frame}, frame)
            log.close()
        cut_csv(tmp_path / "log", 400, finishing=True)
        metrics = read_metrics(tmp_path / "log")
        assert metrics["final/score"][0].tolist() == [200]
        assert metrics["train/cost"][0].tolist() == [200, 400]

    def test_full_disk(self, tmp_path, monkeypatch):
        log = Log(config("csv"), tmp_path, 0, finishing=False)

        def full(*args, **kwargs):
            raise OSError(errno.ENOSPC, "No space left on device")

        monkeypatch.setattr(log._logger, "log_metrics", full)
        with pytest.raises(OSError, match=r"needs 8 bytes.* there are \d+\. Free") as caught:
            log.write({"train/cost": 0.5}, 100)
        assert caught.value.errno == errno.ENOSPC
        assert caught.value.filename == str(tmp_path / "log")
        log.close()


def test_tensorboard_forgets(tmp_path):
    """As TensorBoard itself reads it: what the killed part logged beyond the checkpoint is gone."""
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    write(tmp_path, FRAMES[:3], "tensorboard")
    time.sleep(1.1)  # files are read in the order of their names, which count seconds
    write(tmp_path, FRAMES[2:], "tensorboard", after=200)
    events = EventAccumulator(str(tmp_path / "log")).Reload()
    assert [event.step for event in events.Scalars("train/cost")] == FRAMES


def test_wandb_has_one_id(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    for name, frames, after in (("a", [100], 0), ("a", [200], 100), ("b", [100], 0)):
        (tmp_path / name).mkdir(exist_ok=True)
        write(tmp_path / name, frames, "wandb", after)
    ids = {
        name: [
            path.name.rsplit("-", 1)[1] for path in (tmp_path / name).glob("wandb/offline-run-*")
        ]
        for name in "ab"
    }
    assert len(ids["a"]) == 2
    assert len(set(ids["a"])) == 1
    assert set(ids["a"]) != set(ids["b"])
    (tmp_path / "a" / "wandb_id").write_text("../../x\n")
    with pytest.raises(ValueError, match="wandb_id must hold 8 digits"):
        write(tmp_path / "a", [300], "wandb", 200)


def test_a_link_is_not_written_through(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "log").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="must be a folder, and is a link"):
        write(tmp_path / "run", [100])
    assert not list((tmp_path / "elsewhere").iterdir())
