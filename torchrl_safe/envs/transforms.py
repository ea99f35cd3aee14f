"""Transforms for a cost beside the reward: one that computes it, one that does not lose it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, FrameSkipTransform, Transform
from torchrl.envs.utils import step_mdp

from torchrl_safe._costs import cost_key, costs_among, violation_key
from torchrl_safe.envs.adapters import reject_skipped_frames

__all__ = ["CostFunction", "SafeFrameSkip", "cost_keys"]


def cost_keys(env: EnvBase) -> tuple[str, ...]:
    """Where an environment writes its costs, in the order of its reward spec.

    Args:
        env (EnvBase): the environment, with or without transforms.

    Returns:
        tuple of str: ``("cost",)``; of several costs, ``"<name>_cost"`` each. Beside it, the
        observation ``"<name>_violation"`` says whether the step violated.

    Examples:
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> cost_keys(SafeRobotEnv("jackal", task="navigation_speed", num_envs=2, num_threads=1))
        ('collision_cost', 'speed_cost')
    """
    return costs_among(env.full_reward_spec.keys(True, True))


class CostFunction(Transform):
    """Gives any environment the cost that a function computes of each step.

    The function gets the step as a tensordict ``[*B]``, as a rollout holds it: what the policy saw
    and did at the root, what came of it under ``"next"``, so ``step["observation"]``,
    ``step["action"]``, ``step["next", "observation"]``, ``step["next", "reward"]``, and what an
    environment reads from ``info``. It returns

    * one cost, a tensor ``[*B]`` or ``[*B, 1]``, which becomes the leaf ``"cost"`` of the reward
      spec, with ``"violation"`` among the observations;
    * several by name, ``{"speed": ..., "torque": ...}``, each like one; or a tensor ``[*B, m]``
      whose columns ``names`` names. They become ``"speed_cost"`` with ``"speed_violation"``, and so
      on.

    Costs are float32 of shape ``[*B, 1]``, without a gradient; a bool counts as 0 or 1. How many
    there are is found when the transform is appended, by a call with a step of zeros. Nothing is
    called at a reset, which costs nothing and violates nothing.

    Args:
        function (callable): from the step to its cost or costs. It must not write to the step, and
            must depend on nothing else.

    Keyword Args:
        names (sequence of str, optional): of the columns of a result ``[*B, m]``.
        violation_above (float or dict): the cost above which a step violates the constraint; of
            several, for all of them or for each by name. Default: 0, right for a binary cost.

    Raises:
        TypeError: if ``function`` is not callable, or returns no numbers.
        ValueError: if the names of costs and bounds differ, a bound is no number, the environment
            has an entry of that name already, or frames are skipped, whose costs would be lost; and
            by a step whose cost has another shape or is not finite.
        RuntimeError: if the function fails on a step of zeros.

    Examples:
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_safe.envs import CostFunction
        >>> def speed(step):
        ...     return step["next", "observation"][..., 2].abs() > 4.0  # of Pendulum, in radians
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), CostFunction(speed))
        >>> env.rollout(5)["next", "cost"].shape
        torch.Size([5, 1])
        >>> def costs(step):
        ...     return {"speed": speed(step), "torque": step["action"].square().sum(-1)}
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), CostFunction(costs))
        >>> cost_keys(env)
        ('speed_cost', 'torque_cost')
    """

    def __init__(
        self,
        function: Callable[[TensorDictBase], Any],
        *,
        names: Sequence[str] | None = None,
        violation_above: float | Mapping[str, float] = 0.0,
    ) -> None:
        super().__init__(in_keys=[], out_keys=[])
        if not callable(function):
            raise TypeError(f"function must be callable, got {function!r}.")
        bounds = violation_above.values() if isinstance(violation_above, Mapping) else ()
        for bound in bounds or (violation_above,):
            if not isinstance(bound, (int, float)) or math.isnan(bound):
                raise ValueError(f"violation_above must be a number, got {bound!r}.")
        self.function = function
        self.names = None if names is None else tuple(names)
        self.violation_above = violation_above
        self._costs: tuple[str, ...] | None = None

    @property
    def _found(self) -> tuple[str, ...]:
        """The names of the costs, ``("",)`` of the only one."""
        if self._costs is None:
            parent = self.parent
            if parent is None:
                raise RuntimeError("CostFunction must be appended to a TransformedEnv.")
            step = parent.fake_tensordict()
            try:
                costs = self.function(step)
            except Exception as error:
                raise RuntimeError(
                    f"cost function {_called(self.function)} fails on a step of zeros with the "
                    f"entries {sorted(map(str, step.keys(True, True)))}, by which its costs are "
                    f"counted: {type(error).__name__}: {error}"
                ) from error
            self._costs = tuple(self._named(costs, step.batch_size))
            bounds = self.violation_above
            if isinstance(bounds, Mapping) and bounds.keys() != set(self._costs):
                known = "one number" if self._costs == ("",) else f"for {sorted(self._costs)}"
                raise ValueError(f"violation_above must be {known}, got {sorted(bounds)}.")
        return self._costs

    def _named(self, costs: Any, batch_size: torch.Size) -> dict[str, torch.Tensor]:
        """What the function returned, by name, [*B, 1] and float32 each; one has the name ""."""
        who = f"cost function {_called(self.function)}"
        if not isinstance(costs, Mapping):
            several = self.names
            if several is None:
                costs = {"": costs}
            elif not isinstance(costs, torch.Tensor) or costs.shape != (*batch_size, len(several)):
                raise ValueError(
                    f"{who} must return a tensor {(*batch_size, len(several))}, a column for each "
                    f"of {list(several)}, got {_shown(costs)}."
                )
            else:
                costs = {name: costs[..., k] for k, name in enumerate(several)}
        elif not costs or not all(isinstance(name, str) and name for name in costs):
            raise ValueError(f"{who} must name at least one cost, by strings, got {list(costs)}.")
        out = {}
        for name, cost in costs.items():
            which = f"{who}, cost {name!r}," if name else who
            if not isinstance(cost, torch.Tensor) or cost.is_complex():
                raise TypeError(f"{which} must return a tensor of numbers, got {_shown(cost)}.")
            if cost.shape not in (batch_size, (*batch_size, 1)):
                raise ValueError(
                    f"{which} must return one number per environment, of shape "
                    f"{tuple(batch_size)} or {(*batch_size, 1)}, got {tuple(cost.shape)}; of "
                    "several costs a dict by name, or names=(...) for the columns."
                )
            out[name] = cost.detach().reshape(*batch_size, 1).to(torch.float32)
        return out

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        step = tensordict.copy().set("next", next_tensordict.copy())
        with torch.no_grad():
            costs = self._named(self.function(step), next_tensordict.batch_size)
        if tuple(costs) != self._found:
            raise ValueError(
                f"cost function {_called(self.function)} must return the same costs at every step, "
                f"{list(self._found)}, got {list(costs)}."
            )
        for name, cost in costs.items():
            if not cost.isfinite().all():
                rows = (~cost.isfinite()).nonzero()[:, :-1].tolist()
                where = f" at {rows}" if cost.ndim > 1 else ""
                raise ValueError(
                    f"cost function {_called(self.function)}: {cost_key(name)!r} must be finite, "
                    f"it is not{where}: {cost}."
                )
            next_tensordict.set(cost_key(name), cost)
            next_tensordict.set(violation_key(cost_key(name)), cost > self._bound(name))
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, 1)
        for name in self._found:
            no = torch.zeros(shape, dtype=torch.bool, device=tensordict_reset.device)
            tensordict_reset.set(violation_key(cost_key(name)), no)
        return tensordict_reset

    def _bound(self, name: str) -> float:
        bounds = self.violation_above
        return bounds[name] if isinstance(bounds, Mapping) else bounds

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Adds the costs to the reward spec, the violations to the observations."""
        if self.parent is not None:
            reject_skipped_frames(self.parent)
        output_spec = output_spec.clone()
        rewards, observations = (output_spec[f"full_{x}_spec"] for x in ("reward", "observation"))
        shape, device = (*output_spec.shape, 1), observations.device
        taken = {*observations.keys(True, True), *rewards.keys(True, True)}
        for name in self._found:
            clashes = sorted(map(str, taken & {cost_key(name), violation_key(cost_key(name))}))
            if clashes:
                raise ValueError(
                    f"the environment has entries {clashes} of its own: name the cost otherwise, "
                    "by returning a dict."
                )
            rewards[cost_key(name)] = Unbounded(shape, device=device, dtype=torch.float32)
            flag = Binary(1, shape=shape, dtype=torch.bool, device=device)
            observations[violation_key(cost_key(name))] = flag
        return output_spec


