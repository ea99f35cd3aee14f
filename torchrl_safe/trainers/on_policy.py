"""What CPO, TRC and off-policy TRC share: surrogates, their critics and the policy's step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase

from torchrl_safe.modules import DISTANCES
from torchrl_safe.objectives import CostMoments, CVaRSurrogateLoss, ReturnSurrogateLoss
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.networks import is_discrete
from torchrl_safe.trainers.off_policy import as_components, minibatches
from torchrl_safe.trainers.options import (
    ConstrainedLoss,
    MethodOptions,
    TrustRegion,
    again,
    option,
)
from torchrl_safe.trainers.policy_steps import make_trust_region
from torchrl_safe.trainers.trainer import ConstrainedTrainer


class SurrogateLoss(ConstrainedLoss):
    """Reward and the limit."""

    lmbda: float = option(
        0.9,
        "trace decay of the advantages: with more, cost gradients of two batches have nothing in "
        "common",
        ge=0,
        le=1,
    )


class SurrogateOptim(TrustRegion):
    """Critics and the trust-region step."""

    critic_lr: float = option(1e-3, "of Adam", gt=0)
    max_grad_norm: float = option(1.0, "of the critics together", gt=0)
    max_skipped: int = option(
        100, "critic steps per round skipped as not finite, before the run stops", ge=0
    )
    critic_rounds: int = option(8, "passes over the data per update, each with new targets", ge=1)
    minibatch_size: int = option(512, "steps per gradient step of the critics", ge=1)
    damping: float = again(TrustRegion, "damping", 0.1)
    recovery_ratio: float = again(TrustRegion, "recovery_ratio", 1.0)


class SurrogateOptions(MethodOptions):
    """What the options of these methods have."""

    loss: SurrogateLoss = Field(default_factory=SurrogateLoss)
    optim: SurrogateOptim = Field(default_factory=SurrogateOptim)


class SurrogateTrainer(ConstrainedTrainer):
    """A trust region on surrogates of return and costs, which need no gradient of an action."""

    Options: ClassVar[type[MethodOptions]] = SurrogateOptions
    discrete = True

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, surrogates with critics of states, and the trust region."""
        options = self.options
        self.policy = self.make_policy(env)
        self.reward_loss = ReturnSurrogateLoss(
            self.make_critic(env, "state_value", of_actions=False)
        )
        self.cost_losses = {cost: self._cost_loss(env, cost) for cost in self.costs}
        self.reward_loss.make_value_estimator(gamma=options.loss.gamma, lmbda=options.loss.lmbda)
        for loss in self.cost_losses.values():
            loss.make_value_estimator(gamma=options.loss.cost_gamma, lmbda=options.loss.lmbda)
        params = [
            param
            for loss in (self.reward_loss, *self.cost_losses.values())
            for param in loss.parameters()
        ]
        critic_optim = torch.optim.Adam(params, lr=options.optim.critic_lr, fused=True)
        self.critic_steps = FiniteSteps(
            critic_optim,
            max_grad_norm=options.optim.max_grad_norm,
            max_skipped=options.optim.max_skipped,
        )
        kind = "categorical" if is_discrete(env) else "moment_matched"
        self.distance = DISTANCES[kind]
        self.trust_region = make_trust_region(
            options.optim, self.policy, self.distance, options.device
        )
        return {
            "reward_loss": self.reward_loss,
            **as_components(self, "cost_loss", self.cost_losses),
            "critic_optim": critic_optim,
            "policy_optim": self.trust_region,
        }

    def _cost_loss(self, env: EnvBase, cost: str) -> CVaRSurrogateLoss:
        loss = self.options.loss
        keys = {
            name: self.name_of(name, cost)
            for name in (
                *("cost_value", "cost_variance", "cost_advantage", "square_advantage"),
                *("cost_target", "variance_target"),
            )
        }
        critics = [
            self.make_critic(env, keys["cost_value"], of_actions=False),
            self.make_critic(env, keys["cost_variance"], nn.Softplus(), of_actions=False),
        ]
        surrogate = CVaRSurrogateLoss(
            *critics, risk_level=loss.risk_level, cost_limit=self.limits()[cost]
        )
        surrogate.set_keys(cost=cost, **keys)
        return surrogate

    def with_advantages(
        self, trajectories: TensorDictBase, *, rescored: bool = False
    ) -> TensorDictBase:
        """Steps of trajectories [B, T] with advantages and critics' targets, flat.

        Args:
            trajectories (TensorDictBase): in the order of time.

        Keyword Args:
            rescored (bool): whether advantages are those of the policy of now, in place of the one
                that acted. Defaults to False.
        """
        log_prob = None
        if rescored:
            with torch.no_grad():
                log_prob = self.policy.get_dist(trajectories).log_prob(trajectories["action"])
        for loss in (self.reward_loss, *self.cost_losses.values()):
            trajectories = loss.compute_advantage(trajectories, policy_log_prob=log_prob)
        return trajectories.flatten()

    def fit_critics(self, data: TensorDictBase) -> dict[str, float]:
        """One pass of gradient steps over steps with their targets."""
        for minibatch in minibatches(data, self.options.optim.minibatch_size):
            losses = self.joined(self.cost_losses, minibatch)
            losses.update(self.reward_loss(minibatch))
            self.critic_steps.step(losses)
        metrics = {f"update/{name}": value.item() for name, value in losses.items()}
        return metrics | {"update/skipped_steps": float(self.critic_steps.count())}

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """A trust-region step on ``data``; how high costs stand is measured on ``batch``."""
        limits = self.limits()
        measured = {cost: loss.measure(batch) for cost, loss in self.cost_losses.items()}
        report = self.trust_region.step(self.closure(data, limits, measured))
        deviations = {cost: each.variance.sqrt().item() for cost, each in measured.items()}
        return {
            **self.report(report, limits),
            **self.named("update/measured_cost_std", deviations),
        }

    def closure(
        self,
        data: TensorDictBase,
        limits: Mapping[str, float],
        measured: Mapping[str, CostMoments],
    ) -> Callable[[], TensorDict]:
        """Objective, constraints and statistics as a function of the policy's weights."""

        def closure() -> TensorDict:
            dist = self.policy.get_dist(data)
            log_prob = dist.log_prob(data["action"])
            constraints = [
                loss.constraint(data, log_prob, measured[cost], cost_limit=limits[cost])
                for cost, loss in self.cost_losses.items()
            ]
            return TensorDict(
                {
                    "objective": self.reward_loss.objective(data, log_prob),
                    "constraint": torch.stack(constraints),
                    "statistics": self.distance.statistics(dist),
                }
            )

        return closure
