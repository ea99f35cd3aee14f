"""Off-policy TRC (Kim and Oh 2022): TRC's surrogates on replayed trajectories, by Retrace."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import Field
from tensordict import TensorDictBase
from torchrl._utils import timeit
from torchrl.envs import EnvBase

from torchrl_safe.trainers.off_policy import make_slice_buffer, replayed
from torchrl_safe.trainers.on_policy import SurrogateOptim, SurrogateOptions, TrustRegionTrainer
from torchrl_safe.trainers.options import SliceBuffer, again, option


class OffPolicyTRCBuffer(SliceBuffer):
    """What is replayed: slices of trajectories."""

    size: int = again(
        SliceBuffer, "size", 80_000, meaning="frames: ratios to policies long gone say nothing"
    )


class OffPolicyTRCOptim(SurrogateOptim):
    """Critics and the trust-region step."""

    critic_frames: int = option(16_000, "replayed frames per round", ge=1)
    policy_frames: int = option(16_000, "replayed frames of the trust-region step", ge=1)


class OffPolicyTRCOptions(SurrogateOptions):
    """The options of off-policy TRC."""

    method: ClassVar[str] = "offpolicy_trc"

    replay_buffer: OffPolicyTRCBuffer = Field(default_factory=OffPolicyTRCBuffer)
    optim: OffPolicyTRCOptim = Field(default_factory=OffPolicyTRCOptim)


class OffPolicyTRC(TrustRegionTrainer):
    """TRC on old and new trajectories; how high the cost stands is measured on the new.

    Examples:
        >>> from torchrl_safe.trainers import OffPolicyTRC
        >>> policy = OffPolicyTRC("point").train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = OffPolicyTRCOptions

    def build(self, env: EnvBase) -> dict[str, Any]:
        """As TRC, with a replay buffer."""
        components = super().build(env)
        self.buffer = make_slice_buffer(self)
        return {**components, "buffer": self.buffer}

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Critics, then a trust-region step, on replayed data."""
        self.buffer.extend(batch.select(*replayed(self)))
        optim = self.options.optim
        if self.frames < self.options.collector.init_frames:
            return {}
        with timeit("time/critics"):
            for _ in range(optim.critic_rounds):
                losses = self.fit_critics(self._replay(optim.critic_frames))
        with timeit("time/policy"):
            step = self.policy_step(self._replay(optim.policy_frames), batch)
        return {**losses, **step}

    def _replay(self, num_frames: int) -> TensorDictBase:
        """Steps of slices with the advantages of the policy of now."""
        slices = self.buffer.sample(num_frames)
        slices = slices.reshape(-1, self.options.replay_buffer.slice_len)
        return self.with_advantages(slices, rescored=True)
