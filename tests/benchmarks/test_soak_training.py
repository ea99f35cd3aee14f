"""The watch over long trainings: it sees what grows, and only that."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import soak_training
from soak_training import Sample

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")

FULL = 1000  # frames
# Fills its replay for the first 20 of 120 minutes, then only works.
STEADY = [
    Sample(
        minutes=float(minute),
        frames=50 * minute,
        processes=2,
        memory_mb=500 + 20 * min(minute, 20) + minute % 3,
        files=60 + minute % 5,
        cpu_seconds=2.0 * minute,
    )
    for minute in range(121)
]
SPEED = 1000 + 50 * np.sin(np.arange(300))


def verdicts(samples, speed=SPEED):
    rows = soak_training.judge(samples, speed, settled_at=FULL)
    return {row.quantity: row for row in rows}


def failed(samples, speed=SPEED):
    return {name for name, row in verdicts(samples, speed).items() if row.passed is False}


class TestVerdict:
    def test_filling_a_buffer_is_no_leak(self):
        assert failed(STEADY) == set()
        assert verdicts(STEADY)["processor seconds per 1000 frames"].first == pytest.approx(40)

    @pytest.mark.parametrize(("per_hour", "fails"), [(0.01, False), (0.02, True)])
    def test_leak(self, per_hour, fails):
        """Growth between the medians of two tenths, which are 90 of 100 minutes apart."""
        leaking = [
            replace(s, memory_mb=900 * (1 + per_hour * (s.minutes - 20) / 60)) for s in STEADY
        ]
        assert failed(leaking) == ({"resident memory, MB"} if fails else set())
        change = verdicts(leaking)["resident memory, MB"].change
        assert change == pytest.approx(per_hour * 1.5, rel=0.02)

    def test_one_more_open_file_in_the_end(self):
        growing = [replace(s, files=s.files + (s.minutes > 100)) for s in STEADY]
        assert failed(growing) == {"open files"}

    @pytest.mark.parametrize(("loss", "fails"), [(0.08, False), (0.12, True)])
    def test_slower_in_the_end(self, loss, fails):
        slower = SPEED * np.linspace(1, 1 - loss / 0.9, len(SPEED))
        assert failed(STEADY, slower) == ({"frames/s"} if fails else set())

    def test_an_evaluation_is_no_slowdown(self):
        speed = SPEED.copy()
        speed[-1] = 10
        assert failed(STEADY, speed) == set()

    @pytest.mark.parametrize(("samples", "updates"), [(STEADY[:25], 300), (STEADY, 5)])
    def test_too_short(self, samples, updates):
        with pytest.raises(ValueError, match="watch longer"):
            verdicts(samples, SPEED[:updates])


class TestSamples:
    def test_counts_what_a_process_and_its_worker_hold(self):
        """An open file and 64 MB in a child of the watched process."""
        worker = (
            "import sys; held = bytearray(b'x' * 2**26); opened = open('/dev/null');"
            "print(flush=True); sys.stdin.read()"
        )
        parent = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {worker!r}])"
        empty = worker.replace("2**26", "1").replace("opened = open('/dev/null')", "0")
        memory, files = [], []
        for program in (parent, parent.replace(repr(worker), repr(empty))):
            process = subprocess.Popen(
                [sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
            process.stdout.readline()
            sample = soak_training.take_sample(0.0, 0, process.pid)
            assert soak_training.is_running(process.pid)
            process.communicate()
            assert not soak_training.is_running(process.pid)
            assert sample.processes == 2
            assert sample.cpu_seconds > 0
            memory.append(sample.memory_mb)
            files.append(sample.files)
        assert memory[0] - memory[1] == pytest.approx(64, abs=3)
        assert files[0] - files[1] == 1

    def test_a_zombie_does_not_run(self):
        process = subprocess.Popen([sys.executable, "-c", ""])
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        assert not soak_training.is_running(process.pid)
        process.wait()

    def test_log_that_is_being_written(self, tmp_path):
        file = tmp_path / soak_training.FRAMES_PER_SECOND
        assert soak_training.logged_frames(tmp_path) == 0
        file.parent.mkdir(parents=True)
        file.write_text("".join(f"{8000 * i},{100.0 + i}\n" for i in range(1, 50)) + "4000")
        assert soak_training.logged_frames(tmp_path) == 8000 * 49
        speed = soak_training.logged_speed(tmp_path, since=8000 * 46)
        assert speed.tolist() == [147.0, 148.0, 149.0]

    def test_watches_until_the_process_ends(self, tmp_path, capsys):
        process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(0.5)"])
        table = tmp_path / "soak.csv"
        samples = soak_training.watch({tmp_path: process.pid}, 1.0, 0.05, table)
        process.wait()
        assert f"process {process.pid} ended" in capsys.readouterr().out
        assert len(table.read_text().splitlines()) == len(samples[tmp_path]) + 1 > 2
