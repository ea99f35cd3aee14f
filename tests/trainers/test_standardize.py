"""Observations that networks standardise: against numpy, and through a whole run."""

from __future__ import annotations

import numpy as np
import pytest
import small
import torch
from torch import nn
from torchrl.envs import GymEnv, TransformedEnv

from torchrl_safe.envs import CostFunction
from torchrl_safe.trainers import METHODS, SafeTAC, cli, load_policy
from torchrl_safe.trainers.networks import Standardize, make_critic, scale_of

FRAMES = 120  # three episodes of 40 steps


def options(method, *overrides, run_dir):
    return small.options(
        method,
        "env.task=SafetyPointGoal1",
        "env.episode_length=40",
        f"env.standardize_frames={FRAMES}",
        *overrides,
        run_dir=run_dir,
    )


def pendulum():
    return TransformedEnv(GymEnv("Pendulum-v1"), CostFunction(lambda data: data["action"].abs()))


class TestScale:
    def test_is_numpys(self):
        rng = np.random.default_rng(0)
        values = rng.normal([3.0, -100.0, 0.0], [2.0, 0.5, 1e-3], size=(7, 11, 3))
        scale = scale_of(torch.tensor(values, dtype=torch.float32))
        flat = values.reshape(-1, 3)
        np.testing.assert_allclose(scale.loc, flat.mean(0), rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(scale.scale, flat.std(0, ddof=1), rtol=1e-4)

    def test_constants_keep_their_unit(self):
        """Gravity, which differs by rounding alone, is no signal to blow up."""
        gravity = 9.81 + 1e-6 * torch.tensor([0.0, 1.0, -1.0, 0.0])
        scale = scale_of(torch.stack([gravity, torch.zeros(4)], -1))
        assert scale.scale.tolist() == [1.0, 1.0]

    def test_far_values_are_cut_off(self):
        standardize = Standardize(torch.zeros(2), torch.tensor([1.0, 4.0]), limit=3.0)
        assert standardize(torch.tensor([100.0, -100.0])).tolist() == [3.0, -3.0]


class TestTraining:
    @pytest.mark.parametrize(
        "method", ["safetac", "cpo", "wcsac", "td3_lagrangian", "ppo_lagrangian", "ppo_saute"]
    )
    def test_every_kind_of_method(self, tmp_path, method):
        """All networks have the scales, and those of actions stay as they are."""
        trainer = METHODS[method](options=options(method, run_dir=tmp_path / "run"))
        policy = trainer.train()
        loc, scale = trainer.scales["observation"]
        width = trainer.make_env(1, 0).observation_spec["observation"].shape[-1]
        assert loc.shape == scale.shape == (width,)
        assert loc[2] == pytest.approx(9.81, abs=1e-3)
        [layer] = [m for m in policy.modules() if isinstance(m, Standardize)]
        assert torch.equal(layer.loc, loc)
        assert torch.equal(layer.scale, scale)
        [layer, *rest] = [
            m
            for m in trainer.make_critic(trainer.make_env(1, 0), "value").modules()
            if isinstance(m, Standardize)
        ]
        assert not rest
        assert torch.equal(layer.scale, torch.cat([scale, torch.ones(2)]))

    def test_saved_policy_acts_alike(self, tmp_path):
        trainer = SafeTAC(options=options("safetac", run_dir=tmp_path / "run"))
        policy = trainer.train().eval()
        data = trainer.make_env(2, 5).reset()
        saved = load_policy(tmp_path / "run")
        with torch.no_grad():
            ours, theirs = policy.get_dist(data.copy()), saved.get_dist(data.copy())
        assert torch.equal(ours.deterministic_sample, theirs.deterministic_sample)

    def test_units_do_not_matter(self, tmp_path):
        """A policy that reads observations in other units acts alike once its scales are theirs."""
        trainer = SafeTAC(options=options("safetac", run_dir=tmp_path / "run"))
        policy = trainer.train()
        data = trainer.make_env(3, 5).reset()
        with torch.no_grad():
            expected = policy.get_dist(data.copy()).deterministic_sample
            [layer] = [m for m in policy.modules() if isinstance(m, Standardize)]
            layer.loc *= 1000.0
            layer.scale *= 1000.0
            data["observation"] *= 1000.0
            torch.testing.assert_close(policy.get_dist(data).deterministic_sample, expected)

    def test_resumed_run_has_the_same(self, tmp_path):
        words = [*small.COMMON, *small.OF_METHOD["safetac"], "env.task=SafetyPointGoal1"]
        words += [f"run_dir={tmp_path / 'run'}", f"env.standardize_frames={FRAMES}"]
        cli.main(["train", "safetac", *words])
        before = dict(load_policy(tmp_path / "run").named_buffers())
        cli.main(["train", "safetac", *words, "resume=true", "collector.total_frames=600"])
        after = dict(load_policy(tmp_path / "run").named_buffers())
        assert before.keys() == after.keys()
        assert all(torch.equal(before[name], after[name]) for name in before)

    def test_environment_of_ones_own(self, tmp_path):
        """Pendulum's observation is a cosine, a sine and a speed of up to 8."""
        how = {"env.standardize_frames": 400, "env.num_envs": 2, "run_dir": str(tmp_path / "run")}
        scale = SafeTAC(pendulum, **how).measure_scales()["observation"].scale
        assert (scale[:2] < 1.0).all()
        assert 1.0 < scale[2] < 8.0

    def test_network_of_ones_own(self, tmp_path):
        trainer = SafeTAC(
            options=options("safetac", run_dir=tmp_path / "run"),
            network=lambda inputs, outputs: nn.Linear(inputs[0].shape[-1], outputs),
        )
        with pytest.raises(ValueError, match=r"env.standardize_frames must be 0 .*, got 120"):
            trainer.train()


def test_default_changes_nothing(tmp_path):
    """No layer where nothing is asked for: policies that were kept still load."""
    trainer = SafeTAC("point", run_dir=str(tmp_path / "run"))
    critic = make_critic(trainer.options, trainer.make_env(1, 0), "value")
    assert not [m for m in critic.modules() if isinstance(m, Standardize)]
