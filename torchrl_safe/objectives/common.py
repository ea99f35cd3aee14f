"""What losses of trajectories share: steps as they are read, and the limit on a cost."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torch.distributions import Distribution
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import sample_and_log_prob
from torchrl.objectives import LossModule
from torchrl.objectives.utils import ValueEstimators
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe.objectives.functional import check_cost_limit, check_risk_level
from torchrl_safe.objectives.utils import ValueType, as_given, ensemble, make_estimator
from torchrl_safe.objectives.value import (
    PolicyEvaluation,
    RetraceEstimator,
    visited_value_estimate,
)
from torchrl_safe.objectives.value.utils import (
    behaviour_log_prob,
    get_entry,
    get_time_dim,
    next_key,
    repair_next,
    with_action,
)

Critics: TypeAlias = TensorDictModule | Sequence[TensorDictModule]


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
        key = next_key(reward_key)
        reward = get_entry(tensordict, key, "what a step pays, [*B, T, 1]")
        if reward.ndim <= tensordict.batch_dims:
            raise ValueError(
                f"{key!r} must have a dimension besides the batch's, [*B, T, 1], got shape "
                f"{tuple(reward.shape)} in a tensordict of batch size "
                f"{tuple(tensordict.batch_size)}: unsqueeze(-1) it."
            )
        if not reward.is_floating_point():
            reward = reward.to(torch.get_default_dtype())
        done = get_entry(tensordict, next_key(keys.done), "the end of trajectories, [*B, T, 1]")
        terminated = tensordict.get(next_key(keys.terminated), done)
        for name, flag in ((keys.done, done), (keys.terminated, terminated)):
            if flag.dtype != torch.bool:
                raise TypeError(f"{next_key(name)!r} must be boolean, got {flag.dtype}.")
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

    def _limit(self, cost_limit: float | None) -> float | Tensor:
        """The limit of now: the given one, or the loss's own."""
        if cost_limit is None:
            return self.cost_limit
        check_cost_limit(cost_limit)
        return cost_limit

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

    def _check_single_steps(
        self, tensordict: TensorDictBase, estimator: ValueEstimatorBase
    ) -> None:
        key = estimator.tensor_keys.steps_to_next_obs
        if key in tensordict.keys(True) and (tensordict.get(key) != 1).any():
            raise ValueError(
                f"{key!r} must be 1 everywhere: costs are measured on single steps, not on sums "
                "of several. Measure on the batch before it is made one of n-step transitions."
            )

    def _measured_mean(
        self,
        tensordict: TensorDictBase,
        cost_key: NestedKey,
        estimator: ValueEstimatorBase,
        next_value: Callable[[TensorDictBase], Tensor],
    ) -> Tensor:
        """Mean over the visited states of the discounted cost that follows."""
        self._check_single_steps(tensordict, estimator)
        cost, done, terminated, mask = self._read_steps(tensordict, cost_key, estimator)
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


class MeasuredCVaR(NamedTuple):
    """Where the cost of a policy stands.

    What ``measure`` of :class:`~torchrl_safe.CVaRCostLoss` and of
    :class:`~torchrl_safe.objectives.QuantileCostLoss` returns.

    Attributes:
        level (Tensor): mean CVaR of the policy, a scalar in units of the discounted cost sum.
        reference (Tensor): the critics' CVaR at the policy's own actions, ``[*B]``.
        horizon (Tensor): discounted number of steps for which a change of the policy is kept, a
            scalar: ``1 / (1 - gamma)`` if nothing terminates.
    """

    level: Tensor
    reference: Tensor
    horizon: Tensor


