"""Environments with a cost: the batched goal environment, its robots and its task."""

from torchrl_safe.envs.goal import SafeGoalEnv
from torchrl_safe.envs.robots import ROBOTS, Robot, get_robot
from torchrl_safe.envs.tasks import GoalTask

__all__ = ["ROBOTS", "GoalTask", "Robot", "SafeGoalEnv", "get_robot"]
