"""The baselines and the ablations, from the options to the results."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
import torch
from tensordict import TensorDict

from torchrl_safe import record
from torchrl_safe.trainers import METHODS, cli, load_policy
from torchrl_safe.trainers.commands import evaluate, watch

TINY = [
    "num_threads=1",
    "env.num_envs=20",
    "env.episode_length=50",
    "collector.frames_per_batch=400",
    "collector.init_frames=400",
    "policy.num_cells=[16]",
    "critic.num_cells=[16]",
    "eval.interval=1200",
    "eval.num_episodes=2",
    "eval.num_steps=20",
    "eval.final_episodes=2",
    "checkpoint.interval=400",
    "video.num_steps=0",
]
GRADIENT = ["replay_buffer.size=5000", "optim.num_updates=2", "optim.minibatch_size=50"]
SURROGATE = ["optim.critic_rounds=1", "optim.minibatch_size=200"]
REPLAY = ["replay_buffer.size=5000", "optim.critic_frames=400", "optim.policy_frames=400"]

CASES = {
    "tac": ("tac", GRADIENT, {"update/loss_qvalue", "update/alpha"}),
    "wcsac": ("wcsac", GRADIENT, {"update/loss_cost_std", "update/multiplier"}),
    "sac_lagrangian": ("sac_lagrangian", GRADIENT, {"update/loss_actor", "update/multiplier"}),
    "sac_pid": ("sac_pid", GRADIENT, {"update/loss_actor", "update/multiplier"}),
    "td3_lagrangian": ("td3_lagrangian", GRADIENT, {"update/loss_actor", "update/multiplier"}),
    "cpo": ("cpo", SURROGATE, {"update/kl", "update/loss_cost_value"}),
    "trc": ("trc", SURROGATE, {"update/kl", "update/loss_cost_variance"}),
    **{
        name: (name, SURROGATE, {"update/kl", "update/loss_value", "update/multiplier"})
        for name in ("ppo_lagrangian", "ppo_pid", "trpo_lagrangian", "trpo_pid", "focops")
    },
    "pcpo": ("pcpo", SURROGATE, {"update/kl", "update/loss_cost_value", "update/cost_level"}),
    "crpo": ("crpo", SURROGATE, {"update/kl", "update/cost_level", "update/lowers_cost"}),
    "p3o": ("p3o", SURROGATE, {"update/kl", "update/loss_value", "update/cost_level"}),
    "cup": ("cup", SURROGATE, {"update/kl", "update/projection_kl", "update/multiplier"}),
    **{
        f"{base}_{how}": (f"{base}_{how}", SURROGATE, {"update/kl", "update/overdrawn"})
        for base in ("ppo", "trpo")
        for how in ("saute", "early_terminated")
    },
    "offpolicy_trc": ("offpolicy_trc", [*SURROGATE, *REPLAY], {"update/kl", "update/loss_value"}),
    "safetac_lagrangian": (
        "safetac",
        ["update=lagrangian", *SURROGATE, *REPLAY],
        {"update/multiplier", "update/loss_cost_quantiles"},
    ),
    "safetac_pid": (
        "safetac",
        ["update=pid", *SURROGATE, *REPLAY],
        {"update/multiplier", "update/loss_cost_quantiles"},
    ),
}


def launch(name: str, run_dir: Path, *overrides: str) -> None:
    options = cli.compose(name, [f"run_dir={run_dir}", *TINY, *overrides])
    METHODS[name](options=options).train()


@pytest.mark.parametrize("method", sorted(CASES.keys() - {"cpo", "sac_lagrangian"}))
def test_resumes_exactly(tmp_path, method):
    """Two halves are one run: multipliers and target networks are in a checkpoint, too."""
    script, overrides, logged = CASES[method]
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    launch(script, whole, *overrides, "collector.total_frames=1600")
    launch(script, halves, *overrides, "collector.total_frames=800")
    launch(script, halves, *overrides, "collector.total_frames=1600", "resume=true")

    curves, others = (record.read_metrics(path / "log") for path in (whole, halves))
    assert logged <= curves.keys()
    for name in curves:
        if name.startswith(("train/", "update/")):
            assert curves[name][0].tolist() == others[name][0].tolist(), name
            torch.testing.assert_close(
                curves[name][1], others[name][1], rtol=0, atol=0, equal_nan=True, msg=name
            )
    results = json.loads((halves / "results.json").read_text())
    assert results["frames"] == 1600
    assert math.isfinite(results["eval/score"])


@pytest.mark.parametrize("method", ["sac_lagrangian", "cpo"])
def test_policy_can_be_loaded(tmp_path, method):
    script, overrides, logged = CASES[method]
    launch(script, tmp_path / "run", *overrides, "collector.total_frames=800")
    assert logged <= record.read_metrics(tmp_path / "run" / "log").keys()
    policy = load_policy(tmp_path / "run")
    states = TensorDict({"observation": torch.randn(3, 24)}, [3])
    assert policy(states)["action"].shape == (3, 2)


@pytest.mark.parametrize("method", ["tac", "wcsac", "trc"])
def test_run_can_be_watched_and_evaluated(tmp_path, method, capsys):
    """No method logs all that SafeTAC does: the tools show what there is."""
    script, overrides, _ = CASES[method]
    launch(script, tmp_path / "run", *overrides, "collector.total_frames=800")
    watch.main(tmp_path / "run", every=1.0, once=True)
    assert "800 of 800" in capsys.readouterr().out
    metrics = evaluate.main(tmp_path / "run", episodes=2, seed=5, film=False)
    assert math.isfinite(metrics["det/score"])
    assert not any(name.startswith("calibration/") for name in metrics)
    assert "no calibration" in capsys.readouterr().out


@pytest.mark.parametrize("method", ["trc", "safetac_pid"])
def test_limit_falls_as_configured(tmp_path, method):
    script, overrides, _ = CASES[method]
    schedule = ["loss.initial_cost_limit=9.0", "loss.cost_limit=5.0", "loss.anneal_frames=800"]
    launch(script, tmp_path / "run", *overrides, *schedule, "collector.total_frames=1200")
    frames, limits = record.read_metrics(tmp_path / "run" / "log")["update/cost_limit"]
    assert frames.tolist() == [400, 800, 1200]
    assert limits.tolist() == pytest.approx([7.0, 5.0, 5.0])


def test_update_chooses_how_the_policy_moves(tmp_path):
    """Same seed, so that runs differ by the update alone; only a trust region has a KL."""
    violated = ["loss.cost_limit=0", "loss.anneal_frames=0"]
    overrides = [*SURROGATE, *REPLAY, *violated, "collector.total_frames=800"]
    curves = {}
    for update in ("trust_region", "lagrangian", "pid"):
        launch("safetac", tmp_path / update, f"update={update}", *overrides)
        curves[update] = record.read_metrics(tmp_path / update / "log")
    launch("safetac", tmp_path / "default", *overrides)
    default = record.read_metrics(tmp_path / "default" / "log")
    assert default["update/kl"][1].tolist() == curves["trust_region"]["update/kl"][1].tolist()
    assert (default["update/kl"][1] > 0).all()
    assert "update/multiplier" not in default
    for update in ("lagrangian", "pid"):
        assert "update/kl" not in curves[update]

    def multipliers(update: str) -> list[float]:
        return curves[update]["update/multiplier"][1].tolist()

    assert multipliers("lagrangian") != multipliers("pid")
    violation = curves["pid"]["update/cost_level"][1][0]
    assert violation > 0
    # kp c + ki (init / ki + c), with the gains of the configuration.
    assert multipliers("pid")[0] == pytest.approx(0.1 + 0.06 * violation, rel=1e-4)


@pytest.mark.parametrize(("tolerance", "turn"), [(0.0, 1.0), (1.0, 0.0)])
def test_crpo_lowers_what_exceeds_its_tolerance(tmp_path, tolerance, turn):
    """A cost of a step is at most 1, so that it never exceeds a limit of 0 by more than that."""
    options = ["loss.cost_limit=0", "loss.limit_unit=step", f"loss.tolerance={tolerance}"]
    launch("crpo", tmp_path / "run", *SURROGATE, *options, "collector.total_frames=800")
    curves = record.read_metrics(tmp_path / "run" / "log")
    assert (curves["update/cost_level"][1] > 0).all()
    assert curves["update/lowers_cost"][1].tolist() == [turn, turn]


@pytest.mark.parametrize(("kind", "name"), [("pid", "pid.ki"), ("lagrangian", "lagrangian.init")])
def test_impossible_gain(tmp_path, kind, name):
    with pytest.raises(ValueError, match=f"{name} must be a number"):
        launch("safetac", tmp_path / "run", f"update={kind}", f"{name}=-1")
    assert not (tmp_path / "run").exists()
