"""A folder is one run, before anything is built."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
import tiny
import torch

from torchrl_safe.trainers import run as runs
from torchrl_safe.trainers.run import Run, plain, write_results

REPOSITORY = Path(__file__).parents[2]


def start(path: Path, *overrides: str) -> Run:
    run = Run(tiny.options(path, *overrides))
    run.start()
    return run


def begin(path: Path, *overrides: str) -> None:
    """A run that is killed before its first checkpoint."""
    with Run(tiny.options(path, *overrides)) as run:
        run.restore()


class TestFolder:
    @pytest.mark.parametrize("second", [(), ("seed=1",), ("resume=true",)])
    def test_is_taken_by_a_start(self, tmp_path, second):
        first = start(tmp_path)
        with pytest.raises(FileExistsError, match=f"run_dir={tmp_path} is taken.*process"):
            start(tmp_path, *second)
        first.close()

    def test_is_taken_by_a_resumed_run(self, tmp_path):
        begin(tmp_path)
        first = start(tmp_path, "resume=true")
        with pytest.raises(FileExistsError, match="is taken"):
            start(tmp_path, "resume=true")
        first.close()
        start(tmp_path, "resume=true").close()

    def test_is_free_when_a_start_fails(self, tmp_path):
        begin(tmp_path)
        with pytest.raises(FileExistsError, match="holds a run already"):
            start(tmp_path)
        start(tmp_path, "resume=true").close()

    @pytest.mark.parametrize("resume", ["resume=true", "resume=false"])
    def test_checkpoints_of_nobody_knows_what(self, tmp_path, resume):
        with Run(tiny.options(tmp_path)) as run:
            run.restore(weight=torch.nn.Linear(1, 1))
            run.save()
        (tmp_path / "config.yaml").unlink()
        with pytest.raises(FileExistsError, match=r"checkpoints but no config\.yaml"):
            start(tmp_path, resume)

    def test_other_names_are_no_checkpoints(self, tmp_path):
        (tmp_path / "checkpoints" / "checkpoint-best").mkdir(parents=True)
        start(tmp_path).close()

    def test_tilde_is_home(self, tmp_path, monkeypatch):
        monkeypatch.setenv("HOME", str(tmp_path / "home"))
        monkeypatch.chdir(tmp_path)
        begin(Path("'~/runs/x'"))
        assert (tmp_path / "home" / "runs" / "x" / "config.yaml").exists()
        assert [path.name for path in tmp_path.iterdir()] == ["home"]


class TestFinished:
    def finish(self, path: Path, frames: int, results: str) -> None:
        with Run(tiny.options(path, "collector.total_frames=200")) as run:
            run.restore()
            run.counters["frames"] = frames
            run.save()
        (path / "results.json").write_text(results)

    @pytest.mark.parametrize(
        ("frames", "results", "more", "finished"),
        [
            (200, '{"frames": 200}', (), True),
            (200, '{"frames": 200}', ("collector.total_frames=100",), True),
            (200, '{"frames": 200}', ("collector.total_frames=300",), False),
            (200, '{"frames": 200}', ("eval.final_episodes=3",), False),
            (200, '{"frames": 100}', (), False),
            (200, '{"frames": 2', (), False),
            (200, "[]", (), False),
            (100, '{"frames": 100}', (), False),
        ],
    )
    def test_is_it(self, tmp_path, frames, results, more, finished):
        """Results of fewer frames, or torn ones, keep no run from being finished."""
        self.finish(tmp_path, frames, results)
        overrides = ("resume=true", "collector.total_frames=200", *more)
        with Run(tiny.options(tmp_path, *overrides)) as run:
            run.restore()
            assert run.frames == frames
            assert run.finished == finished


class TestHarmless:
    def test_curves(self, tmp_path, monkeypatch, capsys):
        def fails(*args):
            raise MemoryError("no paper")

        monkeypatch.setattr(runs, "plot_learning_curves", fails)
        run = start(tmp_path)
        run.plot()
        run.plot()
        run.close()
        assert capsys.readouterr().out == "no curves: MemoryError: no paper\n"

    def test_results_are_json(self, tmp_path):
        values = {"a": float("nan"), "b": [1.5, -float("inf")], "c": {"d": 2, "e": None, "f": "x"}}
        write_results(tmp_path / "results.json", values)
        text = (tmp_path / "results.json").read_text()
        read = json.loads(text, parse_constant=pytest.fail)
        assert read == {"a": None, "b": [1.5, None], "c": {"d": 2, "e": None, "f": "x"}}
        assert plain(True) is True


def test_as_a_module_and_as_a_sweep(tmp_path):
    """``python -m`` from the clone finds its files; a sweep leaves nothing but its runs."""
    arguments = ["-m", "examples.safetac_point", "--multirun", "seed=0,1", *tiny.OVERRIDES]
    arguments += ["collector.total_frames=100", f"run_dir={tmp_path}/runs/${{seed}}"]
    result = subprocess.run(
        [sys.executable, *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert not list(tmp_path.rglob("multirun.yaml"))
    assert not (REPOSITORY / "multirun").exists()
    assert sorted(path.name for path in (tmp_path / "runs").iterdir()) == ["0", "1"]
