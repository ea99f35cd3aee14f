"""Critics of quantiles in training: what they learn from, what they learn, what a run keeps."""

from __future__ import annotations

import numpy as np
import pytest
import tiny
import torch
from tensordict import TensorDict

from torchrl_safe import record
from torchrl_safe.trainers import SafeTAC
from torchrl_safe.trainers.cost_sums import CostSums, known_share, learned_by

QUANTILES = ("safety_critic.kind=quantiles", "safety_critic.num_updates=5")
N = 64  # environments


@pytest.fixture
def trainer():
    torch.manual_seed(0)
    trainer = SafeTAC(
        options=tiny.options("unused", *QUANTILES, "critic.num_cells=[32]").changed(
            **{
                "safety_critic.window": 6,
                "safety_critic.num_updates": 200,
                "safety_critic.num_quantiles": 64,
                "optim.minibatch_size": 64,
                "optim.critic_lr": 1e-2,
            }
        )
    )
    trainer.build(trainer.make_env(1, seed=0))
    return trainer


def steps(cost: torch.Tensor, episode: int = 0, ends: bool = False) -> TensorDict:
    """Steps ``[N, T]`` of equal states, with the given costs."""
    shape = cost.shape
    flag = torch.zeros(*shape, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": torch.zeros(*shape, 24),
            "action": torch.zeros(*shape, 2),
            "collector": {"traj_ids": torch.full(shape, episode)},
            "next": {
                "observation": torch.zeros(*shape, 24),
                "cost": cost.unsqueeze(-1),
                "done": flag | ends,
                "terminated": flag | ends,
            },
        },
        batch_size=shape,
    )


class TestWindow:
    def test_keeps_the_newest_in_order(self, trainer):
        sums = trainer.cost_sums
        costs = torch.arange(12.0).expand(N, 12)
        for part in costs.split(4, 1):
            sums.extend(steps(part))
        assert sums.steps["next", "cost"].squeeze(-1).equal(costs[:, -6:])

    def test_episodes_do_not_run_into_one_another(self, trainer):
        """As where a resumed run of several processes goes on with new layouts."""
        sums = trainer.cost_sums
        sums.extend(steps(torch.zeros(N, 3), episode=0))
        sums.extend(steps(torch.ones(N, 3), episode=1))
        rows = sums.rows()
        assert rows["next", "done"][0, :, 0].tolist() == [False, False, True, False, False, False]
        assert not rows["next", "terminated"].any()
        assert not sums.steps["next", "done"].any()  # what is kept is as it was

    def test_another_width(self, trainer):
        trainer.cost_sums.extend(steps(torch.zeros(N, 3)))
        with pytest.raises(ValueError, match=r"all environments in every batch, got 2 after 64"):
            trainer.cost_sums.extend(steps(torch.zeros(2, 3)))

    def test_nothing_yet(self, trainer):
        with pytest.raises(RuntimeError, match="extend must be called before"):
            trainer.cost_sums.fit()

    def test_state(self, trainer):
        sums = trainer.cost_sums
        sums.extend(steps(torch.rand(N, 6)))
        sums.fit()
        other = CostSums(trainer, trainer.cost_losses)
        other.load_state_dict(sums.state_dict())
        assert (other.steps == sums.steps).all()
        torch.testing.assert_close(other.optim.state_dict(), sums.optim.state_dict())
        empty = CostSums(trainer, trainer.cost_losses)
        empty.load_state_dict(CostSums(trainer, trainer.cost_losses).state_dict())
        assert empty.steps is None


def test_learns_the_distribution(trainer):
    """Episodes of one step that cost 8 with probability .1: mean .8, the worst eighth 6.4."""
    cost = 8.0 * (torch.arange(N * 6).reshape(N, 6) % 10 == 0)
    trainer.cost_sums.extend(steps(cost, ends=True))
    for _ in range(3):
        metrics = trainer.cost_sums.fit()
    (loss,) = trainer.cost_losses.values()
    state = steps(torch.zeros(1, 1))[0]
    mean, _ = loss.predict(state, state["action"])
    risk = loss.cvar(state, state["action"])
    assert mean.item() == pytest.approx(cost.mean().item(), abs=0.25)
    assert risk.item() == pytest.approx(cost.mean().item() / 0.125, abs=0.7)
    assert metrics["update/skipped_cost_steps"] == 0


def test_known_share():
    done = torch.zeros(2, 4, 1, dtype=torch.bool)
    done[0, 1] = done[1, 2] = True
    terminated = done.clone()
    terminated[1] = False
    known = known_share(TensorDict(done=done, terminated=terminated), 0.5)
    assert known.tolist() == [[1, 1, 0.75, 0.5], [0.875, 0.75, 0.5, 0.5]]


