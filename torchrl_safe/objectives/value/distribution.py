"""Multi-step targets of the whole distribution of a return, as samples: one function per equation.

Samples are the last dimension, ``[*B, T, K]``, in the place of features.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchrl_safe._checks import check_shape
from torchrl_safe.objectives.value.functional import (
    _check_boolean,
    _check_time_dim,
    _coefficient,
    _log_trace,
    trace_lambda_return_estimate,
)

__all__ = ["distributional_retrace_estimate", "sampled_lambda_return_estimate"]


def sampled_lambda_return_estimate(
    gamma: float | Tensor,
    lmbda: float,
    next_samples: Tensor,
    reward: Tensor,
    done: Tensor,
    terminated: Tensor | None = None,
    *,
    time_dim: int = -2,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Samples of the TD(:math:`\lambda`) target distribution of a return.

    .. math::

        Z^k_t = r_t + \gamma \begin{cases}
            0 & \text{terminated} \\
            z^k_{t+1} & \text{cut, or with probability } 1 - \lambda \\
            Z^k_{t+1} & \text{otherwise}
        \end{cases}

    The rewards are those that really followed, and :math:`z`, draws of a critic, stands for what
    follows a cut. A sample that goes on with probability :math:`\lambda` is the n-step return with
    probability :math:`(1 - \lambda) \lambda^{n - 1}`, so that samples are those of the mixture that
    SDAC regresses on (https://arxiv.org/abs/2301.10923). At :math:`\lambda = 1`, **sums of real
    rewards**, the critic says no more than what follows the last step or a truncation; whatever it
    keeps wrong along a trajectory cannot hide itself in its own target.

    No ratio corrects for a change of policy: the steps should be those of the policy of now, or
    nearly. :func:`distributional_retrace_estimate` corrects for it.

    Args:
        gamma (float or Tensor): discount in [0, 1]. A tensor has one element, or as many
            dimensions as ``reward`` and broadcasts to ``next_samples`` (a discount per step).
        lmbda (float): probability to go on, in [0, 1].
        next_samples (Tensor): :math:`z_{t+1}`, draws of the return of the next state and an action
            of the policy there, ``[*B, T, K]``. Not read where ``terminated`` (may be NaN there)
            nor, at ``lmbda=1``, anywhere but at cuts and in the last step.
        reward (Tensor): ``[*B, T, 1]``.
        done (Tensor): boolean end of trajectory: termination, truncation or end of a slice,
            ``[*B, T, 1]``.
        terminated (Tensor, optional): boolean end of episode, ``[*B, T, 1]``. Defaults to ``done``.

    Keyword Args:
        time_dim (int): the dimension of time, any but the last. Defaults to ``-2``.
        generator (torch.Generator, optional): of the draws where sums end.

    Returns:
        Tensor: equally likely samples of each step's return, ``[*B, T, K]``.

    Raises:
        TypeError: if ``done`` or ``terminated`` is not boolean.
        ValueError: if shapes disagree, ``time_dim`` is not one of the dimensions before the last,
            or a coefficient is outside [0, 1].

    Examples:
        Two draws of what follows the last of two steps:

        >>> import torch
        >>> next_samples = torch.tensor([[torch.nan, torch.nan], [0.0, 4.0]])
        >>> reward, done = torch.tensor([[1.0], [2.0]]), torch.zeros(2, 1, dtype=torch.bool)
        >>> sampled_lambda_return_estimate(0.5, 1.0, next_samples, reward, done)
        tensor([[2., 3.],
                [2., 4.]])

    """
    terminated = done if terminated is None else terminated
    shape = next_samples.shape
    single = (*shape[:-1], 1)
    for name, tensor in (("reward", reward), ("done", done), ("terminated", terminated)):
        check_shape(name, tensor, single, "that of next_samples with one sample")
    _check_boolean("done", done)
    _check_boolean("terminated", terminated)
    _coefficient("lmbda", lmbda, ())
    if not reward.is_floating_point():
        reward = reward.to(next_samples.dtype)
    _check_time_dim(time_dim, shape, "next_samples")
    ends = (done | terminated).expand(shape)
    if lmbda < 1:
        draw = torch.rand(shape, generator=generator, device=next_samples.device)
        ends = ends | (draw >= lmbda)
    earlier, last = ends.split([shape[time_dim] - 1, 1], time_dim)
    ends = torch.cat([earlier, torch.ones_like(last)], time_dim)
    next_samples = torch.where(ends, next_samples, 0)
    nothing = torch.zeros_like(next_samples)
    return trace_lambda_return_estimate(
        gamma,
        1.0,
        None,
        None,
        nothing,
        next_samples,
        reward.to(next_samples.dtype).expand(shape),
        ends,
        terminated.expand(shape),
        trace="q_lambda",
        time_dim=time_dim,
    )


