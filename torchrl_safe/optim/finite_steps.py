"""Gradient steps that numbers which are not finite cannot reach."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

__all__ = ["FiniteSteps"]


class FiniteSteps:
    """Steps of an optimizer: one whose gradient is not finite is skipped and counted.

    It would poison the parameters and the moments of Adam for good. Nothing is read on the host
    before :meth:`count`, so that a GPU need not wait and a CUDA graph can hold the steps.

    Args:
        optimizer (torch.optim.Optimizer): a fused one, whose parameters have no gradients but those
            of :meth:`step`.

    Keyword Args:
        max_grad_norm (float): norm that longer gradients are clipped to, over all parameters.
            Defaults to infinity: none is clipped.
        max_skipped (int): steps that may be skipped from one :meth:`count` to the next. Defaults
            to 0.

    Raises:
        ValueError: if the optimizer is not fused, or a number is out of its range.

    Examples:
        >>> import torch
        >>> from torchrl_safe.optim import FiniteSteps
        >>> x = torch.nn.Parameter(torch.tensor(1.0))
        >>> steps = FiniteSteps(torch.optim.SGD([x], lr=0.5, fused=True), max_skipped=1)
        >>> steps.step({"loss_x": x.square() / 2})
        >>> steps.step({"loss_x": x * torch.inf})
        >>> x.item(), steps.count()
        (0.5, 1)
    """

    def __init__(
        self,
        optimizer: torch.optim.Optimizer,
        *,
        max_grad_norm: float = math.inf,
        max_skipped: int = 0,
    ) -> None:
        if not optimizer.defaults.get("fused"):
            raise ValueError(
                f"optimizer must be made with fused=True, got {type(optimizer).__name__}."
            )
        if not max_grad_norm > 0:
            raise ValueError(f"max_grad_norm must be a positive number, got {max_grad_norm!r}.")
        if not max_skipped >= 0:
            raise ValueError(f"max_skipped must be at least 0, got {max_skipped!r}.")
        self.optimizer: Any = optimizer
        self.max_grad_norm = max_grad_norm
        self.max_skipped = max_skipped
        self._params = [param for group in optimizer.param_groups for param in group["params"]]
        self._skipped = torch.zeros((), device=self._params[0].device)
        self._names: list[str] = []
        self._bad: Tensor | None = None  # their values in the last step that was skipped

    def step(self, losses: TensorDictBase | Mapping[str, Tensor]) -> None:
        """One step down the sum of what is called ``loss_*``, as TorchRL's losses name it.

        Args:
            losses (TensorDictBase or mapping): scalars; those under other names are left out.

        Raises:
            KeyError: if none is called ``loss_*``.
        """
        terms = {name: loss for name, loss in losses.items() if name.startswith("loss_")}
        if not terms:
            raise KeyError(f"losses must hold an entry 'loss_*', it has {sorted(losses.keys())}.")
        try:
            total: Any = sum(terms.values())  # some may be constant
            total.backward()
            norm = nn.utils.get_total_norm(p.grad for p in self._params if p.grad is not None)
            skip = norm.isfinite().logical_not().to(self._skipped.dtype)
            # As torch.amp.GradScaler does it: a fused optimizer divides gradients by the one, and
            # leaves all as it is where the other is 1. It reads both in single precision.
            self.optimizer.grad_scale = (norm / self.max_grad_norm).clamp(min=1).float()
            self.optimizer.found_inf = skip
            self.optimizer.step()
        finally:
            self.optimizer.zero_grad()
        self._skipped += skip
        values = torch.stack([norm, *terms.values()]).detach()
        if self._bad is None:
            self._names, self._bad = ["gradient norm", *terms], torch.zeros_like(values)
        self._bad.copy_(torch.where(skip > 0, values, self._bad))  # in place: a graph's memory

    def count(self) -> int:
        """Steps that were skipped since it was last asked. The one call that reads from the device.

        Raises:
            FloatingPointError: if they are more than ``max_skipped``; it says what the gradient's
                norm and the losses were in the last one.
        """
        skipped = int(self._skipped.item())
        self._skipped.zero_()
        if skipped > self.max_skipped and self._bad is not None:
            bad = dict(zip(self._names, self._bad.tolist(), strict=True))
            raise FloatingPointError(
                f"{skipped} gradient steps were not finite, more than "
                f"max_skipped={self.max_skipped}: gradient norm {bad.pop('gradient norm')}, losses "
                f"{bad}."
            )
        return skipped
