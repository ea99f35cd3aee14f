"""What value estimation reads of a tensordict: entries, its dimension of time, next states."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Bounded


def next_key(key: NestedKey) -> NestedKey:
    """The key of an entry of the next step."""
    return unravel_key(("next", key))


def get_entry(tensordict: TensorDictBase, key: NestedKey, what: str) -> Tensor:
    """An entry; where it is missing, a ``KeyError`` says what it is and what there is instead."""
    key = unravel_key(key)
    value = tensordict.get(key, None)
    if value is None:
        present = ", ".join(sorted(map(str, tensordict.keys(True, True))))
        raise KeyError(
            f"{key!r}, {what}, is not in the tensordict of batch size "
            f"{tuple(tensordict.batch_size)}, which has {present}."
        )
    return value


def with_action(
    tensordict: TensorDictBase,
    action_key: NestedKey,
    action: Tensor | TensorDictBase,
    *critics: TensorDictModule,
) -> TensorDictBase:
    """What critics of states and actions read, with another action; errors name what is missing."""
    in_keys = [key for critic in critics for key in critic.in_keys]
    inputs = tensordict.select(*in_keys, strict=False).set(action_key, action)
    for key in in_keys:
        get_entry(inputs, key, "an input of the critic")
    return inputs


def behaviour_log_prob(
    tensordict: TensorDictBase, key: NestedKey, actor: TensorDictModule | None
) -> Tensor:
    """Log-density of the stored action under what took it: a policy, or a uniform draw.

    For the actions of ``init_random_frames``, TorchRL's collectors store zeros in the place of what
    the policy would have written. No density of a continuous action is zero exactly but for a
    uniform one on a box of volume 1. Where the actor's spec is a box, zeros therefore become the
    log-density of its ``rand()``.
    """
    log_prob = get_entry(
        tensordict,
        key,
        "the log-density of the action under the policy that took it, [*B, T] (collect with an "
        "actor built with return_log_prob=True)",
    )
    specs, action_keys = getattr(actor, "spec", None), getattr(actor, "dist_sample_keys", [])
    if specs is None or len(action_keys) != 1:
        return log_prob
    spec, action = specs[action_keys[0]], tensordict.get(action_keys[0], None)
    if action is None or not isinstance(spec, Bounded) or not spec.dtype.is_floating_point:
        return log_prob
    event_ndim = min(max(action.ndim - log_prob.ndim, 1), spec.ndim)
    width = spec.space.high - spec.space.low
    log_volume = width.log().sum(tuple(range(-event_ndim, 0))).to(log_prob)
    if log_volume.ndim and log_prob.shape[-log_volume.ndim :] != log_volume.shape:
        log_volume = log_volume.flatten()[0]  # of a batched environment's spec: all are the same
    return torch.where(log_prob == 0, -log_volume, log_prob)


def get_time_dim(tensordict: TensorDictBase, time_dim: int | None = None) -> int:
    """The dimension of time, at least 0: as given, else the one named ``"time"``, else the last."""
    ndim = tensordict.ndim
    if time_dim is None:
        names = list(tensordict.names)
        return names.index("time") if "time" in names else ndim - 1
    if not -ndim <= time_dim < ndim:
        raise ValueError(
            f"time_dim must be a dimension of the tensordict of batch size "
            f"{tuple(tensordict.batch_size)}, got {time_dim}."
        )
    return time_dim % ndim


def repair_next(tensordict: TensorDictBase, keys: Sequence[NestedKey]) -> TensorDictBase:
    """Next states that networks can take, in a shallow copy.

    Collectors with ``compact_obs`` leave NaN at the end of a trajectory; the state before it takes
    its place. A recurrent network starts anew where the trajectory does.
    """
    tensordict = tensordict.copy()
    for key in keys:
        value, following = tensordict.get(key, None), tensordict.get(next_key(key), None)
        if value is None or following is None or value.shape != following.shape:
            continue
        if key == "is_init":
            tensordict.set(next_key(key), value | following)
        elif isinstance(following, Tensor) and following.is_floating_point():
            tensordict.set(next_key(key), torch.where(following.isnan(), value, following))
    return tensordict
