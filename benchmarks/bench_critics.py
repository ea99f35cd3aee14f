"""A round of the critics' gradient steps: the example's way, and others."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from bench_training import compose
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import CudaGraphModule
from torch import nn

from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.trainers import SafeTAC
from torchrl_safe.trainers.off_policy import critic_losses, minibatches


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
    options: SafeTAC.Options, env: SafeGoalEnv, data: TensorDict, how: str
) -> Callable[[], None]:
    """The losses of the library, over networks one by one or by vmap."""
    trainer = SafeTAC(options=options)
    trainer.build(env)
    reward_loss, cost_losses = trainer.reward_loss, trainer.cost_losses
    for loss in (reward_loss, *cost_losses.values()):
        loss.deactivate_vmap = how != "losses_vmap"
        loss._make_vmap()
    steps = trainer.fit_critics.steps

    def losses_of(minibatch: TensorDictBase) -> TensorDictBase:
        return critic_losses(trainer, minibatch, reward_loss, cost_losses)

    if how.startswith("losses_compiled"):
        losses_of = torch.compile(losses_of)

    def one_round(data: TensorDict) -> None:
        for minibatch in minibatches(data, options.optim.minibatch_size):
            steps.step(losses_of(minibatch))

    if how.endswith("cuda_graph"):
        one_round = CudaGraphModule(one_round, in_keys=[])
    return lambda: one_round(data)


def plain(options: SafeTAC.Options, env: SafeGoalEnv, data: TensorDict) -> Callable[[], None]:
    """PyTorch without losses and tensordicts: what the same arithmetic costs at least."""

    def network(*last: nn.Module) -> nn.Sequential:
        sizes = [
            data["observation"].shape[-1] + data["action"].shape[-1],
            *options.critic.num_cells,
        ]
        hidden = (
            layer
            for pair in itertools.pairwise(sizes)
            for layer in (nn.Linear(*pair), nn.ReLU(inplace=True))
        )
        return nn.Sequential(*hidden, nn.Linear(sizes[-1], 1), *last)

    last = [(), (), (), (nn.Softplus(),)]
    networks = [network(*layers).to(options.device) for layers in last]
    params = [p for each in networks for p in each.parameters()]
    optim = torch.optim.Adam(params, lr=options.optim.critic_lr, fused=True)
    inputs = torch.cat([data["observation"], data["action"]], -1)
    targets = [
        data[name] for name in ("qvalue_target", "qvalue_target", "cost_target", "std_target")
    ]

    def one_round() -> None:
        order = torch.randperm(len(inputs), device=options.device)
        batches = [
            tensor[order].split(options.optim.minibatch_size) for tensor in (inputs, *targets)
        ]
        for batch, *wanted in zip(*batches, strict=True):
            pairs = zip(networks, wanted, strict=True)
            loss = torch.stack([F.mse_loss(each(batch), target) for each, target in pairs]).sum()
            optim.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(params, options.optim.max_grad_norm)
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
    options = compose([f"critic.num_cells=[{width},{width}]", f"device={device}"])
    env = SafeGoalEnv(num_envs=1, num_threads=1, device=device)
    data = make_data(options.optim.critic_frames, 24, env.action_spec.shape[-1]).to(device)
    step = options.optim.minibatch_size
    benchmark.group = f"critics {width}-{width}, {len(data):,} frames in steps of {step:,}"
    one_round = (
        plain(options, env, data) if how == "plain" else with_losses(options, env, data, how)
    )
    benchmark.pedantic(timed(one_round), rounds=5, warmup_rounds=3)
