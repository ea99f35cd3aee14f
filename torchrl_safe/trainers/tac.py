"""Tsallis actor-critic (Lee et al. 2020), without a constraint: SAC with another entropy."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field
from tensordict import TensorDictBase
from torchrl._utils import timeit
from torchrl.envs import EnvBase
from torchrl.objectives import SoftUpdate

from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.off_policy import (
    SoftUpdates,
    joint_optim,
    make_buffer,
    make_reward_loss,
    replayed,
)
from torchrl_safe.trainers.options import Loss, MethodOptions, ReplayBuffer, option
from torchrl_safe.trainers.trainer import Trainer


class TACLoss(Loss):
    """Reward and entropy."""

    entropic_index: float = option(1.2, "q; 1 is Shannon entropy, which makes it SAC", gt=0)
    alpha: float = option(0.01, "entropy weight to start with; it is tuned", gt=0, fixed=True)


class TACOptions(MethodOptions):
    """The options of Tsallis actor-critic."""

    method: ClassVar[str] = "tac"

    replay_buffer: ReplayBuffer = Field(default_factory=ReplayBuffer)
    loss: TACLoss = Field(default_factory=TACLoss)
    optim: SoftUpdates = Field(default_factory=SoftUpdates)


class TAC(Trainer):
    """Tsallis actor-critic: no limit on anything.

    Examples:
        >>> from torchrl_safe.trainers import TAC
        >>> trainer = TAC("point", entropic_index=1.0)  # SAC
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = TACOptions

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy and the loss of the reward."""
        options = self.options
        self.policy = self.make_policy(env)
        self.loss = make_reward_loss(self, env)
        self.loss.make_value_estimator(gamma=options.loss.gamma)
        self.target = SoftUpdate(self.loss, tau=options.optim.tau)
        optim = joint_optim([self.loss], options.optim.lr)
        self.steps = FiniteSteps(optim, max_skipped=options.optim.max_skipped)
        self.buffer = make_buffer(self)
        return {"loss": self.loss, "optim": optim, "buffer": self.buffer}

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Gradient steps on replayed transitions."""
        self.buffer.extend(batch.select(*replayed(self)).flatten())
        if self.frames < self.options.collector.init_frames:
            return {}
        with timeit("time/update"):
            for _ in range(self.options.optim.num_updates):
                losses = self.loss(self.buffer.sample())
                self.steps.step(losses)
                self.target.step()
        metrics = {f"update/{name}": value.item() for name, value in losses.items()}
        return metrics | {"update/skipped_steps": float(self.steps.count())}
