"""PCPO (Yang et al. 2020): a trust-region step up the return, projected onto the constraints."""

from __future__ import annotations

from typing import ClassVar

from torchrl_safe.trainers.on_policy import KLOptions, TrustRegionTrainer
from torchrl_safe.trainers.options import MethodOptions


class PCPOOptions(KLOptions):
    """The options of PCPO."""

    method: ClassVar[str] = "pcpo"


class PCPO(TrustRegionTrainer):
    """Projection-based constrained policy optimization: CPO's region, and a step in two parts.

    Examples:
        >>> from torchrl_safe.trainers import PCPO
        >>> policy = PCPO("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = PCPOOptions
    projection = True
