"""The environments' ids in Gymnasium's registry, written without loading the simulator."""

from __future__ import annotations

import gymnasium

from torchrl_safe.envs.robots import ROBOTS
from torchrl_safe.envs.tasks import SAFETY_TASKS
from torchrl_safe.envs.tasks.velocity import VELOCITY_TASKS

__all__ = ["register_envs"]


def register_envs() -> None:
    """Registers an id for each robot and each velocity task with Gymnasium.

    ``torchrl_safe/<Robot>Goal-v0``, the robot's name in camel case:
    ``torchrl_safe/DoggoTorquesGoal-v0`` is ``"doggo_torques"``; and
    ``torchrl_safe/SafetyPointGoal1-v0``, ``torchrl_safe/SafetyAntVelocity-v1`` and the like, by
    Safety-Gymnasium's names. The registry has no ``max_episode_steps``, as Gymnasium would cut a
    longer ``episode_length`` short by it; the ``spec`` of an environment has.
    """
    for name in ROBOTS:
        gymnasium.register(
            f"torchrl_safe/{name.title().replace('_', '')}Goal-v0",
            entry_point="torchrl_safe.envs.interfaces.gymnasium:GymRobotEnv",
            vector_entry_point="torchrl_safe.envs.interfaces.gymnasium:GymRobotVectorEnv",
            kwargs={"robot": name},
        )
    for velocity in VELOCITY_TASKS.values():
        gymnasium.register(
            f"torchrl_safe/Safety{velocity.title}Velocity-v1",
            entry_point="torchrl_safe.envs.interfaces.gymnasium:GymVelocityEnv",
            vector_entry_point="torchrl_safe.envs.interfaces.gymnasium:GymVelocityVectorEnv",
            kwargs={"task": velocity.name},
        )
    for name, (robot, task) in SAFETY_TASKS.items():
        gymnasium.register(
            f"torchrl_safe/{name}-v0",
            entry_point="torchrl_safe.envs.interfaces.gymnasium:GymRobotEnv",
            vector_entry_point="torchrl_safe.envs.interfaces.gymnasium:GymRobotVectorEnv",
            kwargs={"robot": robot, "task": task, "episode_length": task.episode_length},
        )
