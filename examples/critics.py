"""What the off-policy examples share: the losses, the replay buffer and the critics' learning."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import torch
from descent import Descent
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import nn
from torchrl._utils import timeit
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    SliceSampler,
    Storage,
    TensorDictReplayBuffer,
)
from torchrl.envs import EnvBase
from utils import make_critic

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, TsallisLoss
from torchrl_safe.objectives.value import with_policy

REPLAYED = [
    "observation",
    "action",
    "action_log_prob",
    ("collector", "traj_ids"),
    *(
        ("next", key)
        for key in ("observation", "reward", "cost", "done", "terminated", "truncated")
    ),
]


def make_losses(
    cfg: DictConfig, env: EnvBase, policy: GMMTanhPolicy
) -> tuple[TsallisLoss, CVaRCostLoss]:
    """The losses of reward and cost, with critics of their own and Retrace targets."""
    reward_loss = TsallisLoss(
        policy,
        make_critic(cfg, env, "state_action_value"),
        entropic_index=cfg.loss.entropic_index,
        alpha_init=cfg.loss.alpha,
        fixed_alpha=True,
        delay_qvalue=False,
        deactivate_vmap=True,  # on a CPU, two small products are faster than a batched one
    )
    reward_loss.make_value_estimator("retrace", gamma=cfg.loss.gamma, lmbda=cfg.loss.lmbda)
    cost_loss = CVaRCostLoss(
        policy,
        make_critic(cfg, env, "cost_value"),
        make_critic(cfg, env, "cost_std", nn.Softplus()),
        risk_level=cfg.loss.risk_level,
        cost_limit=cfg.loss.cost_limit,
        variance_reward=cfg.loss.variance_reward,
        deactivate_vmap=True,
    )
    cost_loss.make_value_estimator(gamma=cfg.loss.cost_gamma, lmbda=cfg.loss.lmbda)
    return reward_loss, cost_loss


def make_critic_optim(
    cfg: DictConfig, reward_loss: TsallisLoss, cost_loss: CVaRCostLoss
) -> torch.optim.Optimizer:
    """Adam on the critics: the losses' own, not those of the networks they were made from."""
    critics = (
        reward_loss.qvalue_network_params,
        cost_loss.cost_network_params,
        cost_loss.std_network_params,
    )
    params = [param for critic in critics for param in critic.parameters()]
    return torch.optim.Adam(params, lr=cfg.optim.critic_lr, fused=True)


def make_buffer(cfg: DictConfig) -> TensorDictReplayBuffer:
    """Replays slices of trajectories, from memory or from files in the run's folder."""
    size, kind = cfg.replay_buffer.size, cfg.replay_buffer.storage
    if kind == "memmap":
        folder = Path(cfg.run_dir) / "replay"
        storage: Storage = LazyMemmapStorage(size, scratch_dir=folder, existsok=True, ndim=2)
    elif kind == "memory":
        storage = LazyTensorStorage(size, ndim=2, device=cfg.device)
    else:
        raise ValueError(f"replay_buffer.storage must be memory or memmap, got {kind!r}.")
    return TensorDictReplayBuffer(
        storage=storage,
        sampler=SliceSampler(
            slice_len=cfg.replay_buffer.slice_len,
            traj_key=("collector", "traj_ids"),
            strict_length=True,
        ),
    )


def fit_critics(
    cfg: DictConfig,
    buffer: TensorDictReplayBuffer,
    reward_loss: TsallisLoss,
    cost_loss: CVaRCostLoss,
    critic_optim: torch.optim.Optimizer,
) -> dict[str, float]:
    """Some rounds of new targets, each with one pass of gradient steps over its transitions."""
    descent = Descent(cfg, critic_optim)
    for _ in range(cfg.optim.critic_rounds):
        # Targets are renewed each round: one round is one step of value iteration.
        with timeit("time/targets"):
            data = buffer.sample(cfg.optim.critic_frames).reshape(-1, cfg.replay_buffer.slice_len)
            data = with_targets(data, reward_loss, cost_loss)
        with timeit("time/critics"):
            for minibatch in minibatches(data, cfg.optim.minibatch_size):
                loss_qvalue, _ = reward_loss.qvalue_v2_loss(minibatch)
                losses = cost_loss(minibatch)
                losses["loss_qvalue"] = loss_qvalue
                descent.step(losses)
    metrics = {f"update/{name}": value.item() for name, value in losses.items()}
    return metrics | {"update/skipped_steps": float(descent.skipped)}


def with_targets(
    trajectories: TensorDictBase, reward_loss: TsallisLoss, cost_loss: CVaRCostLoss
) -> TensorDictBase:
    """Transitions of trajectories [B, T] with the targets of (4) and (18), flat."""
    parts = []
    for part in trajectories.split(250):  # activations of this many stay in the cache
        part = with_policy(part, reward_loss.actor_network, shifted=True)
        target = reward_loss.compute_target(part)
        cost_target, std_target = cost_loss.compute_target(part)
        targets = {"value_target": target, "cost_target": cost_target, "std_target": std_target}
        parts.append(part.select("observation", "action").update(targets))
    return torch.cat(parts).flatten()


def minibatches(data: TensorDictBase, size: int) -> Iterator[TensorDictBase]:
    """All of ``data`` in random order, ``size`` at a time."""
    yield from data[torch.randperm(len(data), device=data.device)].split(size)
