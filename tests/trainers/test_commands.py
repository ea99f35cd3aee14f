"""What one does with a run: load its policy, evaluate, watch, export, drive from the file."""

from __future__ import annotations

import io
import json
import shutil
import subprocess
import sys
import threading
import time
from collections import OrderedDict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import run_exported
import tiny
import torch
from tensordict import TensorDict
from torchrl.checkpoint import CheckpointError
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_safe.modules import GMMTanhPolicy
from torchrl_safe.trainers import checkpoints, load_policy
from torchrl_safe.trainers.commands import evaluate, export, play, watch
from torchrl_safe.trainers.environments import make_env
from torchrl_safe.trainers.saved import Configuration, load_run, read_config, write_config
from torchrl_safe.trainers.streams import stream_seed


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    # Discounted sums that fit into the short episodes, so that there is something to calibrate.
    tiny.launch(
        path,
        "env.num_envs=20",
        "env.episode_length=50",
        "collector.frames_per_batch=400",
        "collector.total_frames=800",
        "replay_buffer.size=10000",
        "loss.cost_gamma=0.8",
        "eval.num_steps=30",
        "eval.final_episodes=2",
    )
    return path


class TestLoadPolicy:
    def test_acts_like_the_trained_one(self, run_dir):
        policy = load_policy(run_dir)
        assert isinstance(policy, GMMTanhPolicy)
        assert not policy.training
        manifest = json.loads(next(run_dir.glob("checkpoints/*/manifest.json")).read_text())
        assert "policy" in manifest["components"]
        # The final evaluation was of this policy: the same layouts give the same score.
        options, _ = load_run(run_dir)
        env = make_env(options, options.eval.final_episodes, seed=0)
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
        load = "from torchrl_safe.trainers import load_policy"
        lines = f"{load}\npolicy = load_policy({str(run_dir)!r})"
        subprocess.run([sys.executable, "-c", lines], check=True)

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
    assert "Constraint" in out
    assert any("\u2800" <= character <= "\u28ff" for character in out)


