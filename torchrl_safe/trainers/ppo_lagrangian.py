"""PPO-Lagrangian (Ray et al. 2019), and PPO-PID (Stooke et al. 2020) with another multiplier."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field
from tensordict import TensorDictBase
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss

from torchrl_safe.objectives import lagrangian
from torchrl_safe.trainers.on_policy import GradientOptions, GradientTrainer, MeanSurrogateLoss
from torchrl_safe.trainers.options import MethodOptions, option
from torchrl_safe.trainers.policy_steps import Controlled, Priced, make_multiplier


class ClippedLoss(MeanSurrogateLoss):
    """Reward, the limit, and how far a ratio may go."""

    clip_epsilon: float = option(0.2, "ratios beyond 1 +- this gain nothing", gt=0, lt=1)


class ClippedOptions(GradientOptions):
    """What the options of methods with clipped ratios have."""

    loss: ClippedLoss = Field(default_factory=ClippedLoss)


class PPOLagrangianOptions(Priced, ClippedOptions):
    """The options of PPO-Lagrangian."""

    method: ClassVar[str] = "ppo_lagrangian"


class PPOLagrangian(GradientTrainer):
    """Proximal policy optimization of the Lagrangian: clipped ratios on its advantage.

    Examples:
        >>> from torchrl_safe.trainers import PPOLagrangian
        >>> trainer = PPOLagrangian("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = PPOLagrangianOptions

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy with PPO's loss, surrogates with critics of states, and a multiplier."""
        components = super().build(env)
        self.policy_loss = ClipPPOLoss(
            self.policy,
            clip_epsilon=self.options.loss.clip_epsilon,
            entropy_bonus=False,
            normalize_advantage=True,
        )
        self.multiplier = make_multiplier(self)
        return {**components, "multiplier": self.multiplier}

    def policy_step(self, data: TensorDictBase, batch: TensorDictBase) -> dict[str, float]:
        """The multiplier's step, then passes up the Lagrangian."""
        measured = self.measure(batch)
        priced = self.multiplier.react(self, self.measured_levels(measured))
        advantage = lagrangian(*self.advantages(data, measured), self.multiplier())
        data = data.copy().set("advantage", advantage.unsqueeze(-1))
        return {**self.descend(data, self.policy_loss), **priced, **self.deviations(measured)}


class PPOPIDOptions(Controlled, ClippedOptions):
    """The options of PPO-PID."""

    method: ClassVar[str] = "ppo_pid"


class PPOPID(PPOLagrangian):
    """PPO-Lagrangian with a multiplier that a PID controller sets.

    Examples:
        >>> from torchrl_safe.trainers import PPOPID
        >>> trainer = PPOPID("point", kp=0.1)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = PPOPIDOptions
