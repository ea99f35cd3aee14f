"""The tasks, one per file: pure functions over a batch, without a simulator."""

from torchrl_safe.envs.tasks.base import Objects, Outcome, Prop, Sensed, Task
from torchrl_safe.envs.tasks.goal import GoalTask
from torchrl_safe.envs.tasks.navigation import NavigationTask

__all__ = ["TASKS", "GoalTask", "NavigationTask", "Objects", "Outcome", "Prop", "Sensed", "Task"]

TASKS: dict[str, type[Task]] = {"goal": GoalTask, "navigation": NavigationTask}
