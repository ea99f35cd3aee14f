"""The distribution of the discounted cost, as quantiles, and the constraint on its risk."""

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
from torchrl.objectives.utils import ValueEstimators
from torchrl.objectives.value import (
    TD0Estimator,
    TD1Estimator,
    TDLambdaEstimator,
    ValueEstimatorBase,
)

from torchrl_safe._checks import check_count, check_number, check_shape
from torchrl_safe.objectives.common import CriticCostLoss, Steps
from torchrl_safe.objectives.distribution import (
    calibration_scales,
    calibration_slope,
    cvar_distortion,
    draw_from_quantiles,
    quantile_loss,
    realised_risk,
    rescale_quantiles,
    spectral_risk,
    spectral_weights,
    stretch_quantiles,
)
from torchrl_safe.objectives.functional import check_regression
from torchrl_safe.objectives.value import (
    PolicyEvaluation,
    RetraceEstimator,
    distributional_retrace_estimate,
    sampled_lambda_return_estimate,
)
from torchrl_safe.objectives.value.utils import get_entry, get_time_dim, with_action

LEVELS = ("mean", "realised")


class QuantileCostLoss(CriticCostLoss):
    r"""A safety critic of the whole distribution of the discounted cost, and the constraint on it.

    One network predicts N quantiles of the discounted sum of costs that follows a state and an
    action. Mean, CVaR and any other spectral risk of it are weighted sums of them: no Gaussian is
    assumed, and no variance is bootstrapped. The constraint is ``E[risk] <= cost_limit``. It takes
    the place of :class:`~torchrl_safe.CVaRCostLoss`, method by method.

    The quantiles regress on samples
    (:func:`~torchrl_safe.objectives.distribution.quantile_loss`). By default these are **sums of
    real costs** up to the end of the data, where draws of the critic take over
    (:func:`~torchrl_safe.objectives.value.sampled_lambda_return_estimate` at ``lmbda=1``): give it
    long rows of the newest steps. ``"tdlambda"`` and ``"td0"`` ask the critic earlier, and
    ``"retrace"`` corrects for another policy
    (:func:`~torchrl_safe.objectives.value.distributional_retrace_estimate`): for short slices of a
    replay buffer.

    A critic's tail is right for the outcomes that it has learned, and too light for others.
    :meth:`recalibrate` measures by how much on steps that a network has not learned from, and
    rescales all that is predicted.

    **Units.** The cost is per step. Quantiles, risk and ``cost_limit`` are *discounted sums* of it,
    see :func:`~torchrl_safe.objectives.functional.discounted_cost_limit`.

    Args:
        actor_network (ProbabilisticTensorDictSequential): stochastic actor.
        cost_network (TensorDictModule or list of them): writes ``"cost_quantiles"``, ``[*B, N]``,
            in any order.

    Keyword Args:
        cost_limit (float): limit on the discounted cost sum, at least 0.
        risk_level (float): share of worst outcomes that the CVaR averages, in (0, 1]; 1 is the
            plain expectation. Defaults to 0.125.
        distortion (callable, optional): another spectral risk in the CVaR's place, without
            ``risk_level``, see :func:`~torchrl_safe.objectives.distribution.spectral_weights`.
        level (str): what :meth:`on_policy_cvar` measures. ``"mean"``: the mean cost is measured,
            the tail's excess over it is the critic's. ``"realised"``: the tail is measured, too.
            Defaults to ``"mean"``.
        num_cost_nets (int): number of networks; their quantiles are averaged. One network is the
            one that was given, those of a list keep their weights, and copies of one network have
            weights drawn anew. Defaults to 1.
        pessimism (float): standard deviations between the networks that their mean risk is raised
            by, at least 0. Defaults to 0.
        num_samples (int): draws of the critic per cut, K. Defaults to 8.
        kappa (float): where the regression's loss turns from a square into a line, in units of the
            discounted cost. Defaults to 0, which has no bias.
        delay_cost (bool): use target networks for the targets. Defaults to ``False``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Defaults to ``"mean"``.
        deactivate_vmap (bool): loop over the networks in place of vmap.
        use_prioritized_weights (bool or "auto"): weigh samples by ``"priority_weight"``.

    .. note::
        If ``"cost_target"`` is in the input, the critic regresses on it in place of computing
        targets, with weights ``"target_weight"`` if they are there, too: :meth:`compute_target` can
        be run once on whole trajectories, and minibatches of single transitions drawn from them.

    Raises:
        ValueError: if ``cost_limit`` is negative or not finite, ``risk_level`` is outside
            (0, 1], or another argument is out of its range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.modules import MLP, ValueOperator
        >>> from torchrl_safe import GMMTanhPolicy
        >>> from torchrl_safe.objectives import QuantileCostLoss
        >>> spec = Bounded(-1, 1, (2,))
        >>> actor = GMMTanhPolicy(MLP(3, 5, num_cells=[8]), spec, num_components=1)
        >>> critic = ValueOperator(
        ...     MLP(3 + 2, 32, num_cells=[8]),
        ...     in_keys=["observation", "action"],
        ...     out_keys=["cost_quantiles"],
        ... )
        >>> loss = QuantileCostLoss(actor, critic, cost_limit=2.5)
        >>> _ = loss.make_value_estimator(gamma=0.99)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 10, 3),
        ...         "action": spec.rand((4, 10)),
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
        ['cost_std', 'cost_value', 'loss_cost_quantiles']
        >>> noise = actor.get_dist(data).draw_noise()
        >>> measured = loss.measure(data, actor.get_dist(data).rsample(noise=noise))
        >>> action = actor.get_dist(data).rsample(noise=noise)  # of the policy to be improved
        >>> loss.constraint(data, action, measured).backward()
    """

    @dataclass
    class _AcceptedKeys(CriticCostLoss._AcceptedKeys):
        """Keys of every loss of a cost with critics of actions, and those of this one.

        Attributes:
            cost_quantiles (NestedKey): Output of the critic. Defaults to ``"cost_quantiles"``.
            target_weight (NestedKey): Weights of the samples under ``cost_target``, used if
                present. Defaults to ``"target_weight"``.
            learned_by (NestedKey): Which of the E networks learn from a step, ``[*B, E]`` bool,
                used if present. Defaults to ``"learned_by"``.
        """

        cost_quantiles: NestedKey = "cost_quantiles"
        target_weight: NestedKey = "target_weight"
        learned_by: NestedKey = "learned_by"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.TD1

    cost_network: TensorDictModule
    cost_network_params: TensorDictParams
    target_cost_network_params: TensorDictParams
    scales: Tensor
    stretch: Tensor

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        cost_network: TensorDictModule | list[TensorDictModule],
        *,
        cost_limit: float,
        risk_level: float = 0.125,
        distortion: Callable[[Tensor], Tensor] | None = None,
        level: Literal["mean", "realised"] = "mean",
        num_cost_nets: int = 1,
        pessimism: float = 0.0,
        num_samples: int = 8,
        kappa: float = 0.0,
        delay_cost: bool = False,
        reduction: Literal["mean", "sum", "none"] = "mean",
        deactivate_vmap: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
    ) -> None:
        check_regression("l1", reduction)
        check_count("num_samples", num_samples)
        check_number("kappa", kappa, least=0)
        check_number("pessimism", pessimism, least=0)
        if level not in LEVELS:
            raise ValueError(f"level must be one of {', '.join(map(repr, LEVELS))}, got {level!r}.")
        if pessimism > 0 and num_cost_nets == 1:
            raise ValueError(
                f"pessimism={pessimism} needs networks that can differ, num_cost_nets of at least "
                "2, got 1."
            )
        if distortion is not None:
            spectral_weights(16, distortion)
        super().__init__(
            actor_network,
            {"cost_network": cost_network},
            num_cost_nets=num_cost_nets,
            cost_limit=cost_limit,
            risk_level=risk_level,
            delay_cost=delay_cost,
            reduction=reduction,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
        )
        self.register_buffer("scales", torch.ones(2, device=self._default_device))
        self.register_buffer("stretch", torch.tensor([0.0, 1.0], device=self._default_device))
        self.out_keys = ["loss_cost_quantiles", "cost_value", "cost_std"]
        self.distortion = distortion
        self.level = level
        self.pessimism = pessimism
        self.num_samples = num_samples
        self.kappa = kappa

    def make_value_estimator(
        self,
        value_type: ValueEstimators | str | type[ValueEstimatorBase] | None = None,
        **hyperparams: Any,
    ) -> QuantileCostLoss:
        """Choose the targets.

        The estimator's discount and trace decay are those of the distribution's target.

        Args:
            value_type (ValueEstimators, str or class, optional): as a member, by name or as a
                class. TD(1), the default: sums of real costs. TD(lambda): samples go on with
                probability ``lmbda``. TD(0): one step. Retrace: weighted samples for data of
                another policy.
            **hyperparams: ``gamma``, the discount of the cost, and ``lmbda`` of those that have it.

        Returns:
            The loss itself.

        Raises:
            ValueError: for another ``value_type``, or if ``gamma`` is outside [0, 1) or ``lmbda``
                outside [0, 1].
        """
        gamma = hyperparams.pop("gamma", 0.99)
        estimator, kind = self._build_estimator(value_type, gamma, **hyperparams)
        known = (RetraceEstimator, TDLambdaEstimator, TD0Estimator, TD1Estimator)
        if not isinstance(estimator, known):
            raise ValueError(
                "value_type must be TD(0), TD(1), TD(lambda) or Retrace, which have a target "
                f"distribution, got {value_type!r}."
            )
        self._value_estimator, self.value_type = estimator, kind
        self._forward_value_estimator_keys()
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Loss of the critic.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``, or transitions ``[*B]`` that
                hold their targets.

        Returns:
            TensorDict of ``loss_cost_quantiles``, and the detached means ``cost_value`` and
            ``cost_std`` of mean and standard deviation of what is predicted.
        """
        weights = self._maybe_get_priority_weight(tensordict)
        quantiles = self._predict(tensordict, self.cost_network_params)
        samples, sample_weights = self._targets(tensordict, quantiles[0])
        loss = quantile_loss(
            quantiles,
            samples.expand(len(quantiles), *samples.shape),
            sample_weights.expand(len(quantiles), *samples.shape),
            kappa=self.kappa,
        )
        learned_by = self._learned_by(tensordict, quantiles)
        loss = (loss if learned_by is None else loss * learned_by).sum(0)
        mean, std = _moments(self._judged(quantiles.detach()))
        reduction = "none" if self.reduction == "none" else "mean"
        out = {
            "loss_cost_quantiles": self._reduce_loss(loss, tensordict=tensordict, weights=weights),
            "cost_value": self._reduce_loss(mean, tensordict=tensordict, reduction=reduction),
            "cost_std": self._reduce_loss(std, tensordict=tensordict, reduction=reduction),
        }
        td_out = TensorDict(out, tensordict.batch_size if self.reduction == "none" else [])
        self._clear_weakrefs(
            tensordict,
            td_out,
            "actor_network_params",
            "cost_network_params",
            "target_actor_network_params",
            "target_cost_network_params",
        )
        return td_out

    @torch.no_grad()
    def compute_target(
        self, tensordict: TensorDictBase, *, policy: PolicyEvaluation | None = None
    ) -> tuple[Tensor, Tensor]:
        """Samples of the target distribution, and their weights.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``.

        Keyword Args:
            policy (PolicyEvaluation, optional): what
                :func:`~torchrl_safe.objectives.value.evaluate_policy` returned for the tensordict
                and the policy of now. Spares evaluating the policy here; sums of real costs
                evaluate it at their cuts alone.

        Returns:
            Samples and weights without gradient, ``[*B, T, M]`` each, of sum 1: ``M = K``, the
            draws of the critic, or ``2 T K`` of Retrace.
        """
        estimator = self.value_estimator
        steps = self._read_steps(tensordict, self.tensor_keys.cost, estimator)
        discount, _ = self._discount(tensordict, steps.reward, estimator)
        next_action = None if policy is None else policy.next_action
        if not isinstance(estimator, RetraceEstimator):
            samples = self._sums(tensordict, steps, discount, _decay(estimator), next_action)
            return samples, torch.full_like(samples, 1 / samples.shape[-1])
        quantiles = _average(self._predict(tensordict, self.target_cost_network_params))
        return distributional_retrace_estimate(
            discount,
            _decay(estimator),
            *self._log_probs(tensordict, policy, steps.reward),
            draw_from_quantiles(quantiles, self.num_samples).masked_fill(~steps.mask, 0),
            self._draw_next(tensordict, steps, torch.ones_like(steps.done), next_action),
            *steps[:3],
            time_dim=self._time_dim(tensordict),
        )

    @torch.no_grad()
    def recalibrate(
        self, tensordict: TensorDictBase, *, rate: float = 1.0, stretch: bool = False
    ) -> TensorDict:
        """Measure how wrong predictions are where networks have not learned, and rescale them.

        The steps must say which networks learn from them, under ``"learned_by"``: those that do
        not are asked. What follows is in :attr:`scales`, of mean and spread, which is part of
        ``state_dict`` (:func:`~torchrl_safe.objectives.distribution.calibration_scales`). Targets
        are not rescaled: they are made where the critic has learned.

        Args:
            tensordict (TensorDictBase): transitions ``[B]`` with their ``"cost_target"``, equally
                weighted samples, as of sums of real costs.

        Keyword Args:
            rate (float): how far the scales move to what was measured, in (0, 1]. Defaults to 1.
            stretch (bool): measure, too, whether good states are judged too high and bad ones too
                low, or the other way round, and set :attr:`stretch` accordingly
                (:func:`~torchrl_safe.objectives.distribution.calibration_slope`). It takes the
                outcomes of hundreds of episodes to tell. Defaults to ``False``.

        Returns:
            TensorDict of scalars: ``predicted_mean``, ``realised_mean``, ``predicted_risk`` and
            ``realised_risk`` of these steps, predictions with the scales as they were before. If
            all networks learn from all steps, nothing is measured, and it is empty. Where one of
            them is not finite, the scales stay.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if an entry has another shape, or ``rate`` is outside (0, 1].
        """
        check_number("rate", rate, positive=True, most=1)
        keys = self.tensor_keys
        sums = get_entry(tensordict, keys.cost_target, "the sums that followed, [B, K]")
        get_entry(tensordict, keys.learned_by, "which networks learn from a step, [B, E]")
        quantiles = self._predict(tensordict, self.cost_network_params).sort(-1).values
        learned_by = self._learned_by(tensordict, quantiles)
        assert learned_by is not None
        asked = ~learned_by.bool()
        some = asked.any(0)
        if not some.any():
            return TensorDict()
        share = asked / asked.sum(0).clamp(min=1)
        raw = (quantiles * share.unsqueeze(-1)).sum(0)[some]
        sums = sums[some].to(raw)
        weights = self._weights(raw)
        predicted = self._rescaled(raw)
        report = TensorDict(
            predicted_mean=predicted.mean(),
            realised_mean=sums.mean(),
            predicted_risk=spectral_risk(predicted, weights).mean(),
            realised_risk=realised_risk(sums, predicted, weights).mean(),
        )
        if all(value.isfinite() for value in report.values()):
            if stretch:
                self.stretch.copy_(torch.tensor(calibration_slope(raw, sums, weights)))
            stretched = stretch_quantiles(raw, *self.stretch)
            measured = torch.tensor(calibration_scales(stretched, sums, weights)).to(self.scales)
            self.scales.lerp_(measured, rate)
        return report

    def predict(self, tensordict: TensorDictBase, action: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and standard deviation of the predicted distribution.

        Gradients reach ``action``, not the critic.

        Args:
            tensordict (TensorDictBase): holds the critic's inputs but the action, ``[*B]``.
            action (Tensor): ``[*B, D]``.

        Returns:
            Mean and standard deviation, in units of the discounted cost sum, ``[*B]`` each.
        """
        return _moments(self.quantiles(tensordict, action))

    def quantiles(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Predicted quantiles of the discounted cost, sorted, and averaged over the networks.

        Gradients reach ``action``, not the critic.

        Args:
            tensordict (TensorDictBase): holds the critic's inputs but the action, ``[*B]``.
            action (Tensor): ``[*B, D]``.

        Returns:
            The quantiles, in units of the discounted cost sum, ``[*B, N]``.
        """
        return self._judged(self._predict_at(tensordict, action))

    def cvar(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """CVaR of the discounted cost, or the spectral risk in its place, with the pessimism.

        Gradients reach ``action``, not the critic.

        Args:
            tensordict (TensorDictBase): holds the critic's inputs but the action, ``[*B]``.
            action (Tensor): ``[*B, D]``.

        Returns:
            The risk, in units of the discounted cost sum, ``[*B]``.
        """
        return self._risk(self._predict_at(tensordict, action))

    @torch.no_grad()
    def on_policy_cvar(self, tensordict: TensorDictBase) -> Tensor:
        r"""Mean CVaR of the policy that took the given steps, from the costs it really met.

        With ``level="mean"`` the mean cost of the visited states is measured
        (:func:`~torchrl_safe.objectives.value.visited_value_estimate`), and the tail's excess over
        it is the critic's. With ``level="realised"`` it is :meth:`realised_cvar`.

        Args:
            tensordict (TensorDictBase): steps of the current policy in the order of time,
                ``[*B, T]``, without n-step transitions.

        Returns:
            The mean CVaR, a scalar without gradient, in units of the discounted cost sum.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if steps are sums of several.
        """
        if self.level == "realised":
            return self.realised_cvar(tensordict)

        def next_mean(tensordict: TensorDictBase) -> Tensor:
            return self._predict_next(self._following(tensordict), None).mean(-1, keepdim=True)

        mean = self._measured_mean(
            tensordict, self.tensor_keys.cost, self.value_estimator, next_mean
        )
        quantiles = self._predict(tensordict, self.cost_network_params)
        excess = self._risk(quantiles) - self._judged(quantiles).mean(-1)
        return mean.to(excess) + self._mean(excess, tensordict)

    @torch.no_grad()
    def realised_cvar(self, tensordict: TensorDictBase) -> Tensor:
        """Mean CVaR of the discounted sums of cost that really followed the given steps.

        What lies beyond the data is drawn from the critic, and so are the thresholds that the tail
        is measured at (:func:`~torchrl_safe.objectives.distribution.realised_risk`): wrong ones
        raise the level, and cannot hide cost. After T steps the critic's share is ``gamma ** T``,
        so rows should be long.

        Args:
            tensordict (TensorDictBase): steps of the current policy in the order of time,
                ``[*B, T]``, without n-step transitions.

        Returns:
            The mean CVaR, or other spectral risk, a scalar in units of the discounted cost sum.

        Raises:
            KeyError: if an entry is missing.
            ValueError: if steps are sums of several.
        """
        estimator = self.value_estimator
        self._check_single_steps(tensordict, estimator)
        steps = self._read_steps(tensordict, self.tensor_keys.cost, estimator)
        sums = self._sums(tensordict, steps, estimator.gamma, 1.0, None)
        quantiles = self._judged(self._predict(tensordict, self.cost_network_params))
        risk = realised_risk(sums, quantiles, self._weights(quantiles))
        return self._mean(risk, tensordict)

    def _targets(self, tensordict: TensorDictBase, quantiles: Tensor) -> tuple[Tensor, Tensor]:
        """Samples and weights, ``[*B, M]``: those in the data, or computed."""
        keys = self.tensor_keys
        samples = tensordict.get(keys.cost_target, None)
        if samples is None:
            return self.compute_target(tensordict)
        weights = tensordict.get(keys.target_weight, None)
        if weights is None:
            weights = torch.full_like(samples, 1 / samples.shape[-1])
        if samples.ndim != quantiles.ndim or samples.shape[:-1] != quantiles.shape[:-1]:
            raise ValueError(
                f"{keys.cost_target!r} must be samples for each of the critic's predictions, "
                f"[{', '.join(map(str, quantiles.shape[:-1]))}, M], got {tuple(samples.shape)}: "
                "compute_target returns them, or set_keys names another entry."
            )
        origin = f"that of {keys.cost_target!r}"
        check_shape(repr(keys.target_weight), weights, samples.shape, origin)
        return samples, weights

    def _sums(
        self,
        tensordict: TensorDictBase,
        steps: Steps,
        discount: float | Tensor,
        decay: float,
        next_action: Tensor | None,
    ) -> Tensor:
        """Samples of the return of every step, ``[*B, T, K]``."""
        time_dim = self._time_dim(tensordict)
        asked = torch.ones_like(steps.done)
        if decay == 1:  # most steps of long rows go on: nothing is asked of the critic there
            asked = steps.done.clone()
            asked.select(time_dim, -1).fill_(True)
            asked &= steps.mask & ~steps.terminated
        return sampled_lambda_return_estimate(
            discount,
            decay,
            self._draw_next(tensordict, steps, asked, next_action),
            *steps[:3],
            time_dim=time_dim,
        )

    def _draw_next(
        self, tensordict: TensorDictBase, steps: Steps, asked: Tensor, action: Tensor | None
    ) -> Tensor:
        """Draws of the target critic at next states, ``[*B, T, K]``; zeros where none are asked."""
        samples = steps.reward.new_zeros((*steps.reward.shape[:-1], self.num_samples))
        where = asked.flatten(tensordict.ndim).any(-1)
        if where.any():
            following = self._following(tensordict)[where]
            quantiles = self._predict_next(following, None if action is None else action[where])
            samples[where] = draw_from_quantiles(quantiles, self.num_samples).to(samples)
        return samples.masked_fill(~steps.mask, 0)

    def _predict_next(self, following: TensorDictBase, action: Tensor | None) -> Tensor:
        """Target critic at next states and actions of the policy there, ``[*B, N]``."""
        inputs = self._next_inputs(following, action)
        return _average(self._predict(inputs, self.target_cost_network_params))

    def _predict_at(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        inputs = with_action(tensordict, self.tensor_keys.action, action, *self._critics)
        return self._predict(inputs, self.cost_network_params.detach())

    def _predict(self, inputs: TensorDictBase, params: TensorDictBase) -> Tensor:
        """Quantiles of every network, ``[E, *B, N]``."""
        (predict,) = self._ensembles
        return predict(inputs, params, self.tensor_keys.cost_quantiles)

    def _weights(self, quantiles: Tensor) -> Tensor:
        distortion = self.distortion or partial(cvar_distortion, risk_level=self.risk_level)
        return spectral_weights(quantiles.shape[-1], distortion)

    def _risk(self, quantiles: Tensor) -> Tensor:
        """Risk of the quantiles of every network ``[E, *B, N]``, with the pessimism, ``[*B]``."""
        risk = spectral_risk(self._rescaled(quantiles), self._weights(quantiles))
        return risk.mean(0) + self.pessimism * _std(risk, 0)

    def _judged(self, quantiles: Tensor) -> Tensor:
        """What the networks ``[E, *B, N]`` say together, rescaled, ``[*B, N]``."""
        return self._rescaled(_average(quantiles))

    def _rescaled(self, quantiles: Tensor) -> Tensor:
        return rescale_quantiles(stretch_quantiles(quantiles, *self.stretch), *self.scales)

    def _learned_by(self, tensordict: TensorDictBase, quantiles: Tensor) -> Tensor | None:
        """Whether each network learns from a step, as numbers ``[E, *B]``, if the data say so."""
        key = self.tensor_keys.learned_by
        learned_by = tensordict.get(key, None)
        if learned_by is None:
            return None
        check_shape(repr(key), learned_by, (*quantiles.shape[1:-1], len(quantiles)), "[*B, E]")
        return learned_by.movedim(-1, 0).to(quantiles)

    def _time_dim(self, tensordict: TensorDictBase) -> int:
        return get_time_dim(tensordict, getattr(self.value_estimator, "time_dim", None))


def _decay(estimator: ValueEstimatorBase) -> float:
    """Probability to go on, or trace decay."""
    if isinstance(estimator, TD0Estimator):
        return 0.0
    return 1.0 if isinstance(estimator, TD1Estimator) else float(estimator.lmbda)


def _average(quantiles: Tensor) -> Tensor:
    """Sorted quantiles, averaged over networks."""
    return quantiles.sort(-1).values.mean(0)


def _moments(quantiles: Tensor) -> tuple[Tensor, Tensor]:
    return quantiles.mean(-1), _std(quantiles, -1)


def _std(tensor: Tensor, dim: int) -> Tensor:
    """Standard deviation of all there is, with a gradient of 0 where it is 0."""
    deviation = tensor - tensor.mean(dim, keepdim=True)
    return torch.linalg.vector_norm(deviation, dim=dim) / tensor.shape[dim] ** 0.5
