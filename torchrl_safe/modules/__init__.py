"""The mixture policy: its distribution and its actor."""

from torchrl_safe.modules.actors import GMMParamExtractor, GMMTanhPolicy
from torchrl_safe.modules.distributions import (
    Relaxation,
    TanhGaussianMixture,
    mixture_moments,
)

__all__ = [
    "GMMParamExtractor",
    "GMMTanhPolicy",
    "Relaxation",
    "TanhGaussianMixture",
    "mixture_moments",
]
