"""Files that are written whole, read with limits, and named so that a terminal only shows them."""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import stat
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure
from tensordict import TensorDict
from test_video import FilmedEnv
from torch import nn
from torchrl.data import Bounded

from torchrl_safe import GMMTanhPolicy, _files
from torchrl_safe.modules import export_policy
from torchrl_safe.record import (
    calibrate,
    format_table,
    plot_calibration,
    plot_learning_curves,
    plot_trajectories,
    read_metrics,
    record_video,
)


def curves(path):
    return plot_learning_curves(Path(os.path.expanduser(path)).parent, path)


def trajectories(path):
    points = np.zeros((3, 2))
    none = np.empty((0, 2))
    inside = np.zeros(3, bool)
    trajectory = {"path": points, "goals": points[:1], "hazards": none, "boxes": none}
    return plot_trajectories([trajectory | {"violation": inside}], path)


def calibration(path):
    x = torch.rand(4, 400, generator=torch.Generator().manual_seed(0))
    return plot_calibration(calibrate(x, x, x, gamma=0.9, risk_level=0.5, num_bins=3), path)


def video(path):
    env = FilmedEnv()
    return record_video(env, env.rand_action, path, num_steps=2, every=1, width=32, height=32)


def exported(path):
    policy = GMMTanhPolicy(nn.Linear(5, 15), Bounded(-1.0, 1.0, (2,)), num_components=3)
    return export_policy(policy, path, TensorDict(observation=torch.zeros(1, 5), batch_size=1))


WRITERS = [
    pytest.param(curves, "curves.png", id="curves"),
    pytest.param(trajectories, "trajectories.svg", id="trajectories"),
    pytest.param(calibration, "calibration.pdf", id="calibration"),
    pytest.param(video, "video.mp4", id="video"),
    pytest.param(exported, "policy.pt2", id="export"),
]


@pytest.mark.parametrize(("write", "name"), WRITERS)
class TestWriters:
    def test_a_link_is_replaced_and_not_followed(self, tmp_path, write, name):
        outside = tmp_path / "outside"
        outside.write_text("precious")
        folder = tmp_path / "folder"
        folder.mkdir()
        (folder / name).symlink_to(outside)
        path = write(folder / name)
        assert path == folder / name
        assert not path.is_symlink()
        assert path.stat().st_size > 100
        assert outside.read_text() == "precious"
        assert [file.name for file in folder.iterdir()] == [name]

    def test_tilde_is_home(self, tmp_path, monkeypatch, write, name):
        home, here = tmp_path / "home", tmp_path / "here"
        for folder in (home, here):
            folder.mkdir()
        monkeypatch.setenv("HOME", str(home))
        monkeypatch.chdir(here)
        assert write(f"~/{name}") == home / name
        assert (home / name).exists()
        assert not list(here.iterdir())

    def test_everybody_may_read_what_the_umask_allows(self, tmp_path, write, name):
        before = os.umask(0o022)
        try:
            path = write(tmp_path / name)
        finally:
            os.umask(before)
        assert stat.S_IMODE(path.stat().st_mode) == 0o644


def test_failed_drawing_keeps_the_old_picture(tmp_path, monkeypatch):
    path = tmp_path / "curves.png"
    path.write_bytes(b"old")

    def fail(self, file, **_):
        Path(file).write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(OSError, match="No space left"):
        plot_learning_curves(tmp_path, path)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_pictures_are_whole_for_whoever_reads_them(tmp_path):
    path = plot_learning_curves(tmp_path, tmp_path / "curves.png")

    def draw():
        for _ in range(8):
            plot_learning_curves(tmp_path, path)

    writers = [threading.Thread(target=draw) for _ in range(2)]
    for writer in writers:
        writer.start()
    reads = 0
    while any(writer.is_alive() for writer in writers):
        assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
        reads += 1
        time.sleep(0.001)
    assert reads > 10


