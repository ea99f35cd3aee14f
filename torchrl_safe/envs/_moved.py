"""Modules of version 0.1 under their old paths, which warn and hand on what is asked of them."""

from __future__ import annotations

import sys
from types import ModuleType

from torchrl_safe._deprecation import moved

_ENVS, _INTERFACES = "torchrl_safe.envs", "torchrl_safe.envs.interfaces"

_NAMES = {
    "goal": {"SafeGoalEnv": f"{_ENVS}.SafeGoalEnv"},
    "velocity": {"SafeVelocityEnv": f"{_ENVS}.SafeVelocityEnv"},
    "gymnasium": {
        "GymGoalEnv": f"{_ENVS}.GymRobotEnv",
        "GymGoalVectorEnv": f"{_ENVS}.GymRobotVectorEnv",
    },
    "velocity_gymnasium": {
        name: f"{_ENVS}.{name}" for name in ("GymVelocityEnv", "GymVelocityVectorEnv")
    },
    "registration": {"register_envs": f"{_INTERFACES}.registration.register_envs"},
    "suite": {name: f"{_INTERFACES}.suite.{name}" for name in ("Physics", "SafeTask", "load")},
}


def keep_old_paths() -> None:
    """Lets ``from torchrl_safe.envs.goal import SafeGoalEnv`` and the like work."""
    for name, names in _NAMES.items():
        old = ModuleType(f"{_ENVS}.{name}", "Moved: see the warnings.")
        old.__getattr__ = moved(old.__name__, names)  # type: ignore[method-assign]
        sys.modules.setdefault(old.__name__, old)
