"""Surrogates of return and CVaR cost out of ratios and advantages: CPO, TRC, off-policy TRC."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import distance_loss
from torchrl.objectives.utils import ValueEstimators
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe._checks import check_shape
from torchrl_safe.objectives.common import CostLoss, Steps, TrajectoryLoss, spread
from torchrl_safe.objectives.functional import (
    check_regression,
    cvar_factor,
    gaussian_cvar,
    surrogate_change,
)
from torchrl_safe.objectives.value import (
    RetraceEstimator,
    retrace_variance_reward,
    squared_td_error,
)
from torchrl_safe.objectives.value.utils import get_entry, next_key, repair_next


class CostMoments(NamedTuple):
    """Where the cost of a policy stands, from :meth:`CVaRSurrogateLoss.measure`; scalars.

    Attributes:
        mean (Tensor): of the discounted cost sum that the policy meets.
        variance (Tensor): of the same.
        horizon (Tensor): discounted number of steps for which a change of the policy is kept,
            ``1 / (1 - gamma)`` if nothing terminates.
        square_horizon (Tensor): the same at discount ``gamma ** 2``, that of the variance.
    """

    mean: Tensor
    variance: Tensor
    horizon: Tensor
    square_horizon: Tensor


class _SurrogateLoss(TrajectoryLoss):
    """What both surrogates share: critics of states, Retrace on them, ratios."""

    default_value_estimator = RetraceEstimator
    loss_function: str

    def make_value_estimator(
        self,
        value_type: ValueEstimators | str | type[ValueEstimatorBase] | None = None,
        *,
        gamma: float = 0.99,
        lmbda: float = 0.97,
    ) -> _SurrogateLoss:
        """Set discount and trace decay of the advantage.

        The estimator is Retrace on values of states. Where the policy took the actions itself,
        that is generalised advantage estimation (https://arxiv.org/abs/1506.02438).

        Args:
            value_type (str or class, optional): ``"retrace"`` or
                :class:`~torchrl_safe.RetraceEstimator`, the default.

        Keyword Args:
            gamma (float): discount in [0, 1). Defaults to 0.99.
            lmbda (float): trace decay in [0, 1]. Defaults to 0.97.

        Returns:
            The loss itself.

        Raises:
            ValueError: for another estimator, or if a coefficient is out of its range.
        """
        if value_type not in (None, RetraceEstimator, "retrace"):
            raise ValueError(
                f"value_type must be 'retrace', RetraceEstimator or None, got {value_type!r}."
            )
        if not 0 <= gamma < 1:
            raise ValueError(f"gamma must be in [0, 1), got {gamma}.")
        self._make_estimators(gamma, lmbda)
        return self

    def _make_estimators(self, gamma: float, lmbda: float) -> None:
        self._value_estimator = RetraceEstimator(gamma=gamma, lmbda=lmbda)
        self.gamma = gamma

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        # Data are handed to the estimators under their own keys.
        self.in_keys = self._regression_keys()

    def _value(self, name: str, key: NestedKey, tensordict: TensorDictBase) -> Tensor:
        """A critic's prediction, [*B, 1]."""
        network: TensorDictModule = getattr(self, name)
        for in_key in network.in_keys:
            get_entry(tensordict, in_key, f"an input of {name}")
        with getattr(self, f"{name}_params").to_module(network):
            out = network(tensordict.select(*network.in_keys))
        return get_entry(out, key, f"the output of {name}")

    def _next_value(self, name: str, key: NestedKey, tensordict: TensorDictBase) -> Tensor:
        """A critic's prediction of the next state, [*B, 1]."""
        in_keys = getattr(self, name).in_keys
        for in_key in in_keys:
            get_entry(tensordict, next_key(in_key), f"an input of {name} at the next state")
        return self._value(name, key, repair_next(tensordict, in_keys).get("next"))

    def _values(
        self, name: str, key: NestedKey, tensordict: TensorDictBase, mask: Tensor
    ) -> tuple[Tensor, Tensor]:
        """A critic's predictions of both states of steps, [*B, T, 1]; 0 for padding."""
        value, next_value = (
            predict(name, key, tensordict) for predict in (self._value, self._next_value)
        )
        return value.masked_fill(~mask, 0), next_value.masked_fill(~mask, 0)

    def _scored(self, tensordict: TensorDictBase, policy_log_prob: Tensor | None) -> TensorDictBase:
        """A shallow copy in which the policy that advantages belong to is the given one."""
        if policy_log_prob is None:
            policy_log_prob = get_entry(
                tensordict,
                self.tensor_keys.log_prob,
                "the log-density of the action under the policy that took it, [*B, T]",
            )
        return tensordict.copy().set(self.tensor_keys.policy_log_prob, policy_log_prob)

    def _log_probs(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Log-densities of the stored action under the policy and under its sampler, [*B]."""
        keys = self.tensor_keys
        log_mu = get_entry(
            tensordict,
            keys.log_prob,
            "the log-density of the action under the policy that took it, [*B, T]",
        )
        return self._computed(tensordict, keys.policy_log_prob), log_mu

    def _advantage(
        self,
        estimator: ValueEstimatorBase,
        tensordict: TensorDictBase,
        steps: Steps,
        value: Tensor,
        next_value: Tensor,
    ) -> Tensor:
        log_pi, log_mu = (
            spread(log_prob, steps.reward[..., :1]) for log_prob in self._log_probs(tensordict)
        )
        data = tensordict.select()  # keeps the name of time
        data.update(
            {
                "action_log_prob": log_mu,
                "state_action_value": value,
                "next": {
                    "reward": steps.reward,
                    "state_value": next_value,
                    "done": steps.done,
                    "terminated": steps.terminated,
                },
            }
        )
        _, num_steps = self._discount(tensordict, steps.reward, estimator)
        if num_steps is not None:
            data.set(estimator.tensor_keys.steps_to_next_obs, num_steps)
        return estimator.value_estimate(data, policy_log_prob=log_pi) - value

    def _weight(self, tensordict: TensorDictBase, like: Tensor) -> Tensor:
        """``min(1, pi / mu)``, the share of a correction that a critic of states takes."""
        log_pi, log_mu = self._log_probs(tensordict)
        return spread((log_pi - log_mu).clamp(max=0).exp(), like)

    def _computed(self, tensordict: TensorDictBase, key: NestedKey) -> Tensor:
        value = tensordict.get(key, None)
        if value is None:
            raise KeyError(
                f"{key!r} is missing: pass what compute_advantage returned; the tensordict "
                f"has {sorted(map(str, tensordict.keys(True)))}."
            )
        return value

    def _change(
        self, tensordict: TensorDictBase, log_prob: Tensor, advantage: Tensor, gamma: float
    ) -> Tensor:
        log_pi, log_mu = self._log_probs(tensordict)
        mask = self._mask(log_prob, tensordict)
        return surrogate_change(log_prob, log_pi, log_mu, advantage.squeeze(-1), gamma, mask=mask)

    def _regression(self, prediction: Tensor, key: NestedKey, tensordict: TensorDictBase) -> Tensor:
        target = self._computed(tensordict, key)
        hint = "compute_advantage writes it, or set_keys names another entry"
        check_shape(repr(key), target, prediction.shape, "that of the critic's output", hint=hint)
        loss = distance_loss(prediction, target, self.loss_function).squeeze(-1)
        return self._reduce_loss(loss, tensordict=tensordict, weights=None)


class ReturnSurrogateLoss(_SurrogateLoss):
    r"""Surrogate of the return, and the critic behind it.

    The objective of TRPO, CPO and TRC: how much the discounted return changes from the policy
    ``pi`` that advantages belong to, to one whose log-densities are given, see
    :func:`~torchrl_safe.objectives.functional.surrogate_change`.

    :meth:`compute_advantage` runs once on trajectories; the critic regresses on minibatches of
    its result (:meth:`forward`), and :meth:`objective` is an entry of a closure for
    :class:`~torchrl_safe.TrustRegionSafeOptimizer`.

    Args:
        value_network (TensorDictModule): writes ``"state_value"``, ``[*B, 1]``.

    Keyword Args:
        loss_function (str): ``"l2"``, ``"smooth_l1"`` or ``"l1"``. Defaults to ``"l2"``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Defaults to ``"mean"``.

    .. note::
        Data of the policy itself need ``"action_log_prob"``. With data of older policies,
        :meth:`compute_advantage` also needs the log-density of the stored action under the policy
        of now: advantages are then corrected as in Retrace.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP, ValueOperator
        >>> from torchrl_safe.objectives import ReturnSurrogateLoss
        >>> loss = ReturnSurrogateLoss(ValueOperator(MLP(3, 1, num_cells=[8])))
        >>> _ = loss.make_value_estimator(gamma=0.99, lmbda=0.97)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 10, 3),
        ...         "action_log_prob": torch.zeros(4, 10),
        ...         "next": {
        ...             "observation": torch.randn(4, 10, 3),
        ...             "reward": torch.rand(4, 10, 1),
        ...             "done": torch.zeros(4, 10, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     batch_size=[4, 10],
        ... )
        >>> data = loss.compute_advantage(data)
        >>> loss(data)["loss_value"].backward()
        >>> loss.objective(data, data["action_log_prob"])  # no change of policy, no change
        tensor(0.)
    """

    @dataclass
    class _AcceptedKeys:
        """Default values of all configurable tensordict keys.

        Attributes:
            log_prob (NestedKey): Log-density of the action under the policy that took it.
                Defaults to ``"action_log_prob"``.
            policy_log_prob (NestedKey): Under the policy that advantages belong to, an output of
                :meth:`compute_advantage`. Defaults to ``"policy_log_prob"``.
            reward (NestedKey): Under ``"next"``. Defaults to ``"reward"``.
            value (NestedKey): Output of the critic. Defaults to ``"state_value"``.
            advantage (NestedKey): Defaults to ``"advantage"``.
            value_target (NestedKey): Defaults to ``"value_target"``.
            done (NestedKey): Under ``"next"``: cuts the trace. Defaults to ``"done"``.
            terminated (NestedKey): Under ``"next"``: no reward follows. Defaults to
                ``"terminated"``.
        """

        log_prob: NestedKey = "action_log_prob"
        policy_log_prob: NestedKey = "policy_log_prob"
        reward: NestedKey = "reward"
        value: NestedKey = "state_value"
        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    value_network: TensorDictModule
    value_network_params: TensorDictParams
    target_value_network_params: TensorDictParams

    def __init__(
        self,
        value_network: TensorDictModule,
        *,
        loss_function: str = "l2",
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        check_regression(loss_function, reduction)
        super().__init__()
        self.convert_to_functional(value_network, "value_network", create_target_params=False)
        self.loss_function = loss_function
        self.reduction = reduction
        self.in_keys = self._regression_keys()
        self.out_keys = ["loss_value"]
        self.make_value_estimator()

    def _regression_keys(self) -> list[NestedKey]:
        return [*self.value_network.in_keys, self.tensor_keys.value_target]

    @torch.no_grad()
    def compute_advantage(
        self, tensordict: TensorDictBase, *, policy_log_prob: Tensor | None = None
    ) -> TensorDictBase:
        """Advantages and the critic's targets.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``.

        Keyword Args:
            policy_log_prob (Tensor, optional): log-density of the stored action under the policy
                of now, ``[*B, T]``, if another one took it.

        Returns:
            A shallow copy with ``"advantage"`` and ``"value_target"``, ``[*B, T, 1]``, and
            ``"policy_log_prob"``, ``[*B, T]``.
        """
        keys = self.tensor_keys
        out = self._scored(tensordict, policy_log_prob)
        steps = self._read_steps(tensordict, keys.reward, self._value_estimator)
        value, next_value = self._values("value_network", keys.value, tensordict, steps.mask)
        advantage = self._advantage(self._value_estimator, out, steps, value, next_value)
        out.set(keys.advantage, advantage)
        out.set(keys.value_target, value + self._weight(out, value) * advantage)
        return out

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of the critic.

        Args:
            tensordict (TensorDictBase): states with their ``"value_target"``, ``[*B]``.

        Returns:
            TensorDict of ``loss_value``.
        """
        keys = self.tensor_keys
        value = self._value("value_network", keys.value, tensordict)
        loss = self._regression(value, keys.value_target, tensordict)
        return TensorDict({"loss_value": loss}, loss.shape)

    def objective(self, tensordict: TensorDictBase, log_prob: Tensor) -> Tensor:
        """Change of the discounted return, 0 at the policy that the advantages belong to.

        Args:
            tensordict (TensorDictBase): what :meth:`compute_advantage` returned, or some of it,
                ``[*B]``.
            log_prob (Tensor): log-density of the stored actions under the new policy, ``[*B]``.

        Returns:
            The change, a scalar, in units of the discounted return, of a policy that is followed
            without end: where episodes terminate it is larger than it will be.

        Raises:
            KeyError: if there is no advantage in the data.
        """
        advantage = self._computed(tensordict, self.tensor_keys.advantage)
        return self._change(tensordict, log_prob, advantage, self.gamma)


class CVaRSurrogateLoss(CostLoss, _SurrogateLoss):
    r"""Surrogate of the CVaR of the discounted cost, and the critics behind it.

    The constraint of TRC (Kim and Oh, "TRC: Trust Region Conditional Value at Risk for Safe
    Reinforcement Learning", RA-L 2022), and at ``risk_level=1`` that of CPO (Achiam et al. 2017,
    https://arxiv.org/abs/1705.10528). With ``J_C`` and ``J_S`` the first two moments of the
    discounted cost sum,

    .. math::

        \Gamma(\pi') = J_C(\pi') + \frac{\phi(\Phi^{-1}(\alpha))}{\alpha}
            \sqrt{J_S(\pi') - J_C(\pi')^2} \le d

    where both moments follow a new policy by surrogates,
    :func:`~torchrl_safe.objectives.functional.surrogate_change`, of the mean at discount ``gamma``
    and of the variance at ``gamma ** 2``:

    .. math::

        \operatorname{Var}' - \operatorname{Var} \approx \frac{1}{1 - \gamma^2}
            E\left[(r - 1) (A_S - 2 J_C A_C)\right]

    **Around the mean.** TRC follows ``J_S`` by ``A_S`` alone and subtracts ``J_C ** 2``. That
    misses how a change of the cost to come multiplies with the cost already paid: the variance
    would fall by about ``J_C`` for every unit that the mean rises, and with it the CVaR.
    ``A_S - 2 J_C A_C`` is the advantage of the squared deviation from ``J_C``, in which the part
    of the mean cancels; its gradient is compared with finite differences of exact variances in
    the tests.

    **Units.** The cost is per step. Moments, ``Gamma`` and ``cost_limit`` are those of its
    *discounted sum*: a limit of ``c`` on the cost per step is ``cost_limit = c / (1 - gamma)``,
    a budget ``D`` per episode of ``T`` steps ``D / T / (1 - gamma)``, see
    :func:`~torchrl_safe.objectives.functional.discounted_cost_limit`. The gradient is in the same
    unit, so that the trust region sees how far a violation can be repaired.

    **Start.** Episodes start where the policy is: the moments are over the states that it visits,
    each counted once. Over those, ``J_C`` is the mean cost per step over ``1 - gamma``, which data
    measure without a critic.

    Args:
        cost_network (TensorDictModule): writes ``"cost_value"``, ``[*B, 1]``.
        variance_network (TensorDictModule): writes ``"cost_variance"``, ``[*B, 1]``,
            non-negative: end it with a softplus.

    Keyword Args:
        cost_limit (float): limit on the discounted cost sum, at least 0.
        risk_level (float): share of worst outcomes that the CVaR averages, in (0, 1]; 1 is the
            plain expectation. Defaults to 0.125.
        loss_function (str): ``"l2"``, ``"smooth_l1"`` or ``"l1"``. Defaults to ``"l2"``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Defaults to ``"mean"``.

    .. note::
        For several costs, make a loss for each, such as ``loss.set_keys(cost="collision_cost")``.
        Each keeps the copy of the data that its own :meth:`compute_advantage` returned, and their
        constraints are stacked.

    Raises:
        ValueError: if ``cost_limit`` is negative or not finite, ``risk_level`` is outside
            (0, 1], or another argument is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import MLP, ValueOperator
        >>> from torchrl_safe.objectives import CVaRSurrogateLoss
        >>> loss = CVaRSurrogateLoss(
        ...     ValueOperator(MLP(3, 1, num_cells=[8]), out_keys=["cost_value"]),
        ...     ValueOperator(
        ...         MLP(3, 1, num_cells=[8]).append(torch.nn.Softplus()), out_keys=["cost_variance"]
        ...     ),
        ...     cost_limit=2.5,
        ... )
        >>> _ = loss.make_value_estimator(gamma=0.99, lmbda=0.97)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 10, 3),
        ...         "action_log_prob": torch.zeros(4, 10),
        ...         "next": {
        ...             "observation": torch.randn(4, 10, 3),
        ...             "cost": torch.rand(4, 10, 1),
        ...             "done": torch.zeros(4, 10, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     batch_size=[4, 10],
        ... )
        >>> data = loss.compute_advantage(data)
        >>> sorted(loss(data).keys())
        ['loss_cost_value', 'loss_cost_variance']
        >>> measured = loss.measure(data)
        >>> log_prob = torch.zeros(4, 10, requires_grad=True)  # of the policy to be improved
        >>> loss.constraint(data, log_prob, measured).backward()  # Gamma - cost_limit
    """

    @dataclass
    class _AcceptedKeys:
        """Default values of all configurable tensordict keys.

        Attributes:
            log_prob (NestedKey): Log-density of the action under the policy that took it.
                Defaults to ``"action_log_prob"``.
            policy_log_prob (NestedKey): Under the policy that advantages belong to, an output of
                :meth:`compute_advantage`. Defaults to ``"policy_log_prob"``.
            cost (NestedKey): Cost of a step, under ``"next"``. Defaults to ``"cost"``.
            cost_value (NestedKey): Output of the critic of the mean. Defaults to ``"cost_value"``.
            cost_variance (NestedKey): Output of the critic of the variance.
                Defaults to ``"cost_variance"``.
            cost_advantage (NestedKey): Advantage of the mean. Defaults to ``"cost_advantage"``.
            square_advantage (NestedKey): Advantage of the second moment.
                Defaults to ``"square_advantage"``.
            cost_target (NestedKey): Defaults to ``"cost_target"``.
            variance_target (NestedKey): Defaults to ``"variance_target"``.
            done (NestedKey): Under ``"next"``: cuts the trace. Defaults to ``"done"``.
            terminated (NestedKey): Under ``"next"``: no cost follows. Defaults to ``"terminated"``.
        """

        log_prob: NestedKey = "action_log_prob"
        policy_log_prob: NestedKey = "policy_log_prob"
        cost: NestedKey = "cost"
        cost_value: NestedKey = "cost_value"
        cost_variance: NestedKey = "cost_variance"
        cost_advantage: NestedKey = "cost_advantage"
        square_advantage: NestedKey = "square_advantage"
        cost_target: NestedKey = "cost_target"
        variance_target: NestedKey = "variance_target"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    cost_network: TensorDictModule
    variance_network: TensorDictModule
    cost_network_params: TensorDictParams
    variance_network_params: TensorDictParams
    target_cost_network_params: TensorDictParams
    target_variance_network_params: TensorDictParams

    def __init__(
        self,
        cost_network: TensorDictModule,
        variance_network: TensorDictModule,
        *,
        cost_limit: float,
        risk_level: float = 0.125,
        loss_function: str = "l2",
        reduction: Literal["mean", "sum", "none"] = "mean",
    ) -> None:
        check_regression(loss_function, reduction)
        super().__init__()
        for name, network in (
            ("cost_network", cost_network),
            ("variance_network", variance_network),
        ):
            self.convert_to_functional(network, name, create_target_params=False)
        self._register_limit(cost_limit, risk_level)
        self.loss_function = loss_function
        self.reduction = reduction
        self.in_keys = self._regression_keys()
        self.out_keys = ["loss_cost_value", "loss_cost_variance"]
        self.make_value_estimator()

    def _regression_keys(self) -> list[NestedKey]:
        critics = [*self.cost_network.in_keys, *self.variance_network.in_keys]
        return [
            *dict.fromkeys(critics),
            self.tensor_keys.cost_target,
            self.tensor_keys.variance_target,
        ]

    def _make_estimators(self, gamma: float, lmbda: float) -> None:
        super()._make_estimators(gamma, lmbda)
        self._square_estimator = RetraceEstimator(gamma=gamma**2, lmbda=lmbda)

    @torch.no_grad()
    def compute_advantage(
        self, tensordict: TensorDictBase, *, policy_log_prob: Tensor | None = None
    ) -> TensorDictBase:
        r"""Advantages of both moments and the critics' targets.

        The variance :math:`V` obeys the recursion of the mean at discount ``gamma ** 2`` with the
        squared TD error for a reward. The second moment :math:`V_C^2 + V` is what it is
        compared with at the stored action, :math:`(c + \gamma V_C')^2 + \gamma^2 V'`.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``.

        Keyword Args:
            policy_log_prob (Tensor, optional): log-density of the stored action under the policy
                of now, ``[*B, T]``, if another one took it.

        Returns:
            A shallow copy with ``"cost_value"``, ``"cost_advantage"``, ``"square_advantage"``,
            ``"cost_target"`` and ``"variance_target"``, ``[*B, T, 1]``, and
            ``"policy_log_prob"``, ``[*B, T]``.
        """
        keys = self.tensor_keys
        out = self._scored(tensordict, policy_log_prob)
        steps = self._read_steps(tensordict, keys.cost, self._value_estimator)
        (mean, next_mean), (variance, next_variance) = (
            self._values(name, key, tensordict, steps.mask)
            for name, key in (
                ("cost_network", keys.cost_value),
                ("variance_network", keys.cost_variance),
            )
        )
        discount, _ = self._discount(tensordict, steps.reward, self._value_estimator)
        advantage = self._advantage(self._value_estimator, out, steps, mean, next_mean)

        def second_order(reward: Callable[..., Tensor]) -> Tensor:
            rewards = reward(discount, steps.reward, mean, next_mean, steps.terminated)
            return self._advantage(
                self._square_estimator, out, steps._replace(reward=rewards), variance, next_variance
            )

        weight = self._weight(out, mean)
        out.set(keys.cost_value, mean)
        out.set(keys.cost_advantage, advantage)
        out.set(keys.square_advantage, second_order(retrace_variance_reward))
        out.set(keys.cost_target, mean + weight * advantage)
        # Trace corrections can make a sampled target of a variance negative.
        target = variance + weight * second_order(squared_td_error)
        out.set(keys.variance_target, target.clamp(min=0))
        return out

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses of the two critics.

        Args:
            tensordict (TensorDictBase): states with their targets, ``[*B]``.

        Returns:
            TensorDict of ``loss_cost_value`` and ``loss_cost_variance``.
        """
        keys = self.tensor_keys
        mean = self._value("cost_network", keys.cost_value, tensordict)
        variance = self._value("variance_network", keys.cost_variance, tensordict)
        losses = {
            "loss_cost_value": self._regression(mean, keys.cost_target, tensordict),
            "loss_cost_variance": self._regression(variance, keys.variance_target, tensordict),
        }
        return TensorDict(losses, losses["loss_cost_value"].shape)

    @torch.no_grad()
    def measure(self, tensordict: TensorDictBase) -> CostMoments:
        r"""Where the cost of the policy stands that took the given steps, for :meth:`constraint`.

        The mean over the visited states is measured,
        :func:`~torchrl_safe.objectives.value.visited_value_estimate`: where nothing terminates, it
        is the mean cost per step over ``1 - gamma``. The variance is the critics',
        :math:`E[V] + Var[V_C]` over the visited states.

        Args:
            tensordict (TensorDictBase): steps of the current policy in the order of time,
                ``[*B, T]``, without n-step transitions.

        Returns:
            CostMoments: in units of the discounted cost sum, and in squared units.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if steps are sums of several.
        """
        keys = self.tensor_keys

        def next_value(tensordict: TensorDictBase) -> Tensor:
            return self._next_value("cost_network", keys.cost_value, tensordict)

        horizon, square_horizon = (
            self._measured_horizon(tensordict, keys.cost, estimator)
            for estimator in (self._value_estimator, self._square_estimator)
        )
        mean = self._measured_mean(tensordict, keys.cost, self._value_estimator, next_value)
        value = self._value("cost_network", keys.cost_value, tensordict).squeeze(-1)
        variance = self._value("variance_network", keys.cost_variance, tensordict).squeeze(-1)
        between = (value - self._mean(value, tensordict)).square()
        variance = self._mean(variance + between, tensordict)
        return CostMoments(mean, variance, horizon, square_horizon)

    def level(self, measured: CostMoments) -> Tensor:
        """The CVaR of the policy that was measured, a scalar in units of the discounted cost sum.

        Args:
            measured (CostMoments): what :meth:`measure` returned.
        """
        _check_moments(measured)
        return gaussian_cvar(measured.mean, _root(measured.variance), self.risk_level)

    def advantage(self, tensordict: TensorDictBase, measured: CostMoments) -> Tensor:
        r"""Advantage of the CVaR, for methods that put it beside that of the return.

        .. math::

            A_\Gamma = A_C + \frac{\phi(\Phi^{-1}(\alpha))}{\alpha}
                \frac{1 - \gamma}{1 - \gamma^2} \frac{A_S - 2 J_C A_C}{2 \sqrt{\operatorname{Var}}}

        The gradient of :meth:`constraint`, at the policy that was measured, is ``horizon`` times
        that of the mean of ratios times this.

        Args:
            tensordict (TensorDictBase): what :meth:`compute_advantage` returned, or some of it,
                ``[*B]``.
            measured (CostMoments): what :meth:`measure` returned for the policy that the advantages
                belong to.

        Returns:
            Advantages in units of the discounted cost sum, ``[*B]``.

        Raises:
            KeyError: if there are no advantages in the data.
            TypeError: if ``measured`` is something else.
        """
        _check_moments(measured)
        advantage = self._computed(tensordict, self.tensor_keys.cost_advantage).squeeze(-1)
        if self.risk_level == 1 or measured.variance <= _LEAST_VARIANCE:
            return advantage
        slope = cvar_factor(self.risk_level) / (2 * measured.variance.sqrt())
        slope = slope * measured.square_horizon / measured.horizon
        return advantage + slope * self._square_deviation(tensordict)

    def _square_deviation(self, tensordict: TensorDictBase) -> Tensor:
        """Advantage of the squared deviation from the mean, [*B]."""
        keys = self.tensor_keys
        mean, advantage, square = (
            self._computed(tensordict, key).squeeze(-1)
            for key in (keys.cost_value, keys.cost_advantage, keys.square_advantage)
        )
        return square - 2 * self._mean(mean, tensordict) * advantage

    def constraint(
        self,
        tensordict: TensorDictBase,
        log_prob: Tensor,
        measured: CostMoments,
        *,
        cost_limit: float | None = None,
    ) -> Tensor:
        """The constraint, ``Gamma - cost_limit``, feasible at or below 0.

        Args:
            tensordict (TensorDictBase): what :meth:`compute_advantage` returned, or some of it,
                ``[*B]``.
            log_prob (Tensor): log-density of the stored actions under the new policy, ``[*B]``.
            measured (CostMoments): what :meth:`measure` returned for the policy that the advantages
                belong to.

        Keyword Args:
            cost_limit (float, optional): the limit of now, of a schedule or of a
                :class:`~torchrl_safe.objectives.LimitController`. Defaults to the loss's.

        Returns:
            The constraint, a scalar, in units of the discounted cost sum.

        Raises:
            KeyError: if there are no advantages in the data.
            TypeError: if ``measured`` is something else.
            ValueError: if ``cost_limit`` is negative or not finite.
        """
        _check_moments(measured)
        limit = self._limit(cost_limit)
        advantage = self._computed(tensordict, self.tensor_keys.cost_advantage)
        change = self._change(tensordict, log_prob, advantage, 0.0)  # of the mean cost per step
        mean = measured.mean + measured.horizon * change
        if self.risk_level == 1:
            return mean - limit
        deviation = self._square_deviation(tensordict).unsqueeze(-1)
        deviation = self._change(tensordict, log_prob, deviation, 0.0) - change.square()
        variance = measured.variance + measured.square_horizon * deviation
        return gaussian_cvar(mean, _root(variance), self.risk_level) - limit


# The root has no slope at 0; a variance this small has no part in a CVaR.
_LEAST_VARIANCE = 1e-8


def _root(variance: Tensor) -> Tensor:
    return variance.clamp(min=_LEAST_VARIANCE).sqrt()


def _check_moments(measured: CostMoments) -> None:
    if not isinstance(measured, CostMoments):
        raise TypeError(
            f"measured must be what measure(...) returned, got {type(measured).__name__}."
        )
