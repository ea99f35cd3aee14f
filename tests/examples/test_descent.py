from __future__ import annotations

import copy

import pytest
import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import nn
from torchrl_safe.trainers.descent import Descent


def make(max_norm: float | None, max_skipped: int = 0) -> tuple[nn.Module, Descent]:
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(3, 4), nn.Tanh(), nn.Linear(4, 1)).double()
    cfg = {"max_skipped": max_skipped} | ({} if max_norm is None else {"max_grad_norm": max_norm})
    optim = torch.optim.Adam(net.parameters(), lr=0.1, fused=True)
    return net, Descent(OmegaConf.create({"optim": cfg}), optim)


def losses_of(net: nn.Module, scale: float) -> TensorDict:
    value = net(torch.linspace(-1, 1, 15, dtype=torch.float64).view(5, 3)) * scale
    return TensorDict(
        loss_a=value.square().mean(),
        loss_b=value.mean(),
        loss_constant=torch.zeros(()).double(),
        entropy=value.std(),
    )


@pytest.mark.parametrize("max_norm", [None, 0.3, 1e6])
def test_steps_are_those_of_clipped_gradients(max_norm):
    net, descent = make(max_norm)
    other = copy.deepcopy(net)
    optim = torch.optim.Adam(other.parameters(), lr=0.1)
    clipped = 0
    for scale in (1.0, 0.01, 30.0, 0.5):
        descent.step(losses_of(net, scale))
        losses = losses_of(other, scale)
        optim.zero_grad()
        (losses["loss_a"] + losses["loss_b"]).backward()
        if max_norm is not None:
            clipped += nn.utils.clip_grad_norm_(other.parameters(), max_norm).item() > max_norm
        optim.step()
        # Torch divides by the norm and a millionth.
        for actual, expected in zip(net.parameters(), other.parameters(), strict=True):
            torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-7)
    assert 0 < clipped < 4 if max_norm == 0.3 else clipped == 0
    assert descent.count() == 0
    assert all(p.grad is None for p in net.parameters())


def test_numbers_of_the_last_skipped_step_are_reported():
    net, descent = make(1.0, max_skipped=1)
    before = copy.deepcopy(net.state_dict())
    for loss in (torch.nan, torch.inf):
        losses = losses_of(net, 1.0)
        losses["loss_b"] = losses["loss_b"] * loss
        descent.step(losses)
    assert all(torch.equal(value, before[name]) for name, value in net.state_dict().items())
    descent.step(losses_of(net, 1.0))
    with pytest.raises(FloatingPointError, match=r"2 gradient .* 'loss_b': (-?inf|nan)") as caught:
        descent.count()
    assert "'loss_a': nan" not in str(caught.value)
    assert descent.count() == 0  # counted anew


def test_the_optimizer_must_be_fused():
    net, _ = make(None)
    with pytest.raises(ValueError, match="fused=True, got Adam"):
        Descent(OmegaConf.create({"optim": {"max_skipped": 0}}), torch.optim.Adam(net.parameters()))
