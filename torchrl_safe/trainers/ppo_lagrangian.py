"""PPO-Lagrangian (Ray et al. 2019), and PPO-PID (Stooke et al. 2020) with another multiplier."""

from __future__ import annotations

from typing import ClassVar

from torchrl_safe.trainers.on_policy import ClippedOptions, ClippedTrainer, PricedTrainer
from torchrl_safe.trainers.options import MethodOptions
from torchrl_safe.trainers.policy_steps import Controlled, Priced


class PPOLagrangianOptions(Priced, ClippedOptions):
    """The options of PPO-Lagrangian."""

    method: ClassVar[str] = "ppo_lagrangian"


class PPOLagrangian(ClippedTrainer, PricedTrainer):
    """Proximal policy optimization of the Lagrangian: clipped ratios on its advantage.

    Examples:
        >>> from torchrl_safe.trainers import PPOLagrangian
        >>> trainer = PPOLagrangian("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options: ClassVar[type[MethodOptions]] = PPOLagrangianOptions


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
