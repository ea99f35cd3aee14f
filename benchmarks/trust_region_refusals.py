"""Share of steps that the trust region refuses: random linear problems, and a small mixture policy.

``python benchmarks/trust_region_refusals.py``, some minutes on one core.
"""

from __future__ import annotations

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.data import Bounded

from torchrl_safe import GMMTanhPolicy, TrustRegionSafeOptimizer
from torchrl_safe.modules import moment_matched_kl


def linear(constraints: int, problems: int = 39, size: int = 12) -> int:
    """How many infeasible linear problems are refused."""
    rng = np.random.default_rng(constraints)
    refused = 0
    for _ in range(problems):
        g, b = (torch.tensor(rng.normal(size=s)) for s in (size, (constraints, size)))
        c = torch.tensor(rng.uniform(0.2, 2.5, size=constraints) * np.sqrt(0.02)) * b.norm(dim=-1)
        x = nn.Parameter(torch.zeros(size, dtype=torch.float64))
        optim = TrustRegionSafeOptimizer([x], max_kl=0.01, damping=0.0)

        def closure(x: Tensor = x, g: Tensor = g, b: Tensor = b, c: Tensor = c) -> TensorDict:
            return TensorDict(objective=g @ x, constraint=c + b @ x, kl=0.5 * x.square().sum())

        refused += not optim.step(closure).accepted
    return refused


def mixture(seed: int, constraints: int, steps: int = 40) -> int:
    """How many steps of a small mixture policy with several violated constraints are refused."""
    torch.manual_seed(seed)
    policy = GMMTanhPolicy(nn.Linear(3, 10), Bounded(-1.0, 1.0, (2,)), num_components=2)
    data = TensorDict(observation=torch.randn(128, 3), batch_size=[128])
    noise = policy.get_dist(data).draw_noise()
    slopes, limit = torch.randn(constraints, 2), 0.3 * torch.randn(constraints) - 0.2
    optim = TrustRegionSafeOptimizer(
        policy.parameters(),
        statistics_kl=lambda old, new: moment_matched_kl(*old.values(), *new.values()).mean(),
    )

    def closure() -> TensorDict:
        dist = policy.get_dist(data)
        action = dist.rsample(noise=noise)
        mean, cov = dist.moments
        return TensorDict(
            objective=(action[:, 0] * data["observation"][:, 0]).mean(),
            constraint=(action @ slopes.T).sigmoid().mean(0) - 0.5 - limit,
            statistics=TensorDict(mean=mean, cov=cov),
        )

    return sum(not optim.step(closure).accepted for _ in range(steps))


if __name__ == "__main__":
    for m in (2, 5, 10):
        print(f"linear, infeasible, {m} constraints: {linear(m)} of 39 refused")
    for m in (1, 2, 3):
        refused = sum(mixture(seed, m) for seed in range(5))
        print(f"mixture of two, {m} constraints: {refused} of 200 refused")
