"""The batched TorchRL environment of the goal task."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_safe.envs._core import Frame, make_core
from torchrl_safe.envs.randomization import Randomization
from torchrl_safe.envs.robots import Robot
from torchrl_safe.envs.tasks import Task

__all__ = ["SafeGoalEnv"]


class SafeGoalEnv(EnvBase):
    """Robots driving to goals among hazards, N at a time in one process.

    Reward and cost are those of SafeTAC. In the goal task, equation (19): progress towards the goal
    plus one for reaching it, and ``sigmoid(10 (0.2 - distance to the nearest hazard))``, both after
    the step; episodes end by truncation only. In the navigation task, Jackal's, boxes and walls are
    seen by a lidar and cost by it, and a contact terminates. A reached goal moves within the step.
    Physics run in float64, tensors are float32.

    Entries under ``"next"`` after a step, N being ``num_envs``:

    * ``observation``, [N, 24] for Point with 16 lidar bins: goal direction in the robot frame (2),
      goal distance, acceleration (2), velocity (2), yaw rate, lidar; fixed scaling;
    * ``reward`` and ``cost``, [N, 1];
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
        task (Task, optional): the task with its options. Default: the robot's.
        randomization (Randomization, optional): ranges that each robot's mass, friction, actuators
            and sensors are drawn from at every reset. Default: all are as their model.
        device (torch.device, optional): device of the tensors; the simulation runs on the CPU.

    Raises:
        ValueError: if the robot is unknown, an option is out of range, or the objects do not fit.

    Examples:
        >>> from torchrl_safe.envs import SafeGoalEnv
        >>> env = SafeGoalEnv("point", num_envs=4, num_threads=1)
        >>> rollout = env.rollout(3)
        >>> rollout["observation"].shape, rollout["next", "cost"].shape
        (torch.Size([4, 3, 24]), torch.Size([4, 3, 1]))
    """

    def __init__(
        self,
        robot: str | Robot = "point",
        *,
        num_envs: int = 64,
        num_threads: int = 2,
        seed: int | None = 0,
        episode_length: int = 1000,
        stagger: bool = False,
        task: Task | None = None,
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
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self._core = core
        self._renderer: Any = None
        device = self.device

        def flag() -> Binary:
            return Binary(1, shape=(num_envs, 1), dtype=torch.bool, device=device)

        self.observation_spec = Composite(
            observation=Unbounded(
                (num_envs, core.observation_size), device=device, dtype=torch.float32
            ),
            violation=flag(),
            violations=Bounded(0, episode_length, (num_envs, 1), device=device, dtype=torch.int64),
            goal_met=flag(),
            diverged=flag(),
            shape=(num_envs,),
            device=device,
        )
        self.action_spec = Bounded(
            -1.0, 1.0, (num_envs, core.action_dim), device=device, dtype=torch.float32
        )
        self.full_reward_spec = Composite(
            reward=Unbounded((num_envs, 1), device=device, dtype=torch.float32),
            cost=Bounded(
                0.0, core.task.max_cost, (num_envs, 1), device=device, dtype=torch.float32
            ),
            shape=(num_envs,),
            device=device,
        )
        self.full_done_spec = Composite(
            done=flag(), terminated=flag(), truncated=flag(), shape=(num_envs,), device=device
        )

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None:
            if mask.numel() != self.batch_size.numel():
                raise ValueError(
                    f"_reset must have shape {(*self.batch_size, 1)}, got {tuple(mask.shape)}."
                )
            mask = mask.reshape(-1).cpu().numpy()
        frame = self._core.reset(mask)
        return self._to_tensordict(frame, {})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "_step" in tensordict.keys():
            raise NotImplementedError("SafeGoalEnv steps all of its environments at once.")
        action = tensordict.get("action").detach().cpu().numpy()
        frame = self._core.step(action)
        rewards = {
            "reward": _column(frame.reward, np.float32),
            "cost": _column(frame.cost, np.float32),
        }
        return self._to_tensordict(frame, rewards)

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # What would be completed and reshaped here leaves _step complete and in shape.
        return next_tensordict_out

    def _to_tensordict(self, frame: Frame, rewards: dict[str, torch.Tensor]) -> TensorDictBase:
        source = {
            # Copies: whoever gets these tensors may write to them.
            "observation": torch.from_numpy(frame.observation.copy()),
            "violation": _column(frame.violation),
            "violations": _column(frame.violations),
            "goal_met": _column(frame.goal_met),
            "diverged": _column(frame.diverged),
            "done": _column(frame.terminated | frame.truncated),
            "terminated": _column(frame.terminated),
            "truncated": _column(frame.truncated),
            **rewards,
        }
        device = self.device
        if device is not None and device.type != "cpu":
            source = {key: value.to(device) for key, value in source.items()}
        # As TorchRL's own environments do: checking the entries takes longer than computing some.
        return TensorDict._new_unsafe(source, batch_size=self.batch_size, device=device)

    def _set_seed(self, seed: int | None) -> None:
        self._core.seed(seed)

    @property
    def instabilities(self) -> int:
        """How many simulations diverged so far."""
        return self._core.instabilities

    def layout(self, index: int = 0) -> dict[str, NDArray[np.float64]]:
        """Where things are in one environment, for plots of trajectories.

        Args:
            index (int): the environment.

        Returns:
            dict of arrays: ``robot`` [2], ``heading`` [2] (unit vector) and the task's objects:
            ``goal`` [2], ``goal_distance`` [], and ``hazards`` [H, 2] or ``boxes`` [B, 2]; metres.

        Examples:
            >>> env = SafeGoalEnv(num_envs=2, num_threads=1)
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

    def state_dict(self, *args: Any, **kwargs: Any) -> OrderedDict[str, Any]:
        """Everything the future of the environments depends on, as tensors on the CPU.

        Physics, layouts, episode clocks, random streams and the current frame: a run that loads
        them goes on exactly as it would have. A transformed environment's own ``state_dict`` holds
        its transforms only: save that of its ``base_env`` too.

        Examples:
            >>> env = SafeGoalEnv(num_envs=2, num_threads=1)
            >>> _ = env.reset()
            >>> state = env.state_dict()
            >>> action = env.full_action_spec.rand()
            >>> first = env.step(action.clone())["next", "observation"]
            >>> env.load_state_dict(state)
            >>> bool((env.step(action.clone())["next", "observation"] == first).all())
            True
        """
        return OrderedDict(
            (name, torch.from_numpy(value)) for name, value in self._core.snapshot().items()
        )

    def load_state_dict(self, state_dict: Mapping[str, Any], **kwargs: Any) -> None:
        """Puts back what :meth:`state_dict` returned.

        Args:
            state_dict (mapping): the state. An empty one changes nothing: a collector saves no
                state for an environment that has no transforms, and hands back none.
            kwargs: those of :meth:`torch.nn.Module.load_state_dict`; they change nothing here.

        Raises:
            ValueError: if it is the state of another number of environments, robot or task;
                nothing has changed then.
        """
        if state_dict:
            self._core.restore({name: value.cpu().numpy() for name, value in state_dict.items()})

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Frees the renderer and ends the simulator's threads; a closed environment says so."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self._core.close()
        super().close(raise_if_closed=raise_if_closed)


def _column(value: NDArray[Any], dtype: DTypeLike | None = None) -> torch.Tensor:
    """A copy of [N] as a tensor [N, 1]."""
    return torch.from_numpy(value[:, None].astype(dtype or value.dtype))
