"""What is not finite never reaches a parameter or the state of an optimizer."""

from __future__ import annotations

import copy
import itertools
import math

import pytest
import torch
from torch.utils._pytree import tree_leaves

from torchrl_safe import record
from torchrl_safe.modules import DISTANCES
from torchrl_safe.trainers import METHODS, SafeTAC, cli, trainer
from torchrl_safe.trainers.off_policy import replayed

MATCHED_BOUND = DISTANCES["matched_bound"]
TINY = [
    "num_threads=1",
    "env.num_envs=4",
    "env.episode_length=50",
    "collector.frames_per_batch=200",
    "collector.init_frames=0",
    "replay_buffer.size=1000",
    "replay_buffer.slice_len=10",
    "policy.num_cells=[8]",
    "critic.num_cells=[8]",
    "optim.critic_rounds=1",
    "optim.critic_frames=100",
    "optim.minibatch_size=50",
    "optim.kl=matched_bound",
]


GAUSSIAN = "safety_critic.kind=gaussian"  # whose critics learn in one step with the reward's


class Update:
    """One update of SafeTAC, with all that it may change."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        self.trainer = SafeTAC(options=cli.compose("safetac", [*TINY, GAUSSIAN]))
        env = self.trainer.make_env(4, seed=0)
        self.critic_optim = self.trainer.build(env)["critic_optim"]
        self.policy = self.trainer.policy
        self.losses = (self.trainer.reward_loss, self.trainer.cost_losses["cost"])
        with torch.no_grad():  # as collectors do
            self.batch = env.rollout(50, self.policy, break_when_any_done=False)
        self.batch["collector", "traj_ids"] = torch.arange(4)[:, None].expand(4, 50).clone()
        self.fit(self.batch)  # Adam has moments to lose

    def fit(self, batch):
        self.trainer.buffer.empty()
        self.trainer.buffer.extend(batch.select(*replayed(self.trainer)))
        return self.trainer.fit_critics()

    def step(self, batch):
        limits = self.trainer.limits()
        states = batch.select("observation").flatten()
        closure = self.trainer.policy_closure(states, limits, batch, distance=MATCHED_BOUND)
        return self.trainer.trust_region.step(closure)

    def state(self):
        parts = (*self.losses, self.policy, self.critic_optim)
        return copy.deepcopy([part.state_dict() for part in parts])

    def is_at(self, state) -> bool:
        old, new = (
            [leaf for leaf in tree_leaves(s) if isinstance(leaf, torch.Tensor)]
            for s in (state, self.state())
        )
        return len(old) == len(new) and all(map(torch.equal, old, new))


@pytest.fixture(scope="module")
def update():
    return Update()


BAD = pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])


@BAD
@pytest.mark.parametrize("key", ["observation", ("next", "reward"), ("next", "cost")])
def test_data(update, key, bad):
    batch, state = update.batch.clone(), update.state()
    batch[key].fill_(bad)
    metrics = update.fit(batch)
    assert metrics["update/skipped_steps"] == 2
    assert update.is_at(state)
    if key != ("next", "reward"):  # the policy's step sees rewards through the critics only
        report = update.step(batch)
        assert not report.accepted
        assert "nan" in report.reason or "inf" in report.reason
        assert update.is_at(state)
    # Training goes on with the next good batch.
    assert update.fit(update.batch)["update/skipped_steps"] == 0
    assert not update.is_at(state)


@BAD
def test_gradients(update, bad):
    state = update.state()
    param = update.critic_optim.param_groups[0]["params"][0]
    hook = param.register_hook(lambda grad: torch.full_like(grad, bad))
    assert update.fit(update.batch)["update/skipped_steps"] == 2
    assert update.is_at(state)
    hook.remove()
    assert update.fit(update.batch)["update/skipped_steps"] == 0


def test_stops_by_configuration(update, monkeypatch):
    monkeypatch.setattr(update.trainer.fit_critics.steps, "max_skipped", 0)
    batch, state = update.batch.clone(), update.state()
    batch["next", "reward"].fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"max_skipped=0: .*'loss_qvalue': nan"):
        update.fit(batch)
    assert update.is_at(state)


@BAD
@pytest.mark.parametrize("critic", ["qvalue_network_params", "cost_network_params"])
def test_critic_outputs(update, critic, bad):
    """A critic that went bad teaches nothing to the others, and the policy does not follow it."""
    owner = update.losses[critic.startswith("cost")]
    param = next(iter(getattr(owner, critic).parameters()))
    good = param.detach().clone()
    with torch.no_grad():
        param.fill_(bad)
    state = update.state()
    assert update.fit(update.batch)["update/skipped_steps"] == 2
    report = update.step(update.batch)
    assert not report.accepted
    assert "the closure returned" in report.reason
    with torch.no_grad():  # NaN is unequal to itself: bad and all, nothing has moved
        assert param.isnan().all() if math.isnan(bad) else (param == bad).all()
        param.copy_(good)
    state = update.state()
    assert update.fit(update.batch)["update/skipped_steps"] == 0
    assert update.step(update.batch).reason == ""
    assert not update.is_at(state)


@BAD
@pytest.mark.parametrize("where", ["curvature", "gradient"])
def test_curvature_products_and_policy_gradients(update, monkeypatch, bad, where):
    state = update.state()

    def spoiled(old, new):
        kl = MATCHED_BOUND.kl(old, new)
        if new["loc"].requires_grad and where == "curvature":
            new["loc"].register_hook(lambda grad: grad * bad)
        return kl

    param = next(update.policy.parameters())
    hook = param.register_hook(lambda grad: grad * bad if where == "gradient" else grad)
    monkeypatch.setattr(update.trainer.trust_region, "statistics_kl", spoiled)
    report = update.step(update.batch)
    monkeypatch.undo()
    hook.remove()
    if where == "curvature" or not report.accepted:
        assert not report.accepted
        assert report.reason == "a gradient or a product with the curvature is not finite"
        assert update.is_at(state)
    assert update.step(update.batch).accepted
    assert not update.is_at(state)


class TestMethods:
    """A reward that is not a number enters the second batch of a run, and of its replay buffer."""

    @pytest.fixture
    def spoiled(self, monkeypatch):
        calls = itertools.count(1)

        def count_violations(batch):
            if next(calls) == 2:
                batch["next", "reward"].fill_(math.nan)
            return record.count_violations(batch)

        monkeypatch.setattr(trainer, "count_violations", count_violations)

    COMMON = (
        "num_threads=1 env.num_envs=4 env.episode_length=50 collector.frames_per_batch=200 "
        "collector.init_frames=0 collector.total_frames=600 policy.num_cells=[8] "
        "critic.num_cells=[8] eval.interval=10000 eval.num_episodes=1 eval.num_steps=5 "
        "eval.final_episodes=1 video.num_steps=0"
    )
    GRADIENT = "replay_buffer.size=2000 optim.num_updates=3 optim.minibatch_size=50"
    SURROGATE = "optim.critic_rounds=1 optim.minibatch_size=100"
    REPLAY = "replay_buffer.size=2000 optim.critic_frames=200 optim.policy_frames=200"

    METHOD = pytest.mark.parametrize(
        ("name", "overrides"),
        [
            ("tac", GRADIENT),
            ("wcsac", GRADIENT),
            ("trc", SURROGATE),
            ("ppo_lagrangian", SURROGATE),
            ("trpo_pid", SURROGATE),
            ("focops", SURROGATE),
            ("cup", SURROGATE),
            ("p3o", SURROGATE),
            ("crpo", SURROGATE),
            ("pcpo", SURROGATE),
            ("ppo_saute", SURROGATE),
            ("td3_lagrangian", f"{GRADIENT} optim.policy_delay=3"),
            ("offpolicy_trc", f"{SURROGATE} {REPLAY}"),
            ("safetac", f"{SURROGATE} {REPLAY} update=pid"),
        ],
    )

    def launch(self, name, run_dir, overrides):
        words = f"run_dir={run_dir} {self.COMMON} {overrides}".split()
        METHODS[name](options=cli.compose(name, words)).train()

    @METHOD
    def test_goes_on(self, spoiled, tmp_path, name, overrides):
        run_dir = tmp_path / "run"
        self.launch(name, run_dir, overrides)
        skipped = record.read_metrics(run_dir / "log")["update/skipped_steps"][1]
        assert len(skipped) == 3
        assert skipped[0] == 0
        assert skipped[1] > 0
        for checkpoint in (run_dir / "checkpoints").glob("*/components/*loss*"):
            for file in checkpoint.glob("state/*.memmap"):
                numbers = torch.from_file(str(file), size=file.stat().st_size // 4)
                assert numbers.isfinite().all(), file

    @METHOD
    def test_stops_by_configuration(self, spoiled, tmp_path, name, overrides):
        with pytest.raises(FloatingPointError, match=r"max_skipped=0: .*losses .*nan"):
            self.launch(name, tmp_path / "run", f"{overrides} optim.max_skipped=0")