class CriticCostLoss(CostLoss):
    """A loss of a cost whose critics are of states and actions: the constraint on their CVaR.

    Args:
        actor_network (ProbabilisticTensorDictSequential): stochastic actor.
        critics (dict): the critics by the names of their attributes, each a module or a list.

    Keyword Args:
        num_cost_nets (int): networks of each kind.
        cost_limit (float): limit on the discounted cost sum, at least 0.
        risk_level (float): in (0, 1].
        delay_cost (bool): use target networks for the targets.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``.
        deactivate_vmap (bool): loop over the networks in place of vmap.
        use_prioritized_weights (bool or "auto"): weigh samples by ``"priority_weight"``.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys of every loss of this kind.

        Attributes:
            action (NestedKey): Defaults to ``"action"``.
            log_prob (NestedKey): Log-density of the action under the policy that took it, read by
                Retrace. Defaults to ``"action_log_prob"``.
            cost (NestedKey): Cost of a step, under ``"next"``. Defaults to ``"cost"``.
            cost_target (NestedKey): What the critic regresses on, used if present.
                Defaults to ``"cost_target"``.
            done (NestedKey): Under ``"next"``: cuts the sum. Defaults to ``"done"``.
            terminated (NestedKey): Under ``"next"``: no cost follows.
                Defaults to ``"terminated"``.
            priority_weight (NestedKey): Defaults to ``"priority_weight"``.
        """

        action: NestedKey = "action"
        log_prob: NestedKey = "action_log_prob"
        cost: NestedKey = "cost"
        cost_target: NestedKey = "cost_target"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    SUPPORTED_VALUE_ESTIMATORS = (
        ValueEstimators.TD0,
        ValueEstimators.TD1,
        ValueEstimators.TDLambda,
        "retrace",
    )

    actor_network: ProbabilisticTensorDictSequential
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        critics: dict[str, Critics],
        *,
        num_cost_nets: int,
        cost_limit: float,
        risk_level: float,
        delay_cost: bool,
        reduction: str,
        deactivate_vmap: bool,
        use_prioritized_weights: bool | Literal["auto"],
    ) -> None:
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        self.use_prioritized_weights = use_prioritized_weights
        self.convert_to_functional(actor_network, "actor_network", create_target_params=False)
        self.delay_cost = delay_cost
        self._critic_names = tuple(critics)
        for name, network in critics.items():
            others = [other for other in critics.values() if other is not network]
            module, expand_dim = as_given(
                network,
                num_cost_nets,
                names=(name, "num_cost_nets"),
                others=[parameter for other in others for parameter in _parameters(other)],
            )
            self.convert_to_functional(
                module,
                name,
                expand_dim,
                create_target_params=delay_cost,
                compare_against=list(actor_network.parameters()),
            )
        self._register_limit(cost_limit, risk_level)
        self.reduction = reduction
        self.deactivate_vmap = deactivate_vmap
        self._make_vmap()

    @property
    def _critics(self) -> list[TensorDictModule]:
        return [getattr(self, name) for name in self._critic_names]

    def _make_vmap(self) -> None:
        self._ensembles = [
            ensemble(critic, randomness=self.vmap_randomness, deactivate_vmap=self.deactivate_vmap)
            for critic in self._critics
        ]

    def _build_estimator(
        self, value_type: ValueType | None, gamma: float, **hyperparams: Any
    ) -> tuple[ValueEstimatorBase, Any]:
        """An estimator of sums of this cost, and what ``value_type`` is then."""
        if value_type is None:
            value_type = self.default_value_estimator
        for name in ("average_rewards", "group_key"):
            if hyperparams.get(name):
                raise ValueError(
                    f"{name} must be left out, got {hyperparams[name]!r}: standardised costs are "
                    "not in the unit of cost_limit."
                )
        if not 0 <= gamma < 1:
            raise ValueError(f"gamma must be in [0, 1), got {gamma}.")
        if isinstance(value_type, str) and value_type.lower() == "retrace":
            value_type = RetraceEstimator
        if isinstance(value_type, type) and issubclass(value_type, RetraceEstimator):
            # On values that the loss computes, in place of networks.
            return value_type(gamma=gamma, **{"lmbda": 0.97, **hyperparams}), value_type
        supported = self.SUPPORTED_VALUE_ESTIMATORS
        return make_estimator(self, value_type, supported=supported, gamma=gamma, **hyperparams)

    def _estimators(self) -> list[ValueEstimatorBase]:
        """Those that have been made."""
        return [] if self._value_estimator is None else [self._value_estimator]

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        for estimator in self._estimators():
            estimator.set_keys(
                reward=self.tensor_keys.cost,
                done=self.tensor_keys.done,
                terminated=self.tensor_keys.terminated,
                sample_log_prob=self.tensor_keys.log_prob,
            )
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that :meth:`forward` reads."""
        if self._in_keys is None:
            keys = self.tensor_keys
            estimator = self._value_estimator
            kind = self.default_value_estimator if estimator is None else type(estimator)
            retrace = isinstance(kind, type) and issubclass(kind, RetraceEstimator)
            in_keys = [
                keys.action,
                *([keys.log_prob] if retrace else []),
                *(next_key(key) for key in (keys.cost, keys.done, keys.terminated)),
                *self.actor_network.in_keys,
                *(next_key(key) for key in self.actor_network.in_keys),
                *(key for critic in self._critics for key in critic.in_keys),
            ]
            self._in_keys = list(dict.fromkeys(in_keys))
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def cvar(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """What the critics say of states ``[*B]`` and actions, ``[*B]``."""
        raise NotImplementedError

    def on_policy_cvar(self, tensordict: TensorDictBase) -> Tensor:
        """What the policy that took the given steps really meets, a scalar."""
        raise NotImplementedError

    @torch.no_grad()
    def measure(
        self, tensordict: TensorDictBase, action: Tensor, *, states: TensorDictBase | None = None
    ) -> MeasuredCVaR:
        """Where the cost of the current policy stands, for :meth:`constraint`.

        Args:
            tensordict (TensorDictBase): steps of the current policy, see :meth:`on_policy_cvar`.
            action (Tensor): reparameterised actions of the current policy, ``[*B, D]``, from the
                noise that actions will be drawn with in :meth:`constraint`.

        Keyword Args:
            states (TensorDictBase, optional): what :meth:`constraint` will be called with,
                ``[*B]``, if that is not the tensordict itself.

        Returns:
            MeasuredCVaR: without gradient.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if steps are sums of several.
        """
        return MeasuredCVaR(
            self.on_policy_cvar(tensordict),
            self.cvar(tensordict if states is None else states, action),
            self._measured_horizon(tensordict, self.tensor_keys.cost, self.value_estimator),
        )

    def constraint(
        self,
        tensordict: TensorDictBase,
        action: Tensor,
        measured: MeasuredCVaR,
        *,
        cost_limit: float | None = None,
    ) -> Tensor:
        r"""The constraint, feasible at or below 0, in the unit of ``cost_limit``.

        .. math::

            \text{level} + \text{horizon} \cdot E[\Gamma - \text{reference}] - d

        (8) as written, ``cvar(tensordict, action).mean() - cost_limit``, follows the policy for one
        action and the critics' policy from then on. A policy keeps its change: by the policy
        gradient theorem, the effect on the discounted sum of following it at every step is
        ``horizon`` times that of one action, ``1 / (1 - gamma)`` times if nothing terminates. At
        the policy that was measured the constraint is how far its level is from the limit.

        In a Lagrangian the objective must follow the policy for as long: put
        :meth:`TsallisLoss.objective <torchrl_safe.TsallisLoss.objective>`, which is of one action,
        beside :meth:`cvar`, or its mean over ``1 - gamma`` beside this. A trust region does not
        mind how the objective is scaled.

        Args:
            tensordict (TensorDictBase): holds the critics' inputs but the action, ``[*B]``.
            action (Tensor): reparameterised actions of the policy, ``[*B, D]``.
            measured (MeasuredCVaR): what :meth:`measure` returned for the policy before its change,
                with the same states and noise.

        Keyword Args:
            cost_limit (float, optional): the limit of now, of a schedule or of a
                :class:`~torchrl_safe.objectives.LimitController`. Defaults to the loss's.

        Returns:
            The constraint, a scalar, in units of the discounted cost sum.

        Raises:
            TypeError: if ``measured`` is something else.
            ValueError: if it was measured on another number of states, or ``cost_limit`` is
                negative or not finite.
        """
        if not isinstance(measured, MeasuredCVaR):
            raise TypeError(
                f"measured must be what measure(...) returned, got {type(measured).__name__}."
            )
        value = self.cvar(tensordict, action)
        if value.shape != measured.reference.shape:
            raise ValueError(
                f"measured must be of the states in the tensordict, {tuple(value.shape)}, got a "
                f"reference of shape {tuple(measured.reference.shape)}: hand them to measure, too."
            )
        change = self._mean(value - measured.reference, tensordict)
        return measured.level + measured.horizon * change - self._limit(cost_limit)

    def _following(self, tensordict: TensorDictBase) -> TensorDictBase:
        """What actor and critics read of the next states."""
        in_keys = [key for critic in self._critics for key in critic.in_keys]
        in_keys = [key for key in in_keys if key != self.tensor_keys.action]
        for key in in_keys:
            get_entry(tensordict, next_key(key), "an input of the critic at the next state")
        in_keys += self.actor_network.in_keys
        return repair_next(tensordict, in_keys).get("next").select(*in_keys, strict=False)

    def _next_inputs(self, following: TensorDictBase, action: Tensor | None) -> TensorDictBase:
        """What critics read of next states and actions of the policy there, drawn if not given."""
        if action is None:
            with set_exploration_type(ExplorationType.RANDOM):
                action, _ = sample_and_log_prob(self._target_dist(following))
        return with_action(following, self.tensor_keys.action, action, *self._critics)

    def _log_probs(
        self, tensordict: TensorDictBase, policy: PolicyEvaluation | None, cost: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Log-densities of the stored action under the policy and its sampler, ``[*B, T, 1]``."""
        keys = self.tensor_keys
        log_mu = behaviour_log_prob(tensordict, keys.log_prob, self.actor_network)
        if policy is None:
            action = get_entry(tensordict, keys.action, "the stored action")
            log_pi = self._target_dist(tensordict).log_prob(action)
        else:
            log_pi = policy.log_prob
        return spread(joint(log_pi), cost[..., :1]), spread(joint(log_mu), cost[..., :1])

    def _target_dist(self, tensordict: TensorDictBase) -> Distribution:
        with self.target_actor_network_params.to_module(
            self.actor_network, preserve_module_state=False
        ):
            return self.actor_network.get_dist(tensordict)


def spread(tensor: Tensor, like: Tensor) -> Tensor:
    """An entry of steps, in the shape of another that has more dimensions, as of agents."""
    missing = (1,) * (like.ndim - tensor.ndim)
    return tensor.reshape(*tensor.shape, *missing).expand_as(like)


def _parameters(critics: Critics) -> list[nn.Parameter]:
    networks = [critics] if isinstance(critics, nn.Module) else critics
    return [parameter for network in networks for parameter in network.parameters()]


def joint(log_prob: Tensor | TensorDictBase) -> Tensor:
    """Log-density of the whole action, also of one with several leaves."""
    if isinstance(log_prob, TensorDictBase):
        return torch.stack([*log_prob.values(True, True)]).sum(0)
    return log_prob
