"""Costs of environments that were not written for TorchRL, brought where the losses read them.

The blocks read a cost as TorchRL reads a reward: a float leaf ``("next", "cost")`` of shape
[*B, 1] in the environment's reward spec. Gymnasium environments put it into ``info``, TorchRL's
``SafetyGymnasiumEnv`` among the observations.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl.data import Binary, Composite, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, FrameSkipTransform, Transform, TransformedEnv
from torchrl.envs.gym_like import BaseInfoDictReader, GymLikeEnv
from torchrl.envs.libs.gym import GymWrapper

from torchrl_safe._costs import cost_key, violation_key

__all__ = ["CostToReward", "cost_from_info"]

CostSource = str | Callable[[Mapping[str, Any]], Any]


class CostToReward(Transform):
    """Moves a cost from the observations into the reward spec, shape ``[*B, 1]``, float32.

    A cost that the environment also shows at a reset is no cost of a step: it is left out there. An
    environment with several costs takes one of these for each, with a ``violation_key`` of its own.

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
        ValueError: if ``violation_above`` is not a number; by the environment, if the cost has
            another shape, the violation is already there, or frames are skipped, whose costs would
            be lost; and by a step whose cost is not finite.

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
        if math.isnan(violation_above):
            raise ValueError(f"violation_above must be a number, got {violation_above}.")
        self.cost_key = cost_key
        self.violation_key = violation_key
        self.violation_above = violation_above

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        shape = (*next_tensordict.batch_size, 1)
        cost = next_tensordict.get(self.cost_key).reshape(shape).to(torch.float32)
        if not cost.isfinite().all():
            rows = (~cost.isfinite()).nonzero()[:, :-1].tolist()
            where = f" at {rows}" if next_tensordict.batch_size else ""
            raise ValueError(f"cost {self.cost_key!r} must be finite, it is not{where}: {cost}.")
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
        if self.parent is not None:
            reject_skipped_frames(self.parent)
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
    cost: CostSource | Mapping[str, CostSource] = "cost",
    *,
    violation_above: float | Mapping[str, float] = 0.0,
) -> TransformedEnv:
    """Gives a wrapped Gymnasium environment the costs that it reports in ``info``.

    The cost becomes the leaf ``"cost"`` of the reward spec, and ``"violation"`` is written beside
    it, as :class:`CostToReward` does. Of several costs by name, each becomes a leaf
    ``"<name>_cost"`` with a flag ``"<name>_violation"`` of its own.

    A cost that is not there, or is not finite, is an error, in a vector environment as in a single
    one. Where an environment reports a cost only sometimes, say what it is otherwise:
    ``lambda info: info.get("cost", 0.0)``.

    Args:
        env (GymWrapper): or ``GymEnv``, without a wrapper around it yet. A vector environment must
            be made with ``autoreset_mode="Disabled"``, which lets TorchRL do the resets.
        cost (str, callable, or dict of them): the key in ``info``, or a function of ``info`` that
            returns the cost of the step: a number, or an array [N] for a vector environment. There,
            ``info[key]`` is an array, and missing if any environment did not report it;
            ``info.get(key, default)`` fills in the default for those. Default: ``"cost"``.

    Keyword Args:
        violation_above (float or dict): the cost above which a step violates the constraint; of
            several, for all of them or for each by name. Default: 0.

    Returns:
        TransformedEnv: with the cost.

    Raises:
        KeyError: at a step whose ``info`` has no such key; the message says in which environments.
        TypeError: if ``env`` is no Gymnasium environment of TorchRL's, or has transforms; or at a
            step whose cost is no number.
        ValueError: if it skips frames, whose costs would be lost, or resets by itself; if the names
            of costs and bounds differ, or one is taken; or at a step whose cost is not finite or
            not one number per environment.

    Examples:
        >>> from torchrl.envs import GymEnv
        >>> from torchrl_safe.envs import cost_from_info
        >>> env = cost_from_info(GymEnv("torchrl_safe/PointGoal-v0"), violation_above=0.5)
        >>> env.rollout(5)["next", "cost"].shape
        torch.Size([5, 1])
        >>> costs = {"hazard": "cost", "haste": lambda info: float(info["goal_met"])}
        >>> env = cost_from_info(GymEnv("torchrl_safe/PointGoal-v0"), costs)
        >>> env.rollout(5)["next", "hazard_cost"].shape
        torch.Size([5, 1])
    """
    inner = env.base_env if isinstance(env, TransformedEnv) else env
    if not isinstance(inner, GymWrapper):
        raise TypeError(f"env must be a GymWrapper or GymEnv, got {type(inner).__name__}.")
    # TorchRL puts a transform around those that reset by themselves.
    if inner is not env and inner.batch_size:
        mode = getattr(inner, "autoreset_mode", None)
        raise ValueError(f"a vector environment must have autoreset_mode='Disabled', got {mode}.")
    if inner is not env:
        raise TypeError(
            "env must not have transforms yet: append them to what this returns. Several costs go "
            "in at once, cost={name: ...}."
        )
    reject_skipped_frames(env)
    several = isinstance(cost, Mapping)
    sources = dict(cost) if isinstance(cost, Mapping) else {"": cost}
    if not sources or not all(isinstance(name, str) for name in sources):
        raise ValueError(f"cost must name at least one cost, by strings, got {list(sources)}.")
    for source in sources.values():
        if not isinstance(source, str) and not callable(source):
            raise TypeError(f"a cost must be a key in info or a function of it, got {source!r}.")
    if isinstance(violation_above, Mapping):
        bounds = dict(violation_above)
    else:
        bounds = dict.fromkeys(sources, violation_above)
    if bounds.keys() != sources.keys():
        names = sorted(sources) if several else "one number"
        raise ValueError(f"violation_above must be for {names}, got {sorted(bounds)}.")
    taken = {*env.full_observation_spec.keys(), *env.full_reward_spec.keys()}
    costs = {name: cost_key(name) for name in sources}
    clashes = sorted(taken & {*costs.values(), *map(violation_key, costs.values())})
    if clashes:
        raise ValueError(
            f"the environment has entries {clashes} of its own: name the costs otherwise, "
            "cost={name: ...}."
        )
    env.set_info_dict_reader(
        _CostReader({costs[name]: source for name, source in sources.items()}, env.batch_size)
    )
    return TransformedEnv(
        env,
        Compose(
            *(
                CostToReward(
                    key,
                    violation_key=violation_key(key),
                    violation_above=bounds[name],
                )
                for name, key in costs.items()
            )
        ),
    )


