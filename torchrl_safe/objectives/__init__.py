"""Objectives of safe reinforcement learning, in the form of TorchRL loss modules."""

from __future__ import annotations

from torchrl_safe.objectives.cvar import CVaRCostLoss
from torchrl_safe.objectives.lagrangian import LagrangeMultiplier, PIDMultiplier, lagrangian
from torchrl_safe.objectives.surrogate import CVaRSurrogateLoss, ReturnSurrogateLoss
from torchrl_safe.objectives.tsallis import TsallisLoss

__all__ = [
    "CVaRCostLoss",
    "CVaRSurrogateLoss",
    "LagrangeMultiplier",
    "PIDMultiplier",
    "ReturnSurrogateLoss",
    "TsallisLoss",
    "lagrangian",
]
