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
        self._bad: dict[str, Tensor] = {}  # of the last step that was skipped

    def step(self, losses: TensorDictBase) -> None:
        """One step down the sum of what is called ``loss_*``."""
        terms = {name: loss for name, loss in losses.items() if name.startswith("loss_")}
        try:
            sum(terms.values()).backward()
            norm = nn.utils.clip_grad_norm_(self._params, self._max_norm)
            skip = norm.isfinite().logical_not().to(self._skipped.dtype)
            # Where it is 1, a fused optimizer leaves all as it is, as torch.amp.GradScaler expects.
            self.optim.found_inf = skip
            self.optim.step()
        finally:
            self.optim.zero_grad()
        self._skipped += skip
        for name, value in {"gradient norm": norm, **terms}.items():
            bad = self._bad.setdefault(name, torch.zeros_like(norm))
            bad.copy_(torch.where(skip > 0, value.detach(), bad))

    def count(self) -> float:
        """Steps that were skipped since it was last asked.

        Raises:
            FloatingPointError: if they are more than ``optim.max_skipped``.
        """
        skipped = self._skipped.item()
        self._skipped.zero_()
        if skipped > self._max_skipped:
            bad = {name: value.item() for name, value in self._bad.items()}
            raise FloatingPointError(
                f"{skipped:.0f} gradient steps were not finite, more than "
                f"optim.max_skipped={self._max_skipped}: gradient norm "
                f"{bad.pop('gradient norm')}, losses {bad}."
            )
        return skipped
