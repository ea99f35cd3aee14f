"""The tasks, one per file: pure functions over a batch, without a simulator."""

from torchrl_safe.envs.robots import SAFETY_ROBOTS, Robot
from torchrl_safe.envs.tasks.base import Objects, Outcome, Prop, Sensed, Task
from torchrl_safe.envs.tasks.goal import GoalTask
from torchrl_safe.envs.tasks.navigation import NavigationTask
from torchrl_safe.envs.tasks.navigation_speed import NavigationSpeedTask
from torchrl_safe.envs.tasks.safety import SafetyTask
from torchrl_safe.envs.tasks.safety_button import SafetyButtonTask
from torchrl_safe.envs.tasks.safety_circle import SafetyCircleTask
from torchrl_safe.envs.tasks.safety_goal import SafetyGoalTask
from torchrl_safe.envs.tasks.safety_push import SafetyPushTask
from torchrl_safe.envs.tasks.safety_run import SafetyRunTask

__all__ = [
    "SAFETY_TASKS",
    "TASKS",
    "GoalTask",
    "NavigationSpeedTask",
    "NavigationTask",
    "Objects",
    "Outcome",
    "Prop",
    "SafetyButtonTask",
    "SafetyCircleTask",
    "SafetyGoalTask",
    "SafetyPushTask",
    "SafetyRunTask",
    "SafetyTask",
    "Sensed",
    "Task",
    "get_task",
]

TASKS: dict[str, type[Task]] = {
    "goal": GoalTask,
    "navigation": NavigationTask,
    "navigation_speed": NavigationSpeedTask,
}

_FAMILIES: dict[str, type[SafetyTask]] = {
    "Goal": SafetyGoalTask,
    "Circle": SafetyCircleTask,
    "Run": SafetyRunTask,
    "Button": SafetyButtonTask,
    "Push": SafetyPushTask,
}
SAFETY_TASKS: dict[str, tuple[Robot, SafetyTask]] = {
    f"Safety{name}{family}{level}": (
        robot,
        task(level, box_half_size=0.125, box_density=0.0005)
        if task is SafetyPushTask and name == "Car"
        else task(level),
    )
    for name, robot in SAFETY_ROBOTS.items()
    for family, task in _FAMILIES.items()
    for level in task.levels
}
"""Robot and task by the names that Safety-Gymnasium has for them."""


def get_task(name: str) -> tuple[Robot, SafetyTask]:
    """Robot and task of one of Safety-Gymnasium's environments.

    Args:
        name (str): a key of ``SAFETY_TASKS``, such as ``"SafetyPointGoal1"``.

    Returns:
        tuple: the robot and the task; ``task.episode_length`` is how long its episodes are.

    Raises:
        ValueError: if there is no such task.

    Examples:
        >>> robot, task = get_task("SafetyPointGoal1")
        >>> robot.name, task.level, task.episode_length
        ('point', 1, 1000)
    """
    try:
        return SAFETY_TASKS[name]
    except KeyError:
        known = ", ".join(SAFETY_TASKS)
        raise ValueError(f"task must be one of {known}, got {name!r}.") from None
