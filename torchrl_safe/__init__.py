"""torchrl_safe: safe reinforcement learning as TorchRL building blocks."""

from __future__ import annotations

from torchrl_safe.modules import GMMTanhPolicy, TanhGaussianMixture
from torchrl_safe.objectives import CVaRCostLoss, TsallisLoss
from torchrl_safe.objectives.value import RetraceEstimator
from torchrl_safe.optim import TrustRegionSafeOptimizer

__all__ = [
    "CVaRCostLoss",
    "GMMTanhPolicy",
    "RetraceEstimator",
    "TanhGaussianMixture",
    "TrustRegionSafeOptimizer",
    "TsallisLoss",
]
