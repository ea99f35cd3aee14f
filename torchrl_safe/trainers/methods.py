"""The methods, by the names that command line and files use."""

from __future__ import annotations

from torchrl_safe.trainers.budgets import (
    PPOEarlyTerminated,
    PPOSaute,
    TRPOEarlyTerminated,
    TRPOSaute,
)
from torchrl_safe.trainers.crpo import CRPO
from torchrl_safe.trainers.cup import CUP
from torchrl_safe.trainers.focops import FOCOPS
from torchrl_safe.trainers.offpolicy_trc import OffPolicyTRC
from torchrl_safe.trainers.p3o import P3O
from torchrl_safe.trainers.pcpo import PCPO
from torchrl_safe.trainers.ppo_lagrangian import PPOPID, PPOLagrangian
from torchrl_safe.trainers.safetac import SafeTAC
from torchrl_safe.trainers.tac import TAC
from torchrl_safe.trainers.td3_lagrangian import TD3Lagrangian
from torchrl_safe.trainers.trainer import Trainer
from torchrl_safe.trainers.trc import CPO, TRC
from torchrl_safe.trainers.trpo_lagrangian import TRPOPID, TRPOLagrangian
from torchrl_safe.trainers.wcsac import SACPID, WCSAC, SACLagrangian

METHODS: dict[str, type[Trainer]] = {
    method.Options.method: method
    for method in (
        *(SafeTAC, TAC, WCSAC, SACLagrangian, SACPID, TD3Lagrangian),
        *(TRC, CPO, OffPolicyTRC),
        *(PPOLagrangian, PPOPID, TRPOLagrangian, TRPOPID),
        *(FOCOPS, CUP, P3O, CRPO, PCPO),
        *(PPOSaute, TRPOSaute, PPOEarlyTerminated, TRPOEarlyTerminated),
    )
}
