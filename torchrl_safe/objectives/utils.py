"""What the losses share: a network called with several sets of its parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.modules import ValueOperator
from torchrl.objectives.utils import _vmap_func

Ensemble = Callable[[TensorDictBase, TensorDictBase], Any]


def ensemble(module: TensorDictModule, *, randomness: str, deactivate_vmap: bool) -> Ensemble:
    """A network as a function of its input and of E sets of parameters.

    Args:
        module (TensorDictModule): the network.

    Keyword Args:
        randomness (str): vmap's, ``"error"``, ``"different"`` or ``"same"``.
        deactivate_vmap (bool): call it E times in place of vmap. A CPU is faster at it, and so is
            this loop than TorchRL's: it stacks what the network writes and nothing else.

    Returns:
        A function of a tensordict ``[*B]`` and parameters ``[E]``, stacked as
        :meth:`~torchrl.objectives.LossModule.convert_to_functional` does it. It returns the
        module's outputs, ``[E, *B]``, and leaves its arguments alone.
    """
    if not deactivate_vmap:
        return _vmap_func(module, (None, 0), randomness=randomness)
    places = _places(module)
    values_of = _values_of(module)

    def call(tensordict: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
        leaves = [(*places[key], leaf.unbind(0)) for key, leaf in params.items(True, True)]
        own = [registry[name] for registry, name, _ in leaves]
        outputs = []
        try:
            for i in range(len(params)):
                for registry, name, members in leaves:
                    registry[name] = members[i]
                outputs.append(values_of(tensordict))
        finally:
            for (registry, name, _), tensor in zip(leaves, own, strict=True):
                registry[name] = tensor
        batch_size = (len(outputs), *tensordict.batch_size)
        out = TensorDict(batch_size=batch_size, device=tensordict.device)
        for key, values in zip(module.out_keys, zip(*outputs, strict=True), strict=True):
            out.set(key, torch.stack(values))
        return out

    return call


def _values_of(module: TensorDictModule) -> Callable[[TensorDictBase], tuple[Tensor, ...]]:
    """What a module writes, as a function of what it reads.

    A value operator is its network: to put one tensor into a tensordict and out again, for every
    set of parameters, costs half as much as a small network.
    """
    if type(module) is ValueOperator and len(module.out_keys) == 1 and module._kwargs is None:
        return lambda tensordict: (module.module(*map(tensordict.get, module.in_keys)),)

    def call(tensordict: TensorDictBase) -> tuple[Tensor, ...]:
        out = module(tensordict.copy())
        return tuple(out.get(key) for key in module.out_keys)

    return call


def _places(module: TensorDictModule) -> dict[NestedKey, tuple[dict[str, Any], str]]:
    """Where a module keeps its parameters and buffers, by their keys in a tensordict.

    To put tensors there is what :func:`torch.func.functional_call` does, too, after it has looked
    for the place by its name, parameter by parameter and call by call.
    """
    return {
        unravel_key((*path.split("."), name) if path else (name,)): (registry, name)
        for path, owner in module.named_modules(remove_duplicate=False)
        for registry in (owner._parameters, owner._buffers)
        for name in registry
    }
