"""What fills a table: which cells are missing, what happens to each, and what it will cost."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import NamedTuple

import fill
import numpy as np
import pytest
from side_by_side import Job, run_jobs


class Cell(NamedTuple):
    name: str
    frames: int = 7_200_000
    method: str = "cpo"

    @property
    def path(self):
        return Path(self.name, "seed_0")

    @property
    def words(self):
        return [self.method, f"name={self.name}"]


def table(tmp_path, result=lambda cell, run_dir: {"name": cell.name}):
    """Runs that write their product, in this process."""

    def here(line):
        (run_dir,) = (Path(word.removeprefix("run_dir=")) for word in line if "run_dir" in word)
        run_dir.mkdir(parents=True)
        (run_dir / "results.json").touch()

    return fill.Table(
        tmp_path / "results", tmp_path / "runs", lambda cell: ["x", *cell.words], result, here=here
    )


def test_each_missing_cell_is_run_once(tmp_path, capsys):
    filled = table(tmp_path)
    cells = [Cell("a"), Cell("b"), Cell("a")]
    assert filled.fill(cells[:1], 1, 1) == 0
    assert filled.missing(cells) == [Cell("b")]
    capsys.readouterr()
    assert filled.fill(cells, 1, 1) == 0
    out = capsys.readouterr().out
    assert out.startswith("1 of 2 cells have a result\n")
    assert out.count("kept") == 1
    assert json.loads((tmp_path / "results/b/seed_0.json").read_text()) == {"name": "b"}
    (launch,) = fill.launches_of(tmp_path / "runs/b/seed_0").read_text().splitlines()
    assert json.loads(launch)["jobs"] == 1


def test_one_that_is_refused_does_not_stop_the_others(tmp_path, capsys):
    def result(cell, run_dir):
        if cell.name == "a":
            raise ValueError("a run of other options")
        return {}

    filled = table(tmp_path, result)
    assert filled.fill([Cell("a"), Cell("b")], 1, 1) == 1
    assert "refused   a run of other options" in capsys.readouterr().out
    assert filled.missing([Cell("a"), Cell("b")]) == [Cell("a")]


def test_dry_run_touches_nothing(tmp_path, capsys):
    assert table(tmp_path).fill([Cell("a")], 1, 1, dry_run=True) == 0
    assert f"x cpo name=a run_dir={tmp_path}/runs/a/seed_0\n" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_hours_are_those_of_what_is_kept(tmp_path):
    """Two runs at 2,000 frames per second, of which one diverged later: an hour for the next."""
    filled = table(tmp_path)
    kept = {
        "command": "torchrl-safe train cpo",
        "frames": 8_000,
        "seconds": 3.0,
        "evaluation_seconds": 1.0,
    }
    fill.write(filled.file(Cell("a")), kept)
    fill.write(filled.file(Cell("b")), {"diverged": "it did"})
    assert filled.core_hours([("cpo", 7_200_000)]) == pytest.approx(1.0)
    # Of which nothing is known: as slow as the slowest of all that is recorded.
    slowest = min({**fill.recorded_speeds(), "cpo": 2_000.0}.values())
    assert filled.core_hours([("new", 3_600)]) == pytest.approx(1 / slowest)
    assert fill.recorded_speeds().keys() >= {"safetac", "cpo", "trc", "wcsac"}


def test_evaluations_are_no_part_of_learning():
    metrics = {
        "time/seconds": (np.array([100, 200, 300]), np.array([1.0, 5.0, 6.0])),
        "time/eval": (np.array([200]), np.array([3.0])),
    }
    learning, evaluating = fill.learning_seconds(metrics)
    assert learning.tolist() == [1.0, 2.0, 3.0]
    assert evaluating == 3.0


def test_a_stop_reaches_what_runs_and_begins_nothing_more(tmp_path):
    wait = (sys.executable, "-c", "import time; time.sleep(60)")
    jobs = [Job(name, tmp_path / name, wait) for name in ("a", "b")]
    begun = []

    def before(job):
        begun.append(job.name)
        threading.Timer(1.0, os.kill, (os.getpid(), signal.SIGINT)).start()

    with pytest.raises(SystemExit, match="the same command goes on"):
        run_jobs(jobs, at_once=1, before=before)
    assert begun == ["a"]
