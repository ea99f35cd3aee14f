"""What methods on surrogates share: critics, advantages, and two ways to move the policy by them.

A surrogate says what a change of the policy does to return and costs, out of ratios of densities
and advantages. It needs no gradient of an action.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl._utils import timeit
from torchrl.envs import EnvBase

from torchrl_safe.modules import DISTANCES
from torchrl_safe.objectives import (
    CostMoments,
    CVaRSurrogateLoss,
    ReturnSurrogateLoss,
    lagrangian,
)
from torchrl_safe.objectives.functional import clipped_surrogate
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.networks import is_discrete
from torchrl_safe.trainers.off_policy import as_components, minibatches
from torchrl_safe.trainers.options import (
    Collector,
    ConstrainedLoss,
    Group,
    KLRegion,
    MethodOptions,
    TrustRegion,
    again,
    option,
)
from torchrl_safe.trainers.policy_steps import make_multiplier, make_trust_region
from torchrl_safe.trainers.trainer import ConstrainedTrainer


class OnPolicyCollector(Collector):
    """Who acts, and for how long."""

    frames_per_batch: int = again(
        Collector,
        "frames_per_batch",
        20_000,
        meaning="frames per update: a step fits the noise of fewer",
    )


class SurrogateLoss(ConstrainedLoss):
    """Reward and the limit."""

    lmbda: float = option(
        0.9,
        "trace decay of the advantages: with more, cost gradients of two batches have nothing in "
        "common",
        ge=0,
        le=1,
    )


class MeanSurrogateLoss(SurrogateLoss):
    """Reward and the limit."""

    risk_level: float = again(SurrogateLoss, "risk_level", 1.0, meaning="1 is the expectation")


class SurrogateCritics(Group):
    """The critics' gradient steps."""

    critic_lr: float = option(1e-3, "of Adam", gt=0)
    max_grad_norm: float = option(1.0, "of the critics together", gt=0)
    max_skipped: int = option(
        100, "critic steps per round skipped as not finite, before the run stops", ge=0
    )
    critic_rounds: int = option(8, "passes over the data per update, each with new targets", ge=1)
    minibatch_size: int = option(512, "steps per gradient step of the critics", ge=1)


class KLOptim(KLRegion, SurrogateCritics):
    """Critics and a trust-region step."""

    damping: float = again(KLRegion, "damping", 0.1)


class SurrogateOptim(TrustRegion, KLOptim):
    """Critics and a trust-region step under constraints."""

    recovery_ratio: float = again(TrustRegion, "recovery_ratio", 1.0)


class GradientOptim(SurrogateCritics):
    """Gradient steps of critics and policy."""

    max_grad_norm: float = again(
        SurrogateCritics, "max_grad_norm", 1.0, meaning="of the critics together, and of the policy"
    )
    max_skipped: int = again(
        SurrogateCritics,
        "max_skipped",
        100,
        meaning="gradient steps per round or update skipped as not finite, before the run stops",
    )
    minibatch_size: int = again(
        SurrogateCritics, "minibatch_size", 512, meaning="steps per gradient step"
    )
    policy_lr: float = option(3e-4, "of Adam, of the policy", gt=0)
    num_epochs: int = option(10, "passes of the policy over the batch, at most", ge=1)
    max_kl: float = option(
        0.02, "the policy makes no further pass once it has moved by this, nats", gt=0
    )


class SurrogateOptions(MethodOptions):
    """The options of methods with a trust region on surrogates."""

    loss: SurrogateLoss = Field(default_factory=SurrogateLoss)
    optim: SurrogateOptim = Field(default_factory=SurrogateOptim)


class OnPolicyOptions(MethodOptions):
    """What the options of on-policy methods have that limit the mean of a cost."""

    collector: OnPolicyCollector = Field(default_factory=OnPolicyCollector)
    loss: MeanSurrogateLoss = Field(default_factory=MeanSurrogateLoss)


