"""Gradient steps that numbers which are not finite cannot reach."""

from __future__ import annotations

import math

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import nn


class Descent:
    """Steps of an optimizer, in one update: a gradient that is not finite is skipped and counted.

    It would poison the parameters and the moments of Adam for good. ``optim.max_grad_norm``, where
    the configuration has it, clips the others.

    Args:
        cfg (DictConfig): the run's configuration.
        optim (torch.optim.Optimizer): has no gradients but those of :meth:`step`.
    """

    def __init__(self, cfg: DictConfig, optim: torch.optim.Optimizer) -> None:
        self.optim = optim
        self.skipped = 0
        self._max_skipped = cfg.optim.max_skipped
        self._max_norm = cfg.optim.get("max_grad_norm", math.inf)
        self._params = [param for group in optim.param_groups for param in group["params"]]

    def step(self, losses: TensorDictBase) -> bool:
        """One step down the sum of what is called ``loss_*``; whether it was taken.

        Raises:
            FloatingPointError: if more than ``optim.max_skipped`` steps had to be skipped.
        """
        terms = {name: loss for name, loss in losses.items() if name.startswith("loss_")}
        self.optim.zero_grad()
        sum(terms.values()).backward()
        norm = nn.utils.clip_grad_norm_(self._params, self._max_norm)
        taken = bool(norm.isfinite())
        if taken:
            self.optim.step()
        else:
            self.skipped += 1
        self.optim.zero_grad()
        if self.skipped > self._max_skipped:
            values = {name: loss.item() for name, loss in terms.items()}
            raise FloatingPointError(
                f"{self.skipped} gradient steps were not finite, more than "
                f"optim.max_skipped={self._max_skipped}: gradient norm {norm.item()}, losses "
                f"{values}."
            )
        return taken
