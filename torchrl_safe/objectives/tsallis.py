"""Tsallis actor-critic as a member of TorchRL's SAC family."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import TensorSpec
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules.distributions.utils import rsample_and_log_prob, sample_and_log_prob
from torchrl.objectives import SACLoss, distance_loss

from torchrl_safe.objectives.functional import (
    check_entropic_index,
    check_regression,
    q_logarithm,
    uniform_tsallis_entropy,
)
from torchrl_safe.objectives.utils import as_given, ensemble
from torchrl_safe.objectives.value import PolicyEvaluation, RetraceEstimator


class TsallisLoss(SACLoss):
    r"""Tsallis actor-critic (TAC) loss, equations (2)-(4) of SafeTAC.

    SAC with its log-probability replaced by a q-logarithm, which maximises Tsallis in place of
    Shannon entropy (Lee et al. 2020, https://arxiv.org/abs/1902.00137):

    .. math::

        \max_\pi \mathbb{E}\left[Q_q(s, a) - \alpha \ln_q \pi(a|s)\right], \qquad
        Q_q(s, a) = r + \gamma \left(Q_q(s', a') - \alpha \ln_q \pi(a'|s')\right).

    At ``entropic_index=1`` its losses and gradients are those of
    :class:`~torchrl.objectives.SACLoss`. The q-logarithm is that of the *joint* density of the
    squashed action; bootstrapped actions are exact draws of the policy, also where its
    ``rsample`` is a relaxation.

    Args:
        actor_network (ProbabilisticTensorDictSequential): stochastic actor.
        qvalue_network (TensorDictModule or list of them): state-action value.

    Keyword Args:
        entropic_index (float): ``q > 0``; 1 is Shannon entropy, larger values penalise
            improbable actions less and give sparser policies. Defaults to 1.2.
        num_qvalue_nets (int): number of Q-value networks. Defaults to 2.
        loss_function (str): ``"smooth_l1"``, ``"l2"`` or ``"l1"``. Defaults to ``"l2"``.
        alpha_init (float): initial entropy weight. Defaults to 1.0.
        min_alpha (float, optional): smallest entropy weight.
        max_alpha (float, optional): largest entropy weight.
        action_spec (TensorSpec, optional): needed for ``target_entropy="auto"`` if the actor
            has no spec.
        fixed_alpha (bool): keep the entropy weight at ``alpha_init``. Defaults to ``False``.
        target_entropy (float or "auto"): target of the *Tsallis* entropy. ``"auto"`` is the
            Tsallis entropy of the uniform density whose Shannon entropy is minus the number of
            action dimensions, which is SAC's own choice at ``entropic_index=1``.
        delay_actor (bool): use a target actor. Defaults to ``False``.
        delay_qvalue (bool): use target Q-value networks. Defaults to ``True``.
        separate_losses (bool): share no gradient between the terms. Defaults to ``False``.
        reduction (str): ``"mean"``, ``"sum"`` or ``"none"``. Defaults to ``"mean"``.
        skip_done_states (bool): do not run the actor on terminated states.
        deactivate_vmap (bool): loop over the Q-value networks in place of vmap.
        use_prioritized_weights (bool or "auto"): weigh samples by ``"priority_weight"``.
        scalar_output_mode (str, optional): see :class:`~torchrl.objectives.SACLoss`.

    ``make_value_estimator`` takes TorchRL's TD(0), TD(1) and TD(lambda) and, on trajectories
    ``[*B, T]``, ``"retrace"``: :class:`~torchrl_safe.RetraceEstimator` on the loss's networks.

    .. note::
        If ``"value_target"`` (``set_keys(value_target=...)``) is in the input, the Q-value loss
        regresses on it in place of computing the target: :meth:`compute_target` can then be run
        once on whole trajectories, and minibatches of single transitions drawn from them.

    Raises:
        ValueError: if ``entropic_index`` is not a positive finite number, or another argument is
            out of its range.

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
        >>> loss.make_value_estimator(gamma=0.99)
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
            value_target (NestedKey): Target of the Q-value, used if present.
                Defaults to ``"value_target"``.
        """

        value_target: NestedKey = "value_target"

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
        if not alpha_init > 0:
            raise ValueError(f"alpha_init must be positive, got {alpha_init}.")
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
        self.entropic_index = entropic_index

    def _make_vmap(self) -> None:
        self._vmap_qnetworkN0 = ensemble(
            self.qvalue_network,
            randomness=self.vmap_randomness,
            deactivate_vmap=self.deactivate_vmap,
        )

    @property
    def target_entropy(self) -> Tensor:
        """Target of the Tsallis entropy, a scalar buffer."""
        if self.__dict__.get("_target_entropy") == "auto":
            # SAC's property resolves "auto" to a Shannon entropy and registers it as a buffer.
            target = super().target_entropy
            target.fill_(uniform_tsallis_entropy(target.item(), self.entropic_index))
        return super().target_entropy

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
            action (Tensor): reparameterised actions, ``[*B, D]``.
            log_prob (Tensor): their log-density, ``[*B]``.

        Returns:
            The objective, to be maximised, ``[*B]``.
        """
        value = self._action_value(tensordict, action, self._cached_detached_qvalue_params)
        if log_prob.shape != value.shape:
            raise ValueError(
                "log_prob and the critic's value must have the same shape, got "
                f"{tuple(log_prob.shape)} and {tuple(value.shape)}."
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
            The target without gradient, of the shape of the reward, ``[*B, 1]``.
        """
        tensordict = tensordict.clone(False)
        next_tensordict = tensordict.get("next").copy()
        tensordict.set("next", next_tensordict)
        with (
            torch.no_grad(),
            set_exploration_type(ExplorationType.RANDOM),
        ):
            alive = None
            states = next_tensordict
            if self.skip_done_states:
                alive = ~next_tensordict.get(self.tensor_keys.terminated).squeeze(-1)
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
            next_tensordict.set(self.value_estimator.tensor_keys.value, value.unsqueeze(-1))
            return self.value_estimator.value_estimate(tensordict, **options)

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Regression of every Q-value network on the target.

        Args:
            tensordict (TensorDictBase): as for :meth:`compute_target`, or with the target in it.

        Returns:
            The reduced loss, and ``{"td_error": ...}``, the largest absolute error over the
            networks, ``[*B]``.
        """
        weights = self._maybe_get_priority_weight(tensordict)
        target = tensordict.get(self.tensor_keys.value_target, None)
        if target is None:
            target = self.compute_target(tensordict)
        target = target.squeeze(-1)
        prediction = self._vmap_qnetworkN0(
            tensordict, self.qvalue_network_params, self.tensor_keys.state_action_value
        ).squeeze(-1)
        td_error = (prediction.detach() - target).abs().max(0)[0]
        loss = distance_loss(prediction, target.expand_as(prediction), self.loss_function).sum(0)
        loss = self._reduce_loss(loss, tensordict=tensordict, weights=weights)
        return loss, {"td_error": td_error}

    def _action_value(
        self, tensordict: TensorDictBase, action: Tensor, params: TensorDictBase
    ) -> Tensor:
        inputs = tensordict.select(*self.qvalue_network.in_keys, strict=False)
        inputs.set(self.tensor_keys.action, action)
        values = self._vmap_qnetworkN0(inputs, params, self.tensor_keys.state_action_value)
        return values.squeeze(-1).min(0)[0]
