"""TRC (Kim and Oh, RA-L 2022), and CPO (Achiam et al. 2017), which limits the mean of the cost."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from torchrl_safe.trainers.on_policy import (
    MeanSurrogateLoss,
    OnPolicyCollector,
    SurrogateOptions,
    TrustRegionTrainer,
)
from torchrl_safe.trainers.options import MethodOptions


class TRCOptions(SurrogateOptions):
    """The options of TRC."""

    method: ClassVar[str] = "trc"

    collector: OnPolicyCollector = Field(default_factory=OnPolicyCollector)


class TRC(TrustRegionTrainer):
    """Trust region conditional value at risk, on-policy.

    Examples:
        >>> from torchrl_safe.trainers import TRC
        >>> trainer = TRC("point", risk_level=0.5)  # the worst half of outcomes
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = TRCOptions


class CPOOptions(TRCOptions):
    """The options of CPO."""

    method: ClassVar[str] = "cpo"

    loss: MeanSurrogateLoss = Field(default_factory=MeanSurrogateLoss)


class CPO(TRC):
    """Constrained policy optimization: TRC at ``risk_level=1``.

    Examples:
        >>> from torchrl_safe.trainers import CPO
        >>> policy = CPO("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = CPOOptions
