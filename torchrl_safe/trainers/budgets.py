"""Saute (Sootla et al. 2022) and early termination (Sun et al. 2021), with PPO and with TRPO.

The limit is the environment's: a budget for the costs of each episode. The method knows none, but
it sees what is left.
"""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Literal

from pydantic import Field
from tensordict import TensorDict, TensorDictBase

from torchrl_safe.envs import EarlyTermination, SafetyBudget, Saute
from torchrl_safe.trainers.on_policy import (
    ClippedLoss,
    ClippedTrainer,
    GradientOptim,
    KLOptim,
    OnPolicyCollector,
    SurrogateLoss,
    TrustRegionTrainer,
    unit_of,
)
from torchrl_safe.trainers.options import (
    ConstrainedLoss,
    Env,
    Group,
    Loss,
    MethodOptions,
    again,
    option,
    per_episode,
)
from torchrl_safe.trainers.trainer import ConstrainedTrainer


class WholeEpisodes(Env):
    """The environment."""

    episode_length: int = again(
        Env,
        "episode_length",
        1000,
        meaning="steps, in training: those of evaluation by default, since the budget is of a "
        "whole episode",
    )


class BudgetLoss(Loss):
    """Reward, and the limit that the budget follows from."""

    cost_gamma: float = again(ConstrainedLoss, "cost_gamma", 0.99)
    cost_limit: float = option(
        5.0, "on the cost, in limit_unit: the budget is that of as much in every step", gt=0
    )
    limit_unit: Literal["discounted", "step", "episode"] = again(
        ConstrainedLoss, "limit_unit", "discounted"
    )
    lmbda: float = again(SurrogateLoss, "lmbda", 0.95, meaning="trace decay of the advantages")


class ClippedBudgetLoss(BudgetLoss):
    """Reward, the limit that the budget follows from, and how far a ratio may go."""

    clip_epsilon: float = again(ClippedLoss, "clip_epsilon", 0.2)


class Budget(Group):
    """The budget of an episode."""

    budget_gamma: float = option(
        1.0, "discount of the cost in it; what is left is divided by this at each step", gt=0, le=1
    )

    @abstractmethod
    def enforced(self, budget: float, **options: Any) -> SafetyBudget:
        """The transform that is trained with."""

    def transform(self, rate: float, steps: int, *, training: bool, **options: Any) -> SafetyBudget:
        """The budget of an episode, which only training enforces.

        Evaluation shows what is left and changes nothing else: returns are those of the task.

        Args:
            rate (float): mean cost per step that is allowed.
            steps (int): of an episode.

        Keyword Args:
            training (bool): whether it is to train in.
            **options: of :class:`~torchrl_safe.envs.SafetyBudget`.
        """
        budget = rate * sum(self.budget_gamma**step for step in range(steps))
        options["gamma"] = self.budget_gamma
        return self.enforced(budget, **options) if training else SafetyBudget(budget, **options)


class SauteBudget(Budget):
    """The budget of an episode."""

    unsafe_reward: float = option(
        -1.0, "of a step in training with the budget overdrawn, in place of its reward", le=0
    )

    def enforced(self, budget: float, **options: Any) -> SafetyBudget:
        """Saute."""
        return Saute(budget, unsafe_reward=self.unsafe_reward, **options)


class TerminationBudget(Budget):
    """The budget of an episode."""

    termination_reward: float = option(
        0.0, "of the step in training that overdraws the budget and ends the episode", le=0
    )

    def enforced(self, budget: float, **options: Any) -> SafetyBudget:
        """Early termination."""
        return EarlyTermination(budget, termination_reward=self.termination_reward, **options)


class BudgetOptions(MethodOptions):
    """What the options of these methods have."""

    env: WholeEpisodes = Field(default_factory=WholeEpisodes)
    collector: OnPolicyCollector = Field(default_factory=OnPolicyCollector)


class PPOBudgetOptions(BudgetOptions):
    """What the options of PPO under a budget have."""

    loss: ClippedBudgetLoss = Field(default_factory=ClippedBudgetLoss)
    optim: GradientOptim = Field(default_factory=GradientOptim)


