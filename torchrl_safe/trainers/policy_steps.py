"""How a policy moves: a trust region of the options, or multipliers of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from pydantic import Field
from tensordict import TensorDict
from torch import Tensor, nn

from torchrl_safe import TrustRegionSafeOptimizer
from torchrl_safe.modules import Distance
from torchrl_safe.objectives import LagrangeMultiplier, PIDMultiplier, lagrangian
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.options import (
    Group,
    InitialPrice,
    KLRegion,
    Lagrangian,
    TrustRegion,
    again,
    option,
    settings_of,
)
from torchrl_safe.trainers.trainer import ConstrainedTrainer


class QuickLagrangian(Lagrangian):
    """A multiplier that learns by gradient, from the cost of one batch after another."""

    lr: float = again(Lagrangian, "lr", 0.035)


class PID(Group):
    """A multiplier that a controller sets."""

    kp: float = option(0.05, "proportional gain, per unit of discounted cost", ge=0)
    ki: float = option(0.01, "integral gain", gt=0)
    kd: float = option(0.05, "derivative gain", ge=0)


class Priced(Group):
    """What the options of methods have whose multiplier learns from every batch."""

    lagrangian: QuickLagrangian = Field(default_factory=QuickLagrangian)


class Controlled(Group):
    """What the options of methods have whose multiplier a controller sets."""

    lagrangian: InitialPrice = Field(default_factory=InitialPrice)
    pid: PID = Field(default_factory=PID)


def make_trust_region(
    options: KLRegion,
    policy: nn.Module,
    distance: Distance,
    device: str,
    *,
    projection: bool = False,
) -> TrustRegionSafeOptimizer:
    """The optimizer of the policy, with the options' numbers."""
    return TrustRegionSafeOptimizer(
        policy.parameters(),
        max_kl=options.max_kl,
        damping=options.damping,
        cg_iters=options.cg_iters,
        backtrack_ratio=options.backtrack_ratio,
        max_backtracks=options.max_backtracks,
        recovery_ratio=options.recovery_ratio if isinstance(options, TrustRegion) else 1.0,
        projection=projection,
        statistics_kl=distance.kl,
        cuda_graph=options.cuda_graphs and torch.device(device).type == "cuda",
    )


class Multiplier:
    """Multipliers of the options, and the optimizer of those that learn by gradient.

    Args:
        num_constraints (int): m.
        lagrangian (InitialPrice): what they start with; a :class:`Lagrangian` says how fast they
            learn.
        pid (PID, optional): the gains of a controller that sets them in place of learning.
        device (str): where they are.
    """

    def __init__(
        self, num_constraints: int, lagrangian: InitialPrice, pid: PID | None, device: str
    ) -> None:
        self.module: LagrangeMultiplier | PIDMultiplier
        self.optim: Any = None  # of one that learns
        if pid is not None:
            self.module = PIDMultiplier(
                num_constraints, kp=pid.kp, ki=pid.ki, kd=pid.kd, init=lagrangian.init
            ).to(device)
        elif isinstance(lagrangian, Lagrangian):
            self.module = LagrangeMultiplier(num_constraints, init=lagrangian.init).to(device)
            # With equal betas no step exceeds the rate, and a quiet time is soon forgotten.
            self.optim = torch.optim.Adam(
                self.module.parameters(), lr=lagrangian.lr, betas=(0.9, 0.9)
            )

    def __call__(self) -> Tensor:
        """The multipliers, ``[m]``."""
        return self.module()

    def react(self, trainer: ConstrainedTrainer, levels: Mapping[str, Tensor]) -> dict[str, float]:
        """React to how high costs stand, against the limits of now.

        Args:
            trainer (ConstrainedTrainer): whose limits they are.
            levels (mapping): discounted sums, by cost.

        Returns:
            dict: metrics, of the multipliers after it.
        """
        limits = trainer.limits()
        self.update(torch.stack([levels[cost] - limit for cost, limit in limits.items()]))
        prices = dict(zip(limits, self().tolist(), strict=True))
        return {**trainer.named("update/multiplier", prices), **trainer.levels(levels)}

    def update(self, constraint: Tensor) -> None:
        """React to the measured constraints, ``[m]``."""
        if isinstance(self.module, PIDMultiplier):
            self.module.update(constraint)
            return
        self.optim.zero_grad()
        self.module.loss(constraint).backward()
        self.optim.step()

    def state_dict(self) -> dict[str, Any]:
        """The multipliers and the state of their optimizer."""
        optim = None if self.optim is None else self.optim.state_dict()
        return {"module": self.module.state_dict(), "optim": optim}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put both back."""
        self.module.load_state_dict(state["module"])
        if self.optim is not None:
            put_back = settings_of(self.optim)
            self.optim.load_state_dict(state["optim"])
            put_back()


def make_multiplier(trainer: ConstrainedTrainer) -> Multiplier:
    """A multiplier for each cost, of the groups ``lagrangian`` and, if there is one, ``pid``."""
    options = trainer.options
    pid = getattr(options, "pid", None)
    return Multiplier(len(trainer.costs), options.lagrangian, pid, options.device)


def ascend(
    steps: FiniteSteps, closure: Callable[[], TensorDict], multiplier: Tensor
) -> dict[str, float]:
    """One gradient step up the Lagrangian of a trust region's closure."""
    out = closure()
    value = lagrangian(out["objective"], out["constraint"], multiplier)
    steps.step(TensorDict(loss_policy=-value))
    return {"update/lagrangian": value.item()}
