"""What the losses share: a network called with several sets of its parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch.func import functional_call
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

    def call(tensordict: TensorDictBase, params: TensorDictBase) -> TensorDictBase:
        members = {
            name if isinstance(name, str) else ".".join(name): stacked.unbind(0)
            for name, stacked in params.items(True, True)
        }
        outputs = [
            functional_call(
                module,
                dict(zip(members, member, strict=True)),
                (tensordict.copy(),),
                tie_weights=False,  # they come with every name
            )
            for member in zip(*members.values(), strict=True)
        ]
        batch_size = (len(outputs), *tensordict.batch_size)
        out = TensorDict(batch_size=batch_size, device=tensordict.device)
        for key in module.out_keys:
            out.set(key, torch.stack([output.get(key) for output in outputs]))
        return out

    return call
