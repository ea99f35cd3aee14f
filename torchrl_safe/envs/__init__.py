"""Environments with a cost: robots, tasks, and their TorchRL, Gymnasium and dm_control faces.

Importing this package registers the environments with Gymnasium. MuJoCo is imported by the first
environment of ours that is asked for: adapters, transforms and checks, which serve any environment,
do without. The dm_control face is imported by those who use it: ``from torchrl_safe.envs import
suite``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from torchrl_safe.envs.adapters import CostToReward, cost_from_info
from torchrl_safe.envs.checks import check_safe_env
from torchrl_safe.envs.randomization import (
    JACKAL_REAL,
    JACKAL_TRAINING,
    RANDOMIZATIONS,
    Randomization,
)
from torchrl_safe.envs.registration import register_envs
from torchrl_safe.envs.robots import ROBOTS, Robot, get_robot
from torchrl_safe.envs.tasks import GoalTask, NavigationTask
from torchrl_safe.envs.tasks.velocity import VELOCITY_TASKS, VelocityTask, get_velocity_task
from torchrl_safe.envs.transforms import SafeFrameSkip

if TYPE_CHECKING:
    from torchrl_safe.envs.goal import SafeGoalEnv
    from torchrl_safe.envs.gymnasium import GymGoalEnv, GymGoalVectorEnv
    from torchrl_safe.envs.velocity import SafeVelocityEnv
    from torchrl_safe.envs.velocity_gymnasium import GymVelocityEnv, GymVelocityVectorEnv

__all__ = [
    "JACKAL_REAL",
    "JACKAL_TRAINING",
    "RANDOMIZATIONS",
    "ROBOTS",
    "VELOCITY_TASKS",
    "CostToReward",
    "GoalTask",
    "GymGoalEnv",
    "GymGoalVectorEnv",
    "GymVelocityEnv",
    "GymVelocityVectorEnv",
    "NavigationTask",
    "Randomization",
    "Robot",
    "SafeFrameSkip",
    "SafeGoalEnv",
    "SafeVelocityEnv",
    "VelocityTask",
    "check_safe_env",
    "cost_from_info",
    "get_robot",
    "get_velocity_task",
]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from torchrl_safe.envs import goal, gymnasium, velocity, velocity_gymnasium

    modules = (goal, gymnasium, velocity, velocity_gymnasium)
    return getattr(next(module for module in modules if name in module.__all__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


register_envs()
