"""Trust-region optimisation under constraints; imports nothing else of this library."""

from __future__ import annotations

from torchrl_safe.optim.trust_region import TrustRegionReport, TrustRegionSafeOptimizer

__all__ = ["TrustRegionReport", "TrustRegionSafeOptimizer"]
