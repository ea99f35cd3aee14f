"""Modules of version 0.1 under their old paths, which warn and hand on what is asked of them."""

from __future__ import annotations

import importlib
import sys
import warnings
from types import ModuleType
from typing import Any

_GYMNASIUM = "torchrl_safe.envs.interfaces.gymnasium"

MODULES = {
    "goal": "torchrl_safe.envs.robot_env",
    "velocity": "torchrl_safe.envs.velocity_env",
    "gymnasium": _GYMNASIUM,
    "velocity_gymnasium": _GYMNASIUM,
    "registration": "torchrl_safe.envs.interfaces.registration",
    "suite": "torchrl_safe.envs.interfaces.suite",
}
"""Modules of ``torchrl_safe.envs`` that moved, and where they are."""

NAMES = {"GymGoalEnv": "GymRobotEnv", "GymGoalVectorEnv": "GymRobotVectorEnv"}
"""Classes that have another name."""


class _Moved(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # what Python and its tools look for
            raise AttributeError(name)
        home = MODULES[self.__name__.rpartition(".")[2]]
        value = getattr(importlib.import_module(home), NAMES.get(name, name))
        warn_moved(f"{self.__name__}.{name}", f"{home}.{NAMES.get(name, name)}")
        return value


def warn_moved(old: str, new: str) -> None:
    """Says once a place that a name is another one now."""
    warnings.warn(f"{old} is deprecated: use {new}.", DeprecationWarning, stacklevel=3)


def keep_old_paths(package: str) -> None:
    """Lets ``from torchrl_safe.envs.goal import SafeGoalEnv`` and the like work."""
    for name in MODULES:
        sys.modules.setdefault(f"{package}.{name}", _Moved(f"{package}.{name}"))
