"""Two ways to move a policy under a constraint: inside a trust region, or by a multiplier."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from descent import Descent
from omegaconf import DictConfig
from options import settings_of
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_safe import GMMTanhPolicy, TanhGaussianMixture, TrustRegionSafeOptimizer
from torchrl_safe.modules import matched_bound_kl, moment_matched_kl
from torchrl_safe.objectives import LagrangeMultiplier, PIDMultiplier, lagrangian


def moments(dist: TanhGaussianMixture) -> dict[str, Tensor]:
    """What :func:`moment_kl` compares."""
    mean, cov = dist.moments
    return {"mean": mean, "cov": cov}


def moment_kl(old: TensorDictBase, new: TensorDictBase) -> Tensor:
    """The trust region's distance (15), averaged over states."""
    return moment_matched_kl(old["mean"], old["cov"], new["mean"], new["cov"]).mean()


def parameters(dist: TanhGaussianMixture) -> dict[str, Tensor]:
    """What :func:`bound_kl` compares."""
    return {"logits": dist.logits, "loc": dist.loc, "scale": dist.scale}


def bound_kl(old: TensorDictBase, new: TensorDictBase) -> Tensor:
    """A bound on the KL of mixtures that holds every component, averaged over states."""
    return matched_bound_kl(
        *(old["logits"], old["loc"], old["scale"]),
        *(new["logits"], new["loc"], new["scale"]),
    ).mean()


class Distance(NamedTuple):
    """A distance of policies, and the statistics of a policy that it compares."""

    statistics: Callable[[TanhGaussianMixture], dict[str, Tensor]]
    kl: Callable[[TensorDictBase, TensorDictBase], Tensor]


MOMENT_MATCHED = Distance(moments, moment_kl)
MATCHED_BOUND = Distance(parameters, bound_kl)  # for one component, the same

DISTANCES = {"moment_matched": MOMENT_MATCHED, "matched_bound": MATCHED_BOUND}


def choose_distance(cfg: DictConfig) -> Distance:
    """The distance of ``optim.kl``.

    ``auto`` is the paper's for the robot that learns more with it, and for the others the one that
    keeps components from collapsing (docs/experiments.md, "The distance of mixtures").
    """
    if cfg.optim.kl == "auto":
        return MOMENT_MATCHED if cfg.env.robot == "point" else MATCHED_BOUND
    return DISTANCES[cfg.optim.kl]


def make_trust_region(
    cfg: DictConfig, policy: GMMTanhPolicy, distance: Distance = MOMENT_MATCHED
) -> TrustRegionSafeOptimizer:
    """The optimizer of the policy, with the options of the configuration."""
    return TrustRegionSafeOptimizer(
        policy.parameters(),
        max_kl=cfg.optim.max_kl,
        damping=cfg.optim.damping,
        cg_iters=cfg.optim.cg_iters,
        backtrack_ratio=cfg.optim.backtrack_ratio,
        max_backtracks=cfg.optim.max_backtracks,
        recovery_ratio=cfg.optim.recovery_ratio,
        statistics_kl=distance.kl,
        cuda_graph=cfg.optim.cuda_graphs and torch.device(cfg.device).type == "cuda",
    )


def cost_limit_at(cfg: DictConfig, frames: int) -> float:
    """The limit of now: it falls, so that the agent learns to drive before it has to avoid."""
    remaining = max(0.0, 1.0 - frames / max(1, cfg.loss.anneal_frames))
    return cfg.loss.cost_limit + remaining * (cfg.loss.initial_cost_limit - cfg.loss.cost_limit)


class Multiplier:
    """The multiplier of the configuration, and the optimizer of one that learns by gradient."""

    def __init__(self, cfg: DictConfig, kind: str) -> None:
        self.module: LagrangeMultiplier | PIDMultiplier
        self.optim: torch.optim.Optimizer | None = None
        if kind == "pid":
            self.module = PIDMultiplier(
                kp=cfg.pid.kp, ki=cfg.pid.ki, kd=cfg.pid.kd, init=cfg.lagrangian.init
            ).to(cfg.device)
        elif kind == "lagrangian":
            self.module = LagrangeMultiplier(init=cfg.lagrangian.init).to(cfg.device)
            # With equal betas no step exceeds the rate, and a quiet time is soon forgotten.
            self.optim = torch.optim.Adam(
                self.module.parameters(), lr=cfg.lagrangian.lr, betas=(0.9, 0.9)
            )
        else:
            raise ValueError(f"kind must be 'lagrangian' or 'pid', got {kind!r}.")

    def __call__(self) -> Tensor:
        """The multiplier, ``[1]``."""
        return self.module()

    def update(self, constraint: Tensor) -> None:
        """React to the measured constraint, ``[1]``."""
        if self.optim is None:
            self.module.update(constraint)
            return
        self.optim.zero_grad()
        self.module.loss(constraint).backward()
        self.optim.step()

    def state_dict(self) -> dict[str, Any]:
        """The multiplier and the state of its optimizer."""
        optim = None if self.optim is None else self.optim.state_dict()
        return {"module": self.module.state_dict(), "optim": optim}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put both back."""
        self.module.load_state_dict(state["module"])
        if self.optim is not None:
            put_back = settings_of(self.optim)
            self.optim.load_state_dict(state["optim"])
            put_back()


def ascend(
    descent: Descent, closure: Callable[[], TensorDict], multiplier: Tensor
) -> dict[str, float]:
    """One gradient step up the Lagrangian of a trust region's closure."""
    out = closure()
    value = lagrangian(out["objective"], out["constraint"], multiplier)
    descent.step(TensorDict(loss_policy=-value))
    return {"update/lagrangian": value.item(), "update/multiplier": multiplier.item()}
