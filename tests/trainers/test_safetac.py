from __future__ import annotations

import contextlib
import itertools
import json
import os
import pty
import signal
import subprocess
import sys
from pathlib import Path

import hydra
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from torchrl_safe import record
from torchrl_safe.trainers import SafeTAC, cli, logs, trainer

EXAMPLES = Path(__file__).parents[2] / "examples"
TINY = [
    "num_threads=1",
    "env.num_envs=20",
    "env.episode_length=50",
    "collector.frames_per_batch=400",
    "collector.init_frames=400",
    "replay_buffer.size=10000",
    "optim.critic_rounds=1",
    "optim.critic_frames=400",
    "optim.policy_frames=100",
    "eval.interval=800",
    "eval.num_episodes=2",
    "eval.num_steps=20",
    "eval.final_episodes=2",
    "checkpoint.interval=400",
    "video.num_steps=0",
]


def launch(run_dir: Path, *overrides: str) -> None:
    options = cli.compose("safetac", [f"run_dir={run_dir}", *TINY, *overrides])
    SafeTAC(options=options).train()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    launch(run_dir, "collector.total_frames=1600")
    return run_dir


@pytest.fixture
def interrupted(monkeypatch):
    """Make a run meet a signal in the middle of its third iteration."""

    def interrupt(number: signal.Signals) -> None:
        calls = itertools.count(1)

        def count_violations(batch):
            if next(calls) == 3:
                signal.raise_signal(number)
            return record.count_violations(batch)

        monkeypatch.setattr(trainer, "count_violations", count_violations)

    return interrupt


class TestRun:
    def test_files(self, finished):
        assert (finished / "curves.png").stat().st_size > 5_000
        config = OmegaConf.load(finished / "config.yaml")
        assert config.collector.total_frames == 1600
        assert config.run_dir == str(finished)  # resolved

    def test_results(self, finished):
        results = json.loads((finished / "results.json").read_text())
        assert results["frames"] == 1600
        assert results["frames_per_second"] > 0
        for name in ("score", "cv_rate", "return"):
            assert f"eval/{name}" in results
            assert f"eval/det/{name}" in results

    def test_metrics(self, finished):
        curves = record.read_metrics(finished / "log")
        assert curves["train/total_cvs"][0].tolist() == [400, 800, 1200, 1600]
        assert curves["eval/det/score"][0].tolist() == [800, 1600]
        for name in (
            "train/reward_per_1000",
            "train/cost_rate",
            "train/entropy",
            "update/cost_level",
            "update/kl",
            "update/case_code",
            "update/loss_cost_quantiles",
            "time/frames_per_second",
            "time/critics",
        ):
            assert len(curves[name][0])

    def test_what_is_logged_is_not_kept(self, tmp_path, monkeypatch):
        """TorchRL's csv logger remembers every value of a run: memory grew with its length."""
        made = []

        class Logger(logs.CSVLogger):
            def __init__(self, *args, **kwargs):
                super().__init__(*args, **kwargs)
                made.append(self)

        monkeypatch.setattr(logs, "CSVLogger", Logger)
        launch(tmp_path / "run", "collector.total_frames=800")
        assert len(record.read_metrics(tmp_path / "run" / "log")["train/entropy"][0]) == 2
        assert not made[0].experiment.scalars

    def test_same_seed_same_metrics(self, finished, tmp_path, capsys):
        again = tmp_path / "again"
        launch(again, "collector.total_frames=1600")
        out = capsys.readouterr()
        assert "total CVs in training" in out.out
        for name in (" left, ", "/s, return ", "cost ", "violations "):
            assert name in out.err
        first, second = (record.read_metrics(path / "log") for path in (finished, again))
        assert first.keys() == second.keys()
        for name in first:
            if not name.startswith("time/"):
                torch.testing.assert_close(
                    first[name][1], second[name][1], rtol=0, atol=0, equal_nan=True, msg=name
                )

    def test_nothing_left_to_do(self, finished, capsys):
        """A sweep that is started again passes over the runs that it has finished."""
        before = {file: file.read_bytes() for file in finished.rglob("*") if file.is_file()}
        launch(finished, "collector.total_frames=1600", "resume=true")
        assert "total_frames=1600 leaves nothing to do" in capsys.readouterr().out
        after = {file: file.read_bytes() for file in finished.rglob("*") if file.is_file()}
        assert before.pop(finished / ".lock")
        assert after.pop(finished / ".lock")
        assert after == before

    def test_refuses_to_mix_runs(self, finished):
        before = (finished / "results.json").read_bytes()
        with pytest.raises(FileExistsError, match="resume=true"):
            launch(finished, "collector.total_frames=800")
        assert (finished / "results.json").read_bytes() == before


