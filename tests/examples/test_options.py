"""A resumed run is the run: which options it keeps, takes up and refuses."""

from __future__ import annotations

import json
import subprocess
import sys

import hydra
import pytest
import tiny
import torch
from omegaconf import OmegaConf
from torch import nn

from torchrl_safe.trainers import options, policy_steps, saved
from torchrl_safe.trainers import run as runs
from torchrl_safe.trainers.options import given, settings_of, settle


def compose(*overrides, name="safetac_point"):
    with hydra.initialize_config_dir(str(tiny.EXAMPLES), version_base="1.3"):
        return hydra.compose(name, list(overrides))


def resolved(cfg):
    return OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))


class TestGiven:
    def test_composed(self):
        assert given(compose()) == set()
        assert given(compose("loss.cost_limit=2.5", "policy.num_cells=[8]", "seed=1")) == {
            "loss.cost_limit",
            "policy.num_cells",
            "seed",
        }

    def test_what_follows_another_option_is_not_given(self):
        assert given(compose("loss.cost_limit=2.5", name="trc")) == {"loss.cost_limit"}

    def test_in_other_files(self):
        """The methods differ in what their own files say."""
        for name in ("cpo", "trc", "wcsac", "sac_lagrangian", "tac", "offpolicy_trc"):
            assert given(compose(name=name)) == set()

    def test_command_line(self, tmp_path):
        """A value that is the default one is given, too, if somebody writes it."""
        script = tmp_path / "script.py"
        script.write_text(
            "import hydra, options\n"
            f"@hydra.main(config_path={str(tiny.EXAMPLES)!r}, config_name='safetac_point',"
            " version_base='1.3')\n"
            "def main(cfg):\n    print(sorted(options.given(cfg)))\n"
            "main()\n"
        )
        arguments = ["loss.cost_limit=5.0", "++optim.max_kl=0.02", "pid={kp: 0.05, ki: 0.01}"]
        result = subprocess.run(
            [sys.executable, script, *arguments],
            env={"PYTHONPATH": f"{tiny.EXAMPLES}:{tiny.EXAMPLES.parent}", "PATH": ""},
            capture_output=True,
            text=True,
            check=False,
        )
        assert "['loss.cost_limit', 'optim.max_kl', 'pid.kd', 'pid.ki', 'pid.kp']" in result.stdout


class TestSettle:
    def test_keeps_and_changes(self):
        before = resolved(compose("loss.cost_limit=2.5", "loss.entropic_index=1.5", "run_dir=a"))
        cfg = compose("loss.entropic_index=1.4", "resume=true", "run_dir=b")
        settled, changed = settle(before, cfg)
        assert changed == {"loss.entropic_index": (1.5, 1.4)}
        assert settled.loss.cost_limit == 2.5
        assert settled.loss.entropic_index == 1.4
        assert settled.run_dir == "b"
        assert settled.resume

    def test_options_that_a_newer_version_has(self):
        before = resolved(compose("seed=3"))
        del before.optim["recovery_ratio"]
        settled, changed = settle(before, compose())
        assert settled.optim.recovery_ratio == 0.7
        assert settled.seed == 3
        assert changed == {}

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
            settle(resolved(compose()), compose(override))

    def test_refuses_another_method(self):
        with pytest.raises(ValueError, match="script was 'trc' and is 'cpo'"):
            settle(resolved(compose(name="trc")), compose(name="cpo"))

    def test_a_learned_temperature_has_no_option_any_more(self):
        settle(resolved(compose()), compose("loss.alpha=0.1"))
        with pytest.raises(ValueError, match=r"loss\.alpha"):
            settle(resolved(compose(name="tac")), compose("loss.alpha=0.5", name="tac"))

    def test_every_fixed_option_exists(self):
        from torchrl_safe.trainers.config import RULES

        assert set(options.FIXED) | set(options.LEARNED) <= RULES.keys()


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
        old, new = (compose(f"lagrangian.lr={lr}") for lr in (0.05, 0.5))
        old, new = (policy_steps.Multiplier(cfg, "lagrangian") for cfg in (old, new))
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

    monkeypatch.setattr(tiny.safetac_point, "Run", Run)
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
    cfg = saved.read_config(trained / "config.yaml")
    assert (cfg.loss.cost_limit, cfg.optim.max_kl) == (2.5, 0.5)
    history = [json.loads(line) for line in (trained / runs.HISTORY).read_text().splitlines()]
    assert [entry["frames"] for entry in history] == [0, 100]
    assert history[0]["changed"] == {}
    assert history[1]["changed"]["loss.gamma"] == {"from": 0.99, "to": 0.9}
    before = (trained / "config.yaml").read_bytes()
    with pytest.raises(ValueError, match=r"env.robot was .point. and is .car."):
        tiny.launch(trained, "resume=true", "collector.total_frames=300", "env.robot=car")
    assert (trained / "config.yaml").read_bytes() == before