def distributional_retrace_estimate(
    gamma: float | Tensor,
    lmbda: float,
    log_pi: Tensor,
    log_mu: Tensor,
    samples: Tensor,
    next_samples: Tensor,
    reward: Tensor,
    done: Tensor,
    terminated: Tensor | None = None,
    *,
    time_dim: int = -2,
) -> tuple[Tensor, Tensor]:
    r"""Retrace(:math:`\lambda`) target distribution of a return, as weighted samples.

    Retrace of a distribution adds to it the TD errors along a trajectory, each the difference of
    two distributions shifted by the rewards :math:`G_{t:n} = \sum_{j=t}^{n} \gamma^{j-t} r_j` on
    the way there (Tang et al. 2022, https://arxiv.org/abs/2207.07570):

    .. math::

        \sum_{n \ge t} c_{t:n} \left[ G_{t:n} + \gamma^{n-t+1} z_{n+1} \right]
            - c_{t:n+1} \left[ G_{t:n} + \gamma^{n-t+1} y_{n+1} \right],
        \qquad c_{t:n} = \prod_{j=t+1}^{n} \lambda \min\left(1, \frac{\pi}{\mu}\right)_j

    with draws :math:`z_{n+1}` at an action of the policy and :math:`y_{n+1}` at the stored one.
    Weights of a trajectory are therefore negative, too; averaged over what the other policy does
    they are those of a distribution, whose only fixed point is that of :math:`\pi`. Their sum is 1
    in every trajectory. The mean is that of
    :func:`~torchrl_safe.objectives.value.trace_lambda_return_estimate`.

    The number of samples grows with the length of the slices: this is for slices of tens of steps.

    Args:
        gamma (float or Tensor): discount in [0, 1]. A tensor has one element, or as many
            dimensions as ``reward`` and broadcasts to it (a discount per step).
        lmbda (float): trace decay in [0, 1].
        log_pi (Tensor): log-density of the stored action under the current policy, ``[*B, T, 1]``.
        log_mu (Tensor): under the policy that took it, ``[*B, T, 1]``.
        samples (Tensor): :math:`y_t`, draws of the return of state and stored action,
            ``[*B, T, K]``.
        next_samples (Tensor): :math:`z_{t+1}`, draws at the next state and an action of the current
            policy, ``[*B, T, K]``. Not read where ``terminated`` (may be NaN there).
        reward (Tensor): ``[*B, T, 1]``.
        done (Tensor): boolean end of trajectory, ``[*B, T, 1]``.
        terminated (Tensor, optional): boolean end of episode, ``[*B, T, 1]``. Defaults to ``done``.

    Keyword Args:
        time_dim (int): the dimension of time, any but the last. Defaults to ``-2``.

    Returns:
        Samples and their weights, ``[*B, T, 2 T K]`` each. Samples of weight 0 are 0.

    Raises:
        TypeError: if ``done`` or ``terminated`` is not boolean.
        ValueError: if shapes disagree, ``time_dim`` is not one of the dimensions before the last,
            or a coefficient is outside [0, 1].

    Examples:
        The second action is half as likely as when it was taken: half of the weight stays with
        what the critic says of the second step.

        >>> import torch
        >>> log_pi, zeros = torch.tensor([[0.0], [0.5]]).log(), torch.zeros(2, 1)
        >>> reward, done = torch.ones(2, 1), torch.tensor([[False], [True]])
        >>> samples, weights = distributional_retrace_estimate(
        ...     1.0, 1.0, log_pi, zeros, zeros + 7, zeros + 5, reward, done
        ... )
        >>> samples[0], weights[0]  # 1 + 5, less half of 1 + 7, and half of 1 + 1
        (tensor([6., 8., 2., 0.]), tensor([ 1.0000, -0.5000,  0.5000,  0.0000]))

    """
    terminated = done if terminated is None else terminated
    shape = reward.shape
    single = (*shape[:-1], 1)
    _check_time_dim(time_dim, shape, "reward")
    for name, tensor in (("reward", reward), ("done", done), ("terminated", terminated)):
        check_shape(name, tensor, single, "one number per step")
    check_shape("samples", samples, (*shape[:-1], *samples.shape[-1:]), "that of reward")
    check_shape("next_samples", next_samples, samples.shape, "that of samples")
    _check_boolean("done", done)
    _check_boolean("terminated", terminated)
    gamma = _coefficient("gamma", gamma, shape)
    _coefficient("lmbda", lmbda, ())
    dtype = samples.dtype
    ends = done | terminated
    trace = lmbda * _log_trace("retrace", log_pi, log_mu, reward).exp()
    discount = torch.as_tensor(gamma, dtype=dtype, device=samples.device).expand(shape)
    trace, discount, reward, ends, terminated = (
        x.movedim(time_dim, -2).squeeze(-1) for x in (trace, discount, reward, ends, terminated)
    )
    samples, next_samples = (x.movedim(time_dim, -2) for x in (samples, next_samples))

    # Matrices [t, n] of what lies between two steps: one cumulative product or sum along n.
    steps = reward.shape[-1]
    later = torch.ones(steps, steps, dtype=torch.bool, device=samples.device).triu()

    def between(of_step: Tensor, where: Tensor) -> Tensor:
        return torch.where(where, of_step.unsqueeze(-2), 1).cumprod(-1)

    # An end of a step cuts the trace of the next; before the first step there is none to cut.
    trace = torch.where(ends.roll(1, -1), 0, trace.to(dtype))
    weight = between(trace, later.triu(1)) * later
    following = torch.cat([weight[..., 1:], torch.zeros_like(weight[..., :1])], -1)
    following = following * later
    decay = between(discount, later)
    before = torch.cat([torch.ones_like(decay[..., :1]), decay[..., :-1]], -1)
    paid = torch.where(later, before * reward.to(dtype).unsqueeze(-2), 0).cumsum(-1)
    decay, paid = decay.unsqueeze(-1), paid.unsqueeze(-1)
    bootstrap = torch.where(terminated.unsqueeze(-1), 0, next_samples).unsqueeze(-3)
    correction = samples.roll(-1, -2).unsqueeze(-3)
    values = torch.stack([paid + decay * bootstrap, paid + decay * correction], -2)
    weights = torch.stack([weight, 0 - following], -1).unsqueeze(-1) / samples.shape[-1]
    values = values.masked_fill(weights == 0, 0)
    weights = weights.expand(values.shape)
    values, weights = (x.flatten(-3).movedim(-2, time_dim) for x in (values, weights))
    return values, weights
