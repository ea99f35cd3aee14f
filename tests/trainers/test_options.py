"""Options: what is allowed, what is said about mistakes, and what a resumed run keeps."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from importlib import util
from pathlib import Path

import pytest
import tiny
import torch
from torch import nn

from torchrl_safe.modules import MATCHED_BOUND, MOMENT_MATCHED
from torchrl_safe.trainers import METHODS, cli, options, saved, trainer
from torchrl_safe.trainers import run as runs
from torchrl_safe.trainers.options import Lagrangian, Options, describe, given, settings_of, settle
from torchrl_safe.trainers.policy_steps import Multiplier
from torchrl_safe.trainers.safetac import choose_distance


def compose(*overrides, name="safetac"):
    return cli.compose(name, overrides)


@pytest.mark.parametrize("name", sorted(METHODS))
class TestEveryMethod:
    def test_defaults_are_allowed(self, name):
        options = METHODS[name].Options
        assert options.of(**{row.name: row.default for row in describe(options)}).settings() == (
            options().settings()
        )

    def test_every_option_says_what_it_is(self, name):
        rows = describe(METHODS[name].Options)
        assert not [row.name for row in rows if not row.meaning or not row.allowed]
        assert len({row.name for row in rows}) == len(rows)

    def test_settings_are_the_way_back(self, name):
        options = METHODS[name].Options.of(**{"seed": 3, "policy.num_cells": [8]})
        back = Options.from_settings(json.loads(json.dumps(options.settings())))
        assert type(back) is type(options)
        assert back == options


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("seed", -1, "seed must be an integer of at least 0 and at most .*, got -1"),
        ("seed", 2**70, "seed must be an integer of .* at most 18446744073709551615, got 118059"),
        ("seed", True, "seed must be an integer of .*, got True"),
        ("device", "cuda:99", r"device must be one of 'cpu'.*got 'cuda:99'"),
        (
            "num_threads",
            1.5,
            "num_threads must be null or an integer of .* at most 2147483647, got 1.5",
        ),
        ("env.robot", "unicycle", "env.robot must be null or one of 'point'.*got 'unicycle'"),
        ("loss.risk_level", 2, r"loss.risk_level must be a number in \(0, 1\], got 2"),
        ("num_threads", 2**31, "num_threads must be null or an integer .*, got 2147483648"),
        ("loss.cost_limit", 1e300, r"loss.cost_limit must be a number in .* got 1e\+300"),
        ("loss.alpha", 1e-60, r"loss.alpha must be .*, got 1e-60, which is 0.0 in single"),
        ("loss.gamma", 1 - 1e-9, "loss.gamma must be .* which is 1.0 in single precision"),
        ("policy.log_std_bounds", [-4, 1e300], "policy.log_std_bounds must be two finite"),
        ("loss.gamma", 1.0, r"loss.gamma must be a number in \[0, 1\), got 1.0"),
        ("loss.gamma", "high", "loss.gamma must be a number.*got 'high'"),
        ("loss.cost_limit", float("nan"), r"loss.cost_limit must be a number in \[0, inf\)"),
        ("optim.max_kl", 0, r"optim.max_kl must be a number in \(0, inf\), got 0"),
        ("policy.num_cells", [64, 0], "policy.num_cells must be a list of integers"),
        ("policy.log_std_bounds", [2, -4], "policy.log_std_bounds must be two finite numbers"),
        ("logger.backend", "wandbb", "logger.backend must be one of 'csv', 'tensorboard', 'wandb'"),
        ("resume", "yes", "resume must be one of True, False, got 'yes'"),
        ("run_dir", "", "run_dir must be null or a path"),
        ("loss.cost_limit", {"a": -1}, r"loss.cost_limit must be .* one for each cost .*'a': -1"),
        ("loss.cost_limit", {}, r"loss.cost_limit must be .* one for each cost by its name"),
        ("loss.limit_unit", "hour", "loss.limit_unit must be one of 'discounted', 'step', 'epi"),
        ("num_cells", [8], "is the name of several options: policy.num_cells, critic.num_cells"),
        ("loss.cost_limt", 1.0, "loss.cost_limt is not an option; there are loss.cost_limit"),
        ("collector.frames_per_batch", 8001, "must be a multiple of env.num_envs=400, got 8001"),
        ("optim.critic_frames", 15_001, "must be a multiple of replay_buffer.slice_len=20"),
        ("env.episode_length", 10, "slice_len must be at most env.episode_length=10, got 20"),
        ("collector.frames_per_batch", 400, "frames_per_batch must be at least 800, got 400"),
        ("collector.init_frames", 0, "frames_per_batch must be at least 8400, got 8000.*slice_len"),
        ("replay_buffer.size", 800, "frames_per_batch must be at most replay_buffer.size=800"),
    ],
)
def test_message(name, value, message):
    named = {name: value}
    if name == "collector.init_frames":
        named |= {"replay_buffer.slice_len": 21, "optim.critic_frames": 21 * 700}
    with pytest.raises(ValueError, match=message):
        METHODS["safetac"].Options.of(**named)


def test_settings_of_no_method():
    with pytest.raises(ValueError, match=r"method must be one of .*'safetac'.*, got 'os.system'"):
        Options.from_settings({"method": "os.system"})


def test_memmap_is_for_the_cpu(monkeypatch):
    monkeypatch.setattr(options, "devices", lambda: ["cpu", "cuda"])  # as where there is a GPU
    compose("device=cuda")
    with pytest.raises(ValueError, match=r"memmap keeps the replay on the CPU.*got 'cuda'"):
        compose("device=cuda", "replay_buffer.storage=memmap")


@pytest.mark.parametrize(
    ("option", "backend"),
    [("logger", "wandb"), ("logger", "tensorboard"), ("collector", "ray")],
)
def test_missing_extra(monkeypatch, option, backend):
    monkeypatch.setattr(
        options, "find_spec", lambda name: None if name == backend else util.find_spec(name)
    )
    with pytest.raises(ModuleNotFoundError, match=rf"pip install 'torchrl-safe\[{backend}\]'"):
        compose(f"{option}.backend={backend}").check_installed()


@pytest.mark.parametrize(
    ("overrides", "distance"),
    [
        ([], MOMENT_MATCHED),
        (["env.robot=jackal"], MATCHED_BOUND),
        (["env.task=SafetyPointGoal1"], MOMENT_MATCHED),
        (["env.task=SafetyCarGoal1"], MATCHED_BOUND),
        (["env.task=SafetyHopperVelocity"], MATCHED_BOUND),
        (["env=gym"], MATCHED_BOUND),
        (["env.robot=jackal", "optim.kl=moment_matched"], MOMENT_MATCHED),
        (["optim.kl=matched_bound"], MATCHED_BOUND),
    ],
)
def test_distance_of_a_robot(overrides, distance):
    assert choose_distance(compose(*overrides)) is distance


def test_workers_must_share_the_environments():
    overrides = ["collector.backend=multi_sync", "collector.num_workers=3"]
    with pytest.raises(ValueError, match=r"env.num_envs must be a multiple of .*num_workers=3"):
        compose(*overrides)
    compose(overrides[1])  # nobody asks for them


def test_the_policys_turn_comes_in_every_batch():
    message = r"optim.num_updates must be a multiple of optim.policy_delay=2, got 121"
    with pytest.raises(ValueError, match=message):
        compose("optim.num_updates=121", name="td3_lagrangian")
    compose("optim.num_updates=121", "optim.policy_delay=11", name="td3_lagrangian")


class TestLimit:
    @pytest.mark.parametrize(
        ("named", "frames", "limit"),
        [
            ({}, 0, 7.5),  # one and a half times
            ({}, 250_000, 6.25),
            ({}, 500_000, 5.0),
            ({"cost_limit": 2.0}, 0, 3.0),
            ({"cost_limit": 2.0, "anneal_frames": 0}, 400, 2.0),
            ({"initial_cost_limit": 9.0, "anneal_frames": 800}, 400, 7.0),
            ({"cost_limit": {"a": 1.0, "b": 2.0}, "initial_cost_limit": 9.0}, 250_000, 5.0),
        ],
    )
    def test_moves(self, named, frames, limit):
        loss = METHODS["safetac"].Options.of(**named).loss
        assert trainer.limit_at(loss, "a", frames) == pytest.approx(limit)

    def test_baselines_begin_with_it(self):
        assert trainer.limit_at(METHODS["trc"].Options().loss, "cost", 0) == 5.0

    @pytest.mark.parametrize(("unit", "sum_of_ones"), [("step", 1.0), ("episode", 200.0)])
    def test_unit(self, unit, sum_of_ones):
        """A cost of 1 in every step stands at the limit of its own sum, whatever the unit."""
        named = {"limit_unit": unit, "cost_gamma": 0.9, "eval.num_steps": 200}
        scale = trainer.discounted_unit(METHODS["trc"].Options.of(**named))
        discounted = sum(0.9**step for step in range(1000))
        assert scale * sum_of_ones == pytest.approx(discounted)


class TestGiven:
    def test_composed(self):
        assert given(compose()) == set()
        assert given(compose("loss.cost_limit=2.5", "policy.num_cells=[8]", "seed=1")) == {
            "loss.cost_limit",
            "policy.num_cells",
            "seed",
        }

    def test_a_default_value_is_given_if_somebody_writes_it(self):
        overrides = ["loss.cost_limit=5.0", "++optim.max_kl=0.02", "pid={kp: 0.05, ki: 0.01}"]
        names = {"loss.cost_limit", "optim.max_kl", "pid.kd", "pid.ki", "pid.kp"}
        assert given(compose(*overrides)) == names

    def test_from_python(self):
        options = METHODS["safetac"].Options.of(cost_limit=5.0)
        assert given(options) == {"loss.cost_limit"}
        assert given(options.changed(seed=0)) == {"loss.cost_limit", "seed"}

    def test_command_line(self, tmp_path):
        script = tmp_path / "script.py"
        script.write_text(
            "from torchrl_safe.trainers import cli\n"
            "from torchrl_safe.trainers.options import given\n"
            "cli.run('safetac', lambda options: print(sorted(given(options))))\n"
        )
        arguments = ["loss.cost_limit=5.0", "++optim.max_kl=0.02", "env=gym"]
        result = subprocess.run(
            [sys.executable, script, *arguments],
            env={"PYTHONPATH": str(Path(options.__file__).parents[2]), "PATH": ""},
            capture_output=True,
            text=True,
            check=False,
        )
        assert "['env.name', 'loss.cost_limit', 'optim.max_kl']" in result.stdout, result.stderr


class TestSettle:
    def test_keeps_and_changes(self):
        before = compose("loss.cost_limit=2.5", "loss.entropic_index=1.5", "run_dir=a").settings()
        now = compose("loss.entropic_index=1.4", "resume=true", "run_dir=b")
        settled, changed = settle(before, now)
        assert changed == {"loss.entropic_index": (1.5, 1.4)}
        assert settled.loss.cost_limit == 2.5
        assert settled.loss.entropic_index == 1.4
        assert settled.run_dir == "b"
        assert settled.resume

    def test_options_that_a_newer_version_has(self):
        before = compose("seed=3").settings()
        del before["optim"]["recovery_ratio"]
        settled, changed = settle(before, compose())
        assert settled.optim.recovery_ratio == 0.7
        assert settled.seed == 3
        assert changed == {}

    def test_limits_of_costs_are_one_option(self):
        before = compose("loss.cost_limit={a: 1, b: 2}").settings()
        assert settle(before, compose())[0].loss.cost_limit == {"a": 1, "b": 2}
        _, changed = settle(before, compose("loss.cost_limit={a: 1, b: 3}"))
        assert changed == {"loss.cost_limit": ({"a": 1, "b": 2}, {"a": 1, "b": 3})}

    @pytest.mark.parametrize(
        ("override", "message"),
        [
            ("seed=1", "seed was 0 and is 1"),
            ("env.robot=car", "env.robot was 'point' and is 'car'"),
            ("policy.num_components=3", "policy.num_components was 5 and is 3"),
            ("critic.num_cells=[8]", r"critic.num_cells was \[128, 128\] and is \[8\]"),
            ("replay_buffer.size=100000", "replay_buffer.size was 1000000 and is 100000"),
            ("update=pid", "update was 'trust_region' and is 'pid'"),
            ("lagrangian.init=1", "lagrangian.init was 0.1 and is 1"),
        ],
    )
    def test_refuses(self, override, message):
        with pytest.raises(ValueError, match=f"run_dir=.* cannot go on with other.*{message}"):
            settle(compose().settings(), compose(override))

    def test_refuses_another_method(self):
        with pytest.raises(ValueError, match="method was 'trc' and is 'cpo'"):
            settle(compose(name="trc").settings(), compose(name="cpo"))

    def test_a_learned_temperature_has_no_option_any_more(self):
        settle(compose().settings(), compose("loss.alpha=0.1"))
        for name in ("tac", "wcsac", "sac_lagrangian"):
            with pytest.raises(ValueError, match=r"loss\.alpha"):
                settle(compose(name=name).settings(), compose("loss.alpha=0.5", name=name))


class TestSettings:
    def test_of_a_module(self):
        class Loss(nn.Module):
            def __init__(self, gamma):
                super().__init__()
                self.register_buffer("gamma", torch.tensor(gamma))
                self.register_buffer("seen", torch.zeros(3))
                self.weight = nn.Parameter(torch.tensor(gamma))

        old, new = Loss(0.9), Loss(0.8)
        old.seen += 1
        put_back = settings_of(new)
        new.load_state_dict(old.state_dict())
        put_back()
        assert new.gamma == torch.tensor(0.8)
        assert new.weight == torch.tensor(0.9)
        assert new.seen.tolist() == [1, 1, 1]

    def test_of_a_multiplier(self):
        old, new = (Multiplier(1, Lagrangian(lr=lr), None, "cpu") for lr in (0.05, 0.5))
        old.update(torch.ones(1))
        new.load_state_dict(old.state_dict())
        assert new().item() == old().item()
        assert new.optim.param_groups[0]["lr"] == 0.5
        assert len(new.optim.state_dict()["state"]) == 1

    def test_of_nothing(self):
        settings_of({"frames": 3})()


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    path = tmp_path_factory.mktemp("runs") / "run"
    tiny.launch(path, "collector.total_frames=100", "loss.cost_limit=2.5", "loss.anneal_frames=0")
    return path


def test_resumed(trained, monkeypatch, capsys):
    """What is not given stays, what is given acts, is said and remembered."""
    made = []

    class Run(runs.Run):
        def close(self):
            made.append(self)
            super().close()

    monkeypatch.setattr(trainer, "Run", Run)
    more = ["optim.max_kl=0.5", "optim.critic_lr=0.125", "loss.gamma=0.9", "optim.damping=0.3"]
    tiny.launch(trained, "resume=true", "collector.total_frames=200", *more)
    kept = made[0].checkpoint.components
    group = kept["policy_optim"].param_groups[0]
    assert (group["max_kl"], group["damping"]) == (0.5, 0.3)
    assert kept["critic_optim"].param_groups[0]["lr"] == 0.125
    assert float(kept["reward_loss"].value_estimator.gamma) == pytest.approx(0.9)
    assert float(kept["cost_loss"].value_estimator.gamma) == pytest.approx(0.99)
    limits = (trained / "log/scalars/update/cost_limit.csv").read_text().split()
    assert limits == ["100,2.5", "200,2.5"]
    assert "from frame 100 on, optim.max_kl is 0.5; it was 0.02" in capsys.readouterr().out
    settings = saved.read_config(trained / "config.yaml")
    assert (settings["loss"]["cost_limit"], settings["optim"]["max_kl"]) == (2.5, 0.5)
    history = [json.loads(line) for line in (trained / saved.HISTORY).read_text().splitlines()]
    assert [entry["frames"] for entry in history] == [0, 100]
    assert history[0]["changed"] == {}
    assert history[1]["changed"]["loss.gamma"] == {"from": 0.99, "to": 0.9}
    before = (trained / "config.yaml").read_bytes()
    with pytest.raises(ValueError, match=r"env.robot was .point. and is .car."):
        tiny.launch(trained, "resume=true", "collector.total_frames=300", "env.robot=car")
    assert (trained / "config.yaml").read_bytes() == before


def test_page_of_configurations_is_the_declared_one(monkeypatch):
    root = Path(options.__file__).parents[2]
    monkeypatch.syspath_prepend(root / "docs")
    write_options = importlib.import_module("write_options")
    for page in write_options.PAGES:
        assert page.read_text() == write_options.text(page), "run docs/write_options.py"
