"""A gradient step of two critics: our loop over sets of parameters, and TorchRL's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SACLoss

from torchrl_safe import GMMTanhPolicy, TsallisLoss

OBSERVATION, ACTION, TRANSITIONS = 40, 2, 1024


def with_torchrl(loss: TsallisLoss) -> Callable[[TensorDictBase, TensorDictBase, str], Tensor]:
    """The call of the networks that TorchRL's own loss makes, in the form of ours."""
    SACLoss._make_vmap(loss)
    call, in_keys = loss._vmap_qnetworkN0, loss.qvalue_network.in_keys
    return lambda data, params, key: call(data.select(*in_keys), params).get(key)


@pytest.mark.parametrize("implementation", ["ours", "torchrl"])
@pytest.mark.parametrize("width", [64, 128], ids="{0}-{0}".format)
def bench_gradient_step(
    benchmark: Any, device: str, timed: Any, width: int, implementation: str
) -> None:
    """Regression on given targets, and Adam."""
    benchmark.group = f"a gradient step of two critics {width}-{width}, {TRANSITIONS} transitions"
    torch.manual_seed(0)
    policy = GMMTanhPolicy(
        nn.Linear(OBSERVATION, 15), Bounded(-1.0, 1.0, (ACTION,)), num_components=3
    )
    net = MLP(OBSERVATION + ACTION, 1, num_cells=[width, width])
    qvalue = ValueOperator(net, in_keys=["observation", "action"])
    loss = TsallisLoss(policy, qvalue, deactivate_vmap=True).to(device)
    if implementation == "torchrl":
        loss._vmap_qnetworkN0 = with_torchrl(loss)
    params = list(loss.qvalue_network_params.values(True, True))
    optim = torch.optim.Adam(params, lr=1e-5, fused=True)
    data = TensorDict(
        {
            "observation": torch.randn(TRANSITIONS, OBSERVATION),
            "action": torch.rand(TRANSITIONS, ACTION),
            "qvalue_target": torch.randn(TRANSITIONS, 1),
        },
        [TRANSITIONS],
        device=device,
    )

    def step() -> None:
        value, _ = loss.qvalue_v2_loss(data)
        value.backward()
        optim.step()
        optim.zero_grad()

    benchmark.pedantic(timed(step), rounds=200, warmup_rounds=20)
