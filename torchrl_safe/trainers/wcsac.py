"""WCSAC (Yang et al. 2021); SAC-Lagrangian (Ha et al. 2020) and SAC-PID limit the mean cost."""

from __future__ import annotations

from collections.abc import Mapping
from typing import ClassVar

from pydantic import Field
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_safe import TsallisLoss
from torchrl_safe.objectives.functional import q_logarithm
from torchrl_safe.trainers.off_policy import (
    PricedActorCritic,
    SoftUpdates,
    critic_losses,
    make_reward_loss,
)
from torchrl_safe.trainers.options import (
    ConstrainedLoss,
    Lagrangian,
    MethodOptions,
    ReplayBuffer,
    again,
    option,
)
from torchrl_safe.trainers.policy_steps import Controlled


class WCSACLoss(ConstrainedLoss):
    """Reward, entropy and the limit."""

    entropic_index: float = option(1.0, "q; 1 is Shannon entropy", gt=0)
    alpha: float = option(0.01, "entropy weight to start with; it is tuned", gt=0, fixed=True)


class SoftOptions(MethodOptions):
    """What the options of these methods have."""

    replay_buffer: ReplayBuffer = Field(default_factory=ReplayBuffer)
    loss: WCSACLoss = Field(default_factory=WCSACLoss)
    optim: SoftUpdates = Field(default_factory=SoftUpdates)


class WCSACOptions(SoftOptions):
    """The options of WCSAC."""

    method: ClassVar[str] = "wcsac"

    lagrangian: Lagrangian = Field(default_factory=Lagrangian)


class WCSAC(PricedActorCritic):
    """Worst-case soft actor-critic: SAC with a multiplier on the CVaR of each cost.

    Examples:
        >>> from torchrl_safe.trainers import WCSAC
        >>> trainer = WCSAC("point", risk_level=0.5)  # the worst half of outcomes
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = WCSACOptions

    def make_reward_loss(self, env: EnvBase) -> TsallisLoss:
        """SAC's, whose entropy weight is tuned."""
        return make_reward_loss(self, env)

    def critic_losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Losses of all critics."""
        return critic_losses(self, minibatch, self.reward_loss, self.cost_losses)

    def policy_losses(
        self, minibatch: TensorDictBase, limits: Mapping[str, float]
    ) -> dict[str, Tensor]:
        """Of the policy, up the Lagrangian, and of the entropy weight."""
        action, log_prob = self.policy.get_dist(minibatch).rsample_and_log_prob()
        objective = self.reward_loss.objective(minibatch, action, log_prob).mean()
        entropy = -q_logarithm(log_prob.detach(), self.options.loss.entropic_index)
        return {
            "loss_actor": -self.priced(objective, minibatch, action, limits),
            "loss_alpha": self.reward_loss.alpha_loss(-entropy).mean(),
            "alpha": self.reward_loss.log_alpha.detach().exp(),
        }


class SACLagrangianLoss(WCSACLoss):
    """Reward, entropy and the limit."""

    risk_level: float = again(WCSACLoss, "risk_level", 1.0, meaning="1 is the expectation")


class SACLagrangianOptions(WCSACOptions):
    """The options of SAC-Lagrangian."""

    method: ClassVar[str] = "sac_lagrangian"

    loss: SACLagrangianLoss = Field(default_factory=SACLagrangianLoss)


class SACLagrangian(WCSAC):
    """SAC with a multiplier on the mean of each cost: WCSAC at ``risk_level=1``.

    Examples:
        >>> from torchrl_safe.trainers import SACLagrangian
        >>> policy = SACLagrangian("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = SACLagrangianOptions


class SACPIDOptions(Controlled, SoftOptions):
    """The options of SAC-PID."""

    method: ClassVar[str] = "sac_pid"

    loss: SACLagrangianLoss = Field(default_factory=SACLagrangianLoss)


class SACPID(SACLagrangian):
    """SAC-Lagrangian with a multiplier that a PID controller sets.

    Examples:
        >>> from torchrl_safe.trainers import SACPID
        >>> policy = SACPID("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = SACPIDOptions
