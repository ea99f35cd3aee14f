"""torchrl_safe: safe reinforcement learning as TorchRL building blocks.

Importing it takes no time: a block, or a package, is loaded when it is asked for.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
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

_PACKAGES = {
    "modules": ["GMMTanhPolicy", "TanhGaussianMixture"],
    "objectives": ["CVaRCostLoss", "TsallisLoss"],
    "objectives.value": ["RetraceEstimator"],
    "optim": ["TrustRegionSafeOptimizer"],
}


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return import_module(f"{__name__}.{name}")
    for package, blocks in _PACKAGES.items():
        if name in blocks:
            return getattr(import_module(f"{__name__}.{package}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
