"""Environments with a cost: the batched environment, its robots and their tasks."""

from torchrl_safe.envs.goal import SafeGoalEnv
from torchrl_safe.envs.randomization import JACKAL_REAL, JACKAL_TRAINING, Randomization
from torchrl_safe.envs.robots import ROBOTS, Robot, get_robot
from torchrl_safe.envs.tasks import GoalTask, NavigationTask

__all__ = [
    "JACKAL_REAL",
    "JACKAL_TRAINING",
    "ROBOTS",
    "GoalTask",
    "NavigationTask",
    "Randomization",
    "Robot",
    "SafeGoalEnv",
    "get_robot",
]
