"""Retrace, vectorised over time, beside a loop over time and TorchRL's vectorised TD(lambda)."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torchrl.objectives.value.functional import vec_td_lambda_return_estimate

from torchrl_safe.objectives.value.functional import trace_lambda_return_estimate

GAMMA, LMBDA = 0.99, 0.97


def retrace_loop(
    log_pi: Tensor,
    log_mu: Tensor,
    action_value: Tensor,
    next_state_value: Tensor,
    reward: Tensor,
    done: Tensor,
    terminated: Tensor,
) -> Tensor:
    """The recursion as the papers write it, one step of time after the other, backwards."""
    target = reward + GAMMA * torch.where(terminated, 0, next_state_value)
    trace = GAMMA * LMBDA * (log_pi - log_mu).clamp(max=0).exp()
    for t in reversed(range(reward.shape[-2] - 1)):
        surprise = target[:, t + 1] - action_value[:, t + 1]
        target[:, t] += torch.where(done[:, t], 0, trace[:, t + 1] * surprise)
    return target


@pytest.mark.parametrize("implementation", ["retrace", "retrace_loop", "td_lambda_torchrl"])
@pytest.mark.parametrize("shape", [(64, 1000), (5, 200)], ids="{0[0]}x{0[1]}".format)
@torch.no_grad()
def bench_targets(
    benchmark: Any, device: str, timed: Any, shape: tuple[int, int], implementation: str
) -> None:
    """Targets of trajectories [B, T]; what they cost apart from the networks."""
    benchmark.group = f"targets of {shape[0]} trajectories of {shape[1]} steps"
    torch.manual_seed(0)
    log_pi, log_mu, value, next_value, reward = torch.randn(5, *shape, 1).unbind()
    done = torch.rand(*shape, 1) < 0.01
    terminated = done & (torch.rand(*shape, 1) < 0.5)
    data = [
        tensor.to(device)
        for tensor in (log_pi, log_mu, value, next_value, reward, done, terminated)
    ]
    if implementation == "retrace":
        target = benchmark(timed(trace_lambda_return_estimate), GAMMA, LMBDA, *data)
        torch.testing.assert_close(target, retrace_loop(*data))
    elif implementation == "retrace_loop":
        benchmark(timed(retrace_loop), *data)
    else:
        benchmark(timed(vec_td_lambda_return_estimate), GAMMA, LMBDA, *data[3:])
