"""TRC (Kim and Oh, RA-L 2022), and CPO (Achiam et al. 2017), which limits the mean of the cost."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field
from tensordict import TensorDictBase
from torchrl._utils import timeit

from torchrl_safe.trainers.on_policy import SurrogateLoss, SurrogateOptions, SurrogateTrainer
from torchrl_safe.trainers.options import Collector, MethodOptions, again


class TRCCollector(Collector):
    """Who acts, and for how long."""

    frames_per_batch: int = again(
        Collector,
        "frames_per_batch",
        20_000,
        meaning="frames per update: a step fits the noise of fewer",
    )


class TRCOptions(SurrogateOptions):
    """The options of TRC."""

    method: ClassVar[str] = "trc"

    collector: TRCCollector = Field(default_factory=TRCCollector)


class TRC(SurrogateTrainer):
    """Trust region conditional value at risk, on-policy.

    Examples:
        >>> from torchrl_safe.trainers import TRC
        >>> trainer = TRC("point", risk_level=0.5)  # the worst half of outcomes
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = TRCOptions

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Critics on the new batch, then a trust-region step on it; then it is thrown away."""
        with timeit("time/critics"):
            for _ in range(self.options.optim.critic_rounds):
                losses = self.fit_critics(self.with_advantages(batch))
        with timeit("time/policy"):
            step = self.policy_step(self.with_advantages(batch), batch)
        return {**losses, **step}


class CPOLoss(SurrogateLoss):
    """Reward and the limit."""

    risk_level: float = again(SurrogateLoss, "risk_level", 1.0, meaning="1 is the expectation")


class CPOOptions(TRCOptions):
    """The options of CPO."""

    method: ClassVar[str] = "cpo"

    loss: CPOLoss = Field(default_factory=CPOLoss)


class CPO(TRC):
    """Constrained policy optimization: TRC at ``risk_level=1``.

    Examples:
        >>> from torchrl_safe.trainers import CPO
        >>> policy = CPO("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = CPOOptions
