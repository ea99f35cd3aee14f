"""The command line: what it passes on, and how it fails."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import tiny

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import cli

SIZES = [word for word in tiny.OVERRIDES if not word.startswith("env.num_envs")]


def command(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """``torchrl-safe`` in a process of its own, as it is started from a shell in a folder."""
    return subprocess.run(
        [sys.executable, "-c", "from torchrl_safe.trainers.cli import main; main()", *words],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2]), "PYTHONSAFEPATH": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.slow
def test_somebodys_environment_from_training_to_its_evaluation(tmp_path):
    """A module that lies where the command is started; trusted at once in training, later not."""
    (tmp_path / "mine.py").write_text(
        "def speed(td):\n    return td['next', 'observation'][..., 2:].abs()\n"
    )
    train = shlex.split(
        "train safetac env=gym env.id=Pendulum-v1 env.cost=mine:speed env.num_envs=2 "
        "loss.cost_limit=25 loss.limit_unit=episode collector.total_frames=200 run_dir=run"
    )
    done = command(tmp_path, *train, *SIZES)
    assert done.returncode == 0, done.stderr
    metrics = read_metrics(tmp_path / "run" / "log")
    assert metrics["update/cost_limit"][1][-1] >= 25
    refused = command(tmp_path, "evaluate", "run", "--episodes", "2", "--no-film")
    assert refused.returncode == 1
    assert "names code, env.cost=mine:speed" in refused.stderr
    assert "--trust" in refused.stderr
    assert "Traceback" not in refused.stderr
    done = command(tmp_path, "evaluate", "run", "--episodes", "2", "--no-film", "--trust")
    assert done.returncode == 0, done.stderr
    assert "det/return" in done.stdout
    assert (tmp_path / "run" / "evaluation" / "results.json").exists()
    done = command(tmp_path, "watch", "run", "--once")
    assert "200 of 200" in done.stdout, done.stderr


@pytest.mark.parametrize(
    ("words", "match"),
    [
        (["evaluate", "nowhere"], r"torchrl-safe evaluate: run_dir=nowhere holds no run"),
        (["watch", "nowhere", "--once"], r"torchrl-safe watch: run_dir=nowhere has no csv log"),
        (["export", "nowhere"], r"torchrl-safe export: run_dir=nowhere holds no run"),
        (["play", "nobody"], r"torchrl-safe play: name must be a run's folder or one of"),
        (["evaluate", "nowhere", "--env", "x"], r"--env must be module:function, got 'x'"),
    ],
)
def test_what_cannot_be_done(tmp_path, monkeypatch, words, match):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    with pytest.raises(SystemExit, match=match):
        cli.main(words)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["env=gym"], "env.id must name an environment for env=gym, got null."),
        (["env=gym", "env.id=Pendulum-v1"], "must have a cost 'cost' beside the reward"),
        (["env=gym", "env.id=Pendulm-v1"], "env.id=Pendulm-v1: Environment `Pendulm` doesn't"),
        (["env=gym", "env.id=Pendulum-v1", "env.cost=mine:speed"], "No module named 'mine'"),
        (["loss.cost_limit=-1"], "loss.cost_limit must be a number in [0, inf)"),
        (["resume=true"], "holds no run to resume from"),
        (["loss.cost_limt=1"], "Key 'cost_limt' is not in struct"),
    ],
)
def test_what_cannot_be_trained(tmp_path, monkeypatch, capsys, words, message):
    """A message, and no trace through the library."""
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit):
        cli.train("cpo", words)
    said = capsys.readouterr().err
    assert message in said
    assert "Traceback" not in said


def test_failure_of_somebodys_function_is_shown_with_its_place(tmp_path, monkeypatch, capsys):
    (tmp_path / "torn.py").write_text("def make():\n    raise ValueError('torn')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SystemExit):
        cli.train("cpo", ["env=torn:make"])
    assert 'torn.py", line 2, in make' in capsys.readouterr().err


def test_unknown_method(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "ppo"])
    assert "'safetac'" in capsys.readouterr().err


def test_options_of_training_are_passed_on(monkeypatch):
    passed = []
    monkeypatch.setattr(cli, "train", lambda *args: passed.append(args))
    monkeypatch.setattr(sys, "path", [*sys.path])
    cli.main(["train", "cpo", "--multirun", "seed=0,1", "env=gym"])
    assert passed == [("cpo", ["--multirun", "seed=0,1", "env=gym"])]