class GradientOptions(OnPolicyOptions):
    """The options of on-policy methods of gradient steps."""

    optim: GradientOptim = Field(default_factory=GradientOptim)


class ClippedLoss(MeanSurrogateLoss):
    """Reward, the limit, and how far a ratio may go."""

    clip_epsilon: float = option(0.2, "ratios beyond 1 +- this gain nothing", gt=0, lt=1)


class ClippedOptions(GradientOptions):
    """The options of on-policy methods with clipped ratios."""

    loss: ClippedLoss = Field(default_factory=ClippedLoss)


class KLOptions(OnPolicyOptions):
    """The options of on-policy methods whose trust-region step makes no room for recovery."""

    optim: KLOptim = Field(default_factory=KLOptim)


class SurrogateTrainer(ConstrainedTrainer):
    """A method on surrogates: its policy, its critics and how they learn."""

    discrete = True

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, and surrogates with critics of states."""
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
        self.distance = DISTANCES["categorical" if is_discrete(env) else "moment_matched"]
        return {
            "reward_loss": self.reward_loss,
            **as_components(self, "cost_loss", self.cost_losses),
            "critic_optim": critic_optim,
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

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Critics on the new batch, then the policy on it; then it is thrown away."""
        with timeit("time/critics"):
            for _ in range(self.options.optim.critic_rounds):
                losses = self.fit_critics(self.with_advantages(batch))
        with timeit("time/policy"):
            step = self.policy_step(self.with_advantages(batch), batch)
        skipped = losses.pop("update/skipped_steps") + step.pop("update/skipped_steps", 0.0)
        return {**losses, **step, "update/skipped_steps": skipped}

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """Move the policy by steps with advantages; how high costs stand ``batch`` says.

        Returns:
            dict: metrics to log.
        """
        raise NotImplementedError

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

    def measure(self, batch: TensorDictBase) -> dict[str, CostMoments]:
        """Where each cost of the policy stands that took the steps of a batch."""
        return {cost: loss.measure(batch) for cost, loss in self.cost_losses.items()}

    def measured_levels(self, measured: Mapping[str, CostMoments]) -> dict[str, Tensor]:
        """What is limited, as it was measured: discounted sums, by cost."""
        return {cost: loss.level(measured[cost]) for cost, loss in self.cost_losses.items()}

    def deviations(self, measured: Mapping[str, CostMoments]) -> dict[str, float]:
        """Metrics of the deviations of costs."""
        deviations = {cost: each.variance.sqrt().item() for cost, each in measured.items()}
        return self.named("update/measured_cost_std", deviations)


