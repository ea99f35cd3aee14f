"""Gradient steps that numbers which are not finite cannot reach."""

from __future__ import annotations

import math

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import Tensor, nn


class Descent:
    """Steps of an optimizer: a gradient that is not finite is skipped and counted.

    It would poison the parameters and the moments of Adam for good. ``optim.max_grad_norm``, where
    the configuration has it, clips the others. Nothing is read on the host before :meth:`count`, so
    that a GPU need not wait and a CUDA graph can hold the steps.

    Args:
        cfg (DictConfig): the run's configuration.
        optim (torch.optim.Optimizer): a fused one, without gradients but those of :meth:`step`.

    Raises:
        ValueError: if the optimizer is not fused.
    """

    def __init__(self, cfg: DictConfig, optim: torch.optim.Optimizer) -> None:
        if not optim.defaults.get("fused"):
            raise ValueError(f"optim must be made with fused=True, got {type(optim).__name__}.")
        self.optim = optim
        self._max_skipped = cfg.optim.max_skipped
        self._max_norm = cfg.optim.get("max_grad_norm", math.inf)
        self._params = [param for group in optim.param_groups for param in group["params"]]
        self._skipped = torch.zeros((), device=self._params[0].device)
        self._names: list[str] = []
        self._bad: Tensor | None = None  # their values in the last step that was skipped

    def step(self, losses: TensorDictBase) -> None:
        """One step down the sum of what is called ``loss_*``."""
        terms = {name: loss for name, loss in losses.items() if name.startswith("loss_")}
        try:
            sum(terms.values()).backward()  # some may be constant
            norm = nn.utils.get_total_norm(p.grad for p in self._params if p.grad is not None)
            skip = norm.isfinite().logical_not().to(self._skipped.dtype)
            # As torch.amp.GradScaler does it: a fused optimizer divides gradients by the one, and
            # leaves all as it is where the other is 1. It reads both in single precision.
            self.optim.grad_scale = (norm / self._max_norm).clamp(min=1).float()
            self.optim.found_inf = skip
            self.optim.step()
        finally:
            self.optim.zero_grad()
        self._skipped += skip
        values = torch.stack([norm, *terms.values()]).detach()
        if self._bad is None:
            self._names, self._bad = ["gradient norm", *terms], torch.zeros_like(values)
        self._bad.copy_(torch.where(skip > 0, values, self._bad))  # in place: a graph's memory

    def count(self) -> float:
        """Steps that were skipped since it was last asked.

        Raises:
            FloatingPointError: if they are more than ``optim.max_skipped``.
        """
        skipped = self._skipped.item()
        self._skipped.zero_()
        if skipped > self._max_skipped:
            bad = dict(zip(self._names, self._bad.tolist(), strict=True))
            raise FloatingPointError(
                f"{skipped:.0f} gradient steps were not finite, more than "
                f"optim.max_skipped={self._max_skipped}: gradient norm "
                f"{bad.pop('gradient norm')}, losses {bad}."
            )
        return skipped
