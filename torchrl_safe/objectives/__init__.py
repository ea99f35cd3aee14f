"""Objectives of safe reinforcement learning, in the form of TorchRL loss modules."""

from __future__ import annotations

from torchrl_safe.objectives.common import MeasuredCVaR
from torchrl_safe.objectives.cvar import CVaRCostLoss
from torchrl_safe.objectives.lagrangian import (
    LagrangeMultiplier,
    PIDMultiplier,
    exact_penalty,
    lagrangian,
)
from torchrl_safe.objectives.limit import LimitController
from torchrl_safe.objectives.quantile import QuantileCostLoss
from torchrl_safe.objectives.surrogate import (
    CostMoments,
    CVaRSurrogateLoss,
    ReturnSurrogateLoss,
)
from torchrl_safe.objectives.tsallis import TsallisLoss

__all__ = [
    "CVaRCostLoss",
    "CVaRSurrogateLoss",
    "CostMoments",
    "LagrangeMultiplier",
    "LimitController",
    "MeasuredCVaR",
    "PIDMultiplier",
    "QuantileCostLoss",
    "ReturnSurrogateLoss",
    "TsallisLoss",
    "exact_penalty",
    "lagrangian",
]
