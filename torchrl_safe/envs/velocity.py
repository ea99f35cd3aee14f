"""The batched TorchRL environment of the velocity tasks."""

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

from torchrl_safe.envs._velocity import VelocityCore, VelocityFrame
from torchrl_safe.envs.tasks.velocity import VelocityTask

__all__ = ["SafeVelocityEnv"]


class SafeVelocityEnv(EnvBase):
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
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self._core = core
        device = self.device

        def number() -> Unbounded:
            return Unbounded((num_envs, 1), device=device, dtype=torch.float32)

        def flag() -> Binary:
            return Binary(1, shape=(num_envs, 1), dtype=torch.bool, device=device)

        self.observation_spec = Composite(
            observation=Unbounded(
                (num_envs, core.observation_size), device=device, dtype=torch.float32
            ),
            violation=flag(),
            diverged=flag(),
            shape=(num_envs,),
            device=device,
        )
        low, high = (
            torch.tensor(bound, dtype=torch.float32, device=device).expand(num_envs, -1)
            for bound in core.action_range
        )
        self.action_spec = Bounded(low, high, device=device, dtype=torch.float32)
        self.full_reward_spec = Composite(
            reward=number(),
            cost=Bounded(0.0, 1.0, (num_envs, 1), device=device, dtype=torch.float32),
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
        return self._to_tensordict(self._core.reset(mask), {})

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "_step" in tensordict.keys():
            raise NotImplementedError("SafeVelocityEnv steps all of its environments at once.")
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

    def _to_tensordict(
        self, frame: VelocityFrame, rewards: dict[str, torch.Tensor]
    ) -> TensorDictBase:
        source = {
            "observation": torch.from_numpy(frame.observation.astype(np.float32)),
            "violation": _column(frame.violation),
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

    def state_dict(self, *args: Any, **kwargs: Any) -> OrderedDict[str, Any]:
        """Everything the future of the environments depends on, as tensors on the CPU.

        Physics, episode clocks, random streams and the current frame: a run that loads them goes
        on exactly as it would have. A transformed environment's own ``state_dict`` holds its
        transforms only: save that of its ``base_env`` too.

        Examples:
            >>> env = SafeVelocityEnv("swimmer", num_envs=2, num_threads=1)
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
            ValueError: if it is the state of another number of environments or another task;
                nothing has changed then.
        """
        if state_dict:
            self._core.restore({name: value.cpu().numpy() for name, value in state_dict.items()})

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Ends the simulator's threads; a closed environment says so."""
        self._core.close()
        super().close(raise_if_closed=raise_if_closed)


def _column(value: NDArray[Any], dtype: DTypeLike | None = None) -> torch.Tensor:
    """A copy of [N] as a tensor [N, 1]."""
    return torch.from_numpy(value[:, None].astype(dtype or value.dtype))
