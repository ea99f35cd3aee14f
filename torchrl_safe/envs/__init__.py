"""Environments with a cost: robots and tasks, and what a cost needs in anybody's environment.

Importing this package registers the environments with Gymnasium. MuJoCo is imported by the first
environment of ours that is asked for: adapters, transforms and checks, which serve any environment,
do without. :mod:`torchrl_safe.envs.interfaces` has the same environments for users of Gymnasium and
dm_control.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchrl_safe._deprecation import moved
from torchrl_safe.envs._moved import keep_old_paths
from torchrl_safe.envs.adapters import CostToReward, cost_from_info
from torchrl_safe.envs.bridge import SafetyGymnasiumBridge
from torchrl_safe.envs.budgets import EarlyTermination, SafetyBudget, Saute
from torchrl_safe.envs.checks import check_safe_env
from torchrl_safe.envs.interfaces.registration import register_envs
from torchrl_safe.envs.randomization import (
    JACKAL_REAL,
    JACKAL_TRAINING,
    RANDOMIZATIONS,
    Randomization,
)
from torchrl_safe.envs.reflection import Reflection
from torchrl_safe.envs.robots import ROBOTS, Instruments, Robot, get_robot
from torchrl_safe.envs.tasks import GoalTask, NavigationSpeedTask, NavigationTask
from torchrl_safe.envs.tasks.velocity import VELOCITY_TASKS, VelocityTask, get_velocity_task
from torchrl_safe.envs.transforms import CostFunction, SafeFrameSkip, cost_keys

if TYPE_CHECKING:
    from torchrl_safe.envs.interfaces.gymnasium import (
        GymRobotEnv,
        GymRobotVectorEnv,
        GymVelocityEnv,
        GymVelocityVectorEnv,
    )
    from torchrl_safe.envs.robot_env import SafeGoalEnv, SafeRobotEnv
    from torchrl_safe.envs.velocity_env import SafeVelocityEnv

__all__ = [
    "JACKAL_REAL",
    "JACKAL_TRAINING",
    "RANDOMIZATIONS",
    "ROBOTS",
    "VELOCITY_TASKS",
    "CostFunction",
    "CostToReward",
    "EarlyTermination",
    "GoalTask",
    "GymRobotEnv",
    "GymRobotVectorEnv",
    "GymVelocityEnv",
    "GymVelocityVectorEnv",
    "Instruments",
    "NavigationSpeedTask",
    "NavigationTask",
    "Randomization",
    "Reflection",
    "Robot",
    "SafeFrameSkip",
    "SafeGoalEnv",
    "SafeRobotEnv",
    "SafeVelocityEnv",
    "SafetyBudget",
    "SafetyGymnasiumBridge",
    "Saute",
    "VelocityTask",
    "check_safe_env",
    "cost_from_info",
    "cost_keys",
    "get_robot",
    "get_velocity_task",
]


_renamed = moved(
    __name__,
    {
        "GymGoalEnv": f"{__name__}.GymRobotEnv",
        "GymGoalVectorEnv": f"{__name__}.GymRobotVectorEnv",
    },
)


def __getattr__(name: str) -> Any:
    if name not in __all__:
        return _renamed(name)
    from torchrl_safe.envs import robot_env, velocity_env
    from torchrl_safe.envs.interfaces import gymnasium

    modules = (robot_env, velocity_env, gymnasium)
    return getattr(next(module for module in modules if name in module.__all__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_envs()
keep_old_paths()
