"""What the losses share: a network called with several sets of its parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.modules import ValueOperator
from torchrl.objectives.utils import _vmap_func

Ensemble = Callable[[TensorDictBase, TensorDictBase, NestedKey], Tensor]
Place = tuple[dict[str, Any], str]


def ensemble(module: TensorDictModule, *, randomness: str, deactivate_vmap: bool) -> Ensemble:
    """A network as a function of its input, of E sets of parameters and of the output in question.

    Args:
        module (TensorDictModule): the network.

    Keyword Args:
        randomness (str): vmap's, ``"error"``, ``"different"`` or ``"same"``.
        deactivate_vmap (bool): call it E times in place of vmap. A CPU is faster at it, and so is
            this loop than TorchRL's: it stacks the output and nothing else.

    Returns:
        A function of a tensordict ``[*B]``, parameters ``[E]``, stacked as
        :meth:`~torchrl.objectives.LossModule.convert_to_functional` does it, and a key. It returns
        what the module writes there, ``[E, *B, ...]``, and leaves its arguments alone. It raises
        ``KeyError`` if the module does not write there.
    """
    if not deactivate_vmap:
        vmapped = _vmap_func(module, (None, 0), randomness=randomness)

        def call_at_once(tensordict: TensorDictBase, params: TensorDictBase, key: NestedKey) -> Any:
            return vmapped(tensordict.select(*module.in_keys, strict=False), params)[key]

        return call_at_once
    places = _places(module)
    value_of = _value_of(module)

    def call(tensordict: TensorDictBase, params: TensorDictBase, key: NestedKey) -> Tensor:
        leaves = [(*place, leaf.unbind(0)) for place, leaf in _pairs(places, params)]
        own = [registry[name] for registry, name, _ in leaves]
        values = []
        try:
            for i in range(len(params)):
                for registry, name, members in leaves:
                    registry[name] = members[i]
                values.append(value_of(tensordict, key))
        finally:
            for (registry, name, _), tensor in zip(leaves, own, strict=True):
                registry[name] = tensor
        return torch.stack(values)

    return call


def _value_of(module: TensorDictModule) -> Callable[[TensorDictBase, NestedKey], Tensor]:
    """What a module writes at a key, as a function of what it reads.

    A value operator is its network: to put one tensor into a tensordict and out again, for every
    set of parameters, costs half as much as a small network.
    """
    direct = type(module) is ValueOperator and len(module.out_keys) == 1 and module._kwargs is None

    def value_of(tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        if direct and key == module.out_keys[0]:
            return module.module(*map(tensordict.get, module.in_keys))
        return module(tensordict.select(*module.in_keys, strict=False))[key]

    return value_of


def _places(module: nn.Module) -> dict[str, Any]:
    """Where a module keeps its parameters and buffers, nested like their tensordict.

    To put tensors there is what :func:`torch.func.functional_call` does, too, after it has looked
    for the place by its name, parameter by parameter and call by call.
    """
    own = {
        name: (registry, name)
        for registry in (module._parameters, module._buffers)
        for name in registry
    }
    children = {name: child for name, child in module._modules.items() if child is not None}
    return own | {name: _places(child) for name, child in children.items()}


def _pairs(places: dict[str, Any], params: TensorDictBase) -> list[tuple[Place, Tensor]]:
    """Places with what belongs there. ``params.items(True, True)`` takes twice as long."""
    pairs: list[tuple[Place, Tensor]] = []
    for name, value in params.items():
        place = places[name]
        pairs += _pairs(place, value) if isinstance(place, dict) else [(place, value)]
    return pairs
