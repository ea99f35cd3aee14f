"""No block reads a tensor's value on the host, or an accelerator would wait for it."""

from __future__ import annotations

import pytest
import torch
from tensordict import TensorDict
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Bounded
from torchrl.modules import MLP, ValueOperator

from torchrl_safe import GMMTanhPolicy, RetraceEstimator, TrustRegionSafeOptimizer, TsallisLoss
from torchrl_safe.modules import GMMParamExtractor

OBS, ACT = 3, 2


class HostReads(TorchDispatchMode):
    """Counts what makes the host wait: values read, and shapes that depend on values."""

    READS = (
        torch.ops.aten._local_scalar_dense,
        torch.ops.aten.nonzero,
        torch.ops.aten.masked_select,
    )

    def __init__(self) -> None:
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        packet = func.overloadpacket
        masks = args[1] if packet in (torch.ops.aten.index, torch.ops.aten.index_put_) else ()
        by_mask = any(mask is not None and mask.dtype == torch.bool for mask in masks)
        self.count += packet in self.READS or by_mask
        return func(*args, **(kwargs or {}))


@pytest.fixture
def blocks():
    torch.manual_seed(0)
    spec = Bounded(-1, 1, (ACT,))
    net = MLP(OBS, GMMParamExtractor(3, ACT).num_features, num_cells=[16])
    policy = GMMTanhPolicy(net, spec, num_components=3)
    critic = MLP(OBS + ACT, 1, num_cells=[16])
    return policy, ValueOperator(critic, in_keys=["observation", "action"])


def make_data() -> TensorDict:
    done = torch.rand(4, 7, 1) < 0.3
    return TensorDict(
        {
            "observation": torch.randn(4, 7, OBS),
            "action": torch.rand(4, 7, ACT) * 1.8 - 0.9,
            "action_log_prob": torch.randn(4, 7),
            "next": {
                "observation": torch.randn(4, 7, OBS),
                "reward": torch.randn(4, 7, 1),
                "done": done,
                "terminated": done.clone(),
            },
        },
        [4, 7],
    )


def test_reads_are_counted():
    x = torch.ones(2)
    for read in (lambda: x[0].item(), lambda: bool(x.sum() > 1), lambda: x[x > 0]):
        with HostReads() as reads:
            read()
        assert reads.count > 0


def test_policy(blocks):
    policy, _ = blocks
    data = make_data()
    with HostReads() as reads:
        policy(data)
        dist = policy.get_dist(data)
        action, log_prob = dist.rsample_and_log_prob()
        (log_prob.sum() + action.sum()).backward()
        dist.log_prob(data["action"])
    assert reads.count == 0


def test_estimator(blocks):
    policy, critic = blocks
    estimator = RetraceEstimator(gamma=0.99, lmbda=0.9, actor_network=policy, qvalue_network=critic)
    with HostReads() as reads:
        estimator.value_estimate(make_data())
        estimator(make_data())
    assert reads.count == 0


@pytest.mark.parametrize("estimator", ["retrace", None])
def test_loss(blocks, estimator):
    loss = TsallisLoss(*blocks, delay_qvalue=False, target_entropy=-1.0)
    if estimator is not None:
        loss.make_value_estimator(estimator, gamma=0.99, lmbda=0.9)
    data = make_data()
    loss(data.copy())  # settles what is settled once
    optimizer = torch.optim.SGD(loss.parameters(), 0.1)
    with HostReads() as reads:
        out = loss(data)
        (out["loss_actor"] + out["loss_qvalue"] + out["loss_alpha"]).backward()
        optimizer.step()
    assert reads.count == 0


def test_trust_region_step():
    """The number of reads is that of the line search's decisions, whatever the iterations."""
    torch.manual_seed(0)
    states = torch.randn(64, OBS, dtype=torch.float64)
    counts = {}
    for iterations in (2, 10):
        for limit in (1e6, -1e6):  # a constraint that holds everywhere, and one that never does
            x = nn.Parameter(torch.linspace(-1, 1, OBS, dtype=torch.float64))

            def closure(x=x, limit=limit):
                mean = (states @ x).tanh()
                return TensorDict(
                    {
                        "objective": mean.mean(),
                        "constraint": (mean.square().mean() - limit)[None],
                        "statistics": mean,
                    }
                )

            optimizer = TrustRegionSafeOptimizer(
                [x],
                statistics_kl=lambda old, new: 0.5 * (new - old).square().mean(),
                max_kl=0.01,
                cg_iters=iterations,
            )
            with HostReads() as reads:
                optimizer.step(closure)
            counts[iterations, limit] = reads.count
    assert len(set(counts.values())) == 1
    assert counts[10, 1e6] <= 2
