"""Trainers: whole methods on the blocks, with runs that survive what happens to them."""

from __future__ import annotations

from torchrl_safe._extras import need

need("training", "train", "hydra", "imageio", "matplotlib", "pydantic", "tqdm")

from torchrl_safe.trainers.methods import METHODS
from torchrl_safe.trainers.offpolicy_trc import OffPolicyTRC
from torchrl_safe.trainers.safetac import SafeTAC
from torchrl_safe.trainers.saved_policies import load_policy
from torchrl_safe.trainers.tac import TAC
from torchrl_safe.trainers.trainer import ConstrainedTrainer, Trainer
from torchrl_safe.trainers.trc import CPO, TRC
from torchrl_safe.trainers.wcsac import WCSAC, SACLagrangian

__all__ = [
    "CPO",
    "METHODS",
    "TAC",
    "TRC",
    "WCSAC",
    "ConstrainedTrainer",
    "OffPolicyTRC",
    "SACLagrangian",
    "SafeTAC",
    "Trainer",
    "load_policy",
]
