"""What losses of trajectories share: steps as they are read, and the limit on a cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.objectives import LossModule
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe.objectives.functional import check_cost_limit, check_risk_level
from torchrl_safe.objectives.value import visited_value_estimate
from torchrl_safe.objectives.value.utils import get_entry, get_time_dim


class Steps(NamedTuple):
    """Steps of trajectories as value estimation takes them, ``[*B, T, F]`` each."""

    reward: Tensor  # floating point
    done: Tensor  # ends of trajectories, also where padding begins
    terminated: Tensor
    mask: Tensor  # false for padding


class TrajectoryLoss(LossModule):
    """A loss whose targets come from trajectories: reads steps, leaves out padding."""

    def _read_steps(
        self, tensordict: TensorDictBase, reward_key: NestedKey, estimator: ValueEstimatorBase
    ) -> Steps:
        keys = self.tensor_keys
        key = unravel_key(("next", reward_key))
        reward = get_entry(tensordict, key, "what a step pays, [*B, T, 1]")
        if reward.ndim <= tensordict.batch_dims:
            raise ValueError(
                f"{key!r} must have a dimension besides the batch's, [*B, T, 1], got shape "
                f"{tuple(reward.shape)} in a tensordict of batch size "
                f"{tuple(tensordict.batch_size)}: unsqueeze(-1) it."
            )
        if not reward.is_floating_point():
            reward = reward.to(torch.get_default_dtype())
        done = get_entry(tensordict, ("next", keys.done), "the end of trajectories, [*B, T, 1]")
        terminated = tensordict.get(unravel_key(("next", keys.terminated)), done)
        for name, flag in ((keys.done, done), (keys.terminated, terminated)):
            if flag.dtype != torch.bool:
                raise TypeError(
                    f"{unravel_key(('next', name))!r} must be boolean, got {flag.dtype}."
                )
        done, terminated = spread(done, reward), spread(terminated, reward)
        mask = self._mask(reward, tensordict)
        dim = get_time_dim(tensordict, getattr(estimator, "time_dim", None))
        following = mask.narrow(dim, 1, mask.shape[dim] - 1)
        last = torch.ones_like(mask.narrow(dim, 0, 1))
        done = done | ~torch.cat([following, last], dim)
        return Steps(reward.masked_fill(~mask, 0), done, terminated, mask)

    def _mask(self, tensor: Tensor, tensordict: TensorDictBase) -> Tensor:
        """False where :meth:`_reduce_loss` leaves steps out, in the shape of a tensor."""
        ones = torch.ones_like(tensor)
        return self._reduce_loss(ones, tensordict=tensordict, reduction="none") > 0

    def _mean(self, tensor: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Mean over the steps that are no padding."""
        return self._reduce_loss(tensor, tensordict=tensordict, reduction="mean")

    def _discount(
        self, tensordict: TensorDictBase, reward: Tensor, estimator: ValueEstimatorBase
    ) -> tuple[float | Tensor, Tensor | None]:
        """Discount of each step, and the number of steps it stands for, if the data say so."""
        steps = tensordict.get(estimator.tensor_keys.steps_to_next_obs, None)
        if steps is None:
            return estimator.gamma, None
        steps = spread(steps, reward)
        return estimator.gamma**steps, steps


class CostLoss(TrajectoryLoss):
    """A loss of a cost, with a limit on its CVaR."""

    _cost_limit: Tensor

    def _register_limit(self, cost_limit: float, risk_level: float) -> None:
        check_cost_limit(cost_limit)
        self.risk_level = risk_level
        limit = torch.tensor(float(cost_limit), device=self._default_device)
        self.register_buffer("_cost_limit", limit)

    @property
    def cost_limit(self) -> Tensor:
        """Limit on the discounted cost sum, a scalar; a number may be assigned at any time."""
        return self._cost_limit

    @cost_limit.setter
    def cost_limit(self, cost_limit: float | Tensor) -> None:
        if isinstance(cost_limit, Tensor):
            cost_limit = cost_limit.item()
        check_cost_limit(cost_limit)
        self._cost_limit.fill_(cost_limit)  # in place: a compiled step or a graph follows it

    @property
    def risk_level(self) -> float:
        """Share of worst outcomes that the CVaR averages; may be assigned at any time."""
        return self._risk_level

    @risk_level.setter
    def risk_level(self, risk_level: float) -> None:
        check_risk_level(risk_level)
        self._risk_level = risk_level

    def get_extra_state(self) -> Tensor:
        """What ``state_dict`` holds besides parameters and the limit: the risk level."""
        return torch.tensor(self.risk_level, dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Take the risk level of a ``state_dict``, and check the limit that came with it."""
        check_cost_limit(self._cost_limit.item())
        self.risk_level = state.item()

    def _measured_mean(
        self,
        tensordict: TensorDictBase,
        cost_key: NestedKey,
        estimator: ValueEstimatorBase,
        next_value: Callable[[TensorDictBase], Tensor],
    ) -> Tensor:
        """Mean over the visited states of the discounted cost that follows."""
        cost, done, terminated, mask = self._read_steps(tensordict, cost_key, estimator)
        key = estimator.tensor_keys.steps_to_next_obs
        if key in tensordict.keys(True) and (tensordict.get(key) != 1).any():
            raise ValueError(
                f"{key!r} must be 1 everywhere: costs are measured on single steps, not on sums "
                "of several. Measure on the batch before it is made one of n-step transitions."
            )
        return visited_value_estimate(
            estimator.gamma,
            cost,
            done,
            terminated,
            # Where nothing terminates, what critics say of cuts cancels.
            next_value=next_value(tensordict) if (terminated & mask).any() else None,
            mask=mask,
            time_dim=get_time_dim(tensordict, getattr(estimator, "time_dim", None)),
        )

    def _measured_horizon(
        self, tensordict: TensorDictBase, cost_key: NestedKey, estimator: ValueEstimatorBase
    ) -> Tensor:
        """Mean over the visited states of the discounted number of steps that follow."""
        cost, done, terminated, mask = self._read_steps(tensordict, cost_key, estimator)
        return visited_value_estimate(
            estimator.gamma,
            torch.ones_like(cost),
            done,
            terminated,
            mask=mask,
            time_dim=get_time_dim(tensordict, getattr(estimator, "time_dim", None)),
        )


def spread(tensor: Tensor, like: Tensor) -> Tensor:
    """An entry of steps, in the shape of another that has more dimensions, as of agents."""
    missing = (1,) * (like.ndim - tensor.ndim)
    return tensor.reshape(*tensor.shape, *missing).expand_as(like)
