"""A limit on a cost as a budget of the episode, which any method can be trained with.

A limit on the sum of an episode's costs becomes part of the environment: what is left of the budget
is part of the state (:class:`SafetyBudget`), and who overdraws it earns nothing any more
(:class:`Saute`) or is stopped (:class:`EarlyTermination`). A method without a constraint does the
rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform
from torchrl.envs.transforms.utils import _get_reset

from torchrl_safe._checks import check_number

__all__ = ["EarlyTermination", "SafetyBudget", "Saute"]


class SafetyBudget(Transform):
    r"""Adds to the state what is left of a budget for the costs of the episode.

    With the budget :math:`d` and the discount :math:`\gamma` of the cost, what is left is

    .. math::

        w_0 = d, \qquad w_{t+1} = (w_t - c_t) / \gamma

    hence :math:`w_t \ge 0` as long as :math:`\sum_{k<t} \gamma^k c_k \le d`. The entry ``out_key``
    holds it, in units of the cost; to each of ``in_keys`` the share :math:`z_t = w_t / d` is
    appended, which is the safety state of Saute (Sootla et al. 2022,
    https://arxiv.org/abs/2202.06558). Below 1, :math:`\gamma` lets the share grow in
    time: after 1,000 steps without a cost it is 2.7 at 0.999, and 23,000 at 0.99.

    Each environment of a batch has a budget of its own, full at its reset. The state is in the
    tensordict, so that it goes where the step goes.

    Args:
        budget (float): d.

    Keyword Args:
        gamma (float): discount of the cost, in (0, 1]. Defaults to 1.0: the plain sum.
        cost (NestedKey): the cost, an entry of the reward spec. Defaults to ``"cost"``.
        in_keys (sequence of NestedKey): observations ``[*B, D]`` that the share is appended to.
            Defaults to ``("observation",)``.
        out_key (NestedKey): what is left, ``[*B, 1]``. Defaults to ``"budget"``.

    Raises:
        ValueError: if ``budget`` is not positive or ``gamma`` outside (0, 1]; when appended, if the
            environment lacks the cost or an observation, or has an entry ``out_key``.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_safe.envs import SafetyBudget, SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=2, num_threads=1)
        >>> env = TransformedEnv(env, SafetyBudget(25.0))
        >>> env.reset()["budget"].flatten()
        tensor([25., 25.])
        >>> env.rollout(3)["observation"].shape  # 24 numbers, and the share
        torch.Size([2, 3, 25])
    """

    def __init__(
        self,
        budget: float,
        *,
        gamma: float = 1.0,
        cost: NestedKey = "cost",
        in_keys: Sequence[NestedKey] = ("observation",),
        out_key: NestedKey = "budget",
    ) -> None:
        check_number("budget", budget, positive=True)
        check_number("gamma", gamma, positive=True, most=1)
        super().__init__(in_keys=list(in_keys), out_keys=[out_key])
        self.budget = budget
        self.gamma = gamma
        self.cost = cost

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        (key,) = self.out_keys
        left = (tensordict.get(key) - next_tensordict.get(self.cost)) / self.gamma
        self._append(next_tensordict, left)
        self._enforce(next_tensordict, left < 0)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        (key,) = self.out_keys
        shape = (*tensordict_reset.batch_size, 1)
        full = torch.full(shape, float(self.budget), device=tensordict_reset.device)
        before = tensordict.get(key, None)
        if before is not None:  # those that go on keep what they have
            full = torch.where(_get_reset("_reset", tensordict).reshape(shape), full, before)
        self._append(tensordict_reset, full)
        return tensordict_reset

    def _append(self, tensordict: TensorDictBase, left: Tensor) -> None:
        tensordict.set(self.out_keys[0], left)
        share = left / self.budget
        for key in self.in_keys:
            seen = tensordict.get(key)
            tensordict.set(key, torch.cat([seen, share.to(seen.dtype)], -1))

    def _enforce(self, step: TensorDictBase, overdrawn: Tensor) -> None:
        """What becomes of a step after which the budget is overdrawn, ``[*B, 1]``."""

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Adds the budget, and widens the observations."""
        (out_key,) = self.out_keys
        observation_spec = observation_spec.clone()
        if out_key in observation_spec.keys(True, True):
            raise ValueError(f"out_key must be a new entry, the environment has {out_key!r}.")
        rewards = self.parent.full_reward_spec.keys(True, True) if self.parent is not None else ()
        if self.parent is not None and self.cost not in rewards:
            raise ValueError(f"cost must be one of {sorted(map(str, rewards))}, got {self.cost!r}.")
        for key in self.in_keys:
            if key not in observation_spec.keys(True, True):
                raise ValueError(
                    f"in_keys must be observations, {sorted(map(str, observation_spec.keys()))}, "
                    f"got {key!r}."
                )
            spec = observation_spec[key]
            shape = (*spec.shape[:-1], spec.shape[-1] + 1)
            observation_spec[key] = Unbounded(shape, device=spec.device, dtype=spec.dtype)
        observation_spec[out_key] = self._spec(observation_spec)
        return observation_spec

    def transform_input_spec(self, input_spec: Composite) -> Composite:
        """Asks for the budget before the step, also of environments in other processes."""
        state = input_spec.get("full_state_spec", None)
        if state is None:
            state = Composite(shape=input_spec.shape, device=input_spec.device)
        state[self.out_keys[0]] = self._spec(state)
        input_spec["full_state_spec"] = state
        return input_spec

    @staticmethod
    def _spec(around: Composite) -> Unbounded:
        return Unbounded((*around.shape, 1), device=around.device, dtype=torch.float32)


