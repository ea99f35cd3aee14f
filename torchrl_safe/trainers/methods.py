"""The methods, by the names that command line and files use."""

from __future__ import annotations

from torchrl_safe.trainers.safetac import SafeTAC
from torchrl_safe.trainers.trainer import Trainer

METHODS: dict[str, type[Trainer]] = {"safetac": SafeTAC}