class TrustRegionTrainer(SurrogateTrainer):
    """A trust region on surrogates of return and costs."""

    Options: ClassVar[type[MethodOptions]] = SurrogateOptions
    projection: ClassVar[bool] = False  # whether a step follows the return and is then projected

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, surrogates with critics of states, and the trust region."""
        components = super().build(env)
        self.trust_region = make_trust_region(
            self.options.optim,
            self.policy,
            self.distance,
            self.options.device,
            projection=self.projection,
        )
        return {**components, "policy_optim": self.trust_region}

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """A trust-region step on ``data``; how high costs stand is measured on ``batch``."""
        limits, measured = self.limits(), self.measure(batch)
        report = self.trust_region.step(self.closure(data, limits, measured))
        return {**self.report(report, limits), **self.deviations(measured)}

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


class GradientTrainer(SurrogateTrainer):
    """Gradient steps on minibatches of a batch, in passes that the policy's movement ends."""

    Options: ClassVar[type[MethodOptions]] = GradientOptions

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, surrogates with critics of states, and the policy's optimizer."""
        components, optim = super().build(env), self.options.optim
        adam = torch.optim.Adam(self.policy.parameters(), lr=optim.policy_lr, fused=True)
        self.policy_steps = FiniteSteps(
            adam, max_grad_norm=optim.max_grad_norm, max_skipped=optim.max_skipped
        )
        return {**components, "policy_optim": adam}

    def advantages(
        self, data: TensorDictBase, measured: Mapping[str, CostMoments]
    ) -> tuple[Tensor, Tensor]:
        """Advantages of the return, ``[*B]``, and of the limited risks of the costs, ``[*B, m]``.

        They are centred, and in one unit: a change of the policy that is kept moves each sum by the
        horizon of the return times the mean of ratios times these.

        Args:
            data (TensorDictBase): what :meth:`with_advantages` returned.
            measured (mapping): what :meth:`measure` returned for the policy that acted.
        """
        to_return = 1 - self.options.loss.gamma  # one over its horizon
        costs = [
            to_return * measured[cost].horizon * loss.advantage(data, measured[cost])
            for cost, loss in self.cost_losses.items()
        ]
        reward, cost = data["advantage"].squeeze(-1), torch.stack(costs, -1)
        return reward - reward.mean(), cost - cost.mean(0)

    def descend(
        self,
        data: TensorDictBase,
        losses_of: Callable[[TensorDictBase], TensorDictBase | Mapping[str, Tensor]],
    ) -> dict[str, float]:
        """Passes over steps, until the policy has moved by ``optim.max_kl``.

        Args:
            data (TensorDictBase): what ``losses_of`` reads, flat.
            losses_of (callable): from a minibatch to losses ``loss_*`` of the policy. A minibatch
                also holds ``"old"``, the statistics of the policy before the first pass.

        Returns:
            dict: metrics, losses those of the last minibatch.
        """
        optim = self.options.optim
        with torch.no_grad():
            old = self.distance.statistics(self.policy.get_dist(data))
            data = data.copy().set("old", TensorDict(old, data.batch_size))
        epochs, kl = 0, 0.0
        while epochs < optim.num_epochs and kl <= optim.max_kl:
            epochs += 1
            for minibatch in minibatches(data, optim.minibatch_size):
                losses = losses_of(minibatch)
                self.policy_steps.step(losses)
            with torch.no_grad():
                new = self.distance.statistics(self.policy.get_dist(data))
                kl = self.distance.kl(old, new).item()
        return {
            **{f"update/{n}": x.item() for n, x in losses.items() if n.startswith("loss_")},
            "update/kl": kl,
            "update/epochs": float(epochs),
            "update/skipped_steps": float(self.policy_steps.count()),
        }


class ClippedTrainer(GradientTrainer):
    """Gradient steps on PPO's surrogate."""

    def losses_of(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """Down minus the clipped surrogate of steps whose ``"advantage"`` is standardised, flat."""
        log_prob = self.policy.get_dist(minibatch).log_prob(minibatch["action"])
        old, advantage = minibatch["policy_log_prob"], minibatch["advantage"]
        surrogate = clipped_surrogate(log_prob, old, advantage, self.options.loss.clip_epsilon)
        return {"loss_policy": -surrogate}


class PricedTrainer(GradientTrainer):
    """Gradient steps on the advantage of the Lagrangian, whose multipliers follow the costs."""

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, surrogates with critics of states, the policy's optimizer, a multiplier."""
        self.multiplier = make_multiplier(self)
        return {**super().build(env), "multiplier": self.multiplier}

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """The multiplier's step, then passes up the Lagrangian."""
        measured = self.measure(batch)
        priced = self.multiplier.react(self, self.measured_levels(measured))
        advantage = lagrangian(*self.advantages(data, measured), self.multiplier())
        advantage = advantage / unit_of(advantage)
        moved = self.descend(data.copy().set("advantage", advantage), self.losses_of)
        return {**moved, **priced, **self.deviations(measured)}

    def losses_of(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        """The policy's losses ``loss_*`` on steps whose advantage is that of the Lagrangian.

        ``"advantage"`` is standardised, and has the shape of the steps.
        """
        raise NotImplementedError


def unit_of(advantage: Tensor) -> Tensor:
    """The unit that gradient steps expect advantages in: their standard deviation, a scalar."""
    return advantage.std(correction=0).clamp(min=1e-6)
