"""TD3-Lagrangian: TD3 (Fujimoto et al. 2018) with a multiplier on each cost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import TD3Loss

from torchrl_safe.trainers.off_policy import PricedActorCritic, SoftUpdates
from torchrl_safe.trainers.options import (
    ConstrainedLoss,
    Lagrangian,
    MethodOptions,
    NoisyPolicy,
    ReplayBuffer,
    again,
    option,
)


class MeanLoss(ConstrainedLoss):
    """Reward and the limit."""

    risk_level: float = again(ConstrainedLoss, "risk_level", 1.0, meaning="1 is the expectation")


class DelayedUpdates(SoftUpdates):
    """Gradient steps of the critics, of which some move the policy, too."""

    policy_delay: int = option(
        2, "gradient steps of the critics for one of policy and target networks", ge=1
    )
    target_noise: float = option(
        0.2, "on the next action in the reward's targets, of half the action's range", ge=0
    )
    noise_clip: float = option(0.5, "what it is cut off at, likewise", ge=0)


class TD3LagrangianOptions(MethodOptions):
    """The options of TD3-Lagrangian."""

    method: ClassVar[str] = "td3_lagrangian"

    policy: NoisyPolicy = Field(default_factory=NoisyPolicy)  # type: ignore[assignment]
    replay_buffer: ReplayBuffer = Field(default_factory=ReplayBuffer)
    loss: MeanLoss = Field(default_factory=MeanLoss)
    optim: DelayedUpdates = Field(default_factory=DelayedUpdates)
    lagrangian: Lagrangian = Field(default_factory=Lagrangian)


class TD3Lagrangian(PricedActorCritic):
    """TD3 with a multiplier on each cost: a deterministic policy, twin critics, delayed steps.

    The critics of costs are SAC-Lagrangian's, of the policy as it acts, with its noise.

    Examples:
        >>> from torchrl_safe.trainers import TD3Lagrangian
        >>> policy = TD3Lagrangian("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = TD3LagrangianOptions

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A deterministic policy, losses with target networks, and a multiplier."""
        self.policy_delay = self.options.optim.policy_delay
        return super().build(env)

    def make_reward_loss(self, env: EnvBase) -> TD3Loss:
        """TorchRL's TD3."""
        optim, spec = self.options.optim, env.action_spec_unbatched
        half = (spec.space.high - spec.space.low) / 2
        return TD3Loss(
            self.policy,
            self.make_critic(env, "state_action_value"),
            bounds=(spec.space.low, spec.space.high),
            policy_noise=optim.target_noise * half,
            noise_clip=optim.noise_clip * half,
            loss_function="l2",
            deactivate_vmap=True,
        )

    def critic_losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Losses of all critics; that of the policy rests until its turn."""
        losses = self.joined(self.cost_losses, minibatch)
        losses["loss_qvalue"], _ = self.reward_loss.value_loss(minibatch)
        return losses.set("loss_actor", torch.zeros_like(losses["loss_qvalue"]))

    def policy_losses(
        self, minibatch: TensorDictBase, limits: Mapping[str, float]
    ) -> dict[str, Tensor]:
        """Of the policy, up the Lagrangian."""
        loss, _ = self.reward_loss.actor_loss(minibatch)
        action = self.policy.get_dist(minibatch).deterministic_sample
        return {"loss_actor": -self.priced(-loss, minibatch, action, limits)}