def test_watch_on_a_terminal_of_few_characters(run_dir, monkeypatch, capsys):
    """What it cannot show is left out: the rest is said all the same."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding="latin-1")
    monkeypatch.setattr("sys.stdout", stream)
    watch.main(run_dir, every=1.0, once=True)
    stream.seek(0)
    assert "update/kl" in stream.read()


def test_watch_without_a_log(tmp_path):
    with pytest.raises(FileNotFoundError, match="no csv log"):
        watch.main(tmp_path, every=1.0, once=True)
    (tmp_path / "log").mkdir()
    write_config(tmp_path / "config.yaml", tiny.options(tmp_path, "logger.backend=tensorboard"))
    with pytest.raises(FileNotFoundError, match="another logger"):
        watch.main(tmp_path, every=1.0, once=True)


def test_drive_from_what_is_not_there(tmp_path, monkeypatch):
    with pytest.raises(
        FileNotFoundError, match=r"policy.pt2 is no file: torchrl-safe export writes one"
    ):
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


class TestPlay:
    def test_a_run(self, run_dir, tmp_path, capsys):
        """The numbers are those of an evaluation on the same layouts; a film is a bonus."""
        film = tmp_path / "film.mp4"
        played = play.main(str(run_dir), episodes=2, steps=30, seed=5, out=film)
        judged = evaluate.main(run_dir, episodes=2, seed=5, film=False)
        for name in ("return", "cost", "violations", "goals"):
            assert played[name] == judged[f"det/{name}"]
        assert film.exists() or "no video" in capsys.readouterr().out

    def test_neither_a_run_nor_a_name(self, tmp_path):
        with pytest.raises(FileNotFoundError, match=r"a run's folder or one of .*, got 'nobody'"):
            play.main("nobody")


class TestBesideATraining:
    """A run that trains replaces what is being read."""

    def rotate(self, run_dir):
        """The newest checkpoint gives way to the next."""
        old = checkpoints.latest(run_dir)
        step = int(old.name.split("-")[1]) + 1
        new = old.with_name(f"checkpoint-{step:012d}")
        shutil.copytree(old, new)
        shutil.rmtree(old)
        return new

    @pytest.mark.parametrize("times", [1, 3])
    @pytest.mark.parametrize("command", ["evaluate", "export", "load_policy"])
    def test_checkpoint_is_replaced_while_it_is_read(
        self, run_dir, tmp_path, monkeypatch, times, command
    ):
        """Policy and critics are of one checkpoint, the newest that is there."""
        run_dir = shutil.copytree(run_dir, tmp_path / "run")
        load, left, used = checkpoints.SealedCheckpoint.load, [times], []

        def late(self, path, **options):
            if "config" not in self.components and left[0]:
                left[0] -= 1
                TestBesideATraining().rotate(run_dir)
            used.append(path)
            return load(self, path, **options)

        monkeypatch.setattr(checkpoints.SealedCheckpoint, "load", late)
        if command == "evaluate":
            evaluate.main(run_dir, episodes=1, seed=5, film=False)
        elif command == "export":
            export.main(run_dir, onnx=False)
        else:
            load_policy(run_dir)
        assert left == [0]
        newest = checkpoints.latest(run_dir)
        assert len({path for path in used if path == newest}) == 1
        assert used[-2:] == [newest] * 2  # its configuration and policy, or policy and critics

    def test_critics_are_of_the_policys_checkpoint(self, run_dir, tmp_path, monkeypatch):
        """Gone between the two, both are read again."""
        run_dir = shutil.copytree(run_dir, tmp_path / "run")
        load, used = checkpoints.SealedCheckpoint.load, []

        def late(self, path, **options):
            if "cost_loss" in self.components and len(used) == 2:
                TestBesideATraining().rotate(run_dir)
            used.append((path.name, *self.components))
            return load(self, path, **options)

        monkeypatch.setattr(checkpoints.SealedCheckpoint, "load", late)
        evaluate.main(run_dir, episodes=1, seed=5, film=False)
        first, last = used[0][0], used[-1][0]
        parts = ("config", "policy", "cost_loss")
        assert used == [(name, part) for name in (first, last) for part in parts]
        assert first != last

    def test_checkpoint_that_is_broken_is_not_tried_for_ever(self, run_dir, tmp_path):
        run_dir = shutil.copytree(run_dir, tmp_path / "run")
        next(checkpoints.latest(run_dir).rglob("*-cost_loss/state/*.memmap")).unlink()
        with pytest.raises(CheckpointError, match="is not what was written"):
            evaluate.main(run_dir, episodes=1, seed=5, film=False)

    def test_nobody_sees_half_a_file(self, run_dir, tmp_path):
        """Everything that is written again and again, read as fast as one can."""
        run_dir = shutil.copytree(run_dir, tmp_path / "run")
        evaluate.main(run_dir, episodes=1, seed=5, film=False)
        watch.look(run_dir)
        out = run_dir / "evaluation"
        ends = {
            run_dir / "curves.png": b"IEND\xaeB`\x82",
            out / "trajectories.png": b"IEND\xaeB`\x82",
            out / "calibration.png": b"IEND\xaeB`\x82",
            out / "results.json": b"}\n",
            run_dir / "config.yaml": b"\n",
        }
        settings = read_config(run_dir / "config.yaml")
        options = SimpleNamespace(settings=lambda: settings)

        def write():
            evaluate.main(run_dir, episodes=1, seed=5, film=False)
            watch.look(run_dir)
            for _ in range(100):
                write_config(run_dir / "config.yaml", options)

        writer = threading.Thread(target=write)
        writer.start()
        reads = 0
        while writer.is_alive():
            for path, end in ends.items():
                assert path.read_bytes().endswith(end), path
            assert read_config(run_dir / "config.yaml") == settings
            reads += 1
            time.sleep(0.001)
        writer.join()
        assert reads > 10


class TestNames:
    def test_only_a_runs_own_names_count(self, run_dir, tmp_path):
        """Copies under other names are neither the newest nor rivals of the newest."""
        run_dir = shutil.copytree(run_dir, tmp_path / "run")
        newest = checkpoints.latest(run_dir)
        others = ["best", "old", "9", "99999", "0000000000009", "000000000900-copy", "٠" * 12, "²"]
        for name in others:
            shutil.copytree(newest, newest.with_name(f"checkpoint-{name}"))
        shutil.copytree(newest, newest.with_name("my-checkpoint-000000000900"))
        assert checkpoints.latest(run_dir) == newest
        rotation = checkpoints.Rotation(run_dir, keep_last=1)
        checkpoint = checkpoints.SealedCheckpoint(config=Configuration())
        saved = rotation.save(checkpoint, step=801)
        assert checkpoints.latest(run_dir) == saved
        assert not newest.exists()
        for name in others:
            assert newest.with_name(f"checkpoint-{name}").exists()

    def test_rotation_keeps_the_newest(self, tmp_path):
        rotation = checkpoints.Rotation(tmp_path, keep_last=2)
        for step in (1, 5, 3, 10**12, 7):
            rotation.save(checkpoints.SealedCheckpoint(config=Configuration()), step=step)
        names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
        assert names == ["checkpoint-000000000007", "checkpoint-1000000000000"]
        assert checkpoints.latest(tmp_path).name == "checkpoint-1000000000000"

    @pytest.mark.parametrize(
        "command",
        [
            lambda path: evaluate.main(path, episodes=1, seed=5, film=False),
            lambda path: watch.main(path, every=1.0, once=True),
            lambda path: run_exported.load(export.main(path, onnx=False)),
            load_policy,
            load_run,
        ],
    )
    def test_tilde_is_home(self, run_dir, tmp_path, monkeypatch, command):
        home, here = tmp_path / "home", tmp_path / "here"
        here.mkdir()
        shutil.copytree(run_dir, home / "run")
        monkeypatch.setenv("HOME", str(home))
        monkeypatch.chdir(here)
        command(Path("~/run"))
        assert not list(here.iterdir())

    def test_exported_file_at_home(self, run_dir, tmp_path, monkeypatch):
        monkeypatch.setenv("HOME", str(tmp_path))
        shutil.copy(export.main(run_dir, onnx=False), tmp_path)
        run_exported.load(Path("~/policy.pt2"))


def test_checkpoint_refuses_to_save_what_it_would_not_load(tmp_path):
    state = SimpleNamespace(state_dict=lambda: {"a": {1, 2}}, load_state_dict=lambda _: None)
    with pytest.raises(TypeError, match=r"the state of odd holds .*set"):
        checkpoints.SealedCheckpoint(odd=state).save(tmp_path / "checkpoint")
    assert not list(tmp_path.iterdir())


def test_every_kind_of_state_comes_back(tmp_path):
    saved = {
        "plain": [1, 2.5, True, None, "text", float("inf")],
        "nested": OrderedDict(a=(1, (2,)), b={"c": torch.Size([3, 4])}),
        3: torch.arange(6).reshape(2, 3),
        "empty": torch.empty(0, 4),
        "bits": torch.tensor(2.5, dtype=torch.bfloat16),
        "array": np.arange(3.0),
    }
    read = {}
    source = SimpleNamespace(state_dict=lambda: saved, load_state_dict=None)
    target = SimpleNamespace(state_dict=lambda: saved, load_state_dict=read.update)
    checkpoints.SealedCheckpoint(x=source).save(tmp_path / "checkpoint")
    checkpoints.load_components(tmp_path / "checkpoint", x=target)
    assert read.keys() == saved.keys()
    for name in ("plain", "nested"):
        assert read[name] == saved[name]
        assert type(read[name]) is type(saved[name])
    for name in (3, "empty", "bits"):
        torch.testing.assert_close(read[name], saved[name], rtol=0, atol=0)
    np.testing.assert_array_equal(read["array"], saved["array"])
