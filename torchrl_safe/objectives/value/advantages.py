"""Retrace as a TorchRL value estimator: tensordict keys around the functional."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, fields
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, dispatch
from tensordict.utils import NestedKey, unravel_key
from torch import Tensor
from torchrl.envs.utils import step_mdp
from torchrl.objectives import LossModule
from torchrl.objectives.utils import register_value_estimator
from torchrl.objectives.value import ValueEstimatorBase

from torchrl_safe.objectives.value.functional import retrace_lambda_return_estimate

__all__ = ["RetraceEstimator"]


@register_value_estimator("retrace", default_kwargs={"gamma": 0.99, "lmbda": 0.97})
class RetraceEstimator(ValueEstimatorBase):
    r"""Retrace(:math:`\lambda`) estimate of an action value from off-policy trajectories.

    The target is that of :func:`~torchrl_safe.objectives.value.retrace_lambda_return_estimate`,
    SafeTAC (18), after Munos et al., 2016 (https://arxiv.org/abs/1606.02647). The estimator gathers
    its arguments from a tensordict of trajectories ``[*B, T]``. An entry that is present is used as
    it is; one that is missing is computed, always without gradient:

    * reward, ``done`` and ``terminated``: under ``"next"``; ``terminated`` falls back to ``done``;
    * log-density of the stored action under the policy that took it: ``"action_log_prob"``, or
      the actor's own key for it. It cannot be computed;
    * log-density of the stored action under the current policy: ``"policy_log_prob"``, or from
      ``actor_network``;
    * Q(s, a) of the stored action: ``"state_action_value"``, or from ``value_network``;
    * value of the next state: ``("next", "state_value")``, or ``value_network`` at an action drawn
      from ``actor_network``.

    A flat batch ``[B * T]`` of slices gives the same targets as ``[B, T]`` if ``done`` marks the
    end of every slice, as :class:`~torchrl.data.SliceSampler` does. Steps must follow each other in
    time: in a batch of unrelated transitions, traces would mix what does not belong together.

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
        value_network (TensorDictModule, optional): the critic Q(s, a).
        average_rewards (bool): standardise rewards over the batch first. Defaults to ``False``.
        differentiable (bool): let gradients flow from the outputs of :meth:`forward` to the entries
            read from the tensordict. Defaults to ``False``.
        skip_existing (bool, optional): ``False`` recomputes Q(s, a) and the current log-density
            with the networks even if they are present. Defaults to ``None``.
        advantage_key (NestedKey, optional): deprecated, raises; use :meth:`set_keys`.
        value_target_key (NestedKey, optional): deprecated, raises; use :meth:`set_keys`.
        value_key (NestedKey, optional): deprecated, raises; use :meth:`set_keys`.
        device (torch.device, optional): device of ``gamma`` and ``lmbda``.
        time_dim (int, optional): dimension of time in the tensordict. Defaults to the one named
            ``"time"`` if any, else the last.
        deactivate_vmap (bool): loop over an ensemble of critics in place of vmap.
        value_chunk_size (int, optional): largest number of elements, along ``value_chunk_dim``, of
            one call of the critic.
        num_chunks (int, optional): number of calls of the critic; excludes ``value_chunk_size``.
        value_chunk_dim (int): dimension along which calls are split. Defaults to ``0``.

    .. note::
        There is no ``shifted``: the critic is called at a stored and at a fresh action, so that one
        pass over a trajectory cannot give both.

    Raises:
        ValueError: if ``gamma`` or ``lmbda`` is not one number in [0, 1], or ``actor_network`` has
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

        Attributes:
            state_action_value (NestedKey): Q(s, a) of the stored action.
                Defaults to ``"state_action_value"``.
            action (NestedKey): The stored action. Defaults to the actor's key, or ``"action"``.
            policy_log_prob (NestedKey): Log-density of the stored action under the current policy.
                Defaults to ``"policy_log_prob"``.
        """

        state_action_value: NestedKey = "state_action_value"
        action: NestedKey = "action"
        policy_log_prob: NestedKey = "policy_log_prob"

    default_keys = _AcceptedKeys
    _tensor_keys: _AcceptedKeys | None
    actor_network: Any
    _loss_module: Any

    @classmethod
    def for_loss(cls, loss_module: LossModule, **hyperparams: Any) -> RetraceEstimator:
        """Tie an estimator to the networks, parameters and keys of a loss.

        The loss must have an ``actor_network`` and a critic of states and actions, named
        ``qvalue_network`` (:class:`~torchrl.objectives.SACLoss`,
        :class:`~torchrl.objectives.TD3Loss`) or ``value_network``
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
            ValueError: if the loss has no actor, or no critic of states and actions.
        """
        critic = "qvalue_network" if hasattr(loss_module, "qvalue_network") else "value_network"
        keys = loss_module.tensor_keys
        if not (
            hasattr(loss_module, "actor_network")
            and hasattr(loss_module, critic)
            and hasattr(keys, "state_action_value")
        ):
            raise ValueError(
                f"Retrace needs an actor and a critic of states and actions, and "
                f"{type(loss_module).__name__} lacks one of them."
            )
        next_value_network = hyperparams.pop("value_network", None)
        if next_value_network is None:
            next_value_network = getattr(loss_module, "actor_critic", None)
        hyperparams.setdefault("deactivate_vmap", getattr(loss_module, "deactivate_vmap", False))
        estimator = cls(
            actor_network=loss_module.actor_network,
            value_network=getattr(loss_module, critic),
            **hyperparams,
        )
        # In __dict__, so that the loss does not become a submodule of its own submodule.
        estimator.__dict__["_loss_module"] = loss_module
        estimator.__dict__["_next_value_network"] = next_value_network
        estimator._critic_name = critic
        estimator.set_keys(
            value=getattr(keys, "value", keys.state_action_value),
            state_action_value=keys.state_action_value,
            reward=keys.reward,
            done=keys.done,
            terminated=keys.terminated,
        )
        return estimator

    def __init__(
        self,
        *,
        gamma: float | Tensor,
        lmbda: float | Tensor,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        value_network: TensorDictModule | None = None,
        average_rewards: bool = False,
        differentiable: bool = False,
        skip_existing: bool | None = None,
        advantage_key: NestedKey | None = None,
        value_target_key: NestedKey | None = None,
        value_key: NestedKey | None = None,
        device: torch.device | None = None,
        time_dim: int | None = None,
        deactivate_vmap: bool = False,
        value_chunk_size: int | None = None,
        num_chunks: int | None = None,
        value_chunk_dim: int = 0,
    ) -> None:
        super().__init__(
            value_network=value_network,
            differentiable=differentiable,
            skip_existing=skip_existing,
            advantage_key=advantage_key,
            value_target_key=value_target_key,
            value_key=value_key,
            device=device,
            deactivate_vmap=deactivate_vmap,
            value_chunk_size=value_chunk_size,
            num_chunks=num_chunks,
            value_chunk_dim=value_chunk_dim,
        )
        for name, value in (("gamma", gamma), ("lmbda", lmbda)):
            buffer = torch.as_tensor(value, device=self._device)
            if buffer.numel() != 1 or not 0 <= buffer.item() <= 1:
                raise ValueError(f"{name} must be one number in [0, 1], got {value}.")
            # Settings, not state: a checkpoint of the loss holds neither.
            self.register_buffer(name, buffer.reshape(()), persistent=False)
        self.average_rewards = average_rewards
        self.time_dim = time_dim
        self.__dict__["actor_network"] = actor_network
        self.__dict__["_loss_module"] = None
        self.__dict__["_next_value_network"] = None
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

    def set_keys(self, **kwargs: NestedKey) -> None:
        """Set tensordict key names.

        Keyword Args:
            **kwargs: a key for each name, among those of every estimator (``advantage``,
                ``value_target``, ``value``, ``reward``, ``done``, ``terminated``,
                ``sample_log_prob``) and ``state_action_value``, ``action``, ``policy_log_prob``.

        Raises:
            KeyError: for a name that is not one of these.
            ValueError: for a key that is neither a string nor a tuple of strings.
        """
        # The base class wants the critic to write `value`; a critic of actions writes another key.
        accepted = {field.name for field in fields(self._AcceptedKeys)}
        for name, key in kwargs.items():
            if name not in accepted:
                raise KeyError(
                    f"{name} is not an accepted tensordict key for {type(self).__name__}; "
                    f"choose from {sorted(accepted)}."
                )
            if not isinstance(key, (str, tuple)):
                raise ValueError(f"The key of {name} must be a string or a tuple, got {key!r}.")
        keys = {name: unravel_key(key) for name, key in kwargs.items()}
        current = self.default_keys() if self._tensor_keys is None else self._tensor_keys
        self._tensor_keys = self._AcceptedKeys(**{**asdict(current), **keys})

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that :meth:`forward` reads, as far as networks do not compute them."""
        keys = self.tensor_keys
        actor_keys = [keys.policy_log_prob]
        if self.actor_network is not None:
            actor_keys = [*self.actor_network.in_keys, keys.action]
        critic_keys, next_keys = [keys.state_action_value], [keys.value]
        if self.value_network is not None:
            critic_keys = self.value_network.in_keys
            if self.actor_network is not None:
                next_keys = [*self.actor_network.in_keys, *self.value_network.in_keys]
        next_keys = [keys.reward, keys.done, keys.terminated, *next_keys]
        in_keys = [
            *actor_keys,
            *critic_keys,
            keys.sample_log_prob,
            *(unravel_key(("next", key)) for key in next_keys if key != keys.action),
        ]
        return list(dict.fromkeys(in_keys))

    @dispatch
    def forward(
        self,
        tensordict: TensorDictBase,
        *,
        params: TensorDictBase | None = None,
        target_params: TensorDictBase | None = None,
        time_dim: int | None = None,
    ) -> TensorDictBase:
        """Write the target and its distance from the action value into the tensordict.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``, see the class for its entries.

        Keyword Args:
            params (TensorDictBase, optional): parameters of ``value_network`` for the action value
                that the advantage is relative to. With one batch dimension they are an ensemble,
                of which the minimum is taken.
            target_params (TensorDictBase, optional): parameters of ``value_network`` in the target.
                Defaults to ``params``.
            time_dim (int, optional): overrides the constructor's.

        Returns:
            TensorDictBase: the input, with ``"value_target"`` and
            ``"advantage" = value_target - Q(s, a)``, both in the shape of the reward.

        Raises:
            KeyError: if an input is missing that no network computes.
            RuntimeError: if the tensordict has no batch dimension.
            ValueError: if shapes disagree.
        """
        if not tensordict.batch_dims:
            raise RuntimeError(
                "Retrace needs trajectories, and the tensordict has no dimension of time: "
                f"batch_size={tuple(tensordict.batch_size)}."
            )
        with nullcontext() if self.differentiable else torch.no_grad():
            value = self._action_value(tensordict, params)
            target_value = None
            if target_params is None and self._loss_module is None:
                target_params, target_value = params, value
            target = self.value_estimate(
                tensordict, target_params, action_value=target_value, time_dim=time_dim
            )
            advantage = target - value
        tensordict.set(self.tensor_keys.advantage, advantage)
        tensordict.set(self.tensor_keys.value_target, target)
        return tensordict

    def value_estimate(
        self,
        tensordict: TensorDictBase,
        target_params: TensorDictBase | None = None,
        next_value: Tensor | None = None,
        time_dim: int | None = None,
        *,
        action_value: Tensor | None = None,
    ) -> Tensor:
        """Return the target; the tensordict is left as it is.

        Args:
            tensordict (TensorDictBase): trajectories ``[*B, T]``, see the class for its entries.
            target_params (TensorDictBase, optional): parameters of ``value_network``; with one
                batch dimension they are an ensemble, of which the minimum is taken. When tied to a
                loss, parameters of what computes the value of the next state.
            next_value (Tensor, optional): value of the next state, in the shape of the reward.
            time_dim (int, optional): overrides the constructor's.
            action_value (Tensor, optional): Q(s, a), in the shape of the reward.

        Returns:
            Tensor: the target, in the shape of the reward.

        Raises:
            KeyError: if an input is missing that no network computes.
            ValueError: if shapes disagree, or rewards were summed over several steps.
        """
        keys = self.tensor_keys
        if tensordict.get(keys.steps_to_next_obs, None) is not None:
            raise ValueError(
                f"Retrace corrects single steps, and the entry {keys.steps_to_next_obs!r} marks "
                "multi-step rewards; leave out the MultiStep transform."
            )
        reward = _get(tensordict, ("next", keys.reward), "the reward")
        if self.average_rewards:
            reward = (reward - reward.mean()) / reward.std().clamp_min(1e-4)
        if action_value is None:
            critic_params = target_params if self._loss_module is None else None
            action_value = self._action_value(tensordict, critic_params)
        if next_value is None:
            next_value = self._next_state_value(tensordict, target_params)
        log_mu = _get(
            tensordict,
            keys.sample_log_prob,
            "the log-density of the action under the policy that took it (collect with an actor "
            "built with return_log_prob=True)",
        )
        return retrace_lambda_return_estimate(
            self.gamma,
            self.lmbda,
            _with_feature(self._policy_log_prob(tensordict), tensordict),
            _with_feature(log_mu, tensordict),
            action_value,
            next_value,
            reward,
            _get(tensordict, ("next", keys.done), "the end of trajectories"),
            tensordict.get(unravel_key(("next", keys.terminated)), None),
            time_dim=self._get_time_dim(time_dim, tensordict),
        )

    def _reads(self, tensordict: TensorDictBase, key: NestedKey, network: Any) -> Tensor | None:
        """The entry, unless a network is to recompute it."""
        if self.skip_existing is False and network is not None:
            return None
        return tensordict.get(key, None)

    def _policy_log_prob(self, tensordict: TensorDictBase) -> Tensor:
        keys, actor = self.tensor_keys, self.actor_network
        log_prob = self._reads(tensordict, keys.policy_log_prob, actor)
        if log_prob is not None:
            return log_prob
        if not hasattr(actor, "get_dist"):
            raise KeyError(
                f"{keys.policy_log_prob!r}, the log-density of the stored action under the current "
                "policy, is not in the tensordict, and there is no actor_network with a "
                f"distribution to compute it, got {type(actor).__name__}. In a loss, build the "
                "estimator with RetraceEstimator.for_loss(loss, ...)."
            )
        action = _get(tensordict, keys.action, "the stored action")
        with torch.no_grad(), self._actor_params():
            return actor.get_dist(_select(tensordict, actor, "actor_network")).log_prob(action)

    def _action_value(self, tensordict: TensorDictBase, params: TensorDictBase | None) -> Tensor:
        keys, critic = self.tensor_keys, self.value_network
        if params is None:
            value = self._reads(tensordict, keys.state_action_value, critic)
            if value is not None:
                return value
        if critic is None:
            raise KeyError(
                f"{keys.state_action_value!r}, the value of the stored action, is not in the "
                "tensordict, and there is no value_network to compute it. In a loss, build the "
                "estimator with RetraceEstimator.for_loss(loss, ...)."
            )
        return self._call_critic(tensordict, params)

    def _next_state_value(
        self, tensordict: TensorDictBase, target_params: TensorDictBase | None
    ) -> Tensor:
        keys, actor = self.tensor_keys, self.actor_network
        value = tensordict.get(unravel_key(("next", keys.value)), None)
        if value is not None:
            return value
        if self._next_value_network is not None and target_params is not None:
            network = self._next_value_network
            with torch.no_grad(), target_params.to_module(network, preserve_module_state=False):
                return network(step_mdp(tensordict, keep_other=False)).get(keys.value)
        if self._loss_module is not None or actor is None or self.value_network is None:
            raise KeyError(
                f"{unravel_key(('next', keys.value))!r}, the value of the next state, is not in "
                "the tensordict. Write it, pass next_value, or build the estimator with "
                "actor_network and value_network; one tied to a loss expects it from the loss."
            )
        next_tensordict = tensordict.get("next").copy()
        with torch.no_grad():
            dist = actor.get_dist(_select(next_tensordict, actor, "actor_network"))
            next_tensordict.set(keys.action, dist.sample())
            return self._call_critic(next_tensordict, target_params)

    def _call_critic(self, tensordict: TensorDictBase, params: TensorDictBase | None) -> Tensor:
        critic, key = self.value_network, self.tensor_keys.state_action_value
        tensordict = _select(tensordict, critic, "value_network")
        if params is None and self._loss_module is not None:
            params = getattr(self._loss_module, f"target_{self._critic_name}_params")

        def call(params: TensorDictBase | None) -> Tensor:
            with _parameters(params, critic):
                chunks = self._split_value_net_input(tensordict)
                values = [
                    _get(critic(chunk.copy()), key, "an output of value_network")
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

    def _actor_params(self) -> AbstractContextManager:
        params = None if self._loss_module is None else self._loss_module.actor_network_params
        return _parameters(params, self.actor_network)


def _parameters(params: TensorDictBase | None, module: TensorDictModule) -> AbstractContextManager:
    if params is None:
        return nullcontext()
    return params.to_module(module, preserve_module_state=False)


def _get(tensordict: TensorDictBase, key: NestedKey, what: str) -> Tensor:
    value = tensordict.get(unravel_key(key), None)
    if value is None:
        raise KeyError(f"{unravel_key(key)!r}, {what}, is not in the tensordict.")
    return value


def _select(tensordict: TensorDictBase, module: TensorDictModule, name: str) -> TensorDictBase:
    for key in module.in_keys:
        _get(tensordict, key, f"an input of {name}")
    return tensordict.select(*module.in_keys)


def _with_feature(log_prob: Tensor, tensordict: TensorDictBase) -> Tensor:
    return log_prob.unsqueeze(-1) if log_prob.shape == tensordict.batch_size else log_prob
