"""CVaR of the discounted cost: its two critics, and the constraint on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import distance_loss
from torchrl.objectives.utils import ValueEstimators
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe._checks import check_shape
from torchrl_safe.objectives.common import CriticCostLoss
from torchrl_safe.objectives.functional import check_regression, gaussian_cvar
from torchrl_safe.objectives.value import (
    PolicyEvaluation,
    RetraceEstimator,
    retrace_variance_reward,
    squared_td_error,
)
from torchrl_safe.objectives.value.utils import next_key, with_action

VARIANCE_REWARDS = {"td_error": squared_td_error, "second_moment": retrace_variance_reward}


class CVaRCostLoss(CriticCostLoss):
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
        cost_network (TensorDictModule or list of them): writes ``"cost_value"``, ``[*B, 1]``.
        std_network (TensorDictModule or list of them): writes ``"cost_std"``, ``[*B, 1]``,
            non-negative: end it with a softplus. The two may share layers.

    Keyword Args:
        cost_limit (float): limit on the discounted cost sum, at least 0.
        risk_level (float): share of worst outcomes that the CVaR averages, in (0, 1]; 1 is the
            plain expectation. Defaults to 0.125.
        num_cost_nets (int): networks of each kind; predictions are averaged. One network is the
            one that was given, those of a list keep their weights, and copies of one network have
            weights drawn anew. Defaults to 1.
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
        >>> noise = actor.get_dist(data).draw_noise()
        >>> measured = loss.measure(data, actor.get_dist(data).rsample(noise=noise))
        >>> action = actor.get_dist(data).rsample(noise=noise)  # of the policy to be improved
        >>> loss.constraint(data, action, measured).backward()
    """

    @dataclass
    class _AcceptedKeys(CriticCostLoss._AcceptedKeys):
        """Keys of every loss of a cost with critics of actions, and those of this one.

        Attributes:
            cost_value (NestedKey): Output of the mean critic. Defaults to ``"cost_value"``.
            cost_std (NestedKey): Output of the standard-deviation critic.
                Defaults to ``"cost_std"``.
            std_target (NestedKey): Target of the standard-deviation critic, used if present, as
                ``cost_target`` is that of the mean critic. Defaults to ``"std_target"``.
        """

        cost_value: NestedKey = "cost_value"
        cost_std: NestedKey = "cost_std"
        std_target: NestedKey = "std_target"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = RetraceEstimator

    cost_network: TensorDictModule
    std_network: TensorDictModule
    cost_network_params: TensorDictParams
    std_network_params: TensorDictParams
    target_cost_network_params: TensorDictParams
    target_std_network_params: TensorDictParams

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        cost_network: TensorDictModule | list[TensorDictModule],
        std_network: TensorDictModule | list[TensorDictModule],
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
        check_regression(loss_function, reduction)
        if variance_reward not in VARIANCE_REWARDS:
            raise ValueError(
                f"variance_reward must be one of {sorted(VARIANCE_REWARDS)}, "
                f"got {variance_reward!r}."
            )
        super().__init__(
            actor_network,
            {"cost_network": cost_network, "std_network": std_network},
            num_cost_nets=num_cost_nets,
            cost_limit=cost_limit,
            risk_level=risk_level,
            delay_cost=delay_cost,
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
        )
        self.out_keys = ["loss_cost_value", "loss_cost_std", "cost_value", "cost_std"]
        self.variance_reward = variance_reward
        self.loss_function = loss_function
        self._variance_estimator: Any = None

    def make_value_estimator(
        self,
        value_type: ValueEstimators | str | type[ValueEstimatorBase] | None = None,
        **hyperparams: Any,
    ) -> CVaRCostLoss:
        """Choose the estimator of both targets.

        The variance obeys the recursion of the mean at discount ``gamma ** 2`` (18), so that
        two estimators of one kind are made.

        Args:
            value_type (ValueEstimators, str or class, optional): TD(0), TD(1), TD(lambda) or
                Retrace, as a member, by name (``"td0"``) or as a class.
                Defaults to :class:`~torchrl_safe.RetraceEstimator`.
            **hyperparams: of the estimator; ``gamma`` is the discount of the cost.

        Returns:
            The loss itself.

        Raises:
            ValueError: for another ``value_type``, an instance included, if ``gamma`` is outside
                [0, 1), or for ``average_rewards`` and ``group_key``.
        """
        if isinstance(value_type, ValueEstimatorBase):
            raise ValueError(
                "value_type must be a name, a member of ValueEstimators or a class, got an "
                f"instance of {type(value_type).__name__}: it has one discount, and the variance "
                "needs the square of the mean's."
            )
        gamma = hyperparams.pop("gamma", 0.99)
        estimator, kind = self._build_estimator(value_type, gamma, **hyperparams)
        self._variance_estimator, _ = self._build_estimator(value_type, gamma**2, **hyperparams)
        self._value_estimator, self.value_type = estimator, kind
        self._forward_value_estimator_keys()
        return self

    def _estimators(self) -> list[ValueEstimatorBase]:
        estimators = (self._value_estimator, self._variance_estimator)
        return [estimator for estimator in estimators if estimator is not None]

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
        weights = self._maybe_get_priority_weight(tensordict)
        mean, std = self._predict(tensordict, self.cost_network_params, self.std_network_params)
        mean_target, std_target = self._targets(tensordict, mean[0])
        out = {}
        for name, prediction, target in (("value", mean, mean_target), ("std", std, std_target)):
            loss = distance_loss(prediction, target.expand_as(prediction), self.loss_function).sum(
                0
            )
            out[f"loss_cost_{name}"] = self._reduce_loss(
                loss, tensordict=tensordict, weights=weights
            )
            out[f"cost_{name}"] = self._reduce_loss(
                prediction.detach().mean(0),
                tensordict=tensordict,
                reduction="none" if self.reduction == "none" else "mean",
            )
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
        critics = (self.target_cost_network_params, self.target_std_network_params)
        cost, done, terminated, mask = self._read_steps(tensordict, keys.cost, estimator)
        discount, steps = self._discount(tensordict, cost, estimator)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            values = (
                *(x.mean(0).unsqueeze(-1) for x in self._predict(tensordict, *critics)),
                *self._predict_next(tensordict, None if policy is None else policy.next_action),
            )
            mean, std, next_mean, next_std = (x.masked_fill(~mask, 0) for x in values)
            data = tensordict.select()
            data.set(next_key(keys.done), done)
            data.set(next_key(keys.terminated), terminated)
            if steps is not None:
                data.set(estimator_keys.steps_to_next_obs, steps)
            options = {}
            if isinstance(estimator, RetraceEstimator):
                log_pi, log_mu = self._log_probs(tensordict, policy, cost)
                data.set(keys.log_prob, log_mu)
                options["policy_log_prob"] = log_pi

            def estimate(
                estimator: ValueEstimatorBase, reward: Tensor, value: Tensor, next_value: Tensor
            ) -> Tensor:
                data.set(next_key(keys.cost), reward)
                data.set(action_value_key, value)
                data.set(next_key(estimator_keys.value), next_value)
                return estimator.value_estimate(data, **options)

            mean_target = estimate(estimator, cost, mean, next_mean)
            variance_reward = VARIANCE_REWARDS[self.variance_reward]
            reward = variance_reward(discount, cost, mean, next_mean, terminated)
            variance_target = estimate(
                self._variance_estimator, reward, std.square(), next_std.square()
            )
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
            with_action(tensordict, self.tensor_keys.action, action, *self._critics),
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

    @torch.no_grad()
    def on_policy_cvar(self, tensordict: TensorDictBase) -> Tensor:
        r"""Mean CVaR of the policy that took the given steps, from the costs it really met.

        The mean over the visited states of ``Q_C`` is measured,
        :func:`~torchrl_safe.objectives.value.visited_value_estimate`: where nothing terminates, it
        is the mean cost per step over ``1 - gamma``. Measured like this, the level follows the
        policy at once, where the critic has to learn it; the standard deviation is the critic's.

        Args:
            tensordict (TensorDictBase): steps of the current policy in the order of time,
                ``[*B, T]``, without n-step transitions.

        Returns:
            The mean CVaR, a scalar without gradient, in units of the discounted cost sum.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if steps are sums of several.
        """
        keys = self.tensor_keys
        mean = self._measured_mean(
            tensordict, keys.cost, self.value_estimator, lambda td: self._predict_next(td, None)[0]
        )
        _, predict_std = self._ensembles
        std = predict_std(tensordict, self.std_network_params, keys.cost_std)
        std = self._mean(std.squeeze(-1).mean(0), tensordict)
        return gaussian_cvar(mean.to(std), std, self.risk_level)

    def _targets(self, tensordict: TensorDictBase, prediction: Tensor) -> tuple[Tensor, Tensor]:
        """Targets of mean and deviation, ``[*B]``: those in the data, or computed."""
        keys = self.tensor_keys.cost_target, self.tensor_keys.std_target
        given = {key: tensordict.get(key, None) for key in keys}
        missing = [key for key, target in given.items() if target is None]
        if len(missing) == 2:
            mean, std = self.compute_target(tensordict)
            return mean.squeeze(-1), std.squeeze(-1)
        if missing:
            (found,) = given.keys() - missing
            raise KeyError(
                f"{missing[0]!r} is missing beside {found!r}: write both, as compute_target "
                "returns them, or neither. An entry of that name that is not this loss's needs "
                "another, set_keys(cost_target=...)."
            )
        shape = (*prediction.shape, 1)
        for key, target in given.items():
            hint = "compute_target returns it, or set_keys names another entry"
            check_shape(repr(key), target, shape, "that of the critics' output", hint=hint)
        return given[keys[0]].squeeze(-1), given[keys[1]].squeeze(-1)

    def _predict_next(
        self, tensordict: TensorDictBase, action: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Target critics at the next state and an action of the policy there, ``[*B, 1]`` each."""
        critics = (self.target_cost_network_params, self.target_std_network_params)
        inputs = self._next_inputs(self._following(tensordict), action)
        mean, std = self._predict(inputs, *critics)
        return mean.mean(0).unsqueeze(-1), std.mean(0).unsqueeze(-1)

    def _predict(
        self, inputs: TensorDictBase, cost_params: TensorDictBase, std_params: TensorDictBase
    ) -> tuple[Tensor, Tensor]:
        keys = self.tensor_keys
        predict_mean, predict_std = self._ensembles
        mean = predict_mean(inputs, cost_params, keys.cost_value)
        std = predict_std(inputs, std_params, keys.cost_std)
        return mean.squeeze(-1), std.squeeze(-1)
