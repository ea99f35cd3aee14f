"""Trust-region steps under constraints, and gradient steps; imports no other room."""

from __future__ import annotations

from torchrl_safe.optim.finite_steps import FiniteSteps
from torchrl_safe.optim.trust_region import TrustRegionReport, TrustRegionSafeOptimizer

__all__ = ["FiniteSteps", "TrustRegionReport", "TrustRegionSafeOptimizer"]
