"""A round of the critics' gradient steps: the example's way, and others."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from bench_training import compose
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule
from torch import nn

from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.trainers.critics import make_critic_optim, make_losses, minibatches
from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.utils import make_policy


def make_data(num_frames: int, observation_dim: int, action_dim: int) -> TensorDict:
    targets = torch.rand(3, num_frames, 1)
    return TensorDict(
        {
            "observation": torch.randn(num_frames, observation_dim),
            "action": torch.rand(num_frames, action_dim) * 2 - 1,
            **dict(zip(("qvalue_target", "cost_target", "std_target"), targets, strict=True)),
        },
        [num_frames],
    )


def with_losses(
    cfg: DictConfig, env: SafeGoalEnv, data: TensorDict, how: str
) -> Callable[[], None]:
    """The losses of the library, over networks one by one or by vmap."""
    reward_loss, cost_loss = make_losses(cfg, env, make_policy(cfg, env))
    for loss in (reward_loss, cost_loss):
        loss.deactivate_vmap = how != "losses_vmap"
        loss._make_vmap()
    descent = Descent(cfg, make_critic_optim(cfg, reward_loss, cost_loss))

    def losses_of(minibatch: TensorDictBase) -> TensorDictBase:
        losses = cost_loss(minibatch)
        losses["loss_qvalue"], _ = reward_loss.qvalue_v2_loss(minibatch)
        return losses

    if how.startswith("losses_compiled"):
        losses_of = torch.compile(losses_of)

    def one_round(data: TensorDict) -> None:
        for minibatch in minibatches(data, cfg.optim.minibatch_size):
            descent.step(losses_of(minibatch))

    if how.endswith("cuda_graph"):
        one_round = CudaGraphModule(one_round, in_keys=[])
    return lambda: one_round(data)


def plain(cfg: DictConfig, env: SafeGoalEnv, data: TensorDict) -> Callable[[], None]:
    """PyTorch without losses and tensordicts: what the same arithmetic costs at least."""

    def network(*last: nn.Module) -> nn.Sequential:
        sizes = [data["observation"].shape[-1] + data["action"].shape[-1], *cfg.critic.num_cells]
        hidden = (
            layer
            for pair in itertools.pairwise(sizes)
            for layer in (nn.Linear(*pair), nn.ReLU(inplace=True))
        )
        return nn.Sequential(*hidden, nn.Linear(sizes[-1], 1), *last)

    last = [(), (), (), (nn.Softplus(),)]
    networks = [network(*layers).to(cfg.device) for layers in last]
    params = [p for each in networks for p in each.parameters()]
    optim = torch.optim.Adam(params, lr=cfg.optim.critic_lr, fused=True)
    inputs = torch.cat([data["observation"], data["action"]], -1)
    targets = [
        data[name] for name in ("qvalue_target", "qvalue_target", "cost_target", "std_target")
    ]

    def one_round() -> None:
        order = torch.randperm(len(inputs), device=cfg.device)
        batches = [tensor[order].split(cfg.optim.minibatch_size) for tensor in (inputs, *targets)]
        for batch, *wanted in zip(*batches, strict=True):
            pairs = zip(networks, wanted, strict=True)
            loss = torch.stack([F.mse_loss(each(batch), target) for each, target in pairs]).sum()
            optim.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(params, cfg.optim.max_grad_norm)
            optim.step()

    return one_round


@pytest.mark.parametrize(
    "how",
    [
        "losses",
        "losses_vmap",
        "losses_compiled",
        "losses_cuda_graph",
        "losses_compiled_cuda_graph",
        "plain",
    ],
)
@pytest.mark.parametrize("width", [64, 128, 256], ids="{0}-{0}".format)
def bench_round(benchmark: Any, device: str, timed: Any, width: int, how: str) -> None:
    """One round, from targets to the last gradient step."""
    torch.manual_seed(0)
    cfg = compose([f"critic.num_cells=[{width},{width}]", f"device={device}"])
    env = SafeGoalEnv(num_envs=1, num_threads=1, device=device)
    data = make_data(cfg.optim.critic_frames, 24, env.action_spec.shape[-1]).to(device)
    benchmark.group = (
        f"critics {width}-{width}, {len(data):,} frames in steps of {cfg.optim.minibatch_size:,}"
    )
    one_round = plain(cfg, env, data) if how == "plain" else with_losses(cfg, env, data, how)
    benchmark.pedantic(timed(one_round), rounds=5, warmup_rounds=3)
