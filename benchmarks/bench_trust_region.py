"""A constrained trust-region step: curvature of policy moments beside that of a KL by itself."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from critics import make_losses
from omegaconf import OmegaConf
from safetac_point import policy_closure, policy_kl
from tensordict import TensorDict
from utils import make_policy

from torchrl_safe import TrustRegionSafeOptimizer
from torchrl_safe.envs import SafeGoalEnv

CONFIG = Path(__file__).parents[1] / "examples" / "safetac_point.yaml"
NUM_STATES = 5000


def in_terms_of_kl(closure: Callable[[], TensorDict]) -> Callable[[], TensorDict]:
    """The same closure, for an optimizer that knows nothing of the policy's moments."""
    with torch.no_grad():
        old = closure()["statistics"]

    def kl_closure() -> TensorDict:
        out = closure()
        out["kl"] = policy_kl(old, out.pop("statistics"))
        return out

    return kl_closure


@pytest.mark.parametrize("curvature", ["gauss_newton", "double_backward"])
@pytest.mark.parametrize("width", [128, 512], ids="24-{0}-{0}".format)
def bench_step(benchmark: Any, width: int, curvature: str) -> None:
    """One step from the same weights on the same states, line search included."""
    benchmark.group = f"trust-region step, 24-{width}-{width}, 5 Gaussians, {NUM_STATES} states"
    torch.manual_seed(0)
    cfg = OmegaConf.load(CONFIG)
    cfg.policy.num_cells = cfg.critic.num_cells = [width, width]
    cfg.policy.num_components = 5
    env = SafeGoalEnv(num_envs=1, num_threads=1)
    policy = make_policy(cfg, env)
    reward_loss, cost_loss = make_losses(cfg, env, policy)
    optim = TrustRegionSafeOptimizer(
        policy.parameters(),
        max_kl=cfg.optim.max_kl,
        damping=cfg.optim.damping,
        cg_iters=10,
        statistics_kl=policy_kl if curvature == "gauss_newton" else None,
    )
    states = TensorDict({"observation": torch.randn(NUM_STATES, 24)}, [NUM_STATES])
    weights = [p.detach().clone() for p in policy.parameters()]
    level = torch.tensor(cfg.loss.cost_limit)  # the constraint is active

    def setup() -> tuple[tuple[Any], dict[str, Any]]:
        torch.manual_seed(0)
        with torch.no_grad():
            torch._foreach_copy_(list(policy.parameters()), weights)
        closure = policy_closure(policy, reward_loss, cost_loss, states, level)
        return (closure if curvature == "gauss_newton" else in_terms_of_kl(closure),), {}

    report = benchmark.pedantic(optim.step, setup=setup, rounds=5, warmup_rounds=1)
    benchmark.extra_info |= {"case": report.case, "backtracks": report.backtracks}
    assert report.accepted, report
