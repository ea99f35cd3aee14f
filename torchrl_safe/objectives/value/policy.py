"""The current policy on stored trajectories, evaluated once for every loss that asks."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.modules.distributions.utils import sample_and_log_prob

__all__ = ["with_policy"]


@torch.no_grad()
def with_policy(
    tensordict: TensorDictBase,
    actor: ProbabilisticTensorDictSequential,
    *,
    shifted: bool = False,
) -> TensorDictBase:
    """What off-policy targets need of the current policy, in one pass for all losses.

    Targets of reward and of cost both need the density of the stored actions and an action at the
    next states. Without this each loss evaluates the policy for itself; with it they share.

    The copy that is returned also holds

    * ``"policy_log_prob"``: log-density of the stored action under the policy, ``[*B, T]``;
    * ``("next", "policy_action")``: an exact draw of the policy at the next state, ``[*B, T, D]``;
    * ``("next", "policy_log_prob")``: its log-density, ``[*B, T]``,

    which :meth:`TsallisLoss.compute_target <torchrl_safe.TsallisLoss.compute_target>`,
    :meth:`CVaRCostLoss.compute_target <torchrl_safe.CVaRCostLoss.compute_target>` and
    :class:`~torchrl_safe.RetraceEstimator` use in place of their own evaluation. They belong to the
    policy of now: they must not be stored.

    Args:
        tensordict (TensorDictBase): trajectories ``[*B, T]`` with the actor's inputs, also under
            ``"next"``, and the stored action. It is left as it is.
        actor (ProbabilisticTensorDictSequential): the current policy.

    Keyword Args:
        shifted (bool): evaluate ``T + 1`` states in place of ``2 T``. Only for pieces of one
            trajectory each, in which the next state of a step is the state of the following one:
            slices as :class:`~torchrl.data.SliceSampler` draws them, but not whole batches of a
            collector, in which episodes end anywhere. Defaults to ``False``.

    Returns:
        TensorDictBase: a shallow copy of the input with the three entries.

    Raises:
        KeyError: if the actor's inputs or the stored action are missing.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_safe import GMMTanhPolicy
        >>> from torchrl_safe.objectives.value import with_policy
        >>> actor = GMMTanhPolicy(torch.nn.Linear(3, 5), Bounded(-1, 1, (2,)), num_components=1)
        >>> states = torch.randn(4, 11, 3)
        >>> slices = TensorDict(
        ...     {
        ...         "observation": states[:, :-1],
        ...         "action": torch.zeros(4, 10, 2),
        ...         "next": {"observation": states[:, 1:]},
        ...     },
        ...     batch_size=[4, 10],
        ... )
        >>> out = with_policy(slices, actor, shifted=True)
        >>> out["policy_log_prob"].shape, out["next", "policy_action"].shape
        (torch.Size([4, 10]), torch.Size([4, 10, 2]))
    """
    out = tensordict.clone(False)
    following = tensordict.get("next").copy()
    out.set("next", following)
    states, next_states = (td.select(*actor.in_keys) for td in (tensordict, following))
    if shifted:
        params = actor.get_dist_params(torch.cat([states, next_states[..., -1:]], -1))
        dist, next_dist = (
            actor.build_dist_from_params(part) for part in (params[..., :-1], params[..., 1:])
        )
    else:
        dist, next_dist = actor.get_dist(states), actor.get_dist(next_states)
    out.set("policy_log_prob", dist.log_prob(tensordict[actor.dist_sample_keys[0]]))
    action, log_prob = sample_and_log_prob(next_dist)
    following.set("policy_action", action)
    following.set("policy_log_prob", log_prob)
    return out
