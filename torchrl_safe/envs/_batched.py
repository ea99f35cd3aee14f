"""N environments in one process as a TorchRL environment: specs, resets, steps, state."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from tensordict import TensorDict, TensorDictBase, is_tensor_collection
from torchrl.data import Binary, Bounded, Composite, TensorSpec, Unbounded
from torchrl.envs import EnvBase

from torchrl_safe._costs import cost_key
from torchrl_safe.envs._core import Core

_OF_A_STEP = ("next", "_reset")  # entries that the next step does not start from


class BatchedEnv(EnvBase):
    """What the environments of ours share: they translate between a core and tensordicts.

    Args:
        core (Core): the N environments.
        device (torch.device, optional): device of the tensors; the simulation runs on the CPU.
    """

    def __init__(self, core: Core[Any], device: torch.device | str | None) -> None:
        num_envs = core.num_envs
        super().__init__(device=device, batch_size=torch.Size([num_envs]))
        self._core = core
        device = self.device

        def number(dtype: torch.dtype = torch.float32, **bounds: float) -> TensorSpec:
            shape = (num_envs, 1)
            if not bounds:
                return Unbounded(shape, device=device, dtype=dtype)
            return Bounded(**bounds, shape=shape, device=device, dtype=dtype)

        def flag() -> Binary:
            return Binary(1, shape=(num_envs, 1), dtype=torch.bool, device=device)

        def whole(**entries: TensorSpec) -> Composite:
            return Composite(**entries, shape=(num_envs,), device=device)

        several = core.cost_names
        costs = [cost_key(name) for name in several or ("",)]
        highest = np.broadcast_to(core.max_cost, len(costs)).tolist()
        self._costs = frozenset(costs)
        shown = {k: v for k, v in core.signals(core.frame).items() if k not in self._costs}
        self.observation_spec = whole(
            observation=Unbounded(
                (num_envs, core.observation_size), device=device, dtype=torch.float32
            ),
            **{
                name: flag()
                if value.dtype == bool
                else number(torch.int64, low=0, high=core.episode_length)
                for name, value in shown.items()
            },
            diverged=flag(),
        )
        low, high = (
            torch.tensor(bound, dtype=torch.float32, device=device).expand(num_envs, -1)
            for bound in core.action_range
        )
        self.action_spec = Bounded(low, high, device=device, dtype=torch.float32)
        self.full_reward_spec = whole(
            reward=number(),
            **{name: number(low=0.0, high=most) for name, most in zip(costs, highest, strict=True)},
        )
        self.full_done_spec = whole(done=flag(), terminated=flag(), truncated=flag())

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None:
            if mask.numel() != self.batch_size.numel():
                raise ValueError(
                    f"_reset must have shape {(*self.batch_size, 1)}, got {tuple(mask.shape)}."
                )
            mask = mask.reshape(-1).cpu().numpy()
        return self._to_tensordict(self._core.reset(mask), stepped=False)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        if "_step" in tensordict.keys():
            raise NotImplementedError(
                f"{type(self).__name__} steps all of its environments at once."
            )
        action = tensordict.get("action").detach().cpu().numpy()
        return self._to_tensordict(self._core.step(action), stepped=True)

    def step_and_maybe_reset(
        self, tensordict: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        """A step, and new episodes where it ended some: what a collector calls.

        The same as TorchRL's own, entry by entry, but a reset shows all environments as they are,
        so that nothing has to be merged.

        Args:
            tensordict (TensorDict): with the ``"action"``; gets what the step brought as
                ``"next"``.

        Returns:
            tuple of TensorDicts: the one that was given, and what the next step starts from.
        """
        if tensordict.device != self.device:
            tensordict = tensordict.to(self.device)
        keys = tensordict.keys()
        if "next" in keys or "_step" in keys or tensordict.batch_size != self.batch_size:
            return super().step_and_maybe_reset(tensordict)
        stepped = self._step(tensordict)
        tensordict.set("next", stepped)
        shown = dict(stepped.items())
        kept = {k: v for k, v in tensordict.items() if k not in shown and k not in _OF_A_STEP}
        done = stepped.get("done")
        if done.any():
            shown = dict(self._reset(self._tensordict({"_reset": done})).items())
            if not done.all():  # a new episode knows nothing of what a policy left
                none = self._tensordict({})
                kept = dict(self._tensordict(kept).where(~done[:, 0], none, pad=0).items())
        following = {k: v.copy() if is_tensor_collection(v) else v for k, v in kept.items()} | shown
        for name in self.reward_keys:
            following.pop(name, None)
        return tensordict, self._tensordict(following)

    def _tensordict(self, entries: dict[str, Any]) -> TensorDict:
        # As TorchRL's own environments do: checking the entries takes longer than computing some.
        return TensorDict._new_unsafe(entries, batch_size=self.batch_size, device=self.device)

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        # What would be completed and reshaped here leaves _step complete and in shape.
        return next_tensordict_out

    def _to_tensordict(self, frame: Any, *, stepped: bool) -> TensorDictBase:
        # Copies: whoever gets these tensors may write to them.
        source = {"observation": torch.from_numpy(frame.observation.astype(np.float32))}
        for name, value in self._core.signals(frame).items():
            if name not in self._costs:
                source[name] = _column(value)
            elif stepped:
                source[name] = _column(value, np.float32)
        if stepped:
            source["reward"] = _column(frame.reward, np.float32)
        source["diverged"] = _column(frame.diverged)
        source["done"] = _column(frame.terminated | frame.truncated)
        source["terminated"] = _column(frame.terminated)
        source["truncated"] = _column(frame.truncated)
        device = self.device
        if device is not None and device.type != "cpu":
            source = {key: value.to(device) for key, value in source.items()}
        return self._tensordict(source)

    def _set_seed(self, seed: int | None) -> None:
        self._core.seed(seed)

    @property
    def episode_length(self) -> int:
        """Steps after which an episode is truncated."""
        return self._core.episode_length

    @property
    def instabilities(self) -> int:
        """How many simulations diverged so far."""
        return self._core.instabilities

    def state_dict(self, *args: Any, **kwargs: Any) -> OrderedDict[str, Any]:
        """Everything the future of the environments depends on, as tensors on the CPU.

        Physics, layouts, episode clocks, random streams and the current frame: a run that loads
        them goes on exactly as it would have. A transformed environment's own ``state_dict`` holds
        its transforms only: save that of its ``base_env`` too.

        Examples:
            >>> from torchrl_safe.envs import SafeRobotEnv
            >>> env = SafeRobotEnv(num_envs=2, num_threads=1)
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
        """Ends the simulator's threads; a closed environment says so."""
        self._core.close()
        super().close(raise_if_closed=raise_if_closed)


def _column(value: NDArray[Any], dtype: DTypeLike | None = None) -> torch.Tensor:
    """A copy of [N] as a tensor [N, 1]."""
    return torch.from_numpy(value[:, None].astype(dtype or value.dtype))
