"""Safety-Gymnasium's tasks by their names, and what follows from a task for other options."""

from __future__ import annotations

from typing import Any

from torchrl_safe.envs.tasks import (
    SAFETY_TASKS,
    TASKS,
    SafetyButtonTask,
    SafetyGoalTask,
    SafetyPushTask,
)
from torchrl_safe.envs.tasks.velocity import VELOCITY_TASKS, VelocityTask

RUNNERS: dict[str, VelocityTask] = {
    f"Safety{task.title}Velocity": task for task in VELOCITY_TASKS.values()
}
"""The velocity tasks by the names that Safety-Gymnasium has for them."""

NAMES = (*TASKS, *SAFETY_TASKS, *RUNNERS)

COST_LIMIT = 25.0  # the mean cost of an episode that the field allows, in every task
RUNNERS_EPISODE = 1000  # steps

# A reached goal moves and the episode goes on: it may be trained on in pieces, of more layouts.
ENDLESS = (SafetyGoalTask, SafetyButtonTask, SafetyPushTask)


def follows(task: str | None) -> dict[str, Any]:
    """What other options are by default where ``env.task`` is one of Safety-Gymnasium's.

    Its problem is the field's: the mean cost of an episode of the task's own length is at most 25.
    A mean is a CVaR at risk level 1. Where goals move on, training keeps the shorter episodes of
    ``env.episode_length``: with them the goal task was learned sooner
    (docs/experiments.md, "Environments and episodes").

    Args:
        task (str, optional): the task's name.

    Returns:
        dict: values by the dotted names of options; empty for tasks of other names.

    Examples:
        >>> follows("SafetyCarCircle1")["env.robot"], follows("SafetyCarCircle1")["eval.num_steps"]
        ('car', 500)
        >>> follows("SafetyHopperVelocity")["env.robot"] is None  # the task has its own
        True
        >>> follows("goal")
        {}
    """
    training: dict[str, Any] = {}
    if task in SAFETY_TASKS:
        robot, navigation = SAFETY_TASKS[task]
        steps = navigation.episode_length
        if not isinstance(navigation, ENDLESS):
            training = {"env.episode_length": steps}
    elif task in RUNNERS:
        robot, steps = None, RUNNERS_EPISODE
        training = {"env.episode_length": steps}
    else:
        return {}
    return {
        "env.robot": robot,
        **training,
        "loss.cost_limit": COST_LIMIT,
        "loss.limit_unit": "episode",
        "loss.risk_level": 1.0,
        "eval.num_steps": steps,
        "video.num_steps": steps,
    }
