"""Trainers: whole methods on the blocks, with runs that survive what happens to them."""

from __future__ import annotations

from torchrl_safe.trainers.methods import METHODS
from torchrl_safe.trainers.safetac import SafeTAC
from torchrl_safe.trainers.trainer import ConstrainedTrainer, Trainer, load_policy

__all__ = ["METHODS", "ConstrainedTrainer", "SafeTAC", "Trainer", "load_policy"]
