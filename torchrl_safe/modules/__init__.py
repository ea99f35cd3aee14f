"""The mixture policy: its distribution and its actor."""

from torchrl_safe.modules.actors import GMMParamExtractor, GMMTanhPolicy
from torchrl_safe.modules.distributions import (
    Relaxation,
    TanhGaussianMixture,
    mixture_moments,
)
from torchrl_safe.modules.export import DeterministicAction, export_policy

__all__ = [
    "DeterministicAction",
    "GMMParamExtractor",
    "GMMTanhPolicy",
    "Relaxation",
    "TanhGaussianMixture",
    "export_policy",
    "mixture_moments",
]
