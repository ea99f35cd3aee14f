"""What the losses share: a network called with several sets of its parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey, unravel_key
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

    def call(tensordict: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
        leaves = [(*places[key], leaf.unbind(0)) for key, leaf in params.items(True, True)]
        own = [registry[name] for registry, name, _ in leaves]
        outputs = []
        try:
            for i in range(len(params)):
                for registry, name, members in leaves:
                    registry[name] = members[i]
                outputs.append(module(tensordict.copy()))
        finally:
            for (registry, name, _), tensor in zip(leaves, own, strict=True):
                registry[name] = tensor
        batch_size = (len(outputs), *tensordict.batch_size)
        out = TensorDict(batch_size=batch_size, device=tensordict.device)
        for key in module.out_keys:
            out.set(key, torch.stack([output.get(key) for output in outputs]))
        return out

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