class TestLogs:
    def log(self, folder, name, content: bytes):
        file = folder / "scalars" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)
        return file

    @pytest.mark.parametrize("bit", range(8))
    @pytest.mark.parametrize("position", range(7))
    def test_one_flipped_bit_costs_one_line(self, tmp_path, bit, position):
        """Every other line is read; the broken one is skipped, or a number like any other."""
        content = bytearray(b"100,1.5\n200,2.5\n300,3.5\n400,4.5\n")
        content[8 + position] ^= 1 << bit
        self.log(tmp_path, "x.csv", bytes(content))
        steps, values = read_metrics(tmp_path)["x"]
        read = dict(zip(steps.tolist(), values.tolist(), strict=True))
        assert read.items() >= {300: 3.5, 400: 4.5}.items()
        assert (np.diff(steps) > 0).all()

    @pytest.mark.parametrize(
        "line", [b"\xff,1", b"1,\xff", b"1" * 5_000 + b",1", b"1e3,1", b"9" * 19 + b",1", b"-5,1",
                 b"", b",", b"1,2,3", b"\0\0\0", "\u2028".encode(), b"nan,1"]
    )  # fmt: skip
    def test_lines_that_are_none(self, tmp_path, line):
        self.log(tmp_path, "x.csv", b"100,1.5\n" + line + b"\n200,2.5\n")
        steps, values = read_metrics(tmp_path)["x"]
        assert steps.tolist() == [100, 200]
        assert values.tolist() == [1.5, 2.5]

    @pytest.mark.filterwarnings("ignore::RuntimeWarning")
    @pytest.mark.parametrize("value", ["inf", "-inf", "nan", "1e308", "-1e308", "5e-324"])
    def test_any_number_can_be_drawn(self, tmp_path, value):
        for name in ("eval/score", "eval/score_low", "eval/score_high", "train/cv_rate"):
            lines = f"100,1.5\n200,{value}\n{2**63 - 1},-{value.lstrip('-')}\n"
            self.log(tmp_path, f"{name}.csv", lines.encode())
        assert plot_learning_curves(tmp_path, tmp_path / "curves.png").stat().st_size > 1_000

    @pytest.mark.parametrize("kind", ["link", "folder link", "pipe", "scalars"])
    def test_only_regular_files_are_read(self, tmp_path, kind):
        folder = tmp_path / "log"
        file = self.log(folder, "x.csv", b"100,1.5\n")
        match kind:
            case "link":
                file.with_name("y.csv").symlink_to(file)
            case "folder link":
                file.with_name("y").symlink_to(tmp_path)
            case "pipe":
                os.mkfifo(file.with_name("y.csv"))
            case "scalars":
                file.parent.rename(tmp_path / "elsewhere")
                file.parent.symlink_to(tmp_path / "elsewhere")
        with pytest.raises(ValueError, match=r"must be .*, and is a (link|pipe)"):
            read_metrics(folder)

    def test_size_is_limited(self, tmp_path):
        os.truncate(self.log(tmp_path, "x.csv", b""), 2**40)
        with pytest.raises(ValueError, match=r"x\.csv is larger than 33,554,432 bytes"):
            read_metrics(tmp_path)

    def test_number_of_files_is_limited(self, tmp_path, monkeypatch):
        for i in range(5):
            self.log(tmp_path, f"{i}.csv", b"1,1\n")
        monkeypatch.setattr(_files, "MAX_ENTRIES", 4)
        with pytest.raises(ValueError, match="more than 4 files"):
            read_metrics(tmp_path)

    def test_home(self, tmp_path, monkeypatch):
        self.log(tmp_path, "x.csv", b"100,1.5\n")
        monkeypatch.setenv("HOME", str(tmp_path))
        assert read_metrics("~").keys() == {"x"}


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("plain name-1.0", "plain name-1.0"),
        ("Läufe/実験", "Läufe/実験"),
        ("\x1b[2J", r"\x1b[2J"),
        ("\x9b2J", r"\x9b2J"),
        ("a\nb\rc\td", r"a\nb\rc\td"),
        ("\u202eabc", r"\u202eabc"),
        ("a\u200bb", r"a\u200bb"),
        ("\udcff", r"\udcff"),
        ("\U000e0041", r"\U000e0041"),
    ],
)
def test_names_are_shown_and_not_obeyed(text, shown):
    assert _files.printable(text) == shown
    assert format_table({text: text}) == f"{shown}  {shown}"
    shown.encode()


def test_text_is_utf_8_with_plain_newlines(tmp_path, monkeypatch):
    """Whatever the locale: as on Windows, where text files are others unless one says so."""
    monkeypatch.setattr("locale.getpreferredencoding", lambda *_: "cp1252")
    _files.write_atomically(tmp_path / "a", "Läufe 実験\n")
    assert (tmp_path / "a").read_bytes() == b"L\xc3\xa4ufe \xe5\xae\x9f\xe9\xa8\x93\n"


def test_what_is_synced_may_be_written(tmp_path, monkeypatch):
    """Windows refuses to sync a descriptor that was opened to read; and opens no folders."""
    synced, fsync = [], os.fsync

    def strict(descriptor):
        if fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY:
            raise OSError(errno.EBADF, "Bad file descriptor")
        synced.append(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", strict)
    _files.write_atomically(tmp_path / "a", "text")
    assert synced == [(tmp_path / "a").stat().st_ino]


def test_folder_is_synced_after_the_new_name(tmp_path, monkeypatch):
    calls, fsync, replace = [], os.fsync, os.replace

    def note(descriptor):
        calls.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", note)
    monkeypatch.setattr(os, "replace", lambda *names: (calls.append("name"), replace(*names)))
    _files.write_atomically(tmp_path / "a", "text")
    assert calls == ["file", "name", "folder"]


def test_json_is_what_it_says(tmp_path):
    path = tmp_path / "a.json"
    value = {"a": [1, 2.5, None, True, "ü"], "b": {"c": {}}}
    path.write_text(json.dumps(value))
    assert _files.read_json(path) == value
    path.write_text("[Infinity]")
    assert _files.read_json(path) == [math.inf]
    with pytest.raises(_files.FileRefusedError, match="larger than 5 bytes"):
        _files.read_json(path, limit=5)
    with pytest.raises(FileNotFoundError):
        _files.read_json(tmp_path / "b.json")


def test_what_took_the_place_of_a_file_is_not_read(tmp_path, monkeypatch):
    """Between the look and the opening, somebody puts a link there."""
    path, secret = tmp_path / "a", tmp_path / "secret"
    path.write_text("a")
    secret.write_text("secret")
    open_ = os.open

    def late(name, flags, *mode):
        path.unlink()
        path.symlink_to(secret)
        return open_(name, flags, *mode)

    monkeypatch.setattr(os, "open", late)
    with pytest.raises(OSError, match="Too many levels of symbolic links"):
        _files.read_bytes(path, 100)


def test_devices_are_no_files():
    with pytest.raises(_files.FileRefusedError, match=r"/dev/zero must be .*, and is a device"):
        _files.read_bytes(Path("/dev/zero"), 100)
    with pytest.raises(_files.FileRefusedError, match="must be a folder, and is a device"):
        _files.regular_files(Path("/dev/null"))
