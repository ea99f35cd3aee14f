"""Policies: the mixture, its distribution and distances; a deterministic one with noise."""

from torchrl_safe.modules.actors import GMMParamExtractor, GMMTanhPolicy
from torchrl_safe.modules.deterministic import ClippedGaussian, DeterministicPolicy
from torchrl_safe.modules.distributions import (
    Relaxation,
    TanhGaussianMixture,
    mixture_moments,
)
from torchrl_safe.modules.divergences import (
    CATEGORICAL,
    DISTANCES,
    MATCHED_BOUND,
    MOMENT_MATCHED,
    Distance,
    categorical_kl,
    matched_bound_kl,
    moment_matched_kl,
)
from torchrl_safe.modules.export import DeterministicAction, export_policy

__all__ = [
    "CATEGORICAL",
    "DISTANCES",
    "MATCHED_BOUND",
    "MOMENT_MATCHED",
    "ClippedGaussian",
    "DeterministicAction",
    "DeterministicPolicy",
    "Distance",
    "GMMParamExtractor",
    "GMMTanhPolicy",
    "Relaxation",
    "TanhGaussianMixture",
    "categorical_kl",
    "export_policy",
    "matched_bound_kl",
    "mixture_moments",
    "moment_matched_kl",
]
