"""CUP (Yang et al. 2022): a step up the return, then a projection at prices of the costs."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_safe.objectives.functional import cup_loss
from torchrl_safe.trainers.on_policy import ClippedOptions, unit_of
from torchrl_safe.trainers.options import Lagrangian, MethodOptions
from torchrl_safe.trainers.ppo_lagrangian import PPOLagrangian


class CUPOptions(ClippedOptions):
    """The options of CUP."""

    method: ClassVar[str] = "cup"

    lagrangian: Lagrangian = Field(default_factory=Lagrangian)


class CUP(PPOLagrangian):
    """Constrained update projection: PPO on the return, then a projection at prices of the costs.

    Examples:
        >>> from torchrl_safe.trainers import CUP
        >>> trainer = CUP("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = CUPOptions

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """The multiplier's step, passes up the return, then passes of the projection."""
        measured = self.measure(batch)
        priced = self.multiplier.react(self, self.measured_levels(measured))
        reward, costs = self.advantages(data, measured)
        improved = self.descend(
            data.copy().set("advantage", reward / unit_of(reward)), self.losses_of
        )
        projected = self.descend(data.copy().set("cost_advantages", costs), self.projection)
        skipped = improved.pop("update/skipped_steps") + projected.pop("update/skipped_steps")
        return {
            **improved,
            **{name.replace("/", "/projection_"): value for name, value in projected.items()},
            **priced,
            **self.deviations(measured),
            "update/skipped_steps": skipped,
        }

    def projection(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """Down the priced costs, and the divergence from the policy that followed the return."""
        dist, loss = self.policy.get_dist(minibatch), self.options.loss
        projected = cup_loss(
            dist.log_prob(minibatch["action"]),
            minibatch["policy_log_prob"],
            self.distance.divergence(minibatch["old"], self.distance.statistics(dist)),
            minibatch["cost_advantages"],
            self.multiplier(),
            gamma=loss.gamma,
            lmbda=loss.lmbda,
        )
        return {"loss_policy": projected}
