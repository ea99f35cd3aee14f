"""What one does with a run: load its policy, evaluate, watch, export, drive from the file."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import evaluate
import export
import numpy as np
import pytest
import run_exported
import torch
import watch
from streams import stream_seed
from tensordict import TensorDict
from test_safetac_point import launch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from utils import load_policy, load_run, make_env

from torchrl_safe.modules import GMMTanhPolicy


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    # Discounted sums that fit into the short episodes, so that there is something to calibrate.
    launch(path, "collector.total_frames=800", "loss.cost_gamma=0.8", "eval.num_steps=30")
    return path


class TestLoadPolicy:
    def test_acts_like_the_trained_one(self, run_dir):
        policy = load_policy(run_dir)
        assert isinstance(policy, GMMTanhPolicy)
        assert not policy.training
        manifest = json.loads(next(run_dir.glob("checkpoints/*/manifest.json")).read_text())
        assert "policy" in manifest["components"]
        # The final evaluation was of this policy: the same layouts give the same score.
        cfg, _ = load_run(run_dir)
        env = make_env(cfg, cfg.eval.final_episodes, seed=0)
        played = evaluate.evaluate(
            env,
            policy,
            num_steps=30,
            exploration_type=ExplorationType.DETERMINISTIC,
            seed=stream_seed("final evaluation"),
        )
        results = json.loads((run_dir / "results.json").read_text())
        assert played["episode_return"].mean().item() == results["eval/det/return"]

    def test_two_lines_of_a_script(self, run_dir):
        """As a user writes them, in a process of its own."""
        lines = f"from utils import load_policy\npolicy = load_policy({str(run_dir)!r})"
        subprocess.run(
            [sys.executable, "-c", lines], check=True, cwd=Path(evaluate.__file__).parent
        )

    def test_no_run(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"holds no run: it has no config.yaml"):
            load_policy(tmp_path)

    def test_no_checkpoint(self, tmp_path, run_dir):
        (tmp_path / "config.yaml").write_text((run_dir / "config.yaml").read_text())
        with pytest.raises(FileNotFoundError, match="no checkpoint yet"):
            load_policy(tmp_path)


def test_evaluate(run_dir, capsys):
    metrics = evaluate.main(run_dir, episodes=4, seed=5, film=False)
    out = run_dir / "evaluation"
    for name in ("trajectories.png", "calibration.png"):
        assert (out / name).stat().st_size > 5_000
    written = json.loads((out / "results.json").read_text(), parse_constant=pytest.fail)
    episodes = written.pop("episodes")
    assert written.keys() == metrics.keys()
    for prefix, played in episodes.items():
        assert len(played) == 4
        for name in ("return", "cost", "violations", "entries", "discounted_cost", "length"):
            mean = sum(episode[name] for episode in played) / 4
            assert mean == pytest.approx(metrics[prefix + name])
        assert {episode["end"] for episode in played} <= {"running", "truncated"}
    for prefix in ("det/", "sampled/"):
        for name in ("score", "score_low", "cv_rate", "success_rate", "failure_rate_high"):
            assert prefix + name in metrics
        assert metrics[f"{prefix}failure_rate_high"] > 0.4  # four episodes say little
    assert metrics["calibration/mean_error"] > 0
    assert "det/score" in capsys.readouterr().out


def test_evaluation_is_that_of_the_seed(run_dir):
    first, again, other = (
        evaluate.main(run_dir, episodes=2, seed=seed, film=False) for seed in (5, 5, 6)
    )
    assert first == again
    assert first["det/return"] != other["det/return"]


def test_evaluation_on_another_robot(run_dir):
    """The same layouts and draws, and a robot of other mass, friction and delay."""
    nominal = evaluate.main(run_dir, episodes=2, seed=5, film=False)
    other = evaluate.main(run_dir, episodes=2, seed=5, film=False, randomization="jackal_real")
    assert nominal["det/return"] != other["det/return"]
    for folder, metrics in (("evaluation_jackal_real", other), ("evaluation", nominal)):
        written = json.loads((run_dir / folder / "results.json").read_text())
        del written["episodes"]
        assert written == metrics


def test_watch(run_dir, capsys):
    (run_dir / "curves.png").unlink()
    watch.main(run_dir, every=1.0, once=True)
    out = capsys.readouterr().out
    assert (run_dir / "curves.png").stat().st_size > 5_000
    assert "800 of 800" in out
    assert "update/kl" in out


def test_watch_without_a_log(tmp_path):
    with pytest.raises(FileNotFoundError, match="no csv log"):
        watch.main(tmp_path, every=1.0, once=True)
    (tmp_path / "log").mkdir()
    (tmp_path / "config.yaml").write_text("logger: {backend: tensorboard}")
    with pytest.raises(FileNotFoundError, match="another logger"):
        watch.main(tmp_path, every=1.0, once=True)


def test_drive_from_what_is_not_there(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"policy.pt2 is no file: export.py writes one"):
        run_exported.load(tmp_path / "policy.pt2")
    path = tmp_path / "policy.onnx"
    path.touch()
    monkeypatch.setattr(run_exported, "find_spec", lambda name: None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'torchrl-safe\[export\]'"):
        run_exported.load(path)


@pytest.mark.parametrize("onnx", [False, True])
def test_export_and_drive(run_dir, onnx, capsys):
    path = export.main(run_dir, onnx=onnx)
    act = run_exported.load(path)
    policy = load_policy(run_dir)
    for batch in (1, 5):
        observation = torch.randn(batch, 24, generator=torch.Generator().manual_seed(batch))
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            expected = policy(TensorDict(observation=observation, batch_size=batch))["action"]
        np.testing.assert_allclose(act(observation.numpy()), expected.numpy(), atol=1e-6)
    goals, violations = run_exported.main(path, robot="point", steps=20, seed=0)
    assert goals >= 0
    assert violations >= 0
    assert "20 steps" in capsys.readouterr().out
