"""Objectives of safe reinforcement learning, in the form of TorchRL loss modules."""

from __future__ import annotations

from torchrl_safe.objectives.cvar import CVaRCostLoss
from torchrl_safe.objectives.tsallis import TsallisLoss

__all__ = ["CVaRCostLoss", "TsallisLoss"]
