"""What is not finite never reaches a parameter or the state of an optimizer."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import critics
import hydra
import policy_steps
import pytest
import safetac_point
import torch
import utils
from torch.utils._pytree import tree_leaves

TINY = [
    "num_threads=1",
    "env.num_envs=4",
    "env.episode_length=50",
    "replay_buffer.size=1000",
    "replay_buffer.slice_len=10",
    "policy.num_cells=[8]",
    "critic.num_cells=[8]",
    "optim.critic_rounds=1",
    "optim.critic_frames=100",
    "optim.minibatch_size=50",
]


class Update:
    """One update of the example, with all that it may change."""

    def __init__(self) -> None:
        torch.manual_seed(0)
        with hydra.initialize_config_dir(
            str(Path(safetac_point.__file__).parent), version_base="1.3"
        ):
            self.cfg = hydra.compose("safetac_point", TINY)
        env = utils.make_env(self.cfg, 4, seed=0)
        self.policy = utils.make_policy(self.cfg, env)
        self.losses = critics.make_losses(self.cfg, env, self.policy)
        self.critic_optim = critics.make_critic_optim(self.cfg, *self.losses)
        self.policy_optim = policy_steps.make_trust_region(self.cfg, self.policy)
        self.batch = env.rollout(50, self.policy, break_when_any_done=False)
        self.batch["collector", "traj_ids"] = torch.arange(4)[:, None].expand(4, 50).clone()
        self.fit(self.batch)  # Adam has moments to lose

    def fit(self, batch):
        buffer = critics.make_buffer(self.cfg)
        buffer.extend(batch.select(*critics.REPLAYED))
        return critics.fit_critics(self.cfg, buffer, *self.losses, self.critic_optim)

    def step(self, batch):
        return self.policy_optim.step(
            safetac_point.policy_closure(
                self.policy,
                *self.losses,
                batch.select("observation").flatten(),
                self.losses[1].on_policy_cvar(batch),
                None,
            )
        )

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
    assert metrics["update/skipped_critic_steps"] == 2
    assert update.is_at(state)
    if key != ("next", "reward"):  # the policy's step sees rewards through the critics only
        report = update.step(batch)
        assert not report.accepted
        assert "nan" in report.reason or "inf" in report.reason
        assert update.is_at(state)
    # Training goes on with the next good batch.
    assert update.fit(update.batch)["update/skipped_critic_steps"] == 0
    assert not update.is_at(state)


@BAD
def test_gradients(update, bad):
    state = update.state()
    param = update.critic_optim.param_groups[0]["params"][0]
    hook = param.register_hook(lambda grad: torch.full_like(grad, bad))
    assert update.fit(update.batch)["update/skipped_critic_steps"] == 2
    assert update.is_at(state)
    hook.remove()
    assert update.fit(update.batch)["update/skipped_critic_steps"] == 0


def test_stops_by_configuration(update, monkeypatch):
    monkeypatch.setattr(update.cfg.optim, "max_skipped", 0)
    batch, state = update.batch.clone(), update.state()
    batch["next", "reward"].fill_(math.nan)
    with pytest.raises(FloatingPointError, match=r"optim.max_skipped=0: .*'loss_qvalue': nan"):
        update.fit(batch)
    assert update.is_at(state)