class Saute(SafetyBudget):
    r"""Who has overdrawn the budget earns ``unsafe_reward`` in place of the reward.

    The sauteed MDP of Sootla et al. 2022 (https://arxiv.org/abs/2202.06558): the state is augmented
    as in :class:`SafetyBudget`, and

    .. math::

        \tilde r_t = \begin{cases} r_t & w_{t+1} \ge 0 \\ n & w_{t+1} < 0 \end{cases}

    A low enough :math:`n` makes the best policy keep to the budget in every episode, not in the
    mean. The cost itself is left as it is.

    Args:
        budget (float): see :class:`SafetyBudget`.

    Keyword Args:
        unsafe_reward (float): n. Defaults to -1.0.
        reward (NestedKey): the reward. Defaults to ``"reward"``.
        **options: of :class:`SafetyBudget`.

    Raises:
        ValueError: as :class:`SafetyBudget`, and if ``unsafe_reward`` is not finite.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_safe.envs import SafeRobotEnv, Saute
        >>> env = SafeRobotEnv("point", num_envs=2, num_threads=1)
        >>> env = TransformedEnv(env, Saute(1e-9, unsafe_reward=-0.2))
        >>> env.rollout(3)["next", "reward"].unique()  # any cost at all is too much
        tensor([-0.2000])
    """

    def __init__(
        self,
        budget: float,
        *,
        unsafe_reward: float = -1.0,
        reward: NestedKey = "reward",
        **options: Any,
    ) -> None:
        check_number("unsafe_reward", unsafe_reward)
        super().__init__(budget, **options)
        self.unsafe_reward = unsafe_reward
        self.reward = reward

    def _enforce(self, step: TensorDictBase, overdrawn: Tensor) -> None:
        step.set(self.reward, torch.where(overdrawn, self.unsafe_reward, step.get(self.reward)))


class EarlyTermination(SafetyBudget):
    r"""Who overdraws the budget is stopped: the episode terminates with ``termination_reward``.

    The early terminated MDP of Sun et al. 2021 (https://arxiv.org/abs/2107.04200). With
    :math:`b_t = \sum_{k \le t} c_k`, the step that makes :math:`b_t > d` leads to a terminal state
    with the reward :math:`r_e`, after which nothing is earned. If :math:`r_e` is low enough, what
    is best here is the best that keeps to the budget. ``"terminated"`` and ``"done"`` are set, so
    that no target bootstraps there.

    Args:
        budget (float): see :class:`SafetyBudget`.

    Keyword Args:
        termination_reward (float): :math:`r_e`. Defaults to 0.0.
        reward (NestedKey): the reward. Defaults to ``"reward"``.
        **options: of :class:`SafetyBudget`.

    Raises:
        ValueError: as :class:`SafetyBudget`, and if ``termination_reward`` is not finite.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from torchrl_safe.envs import EarlyTermination, SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=2, num_threads=1)
        >>> env = TransformedEnv(env, EarlyTermination(1e-9))
        >>> env.rollout(100)["next", "terminated"].shape  # all have paid in the first step
        torch.Size([2, 1, 1])
    """

    def __init__(
        self,
        budget: float,
        *,
        termination_reward: float = 0.0,
        reward: NestedKey = "reward",
        **options: Any,
    ) -> None:
        check_number("termination_reward", termination_reward)
        super().__init__(budget, **options)
        self.termination_reward = termination_reward
        self.reward = reward

    def _enforce(self, step: TensorDictBase, overdrawn: Tensor) -> None:
        reward = step.get(self.reward)
        step.set(self.reward, torch.where(overdrawn, self.termination_reward, reward))
        for key in ("done", "terminated"):
            step.set(key, step.get(key) | overdrawn)
