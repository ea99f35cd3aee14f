"""Trainers: whole methods on the blocks, with runs that survive what happens to them."""

from __future__ import annotations

from torchrl_safe._extras import need

need("training", "train", "hydra", "imageio", "matplotlib", "pydantic", "tqdm")

from torchrl_safe.trainers.budgets import (
    PPOEarlyTerminated,
    PPOSaute,
    TRPOEarlyTerminated,
    TRPOSaute,
)
from torchrl_safe.trainers.crpo import CRPO
from torchrl_safe.trainers.cup import CUP
from torchrl_safe.trainers.focops import FOCOPS
from torchrl_safe.trainers.methods import METHODS
from torchrl_safe.trainers.offpolicy_trc import OffPolicyTRC
from torchrl_safe.trainers.p3o import P3O
from torchrl_safe.trainers.pcpo import PCPO
from torchrl_safe.trainers.ppo_lagrangian import PPOPID, PPOLagrangian
from torchrl_safe.trainers.safetac import SafeTAC
from torchrl_safe.trainers.saved_policies import load_policy
from torchrl_safe.trainers.tac import TAC
from torchrl_safe.trainers.td3_lagrangian import TD3Lagrangian
from torchrl_safe.trainers.trainer import ConstrainedTrainer, Trainer
from torchrl_safe.trainers.trc import CPO, TRC
from torchrl_safe.trainers.trpo_lagrangian import TRPOPID, TRPOLagrangian
from torchrl_safe.trainers.wcsac import SACPID, WCSAC, SACLagrangian

__all__ = [
    "CPO",
    "CRPO",
    "CUP",
    "FOCOPS",
    "METHODS",
    "P3O",
    "PCPO",
    "PPOPID",
    "SACPID",
    "TAC",
    "TRC",
    "TRPOPID",
    "WCSAC",
    "ConstrainedTrainer",
    "OffPolicyTRC",
    "PPOEarlyTerminated",
    "PPOLagrangian",
    "PPOSaute",
    "SACLagrangian",
    "SafeTAC",
    "TD3Lagrangian",
    "TRPOEarlyTerminated",
    "TRPOLagrangian",
    "TRPOSaute",
    "Trainer",
    "load_policy",
]
