"""P3O (Zhang et al. 2022): PPO with a penalty on what exceeds the limits, and no multiplier."""

from __future__ import annotations

from functools import partial
from typing import ClassVar

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor

from torchrl_safe.objectives import exact_penalty
from torchrl_safe.objectives.functional import clipped_surrogate
from torchrl_safe.trainers.on_policy import ClippedLoss, ClippedOptions, GradientTrainer, unit_of
from torchrl_safe.trainers.options import MethodOptions, option


class P3OLoss(ClippedLoss):
    """Reward, the limit, how far a ratio may go, and the price of a violation."""

    penalty: float = option(20.0, "of a unit of cost above its limit, in units of return", gt=0)


class P3OOptions(ClippedOptions):
    """The options of P3O."""

    method: ClassVar[str] = "p3o"

    loss: P3OLoss = Field(default_factory=P3OLoss)


class P3O(GradientTrainer):
    """Penalized proximal policy optimization: clipped ratios, and a price on violations alone.

    Examples:
        >>> from torchrl_safe.trainers import P3O
        >>> trainer = P3O("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = P3OOptions

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """Passes up the clipped return, less the penalty on clipped costs above their limits."""
        measured, limits = self.measure(batch), self.limits()
        levels = self.measured_levels(measured)
        reward, costs = self.advantages(data, measured)
        unit = unit_of(reward)
        excess = torch.stack([levels[cost] - limit for cost, limit in limits.items()])
        data = data.copy().set("advantage", reward / unit).set("cost_advantages", costs / unit)
        per_step = (1 - self.options.loss.gamma) * excess / unit
        moved = self.descend(data, partial(self.losses_of, excess=per_step))
        return {**moved, **self.levels(levels), **self.deviations(measured)}

    def losses_of(self, minibatch: TensorDictBase, excess: Tensor) -> dict[str, Tensor]:
        """The policy's loss; ``excess`` is that of the costs, ``[m]``, in the advantages' unit."""
        log_prob = self.policy.get_dist(minibatch).log_prob(minibatch["action"])
        clipped = partial(
            clipped_surrogate,
            log_prob,
            minibatch["policy_log_prob"],
            clip_epsilon=self.options.loss.clip_epsilon,
        )
        costs = minibatch["cost_advantages"].unbind(-1)
        constraint = excess + torch.stack([-clipped(-cost) for cost in costs])
        penalty = self.options.loss.penalty
        return {"loss_policy": -exact_penalty(clipped(minibatch["advantage"]), constraint, penalty)}
