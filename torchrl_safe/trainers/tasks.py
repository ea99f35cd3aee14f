"""Safety-Gymnasium's tasks by their names, and what follows from a task for other options."""

from __future__ import annotations

from typing import Any

from torchrl_safe.envs.tasks import SAFETY_TASKS, TASKS, get_task
from torchrl_safe.envs.tasks.velocity import VELOCITY_TASKS, VelocityTask

RUNNERS: dict[str, VelocityTask] = {
    f"Safety{task.title}Velocity": task for task in VELOCITY_TASKS.values()
}
"""The velocity tasks by the names that Safety-Gymnasium has for them."""

NAMES = (*TASKS, *SAFETY_TASKS, *RUNNERS)

COST_LIMIT = 25.0  # the mean cost of an episode that the field allows, in every task
RUNNERS_EPISODE = 1000  # steps
STANDARDIZE_FRAMES = 20_000


def follows(task: str | None) -> dict[str, Any]:
    """What other options are by default where ``env.task`` is one of Safety-Gymnasium's.

    Its problem is the field's: the mean cost of an episode of the task's own length is at most 25.
    A mean is a CVaR at risk level 1. Training episodes are the task's, too: an episode begins in
    the clear, so that pieces of it cost less than the whole, and a limit that holds in them does
    not hold in the task. An accelerometer reads up to 18 there, a lidar 0 to 1: networks
    standardise what they read (docs/experiments.md, 2026-11-28).

    Args:
        task (str, optional): the task's name.

    Returns:
        dict: values by the dotted names of options; empty for tasks of other names.

    Examples:
        >>> follows("SafetyCarCircle1")["loss.cost_limit"]
        25.0
        >>> follows("SafetyCarCircle1")["eval.num_steps"]
        500
        >>> follows("goal")
        {}
    """
    if task in SAFETY_TASKS:
        _, navigation = get_task(task)
        steps = navigation.episode_length
    elif task in RUNNERS:
        steps = RUNNERS_EPISODE
    else:
        return {}
    return {
        "env.robot": None,  # the task has its own
        "env.episode_length": steps,
        "env.standardize_frames": STANDARDIZE_FRAMES,
        "loss.cost_limit": COST_LIMIT,
        "loss.limit_unit": "episode",
        "loss.risk_level": 1.0,
        "eval.num_steps": steps,
        "video.num_steps": steps,
    }


def robot_of(task: str | None) -> str | None:
    """The name of the robot that one of Safety-Gymnasium's navigation tasks brings along.

    Examples:
        >>> robot_of("SafetyCarCircle1")
        'car'
    """
    return get_task(task)[0].name if task in SAFETY_TASKS else None