def _called(function: Callable[..., Any]) -> str:
    return repr(getattr(function, "__qualname__", function))


def _shown(value: Any) -> str:
    if isinstance(value, torch.Tensor):
        return f"{value.dtype} {tuple(value.shape)}"
    return f"{type(value).__name__} {value!r}"


class SafeFrameSkip(FrameSkipTransform):
    """Repeats each action for some frames, and loses no cost and no violation on the way.

    TorchRL's :class:`~torchrl.envs.FrameSkipTransform` takes one reward only, and steps on beyond
    the end of an episode. Here, a step of ``frame_skip`` frames returns

    * the sum of each leaf of the reward spec: the reward and every cost;
    * the last observation, but boolean entries (``violation``, ``goal_met``) are true if they were
      in any of the frames;
    * ``violations``, where the environment counts them, in steps of this length, rounded up.

    An episode that ends within a step contributes the frames up to there. The others of its batch
    go on, and it is stepped with them, unseen; what refuses to be stepped beyond an end
    (Gymnasium's vector environments) needs the frame skip in each of its environments.

    Args:
        frame_skip (int): frames per step. Default: 1.

    Raises:
        ValueError: if there is less than one.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_safe.envs import SafeFrameSkip, SafeGoalEnv
        >>> env = SafeGoalEnv(num_envs=2, num_threads=1, episode_length=100)
        >>> env = TransformedEnv(env, SafeFrameSkip(4))
        >>> env.rollout(1_000)["next", "cost"].shape
        torch.Size([2, 25, 1])
    """

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        parent = self.parent
        if parent is None:
            raise RuntimeError("SafeFrameSkip must be appended to a TransformedEnv.")
        observations = parent.full_observation_spec
        keys = list(observations.keys(True, True))
        flags = [key for key in keys if observations[key].dtype == torch.bool]
        counts = [key for key in keys if str(key).endswith("violations")]
        total = next_tensordict.select(*parent.reward_keys, *counts)
        seen = next_tensordict.select(*flags)
        for _ in range(self.frame_skip - 1):
            over = next_tensordict.get("done").reshape(next_tensordict.batch_size)
            if over.all():
                break
            tensordict = step_mdp(
                tensordict.copy().set("next", next_tensordict),
                exclude_action=False,
                reward_keys=parent.reward_keys,
                done_keys=parent.done_keys,
                action_keys=parent.action_keys,
            )
            # Not parent.step: the action has been through the inverse transforms already.
            frame = parent.base_env._step_proc_data(parent.base_env._step(tensordict))
            frame = parent.transform._step(tensordict, frame)
            more = frame.select(*total.keys(True, True))
            if over.any():
                frame, more = torch.where(over, next_tensordict, frame), more.where(~over, 0)
            total = total + more
            seen = seen | frame.select(*flags)
            next_tensordict = frame
        for key in counts:
            total[key] = -(-total[key] // self.frame_skip)
        return next_tensordict.update(total).update(seen)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Widens the bounds of what is added up."""
        output_spec = output_spec.clone()
        rewards = output_spec["full_reward_spec"]
        for key, spec in list(rewards.items(True, True)):
            if isinstance(spec, Bounded):
                low, high = spec.space.low, spec.space.high
                rewards[key] = Bounded(
                    torch.minimum(low, low * self.frame_skip),
                    torch.maximum(high, high * self.frame_skip),
                    spec.shape,
                    device=spec.device,
                    dtype=spec.dtype,
                )
        return output_spec
