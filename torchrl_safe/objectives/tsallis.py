"""Tsallis actor-critic as a member of TorchRL's SAC family."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
    set_composite_lp_aggregate,
)
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import rsample_and_log_prob, sample_and_log_prob
from torchrl.objectives import SACLoss, ValueEstimators, distance_loss
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe._checks import check_number, check_shape
from torchrl_safe.objectives.functional import (
    check_entropic_index,
    check_regression,
    q_logarithm,
    uniform_tsallis_entropy,
)
from torchrl_safe.objectives.utils import as_given, ensemble, make_estimator
from torchrl_safe.objectives.value import PolicyEvaluation, RetraceEstimator
from torchrl_safe.objectives.value.utils import get_entry, repair_next, with_action


class TsallisLoss(SACLoss):
    r"""Tsallis actor-critic (TAC) loss, equations (2)-(4) of SafeTAC.

    SAC with its log-probability replaced by a q-logarithm, which maximises Tsallis in place of
    Shannon entropy (Lee et al. 2020, https://arxiv.org/abs/1902.00137):

    .. math::

        \max_\pi \mathbb{E}\left[Q_q(s, a) - \alpha \ln_q \pi(a|s)\right], \qquad
        Q_q(s, a) = r + \gamma \left(Q_q(s', a') - \alpha \ln_q \pi(a'|s')\right).

    At ``entropic_index=1`` its losses and gradients are those of
    :class:`~torchrl.objectives.SACLoss`. The q-logarithm is that of the *joint* density of the
    squashed action, also of one with several parts
    (:class:`~tensordict.nn.CompositeDistribution`); bootstrapped actions are exact draws of the
    policy, also where its ``rsample`` is a relaxation.

    Args:
        actor_network (ProbabilisticTensorDictSequential): stochastic actor, of one action and one
            log-density.
        qvalue_network (TensorDictModule or list of them): state-action value. The networks of a
            list start with the weights they have.

    Keyword Args:
        entropic_index (float): ``q > 0``; 1 is Shannon entropy, larger values penalise
            improbable actions less and give sparser policies. It may be set later, at every step
            if need be, and is part of the state of the loss. Defaults to 1.2.
        num_qvalue_nets (int): number of Q-value networks. One is ``qvalue_network`` itself, with
            its weights and the layers that it shares. Several copies of a single network are drawn
            anew, apart from each other, as in :class:`~torchrl.objectives.SACLoss`. Defaults to 2.
        loss_function (str): ``"smooth_l1"``, ``"l2"`` or ``"l1"``. Defaults to ``"l2"``.
        alpha_init (float): initial entropy weight. Defaults to 1.0.
        min_alpha (float, optional): smallest entropy weight.
        max_alpha (float, optional): largest entropy weight.
        action_spec (TensorSpec, optional): needed for ``target_entropy="auto"`` if the actor
            has no spec.
        fixed_alpha (bool): keep the entropy weight at ``alpha_init``. Defaults to ``False``.
        target_entropy (float or "auto"): target of the *Tsallis* entropy. ``"auto"`` is the
            Tsallis entropy of the uniform density whose Shannon entropy is minus the number of
            action dimensions, which is SAC's own choice at ``entropic_index=1``; it follows the
            index where that is changed. A number stays.
        delay_actor (bool): use a target actor. Defaults to ``False``.
        delay_qvalue (bool): use target Q-value networks. Defaults to ``True``.
        separate_losses (bool): share no gradient between the terms. Defaults to ``False``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Defaults to ``"mean"``.
        skip_done_states (bool): do not run the actor on terminated states.
        deactivate_vmap (bool): loop over the Q-value networks in place of vmap.
        use_prioritized_weights (bool or "auto"): weigh samples by ``"priority_weight"``.
        scalar_output_mode (str, optional): see :class:`~torchrl.objectives.SACLoss`.

    .. note::
        If ``"qvalue_target"`` (``set_keys(qvalue_target=...)``) is in the input, the Q-value loss
        regresses on it in place of computing the target: :meth:`compute_target` can then be run
        once on whole trajectories, and minibatches of single transitions drawn from them. No
        value estimator writes under that name; ``"value_target"``, where they write theirs, is
        not read.

    .. note::
        Steps that a mask leaves out (``("collector", "mask")``, see
        :attr:`~torchrl.objectives.LossModule.loss_mask_key`) count in no loss and not in the
        entropy. :meth:`objective` and :meth:`compute_target` return a value for every step.

    Raises:
        ValueError: if ``entropic_index`` is not a positive finite number, another argument is
            out of its range, or copies of the critic would lose what it shares with the actor.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl.modules import MLP, ValueOperator
        >>> from torchrl.objectives import SoftUpdate
        >>> from torchrl_safe import GMMTanhPolicy, TsallisLoss
        >>> spec = Bounded(-1, 1, (2,))
        >>> actor = GMMTanhPolicy(MLP(3, 5, num_cells=[8]), spec, num_components=1)
        >>> qvalue = ValueOperator(MLP(3 + 2, 1, num_cells=[8]), in_keys=["observation", "action"])
        >>> loss = TsallisLoss(actor, qvalue, entropic_index=1.5)
        >>> _ = loss.make_value_estimator(gamma=0.99)
        >>> target_updater = SoftUpdate(loss, tau=0.005)
        >>> data = TensorDict(
        ...     {
        ...         "observation": torch.randn(4, 3),
        ...         "action": spec.rand((4,)),
        ...         "next": {
        ...             "observation": torch.randn(4, 3),
        ...             "reward": torch.randn(4, 1),
        ...             "done": torch.zeros(4, 1, dtype=torch.bool),
        ...             "terminated": torch.zeros(4, 1, dtype=torch.bool),
        ...         },
        ...     },
        ...     batch_size=[4],
        ... )
        >>> out = loss(data)
        >>> sorted(out.keys())
        ['alpha', 'entropy', 'loss_actor', 'loss_alpha', 'loss_qvalue']
        >>> out["loss_qvalue"].backward()
    """

    @dataclass
    class _AcceptedKeys(SACLoss._AcceptedKeys):
        """Keys of :class:`~torchrl.objectives.SACLoss`, and the precomputed target.

        Attributes:
            qvalue_target (NestedKey): Target of the Q-value, used if present.
                Defaults to ``"qvalue_target"``.
        """

        qvalue_target: NestedKey = "qvalue_target"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    SUPPORTED_VALUE_ESTIMATORS = (*SACLoss.SUPPORTED_VALUE_ESTIMATORS, "retrace")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule | list[TensorDictModule],
        *,
        entropic_index: float = 1.2,
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        alpha_init: float = 1.0,
        min_alpha: float | None = None,
        max_alpha: float | None = None,
        action_spec: TensorSpec | None = None,
        fixed_alpha: bool = False,
        target_entropy: Literal["auto"] | float = "auto",
        delay_actor: bool = False,
        delay_qvalue: bool = True,
        separate_losses: bool = False,
        reduction: Literal["mean", "sum", "none"] | None = None,
        skip_done_states: bool = False,
        deactivate_vmap: bool = False,
        use_prioritized_weights: bool | Literal["auto"] = "auto",
        scalar_output_mode: Literal["exclude", "non_tensor"] | None = None,
    ) -> None:
        check_entropic_index(entropic_index)
        check_regression(loss_function, reduction or "mean")
        check_number("alpha_init", alpha_init, positive=True)
        if min_alpha is not None:
            check_number("min_alpha", min_alpha, least=0)
        if max_alpha is not None:
            check_number("max_alpha", max_alpha, positive=True)
        if min_alpha is not None and max_alpha is not None and min_alpha > max_alpha:
            raise ValueError(
                f"min_alpha must be at most max_alpha={max_alpha}, got min_alpha={min_alpha}."
            )
        if target_entropy != "auto":
            check_number("target_entropy", target_entropy, instead="'auto' or ")
        if scalar_output_mode not in (None, "exclude", "non_tensor"):
            raise ValueError(
                "scalar_output_mode must be None, 'exclude' or 'non_tensor', got "
                f"{scalar_output_mode!r}."
            )
        keys = [getattr(actor_network, f"{kind}_keys", ()) for kind in ("dist_sample", "log_prob")]
        if any(len(names) != 1 for names in keys):
            raise ValueError(
                "actor_network must be a stochastic actor of one action and one log-density for "
                f"the whole of it, got dist_sample_keys={keys[0]} and log_prob_keys={keys[1]}. The "
                "parts of a composite action go under one key: out_keys=['action']."
            )
        # With separate losses, copies of one network borrow what is the actor's.
        borrows = separate_losses and not isinstance(qvalue_network, (list, tuple))
        qvalue_network, expand_dim = as_given(
            qvalue_network,
            num_qvalue_nets,
            names=("qvalue_network", "num_qvalue_nets"),
            others=() if borrows else actor_network.parameters(),
        )
        super().__init__(
            actor_network=actor_network,
            qvalue_network=qvalue_network,
            num_qvalue_nets=expand_dim,
            loss_function=loss_function,
            alpha_init=alpha_init,
            min_alpha=min_alpha,
            max_alpha=max_alpha,
            action_spec=action_spec,
            fixed_alpha=fixed_alpha,
            target_entropy=target_entropy,
            delay_actor=delay_actor,
            delay_qvalue=delay_qvalue,
            separate_losses=separate_losses,
            reduction=reduction,
            skip_done_states=skip_done_states,
            deactivate_vmap=deactivate_vmap,
            use_prioritized_weights=use_prioritized_weights,
            scalar_output_mode=scalar_output_mode,
        )
        self.num_qvalue_nets = num_qvalue_nets
        self._entropic_index = float(entropic_index)
        self._follows_index = target_entropy == "auto"
        self._shannon_entropy: float | None = None

    def _make_vmap(self) -> None:
        self._vmap_qnetworkN0 = ensemble(
            self.qvalue_network,
            randomness=self.vmap_randomness,
            deactivate_vmap=self.deactivate_vmap,
        )

    @property
    def entropic_index(self) -> float:
        """The entropic index; an automatic target entropy follows where it is set.

        Raises:
            ValueError: if it is set to what is not a positive finite number.
        """
        return self._entropic_index

    @entropic_index.setter
    def entropic_index(self, value: float) -> None:
        check_entropic_index(value)
        self._entropic_index = float(value)
        self._fill_target_entropy()

    @property
    def target_entropy(self) -> Tensor:
        """Target of the Tsallis entropy, a scalar buffer."""
        target = super().target_entropy
        if self._follows_index and self._shannon_entropy is None:
            # What SAC's property has just resolved "auto" to is a Shannon entropy.
            self._shannon_entropy = target.item()
            self._fill_target_entropy()
        return target

    def _fill_target_entropy(self) -> None:
        if self._shannon_entropy is not None:
            entropy = uniform_tsallis_entropy(self._shannon_entropy, self.entropic_index)
            self.target_entropy.fill_(entropy)

    def get_extra_state(self) -> Tensor:
        """The entropic index, a part of ``state_dict``."""
        return torch.tensor(self.entropic_index, dtype=torch.float64)

    def set_extra_state(self, state: Tensor) -> None:
        """Take over the entropic index of a ``state_dict``; an automatic target follows."""
        self.entropic_index = state.item()

    def make_value_estimator(
        self,
        value_type: ValueEstimators
        | str
        | type[ValueEstimatorBase]
        | ValueEstimatorBase
        | None = None,
        **hyperparams: Any,
    ) -> TsallisLoss:
        """Choose the estimator of the target.

        Args:
            value_type (ValueEstimators, str, class or instance, optional): TorchRL's TD(0), TD(1)
                or TD(lambda), or, on trajectories ``[*B, T]``, ``"retrace"``, by name in any case,
                by member or by class: :class:`~torchrl_safe.RetraceEstimator` is tied to the
                networks of the loss. An instance is taken as it is. Defaults to TD(0).
            **hyperparams: of the estimator, such as ``gamma`` and ``lmbda``.

        Returns:
            The loss itself.

        Raises:
            ValueError: if ``value_type`` is none of these, or a hyperparameter is out of its
                range.
        """
        value_type = self.default_value_estimator if value_type is None else value_type
        self._value_estimator, self.value_type = make_estimator(
            self,
            value_type,
            supported=self.SUPPORTED_VALUE_ESTIMATORS,
            **{"device": self._default_device, **hyperparams},
        )
        self._forward_value_estimator_keys()
        return self

    def _forward_value_estimator_keys(self, **kwargs: Any) -> None:
        super()._forward_value_estimator_keys(**kwargs)
        if isinstance(self._value_estimator, RetraceEstimator):
            self._value_estimator.set_keys(
                action=self.tensor_keys.action,
                sample_log_prob=self.tensor_keys.log_prob,
                state_action_value=self.tensor_keys.state_action_value,
            )

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Losses of policy, critics and entropy weight.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]`` or trajectories ``[*B, T]``. The
                priority of each step, ``"td_error"``, is written into it.

        Returns:
            TensorDict of ``loss_actor``, ``loss_qvalue`` and ``loss_alpha``, and detached of
            ``alpha`` and ``entropy``, the mean Tsallis entropy. Under ``reduction="none"`` see
            ``scalar_output_mode``.
        """
        loss_qvalue, qvalue_metadata = self.qvalue_v2_loss(tensordict)
        loss_actor, actor_metadata = self.actor_loss(tensordict)
        log_prob = actor_metadata["log_prob"]
        loss_alpha = self._reduce_loss(
            self.alpha_loss(log_prob),
            tensordict=tensordict,
            weights=self._maybe_get_priority_weight(tensordict),
        )
        tensordict.set(self.tensor_keys.priority, qvalue_metadata["td_error"])
        losses = {"loss_actor": loss_actor, "loss_qvalue": loss_qvalue, "loss_alpha": loss_alpha}
        scalars = {
            "alpha": self._alpha,
            "entropy": self._reduce_loss(-log_prob, tensordict=tensordict, reduction="mean"),
        }
        each = self.reduction == "none"
        out = TensorDict(losses, tensordict.batch_size if each else [])
        if not each:
            out.update(scalars)
        elif self.scalar_output_mode == "non_tensor":
            for name, value in scalars.items():
                out.set_non_tensor(name, value)
        self._clear_weakrefs(
            tensordict,
            out,
            "actor_network_params",
            "qvalue_network_params",
            "target_actor_network_params",
            "target_qvalue_network_params",
        )
        return out

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Negated objective (10) at one reparameterised action per state.

        Args:
            tensordict (TensorDictBase): holds the actor's inputs, batch size ``[*B]``.

        Returns:
            The reduced loss, and ``{"log_prob": ...}``, the q-logarithm of the density,
            detached, ``[*B]``.
        """
        weights = self._maybe_get_priority_weight(tensordict)
        with (
            set_exploration_type(ExplorationType.RANDOM),
            set_composite_lp_aggregate(True),
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False),
        ):
            dist = self.actor_network.get_dist(tensordict)
            action, log_prob = rsample_and_log_prob(dist)
        loss = -self.objective(tensordict, action, log_prob)
        loss = self._reduce_loss(loss, tensordict=tensordict, weights=weights)
        return loss, {"log_prob": q_logarithm(log_prob, self.entropic_index).detach()}

    def objective(self, tensordict: TensorDictBase, action: Tensor, log_prob: Tensor) -> Tensor:
        """Objective of the policy, ``min_i Q_i(s, a) - alpha ln_q pi(a|s)`` (10).

        For a trust-region step, which draws the noise of its actions once and evaluates the
        policy itself. Gradients reach ``action`` and ``log_prob``, not the critics.

        Args:
            tensordict (TensorDictBase): holds the critic's inputs but the action, ``[*B]``.
            action (Tensor): reparameterised actions, ``[*B, D]``; a TensorDict where they are
                composite.
            log_prob (Tensor): log-density of the whole action, ``[*B]``. That of a
                :class:`~tensordict.nn.CompositeDistribution` is one number where it is drawn under
                :class:`~tensordict.nn.set_composite_lp_aggregate`.

        Returns:
            The objective, to be maximised, of every step, ``[*B]``, masked or not.

        Raises:
            KeyError: if an input of the critic is missing.
            ValueError: if ``log_prob`` is not one number for each of the critic's.
        """
        value = self._action_value(tensordict, action, self._cached_detached_qvalue_params)
        if not isinstance(log_prob, Tensor) or log_prob.shape != value.shape:
            raise ValueError(
                "log_prob, a tensor, and the critic's value must have the same shape, got "
                f"{type(log_prob).__name__} {tuple(log_prob.shape)} and {tuple(value.shape)}."
            )
        return value - self._alpha * q_logarithm(log_prob, self.entropic_index)

    def compute_target(
        self, tensordict: TensorDictBase, *, policy: PolicyEvaluation | None = None
    ) -> Tensor:
        """Target of the Q-value (4), from the loss's value estimator.

        Args:
            tensordict (TensorDictBase): transitions ``[*B]``, or trajectories ``[*B, T]`` where
                the value estimator looks further than one step.

        Keyword Args:
            policy (PolicyEvaluation, optional): what
                :func:`~torchrl_safe.objectives.value.evaluate_policy` returned for the tensordict
                and the policy of now. Spares evaluating the policy here.

        Returns:
            The target without gradient, of the shape of the reward, ``[*B, 1]``, of the critics'
            dtype where the reward is an integer or a bool.

        Raises:
            KeyError: if an entry is missing, by its name.
            ValueError: if reward, ``done`` or ``terminated`` are not one number for each of the
                critic's.
        """
        keys = self.tensor_keys
        in_keys = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        # Collectors leave NaN behind the end of a trajectory, which 0 does not mask.
        tensordict = repair_next(tensordict, in_keys)
        next_tensordict = tensordict.get("next")
        reward = get_entry(next_tensordict, keys.reward, "the reward")
        done = get_entry(next_tensordict, keys.done, "the end of trajectories")
        terminated = next_tensordict.get(keys.terminated, done)
        if reward.shape[-1:] != (1,) or reward.ndim <= tensordict.ndim:
            raise ValueError(
                f"{keys.reward!r} must have a last dimension of 1 besides those of the batch, "
                f"{tuple(tensordict.batch_size)}, got {tuple(reward.shape)}; unsqueeze it."
            )
        for key, flag in ((keys.done, done), (keys.terminated, terminated)):
            origin = f"that of {keys.reward!r}"
            check_shape(repr(key), flag, reward.shape, origin, hint="unsqueeze or expand it")
        with (
            torch.no_grad(),
            set_exploration_type(ExplorationType.RANDOM),
            set_composite_lp_aggregate(True),
        ):
            alive = None
            states = next_tensordict
            if self.skip_done_states:
                alive = terminated.squeeze(-1).logical_not()
                if alive.shape != tensordict.batch_size:
                    raise ValueError(
                        f"skip_done_states=True needs {keys.terminated!r} of shape "
                        f"{(*tensordict.batch_size, 1)}, one of each state, got "
                        f"{tuple(terminated.shape)}; use skip_done_states=False."
                    )
                states = next_tensordict[alive]
            options = {}
            if policy is not None:
                action, log_prob = policy.next_action, policy.next_log_prob
                if alive is not None:
                    action, log_prob = action[alive], log_prob[alive]
                if isinstance(self.value_estimator, RetraceEstimator):
                    options["policy_log_prob"] = policy.log_prob
            else:
                with self.target_actor_network_params.to_module(
                    self.actor_network, preserve_module_state=False
                ):
                    action, log_prob = sample_and_log_prob(self.actor_network.get_dist(states))
            value = self._action_value(states, action, self.target_qvalue_network_params)
            value = value - self._alpha * q_logarithm(log_prob, self.entropic_index)
            if alive is not None:
                value = value.new_zeros(alive.shape).masked_scatter_(alive, value)
            value = value.unsqueeze(-1)
            origin = f"that of {keys.reward!r}"
            check_shape(repr(keys.state_action_value), value, reward.shape, origin)
            if not reward.is_floating_point():
                next_tensordict.set(keys.reward, reward.to(value.dtype))
            next_tensordict.set(self.value_estimator.tensor_keys.value, value)
            return self.value_estimator.value_estimate(tensordict, **options)

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Regression of every Q-value network on the target.

        Args:
            tensordict (TensorDictBase): as for :meth:`compute_target`, or with the target in it.

        Returns:
            The reduced loss, and ``{"td_error": ...}``, the largest absolute error over the
            networks, ``[*B]``.

        Raises:
            KeyError: if an entry is missing, by its name.
            ValueError: if the target in the input is not one number for each of the critic's.
        """
        keys = self.tensor_keys
        for key in self.qvalue_network.in_keys:
            get_entry(tensordict, key, "an input of qvalue_network")
        weights = self._maybe_get_priority_weight(tensordict)
        target = tensordict.get(keys.qvalue_target, None)
        if target is None:
            target = self.compute_target(tensordict)
        prediction = self._vmap_qnetworkN0(
            tensordict, self.qvalue_network_params, keys.state_action_value
        )
        origin = "that of the critic's value"
        check_shape(repr(keys.qvalue_target), target, prediction.shape[1:], origin)
        prediction, target = prediction.squeeze(-1), target.squeeze(-1)
        td_error = (prediction.detach() - target).abs().max(0)[0]
        loss = distance_loss(prediction, target.expand_as(prediction), self.loss_function).sum(0)
        loss = self._reduce_loss(loss, tensordict=tensordict, weights=weights)
        return loss, {"td_error": td_error}

    def _action_value(
        self,
        tensordict: TensorDictBase,
        action: Tensor | TensorDictBase,
        params: TensorDictBase,
    ) -> Tensor:
        keys = self.tensor_keys
        inputs = with_action(tensordict, keys.action, action, self.qvalue_network)
        values = self._vmap_qnetworkN0(inputs, params, keys.state_action_value)
        return values.squeeze(-1).min(0)[0]
