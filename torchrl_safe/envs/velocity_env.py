"""The batched TorchRL environment of the velocity tasks."""

from __future__ import annotations

import torch

from torchrl_safe.envs._batched import BatchedEnv
from torchrl_safe.envs._velocity import VelocityCore
from torchrl_safe.envs.tasks.velocity import VelocityTask

__all__ = ["SafeVelocityEnv"]


class SafeVelocityEnv(BatchedEnv):
    """Gymnasium's robots running below a speed limit, N at a time in one process.

    The velocity tasks of Safety-Gymnasium (arXiv:2310.12567): observation, reward, health and
    initial states are those of Gymnasium's environment of that robot, version 4, step by step; the
    cost is 1 in a step whose speed is above the limit, else 0. The speed is that along x, and for
    Ant and Humanoid that in the plane. Physics run in float64, tensors are float32.

    ========================  =======  ===============  ====  =======
    task                      limit    Gymnasium's      D     A
    ========================  =======  ===============  ====  =======
    ``"half_cheetah"``        3.2096   HalfCheetah-v4   17    6
    ``"hopper"``              0.7402   Hopper-v4        11    3
    ``"walker2d"``            2.3415   Walker2d-v4      17    6
    ``"ant"``                 2.6222   Ant-v4           27    8
    ``"humanoid"``            1.4149   Humanoid-v4      376   17
    ``"swimmer"``             0.2282   Swimmer-v4       8     2
    ========================  =======  ===============  ====  =======

    Entries under ``"next"`` after a step, N being ``num_envs``:

    * ``observation``, [N, D]; ``reward`` and ``cost``, [N, 1];
    * ``violation``, [N, 1] bool, faster than the limit; ``diverged``, [N, 1] bool, the simulation
      failed in this step;
    * ``done``, ``terminated`` (no longer healthy), ``truncated`` (time limit), [N, 1] bool.

    Each environment draws from its own random stream, so its initial states depend on the seed and
    its index alone; a rollout is the same on any number of threads. A simulation that diverges
    repeats its last observation, ``diverged``, and is truncated, so that a collector resets it;
    ``env.instabilities`` counts such steps.

    Args:
        task (str or VelocityTask): the task, or its name. Default: ``"half_cheetah"``.

    Keyword Args:
        num_envs (int): environments in the batch, N. Default: 64.
        num_threads (int): simulator threads. Default: 2.
        seed (int or None): seed of the initial states; ``None`` takes one from the operating
            system. Give each worker of a multi-process collector another one. Default: 0.
        episode_length (int): steps until truncation. Default: 1000.
        stagger (bool): start environment i of a reset without mask ``i * episode_length // N``
            steps into its episode, so that truncations are spread over time. Default: ``False``.
        device (torch.device, optional): device of the tensors; the simulation runs on the CPU.

    Raises:
        TypeError: if the task is something else.
        ValueError: if the task is unknown or an option is out of range.

    Examples:
        >>> from torchrl_safe.envs import SafeVelocityEnv
        >>> env = SafeVelocityEnv("hopper", num_envs=4, num_threads=1)
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape, rollout["next", "cost"].shape
        (torch.Size([4, 3, 11]), torch.Size([4, 3, 1]))
    """

    def __init__(
        self,
        task: str | VelocityTask = "half_cheetah",
        *,
        num_envs: int = 64,
        num_threads: int = 2,
        seed: int | None = 0,
        episode_length: int = 1000,
        stagger: bool = False,
        device: torch.device | str | None = None,
    ) -> None:
        core = VelocityCore(
            task,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=seed,
            episode_length=episode_length,
            stagger=stagger,
        )
        super().__init__(core, device)
