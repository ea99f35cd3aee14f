"""What left and right are to an environment: its steps, seen in a mirror."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

__all__ = ["Reflection"]


class Reflection:
    """A mirror: a step in it is a step that could as well have been taken.

    What a robot meets with everything to its left is what it would meet with everything to its
    right. Reward, cost and the law of what follows are the same, so a critic may learn from both.
    Each entry of an observation or action becomes another one, or itself, with or without its sign
    turned.

    An environment that has one says so by its attribute ``reflection``.

    Args:
        observation (sequence of int): for each entry of ``"observation"``, which one it becomes,
            counted from 1, and negative where the sign turns.
        action (sequence of int): the same of ``"action"``.

    Raises:
        ValueError: if done twice it is not what it was.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> mirror = Reflection(observation=[1, -2], action=[2, 1])
        >>> step = TensorDict(observation=torch.tensor([3.0, 4.0]), action=torch.tensor([5.0, 6.0]))
        >>> seen = mirror(step)
        >>> seen["observation"].tolist(), seen["action"].tolist()
        ([3.0, -4.0], [6.0, 5.0])
    """

    def __init__(self, observation: Sequence[int], action: Sequence[int]) -> None:
        self._maps = {
            "observation": _indices("observation", observation),
            "action": _indices("action", action),
        }

    def __call__(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The steps in the mirror; what is neither observation nor action is shared.

        Args:
            tensordict (TensorDictBase): ``observation`` and ``action``, ``[*B, D]`` each.

        Returns:
            TensorDictBase: another one, of the same batch size.

        Raises:
            ValueError: if an entry has another size.
        """
        seen = tensordict.copy()
        for key, (index, sign) in self._maps.items():
            entry = tensordict[key]
            if entry.shape[-1] != len(index):
                raise ValueError(
                    f"{key!r} must have {len(index)} entries, got shape {tuple(entry.shape)}."
                )
            seen[key] = entry[..., index.to(entry.device)] * sign.to(entry)
        return seen

    def of_half(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The first half of a batch ``[B]`` in the mirror, the rest as it is."""
        half = len(tensordict) // 2
        return torch.cat([self(tensordict[:half]), tensordict[half:]])


def _indices(name: str, places: Sequence[int]) -> tuple[Tensor, Tensor]:
    place = torch.tensor(list(places), dtype=torch.long)
    index, sign = place.abs() - 1, place.sign()
    if sorted(index.tolist()) != list(range(len(index))):
        raise ValueError(f"{name} must name each of {len(index)} entries once, got {list(places)}.")
    if not (index[index] == torch.arange(len(index))).all() or not (sign[index] == sign).all():
        raise ValueError(f"{name}, done twice, must change nothing, got {list(places)}.")
    return index, sign.to(torch.get_default_dtype())