class TestLeftOut:
    def test_a_fourth_of_the_episodes(self):
        learned = learned_by(torch.arange(40).reshape(8, 5), 2)
        assert learned.shape == (8, 5, 2)
        assert (~learned).sum((0, 1)).tolist() == [10, 10]
        assert learned.any(-1).all()  # some network learns from every step
        assert (learned[0, :4, 0] == torch.tensor([False, True, True, True])).all()

    def test_not_where_episodes_are_few(self):
        assert learned_by(torch.arange(7), 3).all()

    def test_layouts_by_heart_are_found_out(self, trainer):
        """Costs that nothing tells apart but the episode: what is learned of it fits no other."""
        generator = torch.Generator().manual_seed(0)
        for _ in range(40):
            data = steps(torch.rand(N, 1, generator=generator).expand(N, 6) ** 4, ends=True)
            data["collector", "traj_ids"] = torch.arange(N)[:, None].expand(N, 6)
            data["observation"] = torch.randn(N, 1, 24, generator=generator).expand(N, 6, 24)
            trainer.cost_sums.steps = None
            trainer.cost_sums.extend(data)
            metrics = trainer.cost_sums.fit()
        (loss,) = trainer.cost_losses.values()
        assert metrics["calibration/predicted_risk"] > 0
        assert loss.scales[1] > 1.2  # the spread was too small


class TestHandOver:
    def test_predicts_what_new_episodes_cost(self, trainer):
        """The risk of the last policy, whatever the critic had learned."""
        trainer.options = trainer.options.changed(
            **{"eval.num_steps": 40, "safety_critic.calibration_frames": 640}
        )
        trainer.cost_sums.extend(steps(3 * torch.rand(N, 6), ends=True))
        trainer.cost_sums.fit()  # of costs that the episodes will not have
        (loss,) = trainer.cost_losses.values()
        before = loss.scales.clone()
        first = trainer.cost_sums.calibrate()
        assert first["calibration/predicted_mean"] != pytest.approx(
            first["calibration/realised_mean"], rel=0.05
        )
        random_state = torch.get_rng_state()
        again = trainer.cost_sums.calibrate()  # of the same episodes
        assert torch.get_rng_state().equal(random_state)
        assert again["calibration/realised_mean"] == first["calibration/realised_mean"]
        for name in ("mean", "risk"):
            predicted, realised = (
                again[f"calibration/{kind}_{name}"] for kind in ("predicted", "realised")
            )
            assert predicted == pytest.approx(realised, rel=1e-3)
        trainer.cost_sums.calibrate()
        trainer.cost_sums.take_back()
        assert loss.scales.equal(before)
        assert loss.stretch.tolist() == [0.0, 1.0]

    @pytest.mark.parametrize(
        ("frames", "expected"), [(0, (1, 0)), (39, (1, 0)), (40, (1, 1)), (400, (4, 2))]
    )
    def test_as_many_steps_as_asked_for(self, trainer, frames, expected):
        trainer.options = trainer.options.changed(
            **{"eval.num_steps": 40, "safety_critic.calibration_frames": frames}
        )
        num_envs, num_steps, rounds = trainer.cost_sums.episodes()
        assert num_steps == 40
        assert (num_envs, rounds) == expected

    def test_half_as_many_as_in_training(self, trainer):
        trainer.options = trainer.options.changed(
            **{
                "eval.num_steps": 1000,
                "collector.total_frames": 100_000,
                "collector.frames_per_batch": 400,
                "env.num_envs": 40,
            }
        )
        # What a step is followed by for 2 % of its weight: 390 steps at .99, beside 100 judged.
        assert trainer.cost_sums.episodes() == (40, 490, 2)
        trainer.options = trainer.options.changed(**{"collector.total_frames": 10_000_000})
        assert trainer.cost_sums.episodes() == (40, 490, 25)


def test_continues_exactly(tmp_path):
    """A run in two parts is the run in one, to the last bit."""
    tiny.launch(tmp_path / "whole", *QUANTILES, "collector.total_frames=400")
    tiny.launch(tmp_path / "parts", *QUANTILES, "collector.total_frames=200")
    tiny.launch(tmp_path / "parts", *QUANTILES, "collector.total_frames=400", "resume=true")
    whole, parts = (record.read_metrics(tmp_path / name / "log") for name in ("whole", "parts"))
    assert "update/loss_cost_quantiles" in whole
    assert "update/loss_cost_value" not in whole
    for name in whole:
        if name.startswith(("update/", "train/")):
            for expected, got in zip(whole[name], parts[name], strict=True):
                np.testing.assert_array_equal(got, expected, err_msg=name)