class TestResume:
    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_interruption(self, tmp_path, capsys, interrupted, number):
        run_dir = tmp_path / "run"
        handler = signal.getsignal(number)
        interrupted(number)
        launch(run_dir, "collector.total_frames=40000", "checkpoint.interval=100000")
        assert "stopped at 1200 frames" in capsys.readouterr().out
        assert signal.getsignal(number) is handler
        before = record.read_metrics(run_dir / "log")["train/total_cvs"]
        assert before[0].tolist() == [400, 800, 1200]

        launch(run_dir, "collector.total_frames=2000", "resume=true")
        steps, total = record.read_metrics(run_dir / "log")["train/total_cvs"]
        assert steps.tolist() == [400, 800, 1200, 1600, 2000]
        assert total[:3].tolist() == before[1].tolist()
        assert (total[1:] >= total[:-1]).all()
        assert json.loads((run_dir / "results.json").read_text())["frames"] == 2000

    def test_continues_exactly(self, finished, tmp_path, interrupted):
        """Interrupted in the middle of episodes, and resumed: the same metrics to the last bit."""
        run_dir = tmp_path / "run"
        interrupted(signal.SIGINT)
        launch(run_dir, "collector.total_frames=1600", "checkpoint.interval=100000")
        launch(run_dir, "collector.total_frames=1600", "resume=true")
        whole, parts = (record.read_metrics(path / "log") for path in (finished, run_dir))
        assert whole.keys() == parts.keys()
        for name in whole:
            if not name.startswith("time/"):
                for expected, got in zip(whole[name], parts[name], strict=True):
                    np.testing.assert_array_equal(got, expected, err_msg=name)
        first, second = (json.loads((p / "results.json").read_text()) for p in (finished, run_dir))
        for name in first.keys() - {"seconds", "frames_per_second"}:
            assert first[name] == second[name]

    def test_nothing_to_resume(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="holds no run to resume from"):
            launch(tmp_path / "run", "resume=true")
        assert not (tmp_path / "run").exists()


class TestReplay:
    def test_memmap_learns_the_same_and_resumes(self, finished, tmp_path):
        """Files in place of memory change no number, also across an interruption's checkpoint."""
        run_dir = tmp_path / "run"
        launch(run_dir, "collector.total_frames=1200", "replay_buffer.storage=memmap")
        assert list((run_dir / "replay").glob("*.memmap"))
        first, second = (record.read_metrics(path / "log") for path in (finished, run_dir))
        for name in ("update/loss_qvalue", "update/kl", "train/total_cvs"):
            torch.testing.assert_close(
                first[name][1][:3], second[name][1], rtol=0, atol=0, msg=name
            )
        more = ["collector.total_frames=2000", "replay_buffer.storage=memmap", "resume=true"]
        launch(run_dir, *more)
        losses = record.read_metrics(run_dir / "log")["update/loss_qvalue"]
        assert losses[0].tolist() == [400, 800, 1200, 1600, 2000]


def test_runs_side_by_side(tmp_path):
    """A sweep from the command line: every run has its folder, its seed and its results."""
    more = ["collector.total_frames=400", "seed=0,1", "run_dir=runs/seed_${seed}"]
    side_by_side = ["--multirun", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    result = subprocess.run(
        [sys.executable, str(EXAMPLES / "safetac_point.py"), *side_by_side, *TINY, *more],
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
        cwd=tmp_path,
    )
    assert result.returncode == 0, result.stderr
    runs = [tmp_path / "runs" / f"seed_{seed}" for seed in range(2)]
    assert [OmegaConf.load(run / "config.yaml").seed for run in runs] == [0, 1]
    first, second = (json.loads((run / "results.json").read_text()) for run in runs)
    assert first["frames"] == second["frames"] == 400
    assert first["eval/return"] != second["eval/return"]


class TestLoggers:
    def test_tensorboard(self, tmp_path):
        launch(tmp_path / "run", "collector.total_frames=400", "logger.backend=tensorboard")
        assert list((tmp_path / "run").rglob("events.out.tfevents.*"))

    def test_none(self, tmp_path):
        launch(tmp_path / "run", "collector.total_frames=400", "logger.backend=''")
        assert not (tmp_path / "run" / "log").exists()

    def test_command_line_with_wandb_offline(self, tmp_path):
        """The script as a user starts it, with no account, no terminal, no settings."""
        env = {k: v for k, v in os.environ.items() if not k.startswith("WANDB")}
        more = ["collector.total_frames=400", "logger.backend=wandb", "video.num_steps=4"]
        result = subprocess.run(
            [sys.executable, str(EXAMPLES / "safetac_point.py"), "run_dir=run", *TINY, *more],
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
            stdin=subprocess.DEVNULL,
            env={**env, "HOME": str(tmp_path)},
            cwd=tmp_path,
        )
        assert result.returncode == 0, result.stderr
        assert list((tmp_path / "run").rglob("offline-run-*"))
        assert (tmp_path / "run" / "video.mp4").exists() or "no video" in result.stdout

    def test_online_without_an_account_asks_nothing(self, tmp_path):
        """On a terminal, where wandb would offer to make an account, and wait."""
        env = {k: v for k, v in os.environ.items() if not k.startswith("WANDB")}
        env |= {"WANDB_MODE": "online", "HOME": str(tmp_path), "TERM": "xterm"}
        backend = ["logger.backend=wandb"]
        ours, terminal = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, EXAMPLES / "safetac_point.py", "run_dir=run", *TINY, *backend],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env=env,
            cwd=tmp_path,
        )
        os.close(terminal)
        said = b""
        with contextlib.suppress(OSError):  # how Linux says that nobody holds the terminal any more
            while b"choice" not in said and (more := os.read(ours, 1024)):
                said += more
        os.close(ours)
        process.kill()
        process.wait()
        assert b"choice" not in said
        assert b"wandb login" in said
        assert not (tmp_path / "run" / "config.yaml").exists()


class TestMisuse:
    @pytest.mark.parametrize(
        ("override", "message"),
        [
            ("loss.cost_limt=1", "cost_limt"),
            ("+loss.cost_limt=1", "cost_limt is not an option; there are loss.cost_limit"),
            ("loss.cost_limit=-1", r"cost_limit must be a number in \[0, inf\), .*, got -1"),
            ("env.robot=unicycle", "unicycle"),
            ("replay_buffer.storage=disk", "storage must be one of 'memory', 'memmap', got 'disk'"),
        ],
    )
    def test_message(self, tmp_path, override, message):
        with pytest.raises((ValueError, hydra.errors.ConfigCompositionException), match=message):
            launch(tmp_path / "run", override)
        assert not (tmp_path / "run").exists()
