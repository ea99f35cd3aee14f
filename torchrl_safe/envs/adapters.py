"""Costs of environments that were not written for TorchRL, brought where the losses read them.

The blocks read a cost as TorchRL reads a reward: a float leaf ``("next", "cost")`` of shape
[*B, 1] in the environment's reward spec. Gymnasium environments put it into ``info``, TorchRL's
``SafetyGymnasiumEnv`` among the observations.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase, Transform, TransformedEnv
from torchrl.envs.gym_like import BaseInfoDictReader
from torchrl.envs.libs.gym import GymWrapper

__all__ = ["CostToReward", "cost_from_info"]


class CostToReward(Transform):
    """Moves a cost from the observations into the reward spec, shape ``[*B, 1]``, float32.

    A cost that the environment also shows at a reset is no cost of a step: it is left out there.

    Args:
        cost_key (NestedKey): where the environment writes the cost, one number per environment, of
            any dtype, shape ``[*B]`` or ``[*B, 1]``. The leaf of the reward spec has the same name.
            Default: ``"cost"``.

    Keyword Args:
        violation_key (NestedKey, optional): bool ``[*B, 1]``, to write among the observations,
            true where the cost of the step is above ``violation_above``; false after a reset.
            ``None`` writes none. Default: ``"violation"``.
        violation_above (float): Default: 0, right for a binary cost. For a smooth one, say where
            the constraint is violated.

    Raises:
        KeyError: by the environment it is appended to, if there is no such observation.
        ValueError: by that, if it has another shape, or the violation is already there.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl.envs.libs import SafetyGymnasiumEnv  # doctest: +SKIP
        >>> env = SafetyGymnasiumEnv("SafetyPointGoal1-v0")  # doctest: +SKIP
        >>> env = TransformedEnv(env, CostToReward())  # doctest: +SKIP
    """

    def __init__(
        self,
        cost_key: NestedKey = "cost",
        *,
        violation_key: NestedKey | None = "violation",
        violation_above: float = 0.0,
    ) -> None:
        super().__init__(in_keys=[cost_key], out_keys=[cost_key])
        self.cost_key = cost_key
        self.violation_key = violation_key
        self.violation_above = violation_above

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*next_tensordict.batch_size, 1)
        cost = next_tensordict.get(self.cost_key).reshape(shape).to(torch.float32)
        next_tensordict.set(self.cost_key, cost)
        if self.violation_key is not None:
            next_tensordict.set(self.violation_key, cost > self.violation_above)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        tensordict_reset = tensordict_reset.exclude(self.cost_key)
        if self.violation_key is not None:
            shape = (*tensordict_reset.batch_size, 1)
            no = torch.zeros(shape, dtype=torch.bool, device=tensordict_reset.device)
            tensordict_reset.set(self.violation_key, no)
        return tensordict_reset

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Moves the leaf."""
        output_spec = output_spec.clone()
        observations, batch_size = output_spec["full_observation_spec"], output_spec.shape
        keys = list(observations.keys(True, True))
        if self.cost_key not in keys:
            raise KeyError(f"there is no observation {self.cost_key!r} among {keys}.")
        shape = observations[self.cost_key].shape
        if shape not in (batch_size, (*batch_size, 1)):
            raise ValueError(
                f"{self.cost_key!r} must be one number per environment, of shape "
                f"{tuple(batch_size)} or {(*batch_size, 1)}, got {tuple(shape)}."
            )
        device = observations.device
        del observations[self.cost_key]
        if self.violation_key is not None:
            if self.violation_key in keys:
                raise ValueError(
                    f"the environment has an observation {self.violation_key!r} of its own: "
                    "pass another violation_key, or None."
                )
            flag = Binary(1, shape=(*batch_size, 1), dtype=torch.bool, device=device)
            observations[self.violation_key] = flag
        output_spec["full_reward_spec", self.cost_key] = Unbounded(
            (*batch_size, 1), device=device, dtype=torch.float32
        )
        return output_spec


def cost_from_info(
    env: EnvBase,
    cost: str | Callable[[Mapping[str, Any]], Any] = "cost",
    *,
    violation_above: float = 0.0,
) -> TransformedEnv:
    """Gives a wrapped Gymnasium environment the cost that it reports in ``info``.

    The cost becomes the leaf ``"cost"`` of the reward spec, and ``"violation"`` is written beside
    it, as :class:`CostToReward` does.

    Args:
        env (GymWrapper): or ``GymEnv``, without a wrapper around it yet. A vector environment must
            be made with ``autoreset_mode="Disabled"``, which lets TorchRL do the resets.
        cost (str or callable): the key in ``info``, or a function of ``info`` that returns the cost
            of the step: a number, or an array [N] for a vector environment. Default: ``"cost"``.

    Keyword Args:
        violation_above (float): the cost above which a step violates the constraint. Default: 0.

    Returns:
        TransformedEnv: with the cost.

    Raises:
        KeyError: at a step whose ``info`` has no such key.
        TypeError: if ``env`` is no Gymnasium environment of TorchRL's, or has transforms.
        ValueError: if it skips frames, whose costs would be lost, or resets by itself.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_safe.envs import cost_from_info
        >>> env = cost_from_info(GymEnv("torchrl_safe/PointGoal-v0"), violation_above=0.5)
        >>> env.rollout(5)["next", "cost"].shape
        torch.Size([5, 1])
    """
    inner = env.base_env if isinstance(env, TransformedEnv) else env
    if not isinstance(inner, GymWrapper):
        raise TypeError(f"env must be a GymWrapper or GymEnv, got {type(inner).__name__}.")
    # TorchRL puts a transform around those that reset by themselves.
    if inner is not env and inner.batch_size:
        mode = inner._env.autoreset_mode
        raise ValueError(f"a vector environment must have autoreset_mode='Disabled', got {mode}.")
    if inner is not env:
        raise TypeError("env must not have transforms yet: append them to what this returns.")
    if env.wrapper_frame_skip > 1:
        raise ValueError(
            f"frame_skip={env.wrapper_frame_skip} loses the costs of the frames between: skip "
            "frames inside the Gymnasium environment, where costs can be added up."
        )
    env.set_info_dict_reader(_CostReader(cost, env.batch_size))
    return TransformedEnv(env, CostToReward(violation_above=violation_above))


class _CostReader(BaseInfoDictReader):
    """Reads the cost of a step out of ``info``, and zero where there was no step."""

    def __init__(
        self, cost: str | Callable[[Mapping[str, Any]], Any], batch_size: torch.Size
    ) -> None:
        self.cost = cost
        self._shape = (*batch_size, 1)

    @property
    def info_spec(self) -> dict[str, TensorSpec]:
        return {"cost": Unbounded(self._shape, dtype=torch.float32)}

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        # Gymnasium does not promise a cost at a reset, which alone has no reward.
        if "reward" not in tensordict.keys():
            value: Any = torch.zeros(self._shape)
        elif callable(self.cost):
            value = self.cost(info_dict)
        elif self.cost in info_dict:
            value = info_dict[self.cost]
        else:
            raise KeyError(f"info has no {self.cost!r}, only {sorted(info_dict)}.")
        value = torch.as_tensor(value, dtype=torch.float32, device=tensordict.device)
        return tensordict.set("cost", value.reshape(self._shape))
