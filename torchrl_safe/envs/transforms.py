"""TorchRL's transforms where they take one reward only, for environments with a cost beside it."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite
from torchrl.envs import FrameSkipTransform
from torchrl.envs.utils import step_mdp

__all__ = ["SafeFrameSkip"]


class SafeFrameSkip(FrameSkipTransform):
    """Repeats each action for some frames, and loses no cost and no violation on the way.

    TorchRL's :class:`~torchrl.envs.FrameSkipTransform` takes one reward only, and steps on beyond
    the end of an episode. Here, a step of ``frame_skip`` frames returns

    * the sum of each leaf of the reward spec: the reward and every cost;
    * the last observation, but boolean entries (``violation``, ``goal_met``) are true if they were
      in any of the frames;
    * ``violations``, where the environment counts them, in steps of this length, rounded up.

    An episode that ends within a step contributes the frames up to there. The others of its batch
    go on, and it is stepped with them, unseen; what refuses to be stepped beyond an end
    (Gymnasium's vector environments) needs the frame skip in each of its environments.

    Args:
        frame_skip (int): frames per step. Default: 1.

    Raises:
        ValueError: if there is less than one.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_safe.envs import SafeFrameSkip, SafeGoalEnv
        >>> env = SafeGoalEnv(num_envs=2, num_threads=1, episode_length=100)
        >>> env = TransformedEnv(env, SafeFrameSkip(4))
        >>> env.rollout(1_000)["next", "cost"].shape
        torch.Size([2, 25, 1])
    """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        parent = self.parent
        if parent is None:
            raise RuntimeError("SafeFrameSkip must be appended to a TransformedEnv.")
        observations = parent.full_observation_spec
        keys = list(observations.keys(True, True))
        flags = [key for key in keys if observations[key].dtype == torch.bool]
        counts = [key for key in keys if key == "violations"]
        total = next_tensordict.select(*parent.reward_keys, *counts)
        seen = next_tensordict.select(*flags)
        for _ in range(self.frame_skip - 1):
            over = next_tensordict.get("done").reshape(next_tensordict.batch_size)
            if over.all():
                break
            tensordict = step_mdp(
                tensordict.copy().set("next", next_tensordict),
                exclude_action=False,
                reward_keys=parent.reward_keys,
                done_keys=parent.done_keys,
                action_keys=parent.action_keys,
            )
            # Not parent.step: the action has been through the inverse transforms already.
            frame = parent.base_env._step_proc_data(parent.base_env._step(tensordict))
            frame = parent.transform._step(tensordict, frame)
            more = frame.select(*total.keys(True, True))
            if over.any():
                frame, more = torch.where(over, next_tensordict, frame), more.where(~over, 0)
            total = total + more
            seen = seen | frame.select(*flags)
            next_tensordict = frame
        for key in counts:
            total[key] = -(-total[key] // self.frame_skip)
        return next_tensordict.update(total).update(seen)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Widens the bounds of what is added up."""
        output_spec = output_spec.clone()
        rewards = output_spec["full_reward_spec"]
        for key, spec in list(rewards.items(True, True)):
            if isinstance(spec, Bounded):
                low, high = spec.space.low, spec.space.high
                rewards[key] = Bounded(
                    torch.minimum(low, low * self.frame_skip),
                    torch.maximum(high, high * self.frame_skip),
                    spec.shape,
                    device=spec.device,
                    dtype=spec.dtype,
                )
        return output_spec
