"""The current policy on stored trajectories, evaluated once for every loss that asks."""

from __future__ import annotations

from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.modules.distributions.utils import sample_and_log_prob

from torchrl_safe.objectives.value.utils import get_entry, get_time_dim, next_key, repair_next

__all__ = ["PolicyEvaluation", "evaluate_policy"]


class PolicyEvaluation(NamedTuple):
    """What off-policy targets need of a policy, aligned with the trajectories ``[*B, T]``.

    It belongs to the policy as it was when it was evaluated: hand it to the losses and let it go.

    Attributes:
        log_prob (Tensor): log-density of the stored action, ``[*B, T]``.
        next_action (Tensor): an exact draw at the next state, ``[*B, T, D]``.
        next_log_prob (Tensor): its log-density, ``[*B, T]``.
    """

    log_prob: Tensor
    next_action: Tensor
    next_log_prob: Tensor


@torch.no_grad()
def evaluate_policy(
    tensordict: TensorDictBase,
    actor: ProbabilisticTensorDictSequential,
    *,
    shifted: bool = False,
    time_dim: int | None = None,
) -> PolicyEvaluation:
    """What off-policy targets need of the current policy, in one pass for all losses.

    Targets of reward and of cost both need the density of the stored actions and an action at the
    next states. Alone, each loss evaluates the policy for itself; what this returns they share, as
    the argument ``policy`` of :meth:`TsallisLoss.compute_target
    <torchrl_safe.TsallisLoss.compute_target>` and :meth:`CVaRCostLoss.compute_target
    <torchrl_safe.CVaRCostLoss.compute_target>`. Nothing is written into the data, so that no target
    can follow a policy of the past.

    Args:
        tensordict (TensorDictBase): trajectories ``[*B, T]`` with the actor's inputs, also under
            ``"next"``, and the stored action. It is left as it is. A next state that is NaN, as
            collectors with ``compact_obs`` leave it at a trajectory's end, is replaced by the state
            before it.
        actor (ProbabilisticTensorDictSequential): the current policy.

    Keyword Args:
        shifted (bool): evaluate ``T + 1`` states in place of ``2 T``. Only for pieces of one
            trajectory each, in which the next state of a step is the state of the following one:
            slices as :class:`~torchrl.data.SliceSampler` draws them, but not whole batches of a
            collector, in which episodes end anywhere. Defaults to ``False``.
        time_dim (int, optional): dimension of time. Defaults to the one named ``"time"`` if any,
            else the last.

    Returns:
        PolicyEvaluation: densities and draws, without gradient.

    Raises:
        KeyError: if the actor's inputs or the stored action are missing.
        ValueError: if ``time_dim`` is no dimension of the tensordict.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from torchrl_safe import GMMTanhPolicy
        >>> from torchrl_safe.objectives.value import evaluate_policy
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
        >>> policy = evaluate_policy(slices, actor, shifted=True)
        >>> policy.log_prob.shape, policy.next_action.shape
        (torch.Size([4, 10]), torch.Size([4, 10, 2]))
    """
    action = get_entry(tensordict, actor.dist_sample_keys[0], "the stored action")
    for key in actor.in_keys:
        get_entry(tensordict, key, "an input of the actor")
        get_entry(tensordict, next_key(key), "an input of the actor at the next state")
    following = repair_next(tensordict, actor.in_keys).get("next")
    states, next_states = (td.select(*actor.in_keys) for td in (tensordict, following))
    if shifted:
        dim = get_time_dim(tensordict, time_dim)
        steps = tensordict.batch_size[dim]
        last = next_states.split([steps - 1, 1], dim)[1]
        params = actor.get_dist_params(torch.cat([states, last], dim))
        dist, next_dist = (
            actor.build_dist_from_params(part)
            for part in (params.split([steps, 1], dim)[0], params.split([1, steps], dim)[1])
        )
    else:
        dist, next_dist = actor.get_dist(states), actor.get_dist(next_states)
    return PolicyEvaluation(dist.log_prob(action), *sample_and_log_prob(next_dist))
