from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from torchrl.checkpoint import CheckpointRotation

from torchrl_safe.record import read_metrics

SCRIPT = Path(__file__).parents[2] / "examples" / "safetac_point.py"
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


def command(run_dir: Path, *overrides: str) -> list[str]:
    return [sys.executable, str(SCRIPT), f"run_dir={run_dir}", *TINY, *overrides]


def launch(run_dir: Path, *overrides: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(run_dir, *overrides), capture_output=True, text=True, timeout=300, check=False
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    run_dir = tmp_path_factory.mktemp("runs") / "run"
    result = launch(run_dir, "collector.total_frames=1600")
    assert result.returncode == 0, result.stderr
    return run_dir, result


class TestRun:
    def test_files(self, finished):
        run_dir, _ = finished
        assert (run_dir / "curves.png").stat().st_size > 5_000
        config = OmegaConf.load(run_dir / "config.yaml")
        assert config.collector.total_frames == 1600
        assert config.run_dir == str(run_dir)  # resolved

    def test_results(self, finished):
        run_dir, result = finished
        results = json.loads((run_dir / "results.json").read_text())
        assert results["frames"] == 1600
        assert results["frames_per_second"] > 0
        for name in ("score", "cv_rate", "return"):
            assert f"eval/{name}" in results
            assert f"eval/det/{name}" in results
        assert "total CVs in training" in result.stdout
        assert "frames/s" in result.stdout

    def test_metrics(self, finished):
        run_dir, _ = finished
        curves = read_metrics(run_dir / "log")
        assert curves["train/total_cvs"][0].tolist() == [400, 800, 1200, 1600]
        assert curves["eval/det/score"][0].tolist() == [800, 1600]
        for name in (
            "train/reward_per_1000",
            "train/cost_rate",
            "update/constraint",
            "update/kl",
            "update/case_code",
            "update/loss_cost_value",
            "time/frames_per_second",
            "time/critics",
        ):
            assert len(curves[name][0])

    def test_progress_line(self, finished):
        _, result = finished
        for name in ("frame/s", "reward=", "cost=", "cv=", "kl="):
            assert name in result.stderr

    def test_same_seed_same_metrics(self, finished, tmp_path):
        run_dir, _ = finished
        again = tmp_path / "again"
        assert launch(again, "collector.total_frames=1600").returncode == 0
        first, second = read_metrics(run_dir / "log"), read_metrics(again / "log")
        assert first.keys() == second.keys()
        for name in first:
            if not name.startswith("time/"):
                assert first[name][1].tolist() == second[name][1].tolist(), name

    def test_refuses_to_mix_runs(self, finished):
        run_dir, _ = finished
        before = (run_dir / "results.json").read_bytes()
        result = launch(run_dir, "collector.total_frames=800")
        assert result.returncode != 0
        assert "resume=true" in result.stderr
        assert (run_dir / "results.json").read_bytes() == before


class TestResume:
    def test_goes_on(self, tmp_path):
        run_dir = tmp_path / "run"
        assert launch(run_dir, "collector.total_frames=800").returncode == 0
        before = read_metrics(run_dir / "log")["train/total_cvs"]
        result = launch(run_dir, "collector.total_frames=1600", "resume=true")
        assert result.returncode == 0, result.stderr
        steps, total = read_metrics(run_dir / "log")["train/total_cvs"]
        assert steps.tolist() == [400, 800, 1200, 1600]
        assert total[:2].tolist() == before[1].tolist()
        assert (total[1:] >= total[:-1]).all()

    def test_nothing_to_resume(self, tmp_path):
        result = launch(tmp_path / "run", "resume=true")
        assert result.returncode != 0
        assert "No checkpoints were found" in result.stderr

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_interruption_saves(self, tmp_path, number):
        run_dir = tmp_path / "run"
        process = subprocess.Popen(
            command(run_dir, "collector.total_frames=400000", "checkpoint.interval=1000000"),
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        deadline = time.monotonic() + 120
        log = run_dir / "log" / "scalars" / "train" / "total_cvs.csv"
        while not (log.exists() and log.read_text().count("\n") >= 3):
            assert process.poll() is None, process.stderr.read()
            assert time.monotonic() < deadline
            time.sleep(0.1)
        os.kill(process.pid, number)
        stdout, stderr = process.communicate(timeout=60)
        assert process.returncode == 0, stderr
        assert "resume=true" in stdout
        assert CheckpointRotation(run_dir / "checkpoints", keep_last=1).latest() is not None
        frames = int(stdout.split("stopped at ")[1].split()[0])
        result = launch(run_dir, f"collector.total_frames={frames + 400}", "resume=true")
        assert result.returncode == 0, result.stderr
        assert json.loads((run_dir / "results.json").read_text())["frames"] == frames + 400


class TestLoggers:
    def test_tensorboard(self, tmp_path):
        result = launch(tmp_path / "run", "collector.total_frames=400", "logger.backend=tensorboard")
        assert result.returncode == 0, result.stderr
        assert list((tmp_path / "run").rglob("events.out.tfevents.*"))

    def test_wandb_is_offline(self, tmp_path):
        env = {k: v for k, v in os.environ.items() if not k.startswith("WANDB")}
        result = subprocess.run(
            command(tmp_path / "run", "collector.total_frames=400", "logger.backend=wandb"),
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

    def test_none(self, tmp_path):
        result = launch(tmp_path / "run", "collector.total_frames=400", "logger.backend=''")
        assert result.returncode == 0, result.stderr
        assert not (tmp_path / "run" / "log").exists()


class TestMisuse:
    @pytest.mark.parametrize(
        ("override", "message"),
        [
            ("loss.cost_limt=1", "cost_limt"),
            ("loss.cost_limit=-1", "cost_limit must be finite and at least 0, got -1"),
            ("loss.risk_level=2", "risk_level must be in (0, 1], got 2"),
            ("loss.entropic_index=0", "entropic_index must be"),
            ("env.robot=unicycle", "unicycle"),
        ],
    )
    def test_message(self, tmp_path, override, message):
        result = launch(tmp_path / "run", override)
        assert result.returncode != 0
        assert message in result.stderr
        assert not (tmp_path / "run").exists()
