"""Safety-Gymnasium's tasks by their names: what follows from one, and every method on them."""

from __future__ import annotations

import json
import math
import subprocess
import sys

import gymnasium
import pytest
import small
import torch
import yaml

import torchrl_safe.envs  # noqa: F401 registers the ids
from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import METHODS, SafeTAC, cli, trainer
from torchrl_safe.trainers.commands import evaluate, play
from torchrl_safe.trainers.environments import make_env
from torchrl_safe.trainers.options import flat, given, settle
from torchrl_safe.trainers.tasks import NAMES, RUNNERS, follows
from torchrl_safe.trainers.trc import CPO

NAMED = [name for name in NAMES if follows(name)]
EACH_METHOD = [(m, task) for m in METHODS for task in ("SafetyPointGoal1", "SafetyHopperVelocity")]
OTHERS = ("SafetyCarButton2", "SafetyPointPush1", "SafetyCarCircle1", "SafetyAntVelocity")


def compose(*overrides, method="safetac"):
    return cli.compose(method, overrides)


class TestWhatFollows:
    @pytest.mark.parametrize("name", NAMED)
    def test_is_that_of_the_registered_environment(self, name):
        """Robot, episode and spaces are those of the id in Gymnasium's registry."""
        options = compose(f"env.task={name}", "num_threads=1")
        version = 1 if name in RUNNERS else 0
        with gymnasium.make(f"torchrl_safe/{name}-v{version}") as registered:
            env = make_env(options, 2, 0)
            assert env.observation_spec["observation"].shape[1:] == (
                registered.observation_space.shape
            )
            assert env.action_spec.shape[1:] == registered.action_space.shape
            steps = registered.spec.max_episode_steps
        assert options.eval.num_steps == options.video.num_steps == steps
        assert options.env.episode_length == steps
        assert options.env.robot is None

    def test_fields_problem(self):
        """A mean of 25 in 1,000 steps is a discounted sum of 2.5 at a discount of 0.99."""
        options = compose("env.task=SafetyPointGoal1", "loss.anneal_frames=0")
        assert trainer.limit_at(options.loss, "cost", 1) == 25.0
        assert 25.0 * trainer.discounted_unit(options) == pytest.approx(2.5)
        assert options.loss.risk_level == 1.0
        circle = compose("env.task=SafetyPointCircle1")
        assert 25.0 * trainer.discounted_unit(circle) == pytest.approx(5.0)

    @pytest.mark.parametrize("method", METHODS)
    def test_what_is_given_wins(self, method):
        words = ["env.task=SafetyCarGoal1", "eval.num_steps=400", "env.episode_length=1000"]
        if method != "tac":  # which has no limit
            words += ["loss.cost_limit=5.0", "loss.limit_unit=discounted"]
        options = compose(*words, method=method)
        values = dict(flat(options))
        for word in words:
            name, _, value = word.partition("=")
            assert str(values[name]) == value
        assert options.env.robot is None
        assert values["video.num_steps"] == 1000
        assert given(options) == {word.partition("=")[0] for word in words}

    def test_from_python(self):
        options = SafeTAC("SafetyPointCircle2", risk_level=0.5).options
        assert (options.env.robot, options.eval.num_steps) == (None, 500)
        assert given(options) == {"env.task", "loss.risk_level"}
        assert options.changed(seed=3).loss.cost_limit == 25.0
        assert options.changed(**{"env.task": "SafetyCarGoal2"}).eval.num_steps == 1000
        assert options.folder == "runs/safetac/SafetyPointCircle2/seed_0"
        assert compose("env.task=goal", "env.robot=car").folder == "runs/safetac/car/seed_0"

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            (
                ["env.task=SafetyPointGoal1", "env.robot=car"],
                "env.robot must be null for env.task=SafetyPointGoal1, .*, got 'car'",
            ),
            (
                ["env.task=SafetyHopperVelocity", "env.robot=point"],
                "env.robot must be null for env.task=SafetyHopperVelocity, .*, got 'point'",
            ),
            (["env.robot=null"], "env.robot must be one of 'point', .*, got null"),
            (["env=gym", "env.task=SafetyPointGoal1"], "env.task must be null for env=gym, got 'S"),
            (["env.task=SafetyPointGoal7"], "env.task must be null, .*, got 'SafetyPointGoal7'"),
        ],
    )
    def test_message(self, words, message):
        with pytest.raises(ValueError, match=message):
            compose(*words)

    def test_a_resumed_run_keeps_it(self):
        before = compose("env.task=SafetyCarGoal1", "loss.cost_limit=10").settings()
        for words in ([], ["env.task=SafetyCarGoal1"]):
            settled, changed = settle(before, compose(*words))
            assert not changed
            assert settled.settings() == before
        with pytest.raises(ValueError, match=r"env.task was 'SafetyCarGoal1' and is 'SafetyPoint"):
            settle(before, compose("env.task=SafetyPointGoal1"))


