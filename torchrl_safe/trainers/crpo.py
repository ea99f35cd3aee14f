"""CRPO (Xu et al. 2021): steps up the return, or down the cost that stands too high."""

from __future__ import annotations

from typing import ClassVar

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from torchrl_safe.trainers.on_policy import KLOptions, MeanSurrogateLoss, TrustRegionTrainer
from torchrl_safe.trainers.options import MethodOptions, option
from torchrl_safe.trainers.trainer import discounted_unit


class CRPOLoss(MeanSurrogateLoss):
    """Reward, the limit, and what is left to noise."""

    tolerance: float = option(
        0.0, "by which a cost may exceed its limit before it is lowered, in limit_unit", ge=0
    )


class CRPOOptions(KLOptions):
    """The options of CRPO."""

    method: ClassVar[str] = "crpo"

    loss: CRPOLoss = Field(default_factory=CRPOLoss)


class CRPO(TrustRegionTrainer):
    """Constraint-rectified policy optimization: each trust-region step serves return or one cost.

    Examples:
        >>> from torchrl_safe.trainers import CRPO
        >>> trainer = CRPO("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = CRPOOptions

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """A trust-region step up the return, or down the cost that is furthest above its limit."""
        limits, measured = self.limits(), self.measure(batch)
        levels = self.measured_levels(measured)
        excess = torch.stack([levels[cost] - limit for cost, limit in limits.items()])
        tolerance = self.options.loss.tolerance * discounted_unit(self.options)
        lowered = to_be_lowered(excess, tolerance)
        constrained = self.closure(data, limits, measured)

        def closure() -> TensorDict:
            out = constrained()
            constraint = out.pop("constraint")
            return out if lowered is None else out.set("objective", -constraint[lowered])

        report = self.trust_region.step(closure)
        return {
            **report.to_dict(),
            **self.levels(levels),
            **self.deviations(measured),
            "update/lowers_cost": float(lowered is not None),
        }


def to_be_lowered(excess: Tensor, tolerance: float) -> int | None:
    """The constraint whose turn it is: the one furthest above its limit, if by more than is left.

    CRPO (https://arxiv.org/abs/2011.05869) takes any of those; none is the turn of the return.

    Args:
        excess (Tensor): by which the costs exceed their limits, ``[m]``.
        tolerance (float): by which they may, in their unit.

    Examples:
        >>> to_be_lowered(torch.tensor([0.1, 0.3]), tolerance=0.2)
        1
        >>> to_be_lowered(torch.tensor([0.1, -0.3]), tolerance=0.2) is None
        True
    """
    worst = int(excess.argmax())
    return worst if excess[worst] > tolerance else None
