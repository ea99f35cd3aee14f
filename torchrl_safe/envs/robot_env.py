"""The batched TorchRL environment of robots that drive."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_safe.envs._batched import BatchedEnv
from torchrl_safe.envs._robot import RobotCore, make_core
from torchrl_safe.envs.randomization import Randomization
from torchrl_safe.envs.reflection import Reflection
from torchrl_safe.envs.robots import Robot
from torchrl_safe.envs.tasks import Task

__all__ = ["SafeGoalEnv", "SafeRobotEnv"]


class SafeRobotEnv(BatchedEnv):
    """Robots and their tasks, N at a time in one process. ``SafeGoalEnv`` is the same class.

    Reward and cost are those of SafeTAC. In the goal task, equation (19): progress towards the goal
    plus one for reaching it, and ``sigmoid(10 (0.2 - distance to the nearest hazard))``, both after
    the step; episodes end by truncation only. In the navigation task, Jackal's, boxes and walls are
    seen by a lidar and cost by it, and a contact terminates. A reached goal moves within the step.
    Physics run in float64, tensors are float32.

    Entries under ``"next"`` after a step, N being ``num_envs``:

    * ``observation``, [N, 24] for Point with 16 lidar bins: goal direction in the robot frame (2),
      goal distance, acceleration (2), velocity (2), yaw rate, lidar; fixed scaling;
    * ``reward`` and ``cost``, [N, 1]; of a task with several costs, ``<name>_cost`` and
      ``<name>_violation`` for each name in ``task.cost_names``, in place of ``cost``;
    * ``violation``, [N, 1] bool, inside a hazard; ``violations``, [N, 1] int64, how many violating
      steps this one counts for: a contact stands for the rest of its episode; ``goal_met``, [N, 1]
      bool, goal reached in this step; ``diverged``, [N, 1] bool, the simulation failed in it;
    * ``done``, ``terminated``, ``truncated``, [N, 1] bool.

    Each environment draws from its own random stream, so its layouts depend on the seed and its
    index alone; a rollout is the same on any number of threads. A simulation that diverges repeats
    its last observation, ``diverged``, and is truncated, so that a collector resets it;
    ``env.instabilities`` counts such steps.

    Args:
        robot (str or Robot): the robot, or its name in ``torchrl_safe.envs.ROBOTS``. Default:
            ``"point"``.

    Keyword Args:
        num_envs (int): environments in the batch, N. Default: 64.
        num_threads (int): simulator threads. Default: 2.
        seed (int or None): seed of the layouts; ``None`` takes one from the operating system. Give
            each worker of a multi-process collector another one, or their first episodes are the
            same. Default: 0.
        episode_length (int): steps until truncation. Default: 1000.
        stagger (bool): start environment i of a reset without mask ``i * episode_length // N``
            steps into its episode, so that truncations, and with them new layouts, are spread over
            time. Default: ``False``.
        task (str or Task, optional): the task with its options, or its name in ``TASKS``. Default:
            the robot's.
        randomization (Randomization, optional): ranges that each robot's mass, friction, actuators
            and sensors are drawn from at every reset. Default: all are as their model.
        device (torch.device, optional): device of the tensors; the simulation runs on the CPU.

    Raises:
        ValueError: if robot or task is unknown, an option is out of range, or the objects do not
            fit.

    Examples:
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=4, num_threads=1)
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape, rollout["next", "cost"].shape
        (torch.Size([4, 3, 24]), torch.Size([4, 3, 1]))
    """

    _core: RobotCore

    def __init__(
        self,
        robot: str | Robot = "point",
        *,
        num_envs: int = 64,
        num_threads: int = 2,
        seed: int | None = 0,
        episode_length: int = 1000,
        stagger: bool = False,
        task: str | Task | None = None,
        randomization: Randomization | None = None,
        device: torch.device | str | None = None,
    ) -> None:
        core = make_core(
            robot,
            task,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=seed,
            episode_length=episode_length,
            stagger=stagger,
            randomization=randomization,
        )
        super().__init__(core, device)
        self._renderer: Any = None

    @property
    def reflection(self) -> Reflection | None:
        """The environment's mirror, or None if task or robot look another way in it."""
        find = getattr(self._core.task, "reflection", None)
        return None if find is None else find(self._core.robot)

    def layout(self, index: int = 0) -> dict[str, NDArray[np.float64]]:
        """Where things are in one environment, for plots of trajectories.

        Args:
            index (int): the environment.

        Returns:
            dict of arrays: ``robot`` [2], ``heading`` [2] (unit vector) and the task's objects:
            ``goal`` [2], ``goal_distance`` [], and ``hazards`` [H, 2] or ``boxes`` [B, 2]; metres.

        Examples:
            >>> env = SafeRobotEnv(num_envs=2, num_threads=1)
            >>> _ = env.reset()
            >>> env.layout(1)["hazards"].shape
            (8, 2)
        """
        return self._core.layout(self._checked(index))

    def render(self, index: int = 0, width: int = 480, height: int = 360) -> NDArray[np.uint8]:
        """A picture of one environment from above: robot, goal, hazards, lidar and cost.

        Without ``MUJOCO_GL`` and a display, it is drawn by EGL, which needs no screen.

        Args:
            index (int): the environment.
            width (int): pixels, W.
            height (int): pixels, H.

        Returns:
            array: [H, W, 3], uint8.

        Raises:
            ValueError: if the index or the size is out of range.
        """
        # GL libraries are loaded only by those who draw.
        from torchrl_safe.envs._render import SceneRenderer

        index = self._checked(index)
        if self._renderer is not None and self._renderer.size != (width, height):
            self._renderer.close()
            self._renderer = None
        if self._renderer is None:
            self._renderer = SceneRenderer(self._core, width, height)
        return self._renderer.draw(index)

    def _checked(self, index: int) -> int:
        if not 0 <= index < self.batch_size[0]:
            raise ValueError(f"index must be in [0, {self.batch_size[0]}), got {index}.")
        return index

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Frees the renderer and ends the simulator's threads; a closed environment says so."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        super().close(raise_if_closed=raise_if_closed)


SafeGoalEnv = SafeRobotEnv
"""The name of version 0.1, when the goal task was the only one."""
