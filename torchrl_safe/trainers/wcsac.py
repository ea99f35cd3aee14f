"""WCSAC (Yang et al. 2021); SAC-Lagrangian (Ha et al. 2020) and SAC-PID limit the mean cost."""

from __future__ import annotations

from typing import Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDictBase
from torchrl._utils import timeit
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate, ValueEstimators

from torchrl_safe.objectives import lagrangian
from torchrl_safe.objectives.functional import q_logarithm
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.off_policy import (
    SoftUpdates,
    as_components,
    critic_losses,
    joint_optim,
    make_buffer,
    make_cost_losses,
    make_reward_loss,
    replayed,
)
from torchrl_safe.trainers.options import (
    ConstrainedLoss,
    Lagrangian,
    MethodOptions,
    ReplayBuffer,
    again,
    option,
)
from torchrl_safe.trainers.policy_steps import Controlled, make_multiplier
from torchrl_safe.trainers.trainer import ConstrainedTrainer


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


class WCSAC(ConstrainedTrainer):
    """Worst-case soft actor-critic: SAC with a multiplier on the CVaR of each cost.

    Examples:
        >>> from torchrl_safe.trainers import WCSAC
        >>> trainer = WCSAC("point", risk_level=0.5)  # the worst half of outcomes
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = WCSACOptions

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, losses of reward and costs with target networks, and a multiplier."""
        options = self.options
        self.policy = self.make_policy(env)
        self.reward_loss = make_reward_loss(self, env)
        self.cost_losses = make_cost_losses(self, env, delay_cost=True)
        self.reward_loss.make_value_estimator(ValueEstimators.TD0, gamma=options.loss.gamma)
        for loss in self.cost_losses.values():
            loss.make_value_estimator(ValueEstimators.TD0, gamma=options.loss.cost_gamma)
        losses = [self.reward_loss, *self.cost_losses.values()]
        self.targets = [SoftUpdate(loss, tau=options.optim.tau) for loss in losses]
        optim = joint_optim(losses, options.optim.lr)
        self.steps = FiniteSteps(optim, max_skipped=options.optim.max_skipped)
        self.multiplier = make_multiplier(self)
        self.buffer = make_buffer(self)
        return {
            "reward_loss": self.reward_loss,
            **as_components(self, "cost_loss", self.cost_losses),
            "optim": optim,
            "multiplier": self.multiplier,
            "buffer": self.buffer,
        }

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """The multiplier on the new batch's cost, then gradient steps on replayed transitions."""
        self.buffer.extend(batch.select(*replayed(self)).flatten())
        if self.frames < self.options.collector.init_frames:
            return {}
        limits = self.limits()
        levels = {cost: loss.on_policy_cvar(batch) for cost, loss in self.cost_losses.items()}
        priced = self.multiplier.react(self, levels)
        with timeit("time/update"):
            for _ in range(self.options.optim.num_updates):
                minibatch = self.buffer.sample()
                losses = critic_losses(self, minibatch, self.reward_loss, self.cost_losses)
                losses.update(self._policy_losses(minibatch, limits))
                self.steps.step(losses)
                for target in self.targets:
                    target.step()
        return {
            **{f"update/{name}": value.item() for name, value in losses.items()},
            **priced,
            "update/skipped_steps": float(self.steps.count()),
            "update/alpha": self.reward_loss.log_alpha.exp().item(),
        }

    def _policy_losses(
        self, minibatch: TensorDictBase, limits: dict[str, float]
    ) -> dict[str, torch.Tensor]:
        """Of the policy, up the Lagrangian, and of the entropy weight."""
        action, log_prob = self.policy.get_dist(minibatch).rsample_and_log_prob()
        objective = self.reward_loss.objective(minibatch, action, log_prob).mean()
        constraints = [  # of one action, as the objective is
            self.cost_losses[cost].cvar(minibatch, action).mean() - limit
            for cost, limit in limits.items()
        ]
        value = lagrangian(objective, torch.stack(constraints), self.multiplier())
        entropy = -q_logarithm(log_prob.detach(), self.options.loss.entropic_index)
        return {
            "loss_actor": -value,
            "loss_alpha": self.reward_loss.alpha_loss(-entropy).mean(),
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
