"""What value estimation reads of a tensordict: entries, its dimension of time, next states."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor


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
        next_key = unravel_key(("next", key))
        value, following = tensordict.get(key, None), tensordict.get(next_key, None)
        if value is None or following is None or value.shape != following.shape:
            continue
        if key == "is_init":
            tensordict.set(next_key, value | following)
        elif isinstance(following, Tensor) and following.is_floating_point():
            tensordict.set(next_key, torch.where(following.isnan(), value, following))
    return tensordict
