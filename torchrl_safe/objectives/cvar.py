"""CVaR of the discounted cost: its two critics, and the constraint on it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torch.distributions import Distribution
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import sample_and_log_prob
from torchrl.objectives import LossModule, distance_loss
from torchrl.objectives.utils import ValueEstimators, build_value_estimator
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe.objectives.functional import check_regression, check_risk_level, gaussian_cvar
from torchrl_safe.objectives.utils import ensemble
from torchrl_safe.objectives.value import (
    PolicyEvaluation,
    RetraceEstimator,
    retrace_variance_reward,
    squared_td_error,
)
from torchrl_safe.objectives.value.utils import behaviour_log_prob

VARIANCE_REWARDS = {"td_error": squared_td_error, "second_moment": retrace_variance_reward}


class CVaRCostLoss(LossModule):
    r"""Safety critics and the constraint on the CVaR of the discounted cost, (6)-(8), (18).

    Two critics describe the discounted sum of costs that follows a state and an action by its
    mean ``Q_C`` and its standard deviation ``sqrt(V_C)``. With a Gaussian in between, its CVaR is

    .. math::

        \Gamma(s, a) = Q_C(s, a) + \frac{\phi(\Phi^{-1}(\alpha))}{\alpha} \sqrt{V_C(s, a)}

    and the constraint is ``E[Gamma] <= cost_limit``. The mean regresses on its Retrace target;
    the standard deviation on the square root of the variance's, which is the Wasserstein-2
    distance between two Gaussians of one mean.

    **Units.** The cost is per step. ``Q_C``, its standard deviation, ``Gamma`` and
    ``cost_limit`` are *discounted sums* of it: a limit of ``c`` on the cost per step is
    ``cost_limit = c / (1 - gamma)``, see
    :func:`~torchrl_safe.objectives.functional.discounted_cost_limit`.

    Args:
        actor_network (ProbabilisticTensorDictSequential): stochastic actor.
        cost_network (TensorDictModule): writes ``"cost_value"``, ``[*B, 1]``.
        std_network (TensorDictModule): writes ``"cost_std"``, ``[*B, 1]``, non-negative: end it
            with a softplus.

    Keyword Args:
        cost_limit (float): limit on the discounted cost sum, at least 0.
        risk_level (float): share of worst outcomes that the CVaR averages, in (0, 1]; 1 is the
            plain expectation. Defaults to 0.125.
        num_cost_nets (int): networks of each kind; predictions are averaged. Defaults to 1.
        loss_function (str): ``"l2"``, ``"smooth_l1"`` or ``"l1"``. Defaults to ``"l2"``.
        delay_cost (bool): use target networks for the targets. Defaults to ``False``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Defaults to ``"mean"``.
        variance_reward (str): what the variance accumulates. ``"second_moment"`` is (18) as
            written; ``"td_error"`` has the same mean at a fraction of the noise, see
            :func:`~torchrl_safe.objectives.value.squared_td_error`. Defaults to ``"td_error"``.
        deactivate_vmap (bool): loop over the networks in place of vmap.
        use_prioritized_weights (bool or "auto"): weigh samples by ``"priority_weight"``.

    .. note::
        If ``"cost_target"`` and ``"std_target"`` are in the input, the critics regress on them
        in place of computing them: :meth:`compute_target` can be run once on whole
        trajectories, and minibatches of single transitions drawn from them.

    Raises:
        ValueError: if ``cost_limit`` is negative or not finite, ``risk_level`` is outside
            (0, 1], or another argument is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.modules import MLP, ValueOperator
        >>> from torchrl_safe import CVaRCostLoss, GMMTanhPolicy
        >>> spec = Bounded(-1, 1, (2,))
        >>> actor = GMMTanhPolicy(MLP(3, 5, num_cells=[8]), spec, num_components=1)
        >>> def critic(key, *last):
        ...     net = MLP(3 + 2, 1, num_cells=[8]).extend(last)
        ...     return ValueOperator(net, in_keys=["observation", "action"], out_keys=[key])
        >>> loss = CVaRCostLoss(
        ...     actor, critic("cost_value"), critic("cost_std", torch.nn.Softplus()), cost_limit=2.5
        ... )
        >>> _ = loss.make_value_estimator(gamma=0.99, lmbda=0.97)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 10, 3),
        ...         "action": spec.rand((4, 10)),
        ...         "action_log_prob": torch.zeros(4, 10),
        ...         "next": {
        ...             "observation": torch.randn(4, 10, 3),
        ...             "cost": torch.rand(4, 10, 1),
        ...             "done": torch.zeros(4, 10, 1, dtype=torch.bool),
        ...             "terminated": torch.zeros(4, 10, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     batch_size=[4, 10],
        ... )
        >>> sorted(loss(data).keys())
        ['cost_std', 'cost_value', 'loss_cost_std', 'loss_cost_value']
        >>> action = actor.get_dist(data).rsample()
        >>> loss.constraint(data, action).backward()  # E[Gamma] - cost_limit
    """

    @dataclass
    class _AcceptedKeys:
        """Default values of all configurable tensordict keys.

        Attributes:
            action (NestedKey): Defaults to ``"action"``.
            log_prob (NestedKey): Log-density of the action under the policy that took it.
                Defaults to ``"action_log_prob"``.
            cost (NestedKey): Cost of a step, under ``"next"``. Defaults to ``"cost"``.
            cost_value (NestedKey): Output of the mean critic. Defaults to ``"cost_value"``.
            cost_std (NestedKey): Output of the standard-deviation critic.
                Defaults to ``"cost_std"``.
            cost_target (NestedKey): Target of the mean critic, used if present.
                Defaults to ``"cost_target"``.
            std_target (NestedKey): Target of the standard-deviation critic, used if present.
                Defaults to ``"std_target"``.
            done (NestedKey): Under ``"next"``: cuts the trace. Defaults to ``"done"``.
            terminated (NestedKey): Under ``"next"``: no cost follows.
                Defaults to ``"terminated"``.
            priority_weight (NestedKey): Defaults to ``"priority_weight"``.
        """

        action: NestedKey = "action"
        log_prob: NestedKey = "action_log_prob"
        cost: NestedKey = "cost"
        cost_value: NestedKey = "cost_value"
        cost_std: NestedKey = "cost_std"
        cost_target: NestedKey = "cost_target"
        std_target: NestedKey = "std_target"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority_weight: NestedKey = "priority_weight"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = RetraceEstimator

    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.TD0, ValueEstimators.TDLambda)

    actor_network: ProbabilisticTensorDictSequential
    cost_network: TensorDictModule
    std_network: TensorDictModule
    actor_network_params: TensorDictParams
    cost_network_params: TensorDictParams
    std_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    target_cost_network_params: TensorDictParams
    target_std_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        cost_network: TensorDictModule,
        std_network: TensorDictModule,
        *,
        cost_limit: float,
        risk_level: float = 0.125,
        num_cost_nets: int = 1,
        loss_function: str = "l2",
        delay_cost: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
        variance_reward: Literal["td_error", "second_moment"] = "td_error",
        deactivate_vmap: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
    ) -> None:
        check_risk_level(risk_level)
        check_regression(loss_function, reduction)
        if not 0 <= cost_limit < float("inf"):
            raise ValueError(f"cost_limit must be finite and at least 0, got {cost_limit}.")
        if num_cost_nets < 1:
            raise ValueError(f"num_cost_nets must be at least 1, got {num_cost_nets}.")
        if variance_reward not in VARIANCE_REWARDS:
            raise ValueError(
                f"variance_reward must be one of {sorted(VARIANCE_REWARDS)}, "
                f"got {variance_reward!r}."
            )
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        self.out_keys = ["loss_cost_value", "loss_cost_std", "cost_value", "cost_std"]
        self.use_prioritized_weights = use_prioritized_weights
        self.convert_to_functional(actor_network, "actor_network", create_target_params=False)
        self.delay_cost = delay_cost
        for name, network in (("cost_network", cost_network), ("std_network", std_network)):
            self.convert_to_functional(
                network,
                name,
                num_cost_nets,
                create_target_params=delay_cost,
                compare_against=list(actor_network.parameters()),
            )
        self.risk_level = risk_level
        self.variance_reward = variance_reward
        self.register_coeff_buffer("cost_limit", float(cost_limit), device=self._default_device)
        self.loss_function = loss_function
        self.reduction = reduction
        self.deactivate_vmap = deactivate_vmap
        self._variance_estimator: Any = None
        self._make_vmap()

    def _make_vmap(self) -> None:
        self._vmap_cost_network, self._vmap_std_network = (
            ensemble(network, randomness=self.vmap_randomness, deactivate_vmap=self.deactivate_vmap)
            for network in (self.cost_network, self.std_network)
        )

    def make_value_estimator(
        self,
        value_type: ValueEstimators | type[ValueEstimatorBase] | None = None,
        **hyperparams: Any,
    ) -> CVaRCostLoss:
        """Choose the estimator of both targets.

        The variance obeys the recursion of the mean at discount ``gamma ** 2`` (18), so that
        two estimators of one kind are made.

        Args:
            value_type (ValueEstimators or class, optional): TD(0), TD(lambda) or an estimator
                class. Defaults to :class:`~torchrl_safe.RetraceEstimator`.
            **hyperparams: of the estimator; ``gamma`` is the discount of the cost.

        Returns:
            The loss itself.
        """
        value_type = self.default_value_estimator if value_type is None else value_type
        gamma = hyperparams.pop("gamma", 0.99)
        if not 0 <= gamma < 1:
            raise ValueError(f"gamma must be in [0, 1), got {gamma}.")
        if value_type is RetraceEstimator:
            hyperparams.setdefault("lmbda", 0.97)
        if isinstance(value_type, ValueEstimators):
            if value_type not in self.SUPPORTED_VALUE_ESTIMATORS:
                supported = [member.name for member in self.SUPPORTED_VALUE_ESTIMATORS]
                raise NotImplementedError(
                    f"value_type {value_type} is not supported; use one of {supported} or an "
                    "estimator class."
                )
            build: Callable[..., ValueEstimatorBase] = partial(
                build_value_estimator, self, value_type
            )
        else:
            build = value_type
        self._value_estimator, self._variance_estimator = (
            build(gamma=discount, value_network=None, **hyperparams)
            for discount in (gamma, gamma**2)
        )
        self.value_type = value_type
        self._forward_value_estimator_keys()
        return self

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        for estimator in (self._value_estimator, self._variance_estimator):
            if estimator is not None:
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
            self._in_keys = list(
                dict.fromkeys(
                    [
                        keys.action,
                        keys.log_prob,
                        *(_next(key) for key in (keys.cost, keys.done, keys.terminated)),
                        *self.actor_network.in_keys,
                        *(_next(key) for key in self.actor_network.in_keys),
                        *self.cost_network.in_keys,
                        *self.std_network.in_keys,
                    ]
                )
            )
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses of the two critics.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``, or transitions ``[*B]`` that
                hold their targets.

        Returns:
            TensorDict of ``loss_cost_value``, ``loss_cost_std``, and the detached means
            ``cost_value`` and ``cost_std`` of the predictions.
        """
        keys = self.tensor_keys
        weights = self._maybe_get_priority_weight(tensordict)
        mean_target = tensordict.get(keys.cost_target, None)
        std_target = tensordict.get(keys.std_target, None)
        if mean_target is None or std_target is None:
            mean_target, std_target = self.compute_target(tensordict)
        mean, std = self._predict(tensordict, self.cost_network_params, self.std_network_params)
        out = {}
        for name, prediction, target in (("value", mean, mean_target), ("std", std, std_target)):
            loss = distance_loss(
                prediction, target.squeeze(-1).expand_as(prediction), self.loss_function
            ).sum(0)
            out[f"loss_cost_{name}"] = self._reduce_loss(
                loss, tensordict=tensordict, weights=weights
            )
            each = self.reduction == "none"
            out[f"cost_{name}"] = prediction.detach().mean(0 if each else None)
        td_out = TensorDict(out, tensordict.batch_size if self.reduction == "none" else [])
        self._clear_weakrefs(
            tensordict,
            td_out,
            "actor_network_params",
            "cost_network_params",
            "std_network_params",
            "target_actor_network_params",
            "target_cost_network_params",
            "target_std_network_params",
        )
        return td_out

    def compute_target(
        self, tensordict: TensorDictBase, *, policy: PolicyEvaluation | None = None
    ) -> tuple[Tensor, Tensor]:
        """Retrace targets of both critics (18).

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``.

        Keyword Args:
            policy (PolicyEvaluation, optional): what
                :func:`~torchrl_safe.objectives.value.evaluate_policy` returned for the tensordict
                and the policy of now. Spares evaluating the policy here.

        Returns:
            Targets of the mean and of the standard deviation, without gradient, each of the
            shape of the cost, ``[*B, T, 1]``.
        """
        keys = self.tensor_keys
        estimator = self.value_estimator
        estimator_keys = estimator.tensor_keys
        # Estimators of state values read no value of the stored action.
        action_value_key = getattr(estimator_keys, "state_action_value", "state_action_value")
        next_tensordict = tensordict.get("next")
        critics = (self.target_cost_network_params, self.target_std_network_params)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            if policy is None:
                next_action, _ = sample_and_log_prob(self._target_dist(next_tensordict))
            else:
                next_action = policy.next_action
            data = tensordict.select(
                keys.log_prob,
                *(_next(key) for key in (keys.cost, keys.done, keys.terminated)),
                strict=False,
            )
            mean, std = (
                prediction.mean(0).unsqueeze(-1)
                for prediction in self._predict(tensordict, *critics)
            )
            next_mean, next_std = (
                prediction.mean(0).unsqueeze(-1)
                for prediction in self._predict(
                    self._inputs(next_tensordict, next_action), *critics
                )
            )
            options = {}
            if isinstance(estimator, RetraceEstimator):
                if policy is None:
                    log_prob = self._target_dist(tensordict).log_prob(tensordict.get(keys.action))
                else:
                    log_prob = policy.log_prob
                options["policy_log_prob"] = log_prob
                log_mu = behaviour_log_prob(tensordict, keys.log_prob, self.actor_network)
                data.set(keys.log_prob, log_mu)
            cost = data.get(_next(keys.cost))
            terminated = data.get(_next(keys.terminated), data.get(_next(keys.done)))

            data.set(action_value_key, mean)
            data.set(_next(estimator_keys.value), next_mean)
            mean_target = estimator.value_estimate(data, **options)

            variance_reward = VARIANCE_REWARDS[self.variance_reward]
            reward = variance_reward(estimator.gamma, cost, mean, next_mean, terminated)
            data.set(_next(keys.cost), reward)
            data.set(action_value_key, std.square())
            data.set(_next(estimator_keys.value), next_std.square())
            variance_target = self._variance_estimator.value_estimate(data, **options)
        # Trace corrections can make a sampled target of a variance negative.
        return mean_target, variance_target.clamp(min=0).sqrt()

    def predict(self, tensordict: TensorDictBase, action: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the discounted cost, ``Q_C(s, a)`` and ``sqrt(V_C)``.

        Gradients reach ``action``, not the critics.

        Args:
            tensordict (TensorDictBase): holds the critics' inputs but the action, ``[*B]``.
            action (Tensor): ``[*B, D]``.

        Returns:
            Mean and standard deviation, in units of the discounted cost sum, ``[*B]`` each.
        """
        mean, std = self._predict(
            self._inputs(tensordict, action),
            self.cost_network_params.detach(),
            self.std_network_params.detach(),
        )
        return mean.mean(0), std.mean(0)

    def cvar(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """CVaR of the discounted cost (7), ``Gamma(s, a)``.

        Gradients reach ``action``, not the critics.

        Args:
            tensordict (TensorDictBase): holds the critics' inputs but the action, ``[*B]``.
            action (Tensor): ``[*B, D]``.

        Returns:
            The CVaR, in units of the discounted cost sum, ``[*B]``.
        """
        return gaussian_cvar(*self.predict(tensordict, action), self.risk_level)

    def on_policy_cvar(self, tensordict: TensorDictBase) -> Tensor:
        r"""Mean CVaR of the policy that took the given steps, from the costs it really met.

        Over the states that a policy visits, the mean of its ``Q_C`` is its mean cost per step
        over ``1 - gamma``. Measured like this, the level follows the policy at once, where the
        critic has to learn it; the standard deviation is the critic's.

        Args:
            tensordict (TensorDictBase): steps of the current policy, ``[*B]``.

        Returns:
            The mean CVaR, a scalar without gradient, in units of the discounted cost sum.
        """
        keys = self.tensor_keys
        with torch.no_grad():
            std = self._vmap_std_network(tensordict, self.std_network_params, keys.cost_std)
            mean = tensordict.get(_next(keys.cost)).mean() / (1 - self.value_estimator.gamma)
            return gaussian_cvar(mean, std.mean(), self.risk_level)

    def constraint(
        self,
        tensordict: TensorDictBase,
        action: Tensor,
        *,
        reference: Tensor | None = None,
        level: Tensor | None = None,
    ) -> Tensor:
        r"""The constraint (8), ``E[Gamma] - cost_limit``, feasible at or below 0.

        (8) follows the policy for one action and the critics' policy from then on. A policy
        keeps its change: by the policy gradient theorem, the effect on the discounted sum of
        following it at every step is ``1 / (1 - gamma)`` times that of one action. Given the
        ``reference``, the mean of :meth:`cvar` at the policy that the critics describe, the
        constraint is in the units of what the change really does:

        .. math::

            \text{level} + \frac{E[\Gamma] - \text{reference}}{1 - \gamma} - d

        Args:
            tensordict (TensorDictBase): holds the critics' inputs but the action, ``[*B]``.
            action (Tensor): reparameterised actions of the policy, ``[*B, D]``.

        Keyword Args:
            reference (Tensor, optional): scalar. Without it, the constraint is (8) as written.
            level (Tensor, optional): CVaR of the policy before its change, a scalar, such as
                :meth:`on_policy_cvar`. Defaults to ``reference``.

        Returns:
            The constraint, a scalar, in units of the discounted cost sum.

        Raises:
            ValueError: if there is a ``level`` and no ``reference``.
        """
        value = self.cvar(tensordict, action).mean()
        if reference is not None:
            change = (value - reference) / (1 - self.value_estimator.gamma)
            value = (reference if level is None else level) + change
        elif level is not None:
            raise ValueError(f"level={level} needs the reference that it takes the place of.")
        return value - self.cost_limit

    def _target_dist(self, tensordict: TensorDictBase) -> Distribution:
        with self.target_actor_network_params.to_module(
            self.actor_network, preserve_module_state=False
        ):
            return self.actor_network.get_dist(tensordict)

    def _inputs(self, tensordict: TensorDictBase, action: Tensor) -> TensorDictBase:
        """What the critics read, with another action."""
        inputs = tensordict.select(
            *self.cost_network.in_keys, *self.std_network.in_keys, strict=False
        )
        return inputs.set(self.tensor_keys.action, action)

    def _predict(
        self, inputs: TensorDictBase, cost_params: TensorDictBase, std_params: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        keys = self.tensor_keys
        mean = self._vmap_cost_network(inputs, cost_params, keys.cost_value)
        std = self._vmap_std_network(inputs, std_params, keys.cost_std)
        return mean.squeeze(-1), std.squeeze(-1)


def _next(key: NestedKey) -> NestedKey:
    return ("next", *key) if isinstance(key, tuple) else ("next", key)
