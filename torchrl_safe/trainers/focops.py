"""FOCOPS (Zhang et al. 2020): gradient steps towards the best policy in a trust region."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_safe.objectives.functional import focops_loss
from torchrl_safe.trainers.on_policy import (
    GradientOptim,
    GradientOptions,
    MeanSurrogateLoss,
    PricedTrainer,
)
from torchrl_safe.trainers.options import MethodOptions, again, option
from torchrl_safe.trainers.policy_steps import Priced


class FOCOPSLoss(MeanSurrogateLoss):
    """Reward, the limit, and what a change of the policy costs."""

    kl_weight: float = option(
        1.5, "of the policy's movement, in standard deviations of the advantage per nat", gt=0
    )


class FOCOPSOptim(GradientOptim):
    """Gradient steps of critics and policy, inside a trust region."""

    max_kl: float = again(
        GradientOptim,
        "max_kl",
        0.02,
        meaning="size of the trust region, nats: a state that has moved by this moves no further, "
        "and there is no further pass once all have in the mean",
    )


class FOCOPSOptions(Priced, GradientOptions):
    """The options of FOCOPS."""

    method: ClassVar[str] = "focops"

    loss: FOCOPSLoss = Field(default_factory=FOCOPSLoss)
    optim: FOCOPSOptim = Field(default_factory=FOCOPSOptim)


class FOCOPS(PricedTrainer):
    """First order constrained optimization in policy space.

    The best policy inside the trust region is known up to a factor; gradient steps project the
    network onto it. States that have moved by ``optim.max_kl`` move no further.

    Examples:
        >>> from torchrl_safe.trainers import FOCOPS
        >>> trainer = FOCOPS("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = FOCOPSOptions

    def losses_of(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """Down the divergence from the best policy inside the region."""
        dist, options = self.policy.get_dist(minibatch), self.options
        loss = focops_loss(
            dist.log_prob(minibatch["action"]),
            minibatch["policy_log_prob"],
            self.distance.divergence(self.distance.statistics(dist), minibatch["old"]),
            minibatch["advantage"],
            kl_weight=options.loss.kl_weight,
            max_kl=options.optim.max_kl,
        )
        return {"loss_policy": loss}