class TRPOBudgetOptions(BudgetOptions):
    """What the options of TRPO under a budget have."""

    loss: BudgetLoss = Field(default_factory=BudgetLoss)
    optim: KLOptim = Field(default_factory=KLOptim)


class BudgetTrainer(ConstrainedTrainer):
    """A method without a constraint, in an environment with a budget."""

    @property
    def costs(self) -> list[str]:
        """None: no loss prices a cost."""
        return []

    def episode_limits(self) -> dict[str, float]:
        """The limit as the sum of an episode of ``eval.num_steps``."""
        loss, steps = self.options.loss, self.options.eval.num_steps
        return {"cost": per_episode(loss.cost_limit, loss.limit_unit, loss.cost_gamma, steps)}

    def budgeted(self, batch: TensorDictBase) -> dict[str, float]:
        """Metrics of what is left in a batch, and of its cost beside the limit."""
        loss, steps = self.options.loss, self.options.eval.num_steps
        allowed = self.episode_limits()["cost"] / steps
        rate = batch["next", "cost"].mean().item()
        return {
            "update/cost_level": loss.cost_limit * rate / allowed,
            "update/cost_limit": loss.cost_limit,
            "update/overdrawn": (batch["next", "budget"] < 0).float().mean().item(),
        }


class BudgetPPO(BudgetTrainer, ClippedTrainer):
    """PPO in an environment with a budget."""

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """Passes up the return."""
        advantage = data["advantage"].squeeze(-1)
        advantage = (advantage - advantage.mean()) / unit_of(advantage)
        moved = self.descend(data.copy().set("advantage", advantage), self.losses_of)
        return {**moved, **self.budgeted(batch)}


class BudgetTRPO(BudgetTrainer, TrustRegionTrainer):
    """TRPO in an environment with a budget."""

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """A trust-region step up the return."""

        def closure() -> TensorDict:
            dist = self.policy.get_dist(data)
            log_prob = dist.log_prob(data["action"])
            return TensorDict(
                {
                    "objective": self.reward_loss.objective(data, log_prob),
                    "statistics": self.distance.statistics(dist),
                }
            )

        return {**self.trust_region.step(closure).to_dict(), **self.budgeted(batch)}


class PPOSauteOptions(PPOBudgetOptions):
    """The options of PPO with Saute."""

    method: ClassVar[str] = "ppo_saute"

    budget: SauteBudget = Field(default_factory=SauteBudget)


class PPOSaute(BudgetPPO):
    """PPO that earns nothing good once an episode's budget is overdrawn.

    Examples:
        >>> from torchrl_safe.trainers import PPOSaute
        >>> trainer = PPOSaute("point", cost_limit=25.0, limit_unit="episode")
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = PPOSauteOptions


class TRPOSauteOptions(TRPOBudgetOptions):
    """The options of TRPO with Saute."""

    method: ClassVar[str] = "trpo_saute"

    budget: SauteBudget = Field(default_factory=SauteBudget)


class TRPOSaute(BudgetTRPO):
    """TRPO that earns nothing good once an episode's budget is overdrawn.

    Examples:
        >>> from torchrl_safe.trainers import TRPOSaute
        >>> policy = TRPOSaute("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = TRPOSauteOptions


class PPOEarlyTerminatedOptions(PPOBudgetOptions):
    """The options of PPO with early termination."""

    method: ClassVar[str] = "ppo_early_terminated"

    budget: TerminationBudget = Field(default_factory=TerminationBudget)


class PPOEarlyTerminated(BudgetPPO):
    """PPO whose training episodes end once their budget is overdrawn.

    Examples:
        >>> from torchrl_safe.trainers import PPOEarlyTerminated
        >>> policy = PPOEarlyTerminated("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = PPOEarlyTerminatedOptions


class TRPOEarlyTerminatedOptions(TRPOBudgetOptions):
    """The options of TRPO with early termination."""

    method: ClassVar[str] = "trpo_early_terminated"

    budget: TerminationBudget = Field(default_factory=TerminationBudget)


class TRPOEarlyTerminated(BudgetTRPO):
    """TRPO whose training episodes end once their budget is overdrawn.

    Examples:
        >>> from torchrl_safe.trainers import TRPOEarlyTerminated
        >>> policy = TRPOEarlyTerminated("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = TRPOEarlyTerminatedOptions