def test_printed_configuration_is_that_of_the_job():
    """What ``--cfg job`` prints is what is run, option by option."""
    words = ["env.task=SafetyCarCircle1", "loss.cost_limit=10.0", "seed=3"]
    script = "from torchrl_safe.trainers import cli; cli.train('cpo')"
    printed = subprocess.run(
        [sys.executable, "-c", script, *words, "--cfg", "job"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    settings = compose(*words, method="cpo").settings()
    assert settings.pop("method") == "cpo"
    assert yaml.safe_load(printed) == settings


def test_sweep_over_tasks(tmp_path, monkeypatch):
    """Each job of a sweep follows its own task."""
    seen = []
    monkeypatch.setattr(METHODS["cpo"], "train", lambda self: seen.append(self.options))
    monkeypatch.chdir(tmp_path)
    tasks = "env.task=SafetyPointCircle1,SafetyCarGoal1,SafetySwimmerVelocity"
    cli.train("cpo", ["--multirun", tasks, "loss.cost_limit=5.0"])
    assert [options.eval.num_steps for options in seen] == [500, 1000, 1000]
    assert [options.env.episode_length for options in seen] == [500, 1000, 1000]
    assert {options.loss.cost_limit for options in seen} == {5.0}


@pytest.mark.parametrize(
    ("method", "task"), [*EACH_METHOD, *(("safetac", task) for task in OTHERS)]
)
def test_every_method_trains(tmp_path, method, task):
    run_dir = tmp_path / "run"
    options = small.options(method, f"env.task={task}", run_dir=run_dir)
    METHODS[method](options=options).train()
    logged = {name: values.tolist() for name, (_, values) in read_metrics(run_dir / "log").items()}
    results = json.loads((run_dir / "results.json").read_text())
    assert all(len(results["episodes"][kind]) == 2 for kind in ("eval/", "eval/det/"))
    assert math.isfinite(results["eval/det/cost"])
    if method != "tac":
        assert math.isfinite(logged["update/cost_level"][-1])
        wanted = 25.0
        if method == "safetac":  # from one and a half times the limit downwards
            wanted *= 1.5 - 0.5 * 400 / options.loss.anneal_frames
        assert logged["update/cost_limit"][-1] == pytest.approx(wanted)


@pytest.mark.parametrize("task", ["SafetyCarCircle1", "SafetyHopperVelocity"])
def test_what_one_does_with_a_run(tmp_path, monkeypatch, task):
    run_dir = tmp_path / "run"
    CPO(options=small.options("cpo", f"env.task={task}", run_dir=run_dir)).train()
    metrics = evaluate.main(run_dir, episodes=2, film=False)
    assert metrics["det/length"] <= 20
    assert math.isfinite(metrics["sampled/cost"])
    monkeypatch.chdir(tmp_path)
    assert play.main(str(run_dir), episodes=1, steps=3)["length"] == 3
    if task in RUNNERS:
        with pytest.raises(ValueError, match="is of a robot, and this run has none"):
            evaluate.main(run_dir, randomization="jackal_real")


def test_training_episodes(tmp_path):
    """Shorter ones than the task's where they are asked for; evaluation keeps the task's."""
    options = compose("env.task=SafetyPointCircle0", "env.episode_length=25", "num_threads=1")
    action = torch.zeros(2, 2)
    lengths = {}
    for training in (True, False):
        env = make_env(options, 2, 0, training=training)
        td, lengths[training] = env.reset(), 0
        while not td["done"].any():
            td = env.step(td.set("action", action))["next"]
            lengths[training] += 1
    assert lengths[True] <= 25
    assert lengths[False] == 500