def reject_skipped_frames(env: EnvBase) -> None:
    """The cost of a step is then that of its last frame, while rewards are added up."""
    skip = 1
    while isinstance(env, TransformedEnv):
        for transform in env.transform.modules():
            if isinstance(transform, FrameSkipTransform):
                skip = max(skip, transform.frame_skip)
        env = env.base_env
    if isinstance(env, GymLikeEnv):
        skip = max(skip, env.wrapper_frame_skip)
    if skip > 1:
        raise ValueError(
            f"frame_skip={skip} loses the costs of the frames between: append "
            "SafeFrameSkip behind the cost, or skip frames inside the environment, where costs can "
            "be added up."
        )


class _CostReader(BaseInfoDictReader):
    """Reads the costs of a step out of ``info``, and zero where there was no step."""

    def __init__(self, costs: dict[str, CostSource], batch_size: torch.Size) -> None:
        self.costs = costs
        self._shape = (*batch_size, 1)

    @property
    def info_spec(self) -> dict[str, TensorSpec]:
        return {key: Unbounded(self._shape, dtype=torch.float32) for key in self.costs}

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        vector = len(self._shape) > 1
        info = _VectorInfo(info_dict, self._shape[0]) if vector else info_dict
        # Gymnasium does not promise a cost at a reset, which alone has no reward.
        stepped = "reward" in tensordict.keys()
        for key, source in self.costs.items():
            value = self._read(key, source, info) if stepped else torch.zeros(self._shape)
            tensordict.set(key, value.to(tensordict.device))
        return tensordict

    def _read(self, key: str, source: CostSource, info: Mapping[str, Any]) -> torch.Tensor:
        try:
            value = info[source] if isinstance(source, str) else source(info)
        except KeyError as error:
            where = error.args[0] if isinstance(info, _VectorInfo) else repr(error.args[0])
            known = sorted(name for name in info if not name.startswith("_"))
            raise KeyError(f"{key!r}: info has no {where}; it has {known}.") from error
        try:
            if not isinstance(value, torch.Tensor):
                value = torch.from_numpy(np.asarray(value, np.float32))
        except (TypeError, ValueError) as error:
            raise TypeError(f"{key!r} must be numbers, got {value!r}.") from error
        if value.numel() != math.prod(self._shape):
            raise ValueError(
                f"{key!r} must be one number per environment, of shape {self._shape[:-1]}, "
                f"got {tuple(value.shape)}."
            )
        return value.to(torch.float32).reshape(self._shape)


class _VectorInfo(Mapping[str, Any]):
    """The infos of N environments under the masks that Gymnasium keeps, read as those of one.

    Gymnasium writes 0 where an environment did not report an entry, and says so in a mask whose
    name has an underscore before it.
    """

    def __init__(self, infos: Mapping[str, Any], num_envs: int) -> None:
        self._infos = infos
        self._num_envs = num_envs

    def __getitem__(self, key: str) -> Any:
        if key not in self._infos:
            raise KeyError(repr(key))
        value = self._infos[key]
        if isinstance(value, Mapping):
            return _VectorInfo(value, self._num_envs)
        missing = ~np.asarray(self._infos.get(f"_{key}", True), bool)
        if missing.any():
            raise KeyError(f"{key!r} in environments {np.flatnonzero(missing).tolist()}")
        return value

    def get(self, key: str, default: Any = None) -> Any:
        """The entry, with the default where it is missing."""
        value = self._infos.get(key, np.zeros(self._num_envs))
        if isinstance(value, Mapping):
            return self[key]
        reported = np.asarray(self._infos.get(f"_{key}", key in self._infos), bool)
        reported = np.broadcast_to(reported, self._num_envs)
        value = np.asarray(value)
        return np.where(reported.reshape(-1, *[1] * (value.ndim - 1)), value, default)

    def __iter__(self) -> Iterator[str]:
        return iter(self._infos)

    def __len__(self) -> int:
        return len(self._infos)
