"""Retrace as a TorchRL value estimator: tensordict keys around the functional."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
    skip_existing,
)
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.data import Categorical, OneHot, TensorSpec
from torchrl.objectives.utils import register_value_estimator
from torchrl.objectives.value import ValueEstimatorBase
from torchrl.objectives.value.advantages import (
    _self_set_grad_enabled,
    _self_set_skip_existing,
    _standardize_by_group,
)

from torchrl_safe.objectives.value.functional import trace_lambda_return_estimate
from torchrl_safe.objectives.value.utils import (
    behaviour_log_prob,
    get_entry,
    get_time_dim,
    next_key,
    repair_next,
)

if TYPE_CHECKING:
    from torchrl.objectives import LossModule

__all__ = ["RetraceEstimator"]


@register_value_estimator("retrace", default_kwargs={"gamma": 0.99, "lmbda": 0.97})
class RetraceEstimator(ValueEstimatorBase):
    r"""Retrace(:math:`\lambda`) estimate of an action value from off-policy trajectories.

    The target is that of :func:`~torchrl_safe.objectives.value.trace_lambda_return_estimate`,
    SafeTAC (18), after Munos et al., 2016 (https://arxiv.org/abs/1606.02647). The estimator gathers
    its arguments from a tensordict of trajectories ``[*B, T]``:

    * reward, ``done`` and ``terminated``: under ``"next"``; ``terminated`` falls back to ``done``;
    * log-density of the stored action under the policy that took it: ``"action_log_prob"``, or
      the actor's own key for it. It cannot be computed. An exact zero is what collectors store for
      the actions of ``init_random_frames``: if ``actor_network`` has a bounded spec, the density
      there is that of its uniform draws;
    * log-density of the stored action under the current policy: the argument ``policy_log_prob``,
      or from ``actor_network``, or ``"policy_log_prob"``;
    * Q(s, a) of the stored action: from ``qvalue_network``, or ``"state_action_value"``;
    * value of the next state: from ``value_network``, else from ``qvalue_network`` at
      actions of ``actor_network``, or ``("next", "state_value")``. With an ``action_space`` of
      discrete actions the expectation over them is exact; otherwise it is a mean over
      ``num_next_actions`` draws.

    Entries are used where there is no network to compute them, or if ``skip_existing``: what
    belongs to a policy or a critic of the past does not take the place of that of now. What
    networks compute has no gradient.

    A flat batch ``[B * T]`` of slices gives the same targets as ``[B, T]`` if ``done`` marks the
    end of every slice, as :class:`~torchrl.data.SliceSampler` does. Steps must follow each other in
    time: in a batch of unrelated transitions, traces would mix what does not belong together.

    Agents have a dimension after time: rewards ``[*B, T, A, 1]`` and log-densities ``[*B, T, A]``.
    Ends and discounts may be those of all agents, ``[*B, T, 1]``.

    With an entry ``"steps_to_next_obs"`` (n-step transitions) the discount of a step is
    ``gamma ** steps_to_next_obs``, as in TorchRL's other estimators. The rewards that such a step
    adds up are not corrected for the change of policy.

    **In a loss.** :meth:`for_loss` ties the estimator to the networks of
    :class:`~torchrl.objectives.SACLoss` and its relatives::

        loss.make_value_estimator(RetraceEstimator.for_loss(loss, gamma=0.99, lmbda=0.97))

    Losses that list ``"retrace"`` in ``SUPPORTED_VALUE_ESTIMATORS`` also take
    ``loss.make_value_estimator("retrace", gamma=0.99, lmbda=0.97)``.

    The value of the next state is then what the loss computes, with an entropy bonus where the loss
    has one; Q(s, a) is the minimum over its target critics, and the current policy is its actor
    as it is at the time of the call. The estimator adds nothing to the loss's parameters and state.

    Keyword Args:
        gamma (float or Tensor): discount in [0, 1], scalar.
        lmbda (float or Tensor): trace decay in [0, 1], scalar.
        actor_network (ProbabilisticTensorDictSequential, optional): the current policy.
        qvalue_network (TensorDictModule, optional): the critic. It writes Q(s, a) under
            ``"state_action_value"``, or with an ``action_space`` the values of all actions,
            ``[*B, T, A]``, under ``"action_value"``.
        value_network (TensorDictModule, optional): writes the value of a state.
        action_space (str or TensorSpec, optional): ``"one-hot"`` or ``"categorical"``, or a spec of
            that kind, where ``qvalue_network`` gives the values of all actions.
        num_next_actions (int): draws in the value of the next state. Defaults to 1.
        average_rewards (bool): standardise rewards over the batch first. Defaults to ``False``.
        group_key (NestedKey, optional): an integer entry; rewards are standardised within each
            of its values.
        differentiable (bool): let gradients flow from the outputs of :meth:`forward` to the entries
            read from the tensordict. Defaults to ``False``.
        vectorized (bool): see the functional. Defaults to ``True``, also when compiling.
        skip_existing (bool, optional): use entries that are present in place of networks. Defaults
            to ``None``, that is :func:`tensordict.nn.skip_existing`.
        shifted (bool): :meth:`forward` runs the networks once over ``T + shifted_budget`` states,
            taking the next observation of a step from the step that follows, in place of twice over
            ``T``. Truncations use up the budget; steps that no longer fit are zero in the outputs
            and false in ``"shifted_valid"``, see
            :class:`~torchrl.objectives.value.TDLambdaEstimator`. Not with ``target_params``, nor
            in a loss. Without effect where no network is called. Defaults to ``False``.
        shifted_budget (int): number of states besides ``T``. Defaults to 1.
        device (torch.device, optional): device of ``gamma`` and ``lmbda``.
        time_dim (int, optional): dimension of time in the tensordict. Defaults to the one named
            ``"time"`` if any, else the last.
        deactivate_vmap (bool): loop over an ensemble of critics in place of vmap.
        value_chunk_size (int, optional): largest number of elements, along ``value_chunk_dim``, of
            one call of the critic.
        num_chunks (int, optional): number of calls of the critic; excludes ``value_chunk_size``.
        value_chunk_dim (int): dimension along which calls are split. Defaults to ``0``.

    Raises:
        ValueError: if ``gamma`` or ``lmbda`` is not one number in [0, 1], ``num_next_actions``
            is not positive, ``action_space`` is of another kind, or ``actor_network`` has
            several log-densities.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_safe.objectives.value import RetraceEstimator
        >>> estimator = RetraceEstimator(gamma=0.5, lmbda=1.0)
        >>> data = TensorDict(
        ...     {
        ...         "action_log_prob": torch.zeros(2),
        ...         "policy_log_prob": torch.tensor([0.0, -1.0]),
        ...         "state_action_value": torch.ones(2, 1),
        ...         "next": {
        ...             "reward": torch.ones(2, 1),
        ...             "done": torch.tensor([[False], [True]]),
        ...             "state_value": torch.zeros(2, 1),
        ...         },
        ...     },
        ...     batch_size=[2],
        ... )
        >>> estimator(data)["value_target"].squeeze(-1)
        tensor([1., 1.])

    """

    @dataclass
    class _AcceptedKeys(ValueEstimatorBase._AcceptedKeys):
        """Keys of every estimator, and those of actions.

        The base class accepts what is declared here, so that its own keys are repeated.

        Attributes:
            advantage (NestedKey): Target minus Q(s, a). Defaults to ``"advantage"``.
            value_target (NestedKey): The target. Defaults to ``"value_target"``.
            value (NestedKey): Value of a state. Defaults to ``"state_value"``.
            reward (NestedKey): Defaults to ``"reward"``.
            done (NestedKey): Defaults to ``"done"``.
            terminated (NestedKey): Defaults to ``"terminated"``.
            steps_to_next_obs (NestedKey): Defaults to ``"steps_to_next_obs"``.
            sample_log_prob (NestedKey): Log-density of the stored action under the policy that
                took it. Defaults to the actor's key, or as in every estimator.
            state_action_value (NestedKey): Q(s, a) of the stored action.
                Defaults to ``"state_action_value"``.
            action_value (NestedKey): Values of all discrete actions. Defaults to
                ``"action_value"``.
            action (NestedKey): The stored action. Defaults to the actor's key, or ``"action"``.
            policy_log_prob (NestedKey): Log-density of the stored action under the current policy.
                Defaults to ``"policy_log_prob"``.
        """

        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"
        sample_log_prob: NestedKey | None = None
        state_action_value: NestedKey = "state_action_value"
        action_value: NestedKey = "action_value"
        action: NestedKey = "action"
        policy_log_prob: NestedKey = "policy_log_prob"

    default_keys = _AcceptedKeys
    actor_network: Any
    qvalue_network: Any
    _loss_module: Any

    @classmethod
    def for_loss(cls, loss_module: LossModule, **hyperparams: Any) -> RetraceEstimator:
        """Tie an estimator to the networks, parameters and keys of a loss.

        The loss must have an ``actor_network`` and a critic of states and actions, named
        ``qvalue_network`` (:class:`~torchrl.objectives.SACLoss`,
        :class:`~torchrl.objectives.DiscreteSACLoss`, :class:`~torchrl.objectives.TD3Loss`,
        :class:`~torchrl.objectives.IQLLoss`) or ``value_network``
        (:class:`~torchrl.objectives.DDPGLoss`). A deterministic actor has no density:
        ``"policy_log_prob"`` must then be in the data.

        Args:
            loss_module (LossModule): the loss. Its parameters are read at every call.
            **hyperparams: keyword arguments of the constructor. A ``value_network`` is what
                TorchRL's dispatch passes to every estimator, the loss's map from a next state to
                its value.

        Returns:
            RetraceEstimator: the estimator, for ``loss_module.make_value_estimator(...)``.

        Raises:
            ValueError: if the loss has no actor, or no critic of states and actions, or for
                ``shifted=True``.
        """
        name = "qvalue_network" if hasattr(loss_module, "qvalue_network") else "value_network"
        keys = loss_module.tensor_keys
        critic_key = getattr(keys, "state_action_value", getattr(keys, "action_value", None))
        if not (
            hasattr(loss_module, "actor_network")
            and hasattr(loss_module, name)
            and critic_key is not None
        ):
            raise ValueError(
                f"Retrace needs an actor and a critic of states and actions, and "
                f"{type(loss_module).__name__} lacks one of them."
            )
        if hyperparams.get("shifted"):
            raise ValueError("shifted=True: in a loss, the loss computes the next state's value.")
        value_network = hyperparams.pop("value_network", None)
        if value_network is None:
            value_network = getattr(loss_module, "actor_critic", None)
        if value_network is None and name == "qvalue_network":
            value_network = getattr(loss_module, "value_network", None)
        hyperparams.setdefault("deactivate_vmap", getattr(loss_module, "deactivate_vmap", False))
        hyperparams.setdefault("action_space", getattr(loss_module, "action_space", None))
        estimator = cls(
            actor_network=loss_module.actor_network,
            qvalue_network=getattr(loss_module, name),
            value_network=value_network,
            **hyperparams,
        )
        # In __dict__, so that the loss does not become a submodule of its own submodule.
        estimator.__dict__["_loss_module"] = loss_module
        estimator._critic_name = name
        critic_keys = {"state_action_value": critic_key}
        if estimator.action_space is not None:
            critic_keys = {"action_value": critic_key}
        estimator.set_keys(
            value=getattr(keys, "value", critic_key),
            reward=keys.reward,
            done=keys.done,
            terminated=keys.terminated,
            **critic_keys,
        )
        return estimator

    def __init__(
        self,
        *,
        gamma: float | Tensor,
        lmbda: float | Tensor,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        qvalue_network: TensorDictModule | None = None,
        value_network: TensorDictModule | None = None,
        action_space: Literal["one-hot", "categorical"] | TensorSpec | None = None,
        num_next_actions: int = 1,
        average_rewards: bool = False,
        differentiable: bool = False,
        vectorized: bool = True,
        skip_existing: bool | None = None,
        shifted: bool = False,
        device: torch.device | None = None,
        time_dim: int | None = None,
        deactivate_vmap: bool = False,
        value_chunk_size: int | None = None,
        num_chunks: int | None = None,
        value_chunk_dim: int = 0,
        shifted_budget: int = 1,
        group_key: NestedKey | None = None,
    ) -> None:
        super().__init__(
            value_network=value_network,
            shifted=shifted,
            differentiable=differentiable,
            skip_existing=skip_existing,
            device=device,
            deactivate_vmap=deactivate_vmap,
            value_chunk_size=value_chunk_size,
            num_chunks=num_chunks,
            value_chunk_dim=value_chunk_dim,
            shifted_budget=shifted_budget,
            group_key=group_key,
        )
        for name, value in (("gamma", gamma), ("lmbda", lmbda)):
            buffer = torch.as_tensor(value, device=self._device)
            if buffer.numel() != 1 or not 0 <= buffer.item() <= 1:
                raise ValueError(f"{name} must be one number in [0, 1], got {value}.")
            # Settings, not state: a checkpoint of the loss holds neither.
            self.register_buffer(name, buffer.reshape(()), persistent=False)
        if num_next_actions < 1:
            raise ValueError(f"num_next_actions must be at least 1, got {num_next_actions}.")
        self.num_next_actions = num_next_actions
        self.action_space = _discrete(action_space)
        self.average_rewards = average_rewards
        self.vectorized = vectorized
        self.time_dim = time_dim
        self.__dict__["actor_network"] = actor_network
        self.__dict__["qvalue_network"] = qvalue_network
        self.__dict__["_loss_module"] = None
        self._critic_name: str | None = None
        keys: dict[str, NestedKey] = {}
        if actor_network is not None and hasattr(actor_network, "get_dist"):
            if len(actor_network.log_prob_keys) != 1:
                raise ValueError(
                    "actor_network must have one log-density for the whole action, got "
                    f"log_prob_keys={actor_network.log_prob_keys}."
                )
            keys["action"] = actor_network.dist_sample_keys[0]
            keys["sample_log_prob"] = actor_network.log_prob_keys[0]
        self.set_keys(**keys)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that :meth:`forward` reads, as far as networks do not compute them."""
        keys = self.tensor_keys
        actor_keys = [keys.policy_log_prob]
        if self.actor_network is not None:
            actor_keys = [*self.actor_network.in_keys, keys.action]
        critic_keys, next_keys = [keys.state_action_value], [keys.value]
        if self.qvalue_network is not None:
            critic_keys = self.qvalue_network.in_keys
        if self.value_network is not None:
            next_keys = self.value_network.in_keys
        elif self.qvalue_network is not None and self.actor_network is not None:
            next_keys = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
        next_keys = [keys.reward, keys.done, keys.terminated, *next_keys]
        in_keys = [
            *actor_keys,
            *critic_keys,
            keys.sample_log_prob,
            *(next_key(key) for key in next_keys if key != keys.action),
        ]
        if self.group_key is not None:
            in_keys.append(self.group_key)
        return list(dict.fromkeys(in_keys))

    @_self_set_skip_existing
    @_self_set_grad_enabled
    @dispatch
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
        time_dim: int | None = None,
        policy_log_prob: Tensor | None = None,
    ) -> TensorDictBase:
        """Write the target and its distance from the action value into the tensordict.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``, see the class for its entries.

        Keyword Args:
            params (TensorDictBase, optional): parameters of ``qvalue_network`` for the action value
                that the advantage is relative to. With one batch dimension they are an ensemble,
                of which the minimum is taken.
            target_params (TensorDictBase, optional): parameters in the target: of
                ``value_network`` if there is one, else of ``qvalue_network``, where they default
                to ``params``.
            time_dim (int, optional): overrides the constructor's.
            policy_log_prob (Tensor, optional): log-density of the stored action under the current
                policy, ``[*B, T]``, such as that of
                :func:`~torchrl_safe.objectives.value.evaluate_policy`.

        Returns:
            TensorDictBase: the input, with ``"value_target"`` and
            ``"advantage" = value_target - Q(s, a)``, both in the shape of the reward.

        Raises:
            KeyError: if an input is missing that no network computes.
            RuntimeError: if the tensordict has no batch dimension.
            ValueError: if shapes disagree, or for ``target_params`` when ``shifted``.
        """
        if not tensordict.batch_dims:
            raise RuntimeError(
                "Retrace needs trajectories, and the tensordict has no dimension of time: "
                f"batch_size={tuple(tensordict.batch_size)}."
            )
        time_dim = self._time_dim(tensordict, time_dim)
        data, valid = tensordict, None
        if self.shifted and self._computes(tensordict):
            if target_params is not None:
                raise ValueError("shifted=True has one set of parameters; leave out target_params.")
            value, next_value, log_pi, valid = self._shifted_values(tensordict, params, time_dim)
            target_value = value
            data = self._prepare_shifted_tensordict(tensordict, valid, time_dim)
        else:
            log_pi = self._policy_log_prob(tensordict, policy_log_prob)
            value = self._action_value(tensordict, params)
            critic_params = self._critic_params(target_params)
            if critic_params is None and self._loss_module is None:
                critic_params = params
            target_value = value
            if critic_params is not params:
                target_value = self._action_value(tensordict, critic_params)
            next_value = self._next_state_value(tensordict, target_params, critic_params)
        target = self._target(data, log_pi, target_value, next_value, time_dim)
        tensordict.set(self.tensor_keys.advantage, target - value)
        tensordict.set(self.tensor_keys.value_target, target)
        self._mask_shifted_output(tensordict, valid)
        return tensordict

    @_self_set_skip_existing
    def value_estimate(
        self,
        tensordict: TensorDictBase,
        target_params: TensorDictBase | None = None,
        next_value: Tensor | None = None,
        time_dim: int | None = None,
        *,
        policy_log_prob: Tensor | None = None,
        **kwargs: Any,
    ) -> Tensor:
        """Return the target; the tensordict is left as it is.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``, see the class for its entries.
            target_params (TensorDictBase, optional): parameters of ``value_network`` if there is
                one, else of ``qvalue_network``; with one batch dimension these are an ensemble, of
                which the minimum is taken.
            next_value (Tensor, optional): value of the next state, in the shape of the reward.
            time_dim (int, optional): overrides the constructor's.
            policy_log_prob (Tensor, optional): log-density of the stored action under the current
                policy, ``[*B, T]``, such as that of
                :func:`~torchrl_safe.objectives.value.evaluate_policy`.
            **kwargs: unused, as in TorchRL's other estimators.

        Returns:
            Tensor: the target, in the shape of the reward.

        Raises:
            KeyError: if an input is missing that no network computes.
            ValueError: if shapes disagree.
        """
        critic_params = self._critic_params(target_params)
        log_pi = self._policy_log_prob(tensordict, policy_log_prob)
        action_value = self._action_value(tensordict, critic_params)
        if next_value is None:
            next_value = self._next_state_value(tensordict, target_params, critic_params)
        time_dim = self._time_dim(tensordict, time_dim)
        return self._target(tensordict, log_pi, action_value, next_value, time_dim)

    def _target(
        self,
        tensordict: TensorDictBase,
        log_pi: Tensor,
        action_value: Tensor,
        next_value: Tensor,
        time_dim: int,
    ) -> Tensor:
        keys = self.tensor_keys
        reward = get_entry(tensordict, next_key(keys.reward), "the reward, [*B, T, 1]")
        if not reward.is_floating_point():
            reward = reward.to(next_value.dtype)
        gamma = self.gamma
        steps = tensordict.get(keys.steps_to_next_obs, None)
        if steps is not None:
            gamma = gamma ** _of_steps(keys.steps_to_next_obs, steps, reward, tensordict)
        if self.average_rewards:
            groups = self._group_ids(tensordict)
            if groups is None:
                reward = (reward - reward.mean()) / reward.std().clamp_min(1e-4)
            else:
                reward = _standardize_by_group(reward, groups)
        log_mu = behaviour_log_prob(tensordict, keys.sample_log_prob, self.actor_network)
        done = get_entry(tensordict, next_key(keys.done), "the end of trajectories, [*B, T, 1]")
        terminated = tensordict.get(next_key(keys.terminated), done)
        log_pi, log_mu, done, terminated = (
            _of_steps(key, tensor, reward, tensordict)
            for key, tensor in (
                (keys.policy_log_prob, log_pi),
                (keys.sample_log_prob, log_mu),
                (next_key(keys.done), done),
                (next_key(keys.terminated), terminated),
            )
        )
        return trace_lambda_return_estimate(
            gamma,
            self.lmbda,
            log_pi,
            log_mu,
            action_value,
            next_value,
            reward,
            done.expand_as(reward),
            terminated.expand_as(reward),
            vectorized=self.vectorized,
            time_dim=time_dim,
        )

    def _time_dim(self, tensordict: TensorDictBase, time_dim: int | None) -> int:
        return get_time_dim(tensordict, self.time_dim if time_dim is None else time_dim)

    def _computes(self, tensordict: TensorDictBase) -> bool:
        """Whether networks have anything to do."""
        if self.actor_network is None and self.qvalue_network is None:
            return self.value_network is not None
        keys = self.tensor_keys
        outputs = (keys.policy_log_prob, keys.state_action_value, next_key(keys.value))
        present = (tensordict.get(unravel_key(key), None) is not None for key in outputs)
        return not (skip_existing() and all(present))

    def _policy_log_prob(self, tensordict: TensorDictBase, given: Tensor | None) -> Tensor:
        if given is not None:
            return given
        key, actor = self.tensor_keys.policy_log_prob, self.actor_network
        has_density = hasattr(actor, "get_dist")
        if skip_existing() or not has_density:
            log_prob = tensordict.get(key, None)
            if log_prob is not None:
                return log_prob
        if not has_density:
            raise KeyError(
                f"{key!r}, the log-density of the stored action under the current policy, is not "
                "in the tensordict, and there is no actor_network with a distribution to compute "
                f"it, got {type(actor).__name__}. In a loss, build the estimator with "
                "RetraceEstimator.for_loss(loss, ...)."
            )
        action = get_entry(tensordict, self.tensor_keys.action, "the stored action")
        with torch.no_grad():
            return self._policy(tensordict).log_prob(action)

    def _policy(self, tensordict: TensorDictBase) -> Any:
        """The current policy's distribution."""
        actor, loss = self.actor_network, self._loss_module
        with _parameters(None if loss is None else loss.actor_network_params, actor):
            return actor.get_dist(_select(tensordict, actor, "actor_network"))

    def _critic_params(self, target_params: TensorDictBase | None) -> TensorDictBase | None:
        """What of ``target_params`` is the critic's."""
        tied = self._loss_module is not None
        return None if tied or self.value_network is not None else target_params

    def _action_value(self, tensordict: TensorDictBase, params: TensorDictBase | None) -> Tensor:
        keys = self.tensor_keys
        if skip_existing() or self.qvalue_network is None:
            value = tensordict.get(keys.state_action_value, None)
            if value is not None:
                return value
        if self.qvalue_network is None:
            raise KeyError(
                f"{keys.state_action_value!r}, the value of the stored action, is not in the "
                "tensordict, and there is no qvalue_network to compute it. In a loss, build the "
                "estimator with RetraceEstimator.for_loss(loss, ...)."
            )
        return self._of_stored_action(self._call_critic(tensordict, params), tensordict)

    def _of_stored_action(self, value: Tensor, tensordict: TensorDictBase) -> Tensor:
        """Q(s, a) from the values of all actions, where these are discrete."""
        if self.action_space is None:
            return value
        action = get_entry(tensordict, self.tensor_keys.action, "the stored action")
        if self.action_space == "one_hot":
            return (value * action).sum(-1, keepdim=True)
        return value.gather(-1, _with_feature(action, tensordict))

    def _next_state_value(
        self,
        tensordict: TensorDictBase,
        target_params: TensorDictBase | None,
        critic_params: TensorDictBase | None,
    ) -> Tensor:
        key = next_key(self.tensor_keys.value)
        tied = self._loss_module is not None
        sampled = self.actor_network is not None and self.qvalue_network is not None
        computes = self.value_network is not None or (sampled and not tied)
        # A loss that computes the value itself writes it, and passes no parameters.
        if skip_existing() or not computes or (tied and target_params is None):
            value = tensordict.get(key, None)
            if value is not None:
                return value
        if not computes or (tied and target_params is None):
            raise KeyError(
                f"{key!r}, the value of the next state, is not in the tensordict. Write it, pass "
                "next_value, or build the estimator with value_network, or with actor_network and "
                "qvalue_network; one tied to a loss expects it from the loss."
            )
        with torch.no_grad():
            if self.value_network is not None:
                tensordict = repair_next(tensordict, self.value_network.in_keys)
                return self._next_value(tensordict, target_params, kwargs={})
            in_keys = [*self.actor_network.in_keys, *self.qvalue_network.in_keys]
            following = repair_next(tensordict, in_keys).get("next")
            return self._expected_value(self._policy(following), following, critic_params)

    def _expected_value(
        self, dist: Any, tensordict: TensorDictBase, params: TensorDictBase | None
    ) -> Tensor:
        """Value of a state under its policy, from the critic."""
        if self.action_space is not None:
            return (dist.probs * self._call_critic(tensordict, params)).sum(-1, keepdim=True)
        tensordict = tensordict.copy()
        values = [
            self._call_critic(tensordict.set(self.tensor_keys.action, dist.sample()), params)
            for _ in range(self.num_next_actions)
        ]
        return torch.stack(values).mean(0)

    def _shifted_values(
        self, tensordict: TensorDictBase, params: TensorDictBase | None, time_dim: int
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Q(s, a), V(s'), log pi(a | s) and the mask of the steps that fit."""
        actor, critic, action_key = self.actor_network, self.qvalue_network, self.tensor_keys.action
        if actor is None or critic is None or self.value_network is not None:
            raise ValueError(
                "shifted=True needs actor_network and qvalue_network, and no value_network."
            )

        def call(states: TensorDictBase) -> Tensor:
            with torch.no_grad():
                dist = self._policy(states)
                value = self._call_critic(states, params)
                log_pi = dist.log_prob(states.get(action_key)).reshape(*value.shape[:-1], 1)
                if self.action_space is None:
                    state_value = self._expected_value(dist, states, params)
                else:
                    state_value = (dist.probs * value).sum(-1, keepdim=True)
                return torch.cat([self._of_stored_action(value, states), state_value, log_pi], -1)

        network = SimpleNamespace(in_keys=list({*actor.in_keys, *critic.in_keys, action_key}))
        values, next_values, valid = self._call_value_net_shifted(
            repair_next(tensordict, network.in_keys),
            params=None,
            next_params=None,
            value_key=self.tensor_keys.value,
            ndim=time_dim + 1,
            value_net=network,
            _call_value_net=call,
        )
        features = values.shape[-1] // 2
        value, _, log_pi = values.split([features, features, 1], -1)
        return value, next_values[..., features:-1], log_pi, valid

    def _call_critic(self, tensordict: TensorDictBase, params: TensorDictBase | None) -> Tensor:
        critic, loss = self.qvalue_network, self._loss_module
        keys = self.tensor_keys
        key = keys.state_action_value if self.action_space is None else keys.action_value
        tensordict = _select(tensordict, critic, "qvalue_network")
        if params is None and loss is not None:
            params = getattr(loss, f"target_{self._critic_name}_params")

        def call(params: TensorDictBase | None) -> Tensor:
            with _parameters(params, critic):
                chunks = self._split_value_net_input(tensordict)
                values = [
                    get_entry(critic(chunk.copy()), key, "an output of qvalue_network")
                    for chunk in chunks
                ]
            return torch.cat(values, self._resolve_value_chunk_dim(tensordict.ndim))

        with torch.no_grad():
            if params is None or not params.batch_dims:
                return call(params)
            if self.deactivate_vmap:
                values = torch.stack([call(member) for member in params.unbind(0)])
            else:
                values = torch.vmap(call, randomness=self.vmap_randomness)(params)
            return values.amin(0)


def _discrete(action_space: str | TensorSpec | None) -> str | None:
    if isinstance(action_space, OneHot):
        return "one_hot"
    if isinstance(action_space, Categorical):
        return "categorical"
    name = action_space.replace("-", "_") if isinstance(action_space, str) else action_space
    if name not in (None, "one_hot", "categorical"):
        raise ValueError(
            "action_space must be 'one-hot', 'categorical' or a spec of that kind, got "
            f"{action_space!r}."
        )
    return name


def _parameters(params: TensorDictBase | None, module: TensorDictModule) -> AbstractContextManager:
    if params is None:
        return nullcontext()
    return params.to_module(module, preserve_module_state=False)


def _select(tensordict: TensorDictBase, module: TensorDictModule, name: str) -> TensorDictBase:
    for key in module.in_keys:
        get_entry(tensordict, key, f"an input of {name}")
    return tensordict.select(*module.in_keys)


def _with_feature(tensor: Tensor, tensordict: TensorDictBase) -> Tensor:
    return tensor.unsqueeze(-1) if tensor.shape == tensordict.batch_size else tensor


def _of_steps(key: NestedKey, tensor: Tensor, reward: Tensor, tensordict: TensorDictBase) -> Tensor:
    """What steps have in common, aligned with a reward ``[*B, T, ..., F]``: as it, or ``F = 1``.

    One number per step ``[*B, T]``, or one per step and agent ``[*B, T, A]``.
    """
    shape, batch = tensor.shape, tensordict.batch_size
    for size in (1, reward.shape[-1]):
        target = (*reward.shape[:-1], size)
        if shape == target:
            return tensor
        if shape == target[:-1]:
            return tensor.unsqueeze(-1)
        if shape in (batch, (*batch, size)):  # shared by all agents
            between = (1,) * (reward.ndim - len(batch) - 1)
            return tensor.reshape(*batch, *between, *shape[len(batch) :] or (1,)).expand(target)
    raise ValueError(
        f"{unravel_key(key)!r} has shape {tuple(shape)}, which does not fit the reward's "
        f"{tuple(reward.shape)} in a tensordict of batch size {tuple(batch)}: it needs one number "
        f"per step, {tuple(batch)}, or the shape {tuple(reward.shape[:-1])}. Where agents share a "
        "reward, add up their log-densities."
    )
