"""Environments with a cost: robots, tasks, and their TorchRL, Gymnasium and dm_control faces.

Importing this package registers the environments with Gymnasium. The dm_control face is imported
by those who use it: ``from torchrl_safe.envs import suite``.
"""

from torchrl_safe.envs.adapters import CostToReward, cost_from_info
from torchrl_safe.envs.checks import check_safe_env
from torchrl_safe.envs.goal import SafeGoalEnv
from torchrl_safe.envs.gymnasium import GymGoalEnv, GymGoalVectorEnv, register_envs
from torchrl_safe.envs.randomization import (
    JACKAL_REAL,
    JACKAL_TRAINING,
    RANDOMIZATIONS,
    Randomization,
)
from torchrl_safe.envs.robots import ROBOTS, Robot, get_robot
from torchrl_safe.envs.tasks import GoalTask, NavigationTask

__all__ = [
    "JACKAL_REAL",
    "JACKAL_TRAINING",
    "RANDOMIZATIONS",
    "ROBOTS",
    "CostToReward",
    "GoalTask",
    "GymGoalEnv",
    "GymGoalVectorEnv",
    "NavigationTask",
    "Randomization",
    "Robot",
    "SafeGoalEnv",
    "check_safe_env",
    "cost_from_info",
    "get_robot",
]

register_envs()
