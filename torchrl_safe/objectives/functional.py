"""The equations of the objectives, one pure function each.

Equation numbers are those of SafeTAC (Kim, Heo and Oh); modules wire tensordict keys to these
functions and add nothing to them.
"""

from __future__ import annotations

import math
from numbers import Real
from statistics import NormalDist

import torch
from torch import Tensor

from torchrl_safe._checks import check_number, check_shape
from torchrl_safe._deprecation import moved

__all__ = [
    "clipped_surrogate",
    "cup_loss",
    "cvar_factor",
    "discounted_cost_limit",
    "focops_loss",
    "gaussian_cvar",
    "q_logarithm",
    "surrogate_change",
    "uniform_tsallis_entropy",
]

__getattr__ = moved(
    __name__,
    {
        "matched_bound_kl": "torchrl_safe.modules.divergences.matched_bound_kl",
        "moment_matched_kl": "torchrl_safe.modules.divergences.moment_matched_kl",
    },
)

# exp(10) = 2e4: far above what a density bounded by log_std >= -4 earns where it matters, far
# below what a float32 gradient overflows at.
_MAX_EXPONENT = 10.0


def q_logarithm(log_prob: Tensor, entropic_index: float) -> Tensor:
    r"""The q-logarithm of a density, computed from its log-density (2).

    .. math::

        \ln_q(x) = \frac{x^{q-1} - 1}{q - 1}, \qquad \ln_1(x) = \log(x).

    Above ``(q - 1) * log_prob = 10`` the exponential is continued by its tangent: the result
    stays increasing in ``log_prob``, and its gradient stays finite (at most ``exp(10)``) where
    a squashed density grows without bound. Densities of 0 and of infinity have their limits:
    ``-1 / (q - 1)`` for a density of 0 above ``q = 1``, ``1 / (1 - q)`` for one of infinity below.

    Args:
        log_prob (Tensor): log-density of any shape, ``[*B]``.
        entropic_index (float): ``q > 0``.

    Returns:
        The q-logarithm, of the shape of ``log_prob``; in single precision where that is in half,
        whose range and digits do not suffice.

    Raises:
        ValueError: if ``entropic_index`` is not a positive finite number.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives.functional import q_logarithm
        >>> log_prob = torch.tensor([2.0, 0.5]).log()
        >>> q_logarithm(log_prob, 2.0)  # x - 1
        tensor([ 1.0000, -0.5000])
        >>> torch.equal(q_logarithm(log_prob, 1.0), log_prob)
        True
    """
    check_entropic_index(entropic_index)
    order = entropic_index - 1.0
    if log_prob.dtype in (torch.float16, torch.bfloat16):
        log_prob = log_prob.float()
    if order == 0.0:
        return log_prob
    exponent = order * log_prob
    # Not clamp, whose gradient at the bound itself depends on torch's version.
    bounded = torch.where(exponent > _MAX_EXPONENT, _MAX_EXPONENT, exponent)
    excess = torch.relu(exponent - _MAX_EXPONENT)  # not from `bounded`: inf - inf
    return (torch.expm1(bounded) + math.exp(_MAX_EXPONENT) * excess) / order


def uniform_tsallis_entropy(shannon_entropy: float, entropic_index: float) -> float:
    """Tsallis entropy of the uniform density that has the given Shannon entropy.

    It carries a Shannon target entropy over to another entropic index: a uniform density of
    volume ``exp(h)`` has Shannon entropy ``h`` and Tsallis entropy ``-ln_q(exp(-h))``.

    Args:
        shannon_entropy (float): ``h``, in nats.
        entropic_index (float): ``q > 0``.

    Examples:
        >>> from torchrl_safe.objectives.functional import uniform_tsallis_entropy
        >>> uniform_tsallis_entropy(-2.0, 1.0)
        -2.0
    """
    log_density = torch.tensor(-shannon_entropy, dtype=torch.float64)
    return -q_logarithm(log_density, entropic_index).item()


def cvar_factor(risk_level: float) -> float:
    r"""Standard deviations between a Gaussian's mean and its CVaR (7).

    .. math::

        \frac{\phi(\Phi^{-1}(\alpha))}{\alpha}

    Args:
        risk_level (float): share of worst outcomes that are averaged, in (0, 1]; 1 averages all
            of them, which is the plain expectation.

    Raises:
        ValueError: if ``risk_level`` is outside (0, 1].

    Examples:
        >>> from torchrl_safe.objectives.functional import cvar_factor
        >>> round(cvar_factor(0.125), 4), cvar_factor(1.0)
        (1.6468, 0.0)
    """
    check_risk_level(risk_level)
    if risk_level == 1.0:
        return 0.0
    normal = NormalDist()
    return normal.pdf(normal.inv_cdf(risk_level)) / risk_level


def gaussian_cvar(mean: Tensor, std: Tensor, risk_level: float) -> Tensor:
    r"""Conditional value at risk of a Gaussian: the mean of its worst outcomes (5), (7).

    .. math::

        \Gamma = \mu + \frac{\phi(\Phi^{-1}(\alpha))}{\alpha} \sigma

    Args:
        mean (Tensor): ``[*B]``.
        std (Tensor): standard deviation, ``[*B]``, in the unit of ``mean``.
        risk_level (float): in (0, 1]; see :func:`cvar_factor`.

    Returns:
        The CVaR, ``[*B]``, in the unit of ``mean``.

    Raises:
        ValueError: if shapes disagree or ``risk_level`` is outside (0, 1].

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives.functional import gaussian_cvar
        >>> gaussian_cvar(torch.tensor(1.0), torch.tensor(2.0), risk_level=0.5)
        tensor(2.5958)
    """
    check_shape("std", std, mean.shape, "that of mean")
    return mean + cvar_factor(risk_level) * std


def discounted_cost_limit(cost_rate: float, gamma: float) -> float:
    """Limit on the discounted cost sum that a constant cost per step adds up to.

    Every ``cost_limit`` of this library is a limit on the *discounted sum* of costs, the
    quantity that the safety critic predicts. This converts a limit on the cost per step.

    Args:
        cost_rate (float): cost per step, at least 0.
        gamma (float): discount of the safety critic, in [0, 1).

    Raises:
        ValueError: if an argument is out of its range.

    Examples:
        >>> from torchrl_safe.objectives.functional import discounted_cost_limit
        >>> round(discounted_cost_limit(0.025, gamma=0.99), 6)
        2.5
    """
    if not cost_rate >= 0:
        raise ValueError(f"cost_rate must be at least 0, got {cost_rate}.")
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma must be in [0, 1), got {gamma}.")
    return cost_rate / (1 - gamma)


def surrogate_change(
    log_prob: Tensor,
    log_pi: Tensor,
    log_mu: Tensor,
    advantage: Tensor,
    gamma: float,
    *,
    mask: Tensor | None = None,
) -> Tensor:
    r"""Change of a discounted sum from one policy to another, to first order.

    .. math::

        J(\pi') - J(\pi) \approx \frac{1}{1 - \gamma} E_{s, a \sim \mu}\left[
            \left(\frac{\pi'(a|s)}{\pi(a|s)} - 1\right)
            \min\left(1, \frac{\pi(a|s)}{\mu(a|s)}\right) A^\pi(s, a)\right]

    The surrogate of TRPO and CPO (Achiam et al. 2017, https://arxiv.org/abs/1705.10528, corollaries
    1 and 2) is the case ``mu = pi``. At ``pi' = pi`` it is 0 and its gradient is the policy
    gradient, *in the unit of J*: the factor ``1 / (1 - gamma)`` belongs to it wherever it is
    compared with a limit on ``J``. States count as often as they are visited, see
    :class:`~torchrl_safe.objectives.CVaRSurrogateLoss`. Advantages are centred, which in
    expectation changes nothing.

    Ratios are multiplied as logarithms. Where actions are so improbable under ``pi`` that every
    ratio to the sampler underflows, the data say nothing about ``pi``: the change and its gradient
    are 0.

    Args:
        log_prob (Tensor): log-density of the stored action under ``pi'``, ``[*B]``.
        log_pi (Tensor): under ``pi``, ``[*B]``.
        log_mu (Tensor): under the policy that took it, ``[*B]``.
        advantage (Tensor): of ``pi``, ``[*B]``.
        gamma (float): discount of ``J``, in [0, 1).

    Keyword Args:
        mask (Tensor, optional): false for steps to leave out, ``[*B]`` boolean.

    Returns:
        The change, a scalar.

    Raises:
        ValueError: if shapes disagree or ``gamma`` is outside [0, 1).

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives.functional import surrogate_change
        >>> log_pi, advantage = torch.tensor([0.5, 0.5]).log(), torch.tensor([1.0, -1.0])
        >>> log_prob = torch.tensor([0.6, 0.4]).log()  # the better action, more often
        >>> surrogate_change(log_prob, log_pi, log_pi, advantage, gamma=0.9)
        tensor(2.0000)
    """
    for name, tensor in (("log_pi", log_pi), ("log_mu", log_mu), ("advantage", advantage)):
        check_shape(name, tensor, log_prob.shape, "that of log_prob")
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma must be in [0, 1), got {gamma}.")
    if mask is None:
        mask = torch.ones_like(log_prob, dtype=torch.bool)
    check_shape("mask", mask, log_prob.shape, "that of log_prob")
    # Finite, so that a softmax over weights that are all zero is an average like any other.
    lowest = torch.finfo(log_pi.dtype).min
    log_weight = (log_pi - log_mu).clamp(min=lowest, max=0).masked_fill(~mask, lowest)
    advantage = advantage.masked_fill(~mask, 0)
    baseline = (log_weight.flatten().softmax(0) * advantage.flatten()).sum()
    # (ratio - 1) weight, without a factor that overflows where the product is moderate.
    log_ratio = (log_prob - log_pi).masked_fill(~mask, 0)
    rise, fall = (torch.where(x, log_ratio, 0) for x in (log_ratio > 0, ~(log_ratio > 0)))
    moved = log_weight.exp() * fall.expm1() - (log_weight + rise).exp() * (-rise).expm1()
    return (moved * (advantage - baseline)).sum() / mask.sum().clamp(min=1) / (1 - gamma)


def clipped_surrogate(
    log_prob: Tensor, log_pi: Tensor, advantage: Tensor, clip_epsilon: float
) -> Tensor:
    r"""Surrogate of PPO (Schulman et al. 2017, https://arxiv.org/abs/1707.06347, equation 7).

    .. math::

        E\left[\min\left(r A,\ \text{clip}(r, 1 - \epsilon, 1 + \epsilon) A\right)\right], \qquad
        r = \frac{\pi'(a|s)}{\pi(a|s)}

    A pessimistic bound on the mean of ``r A``: a ratio that has left the interval gains nothing. Of
    a cost, the bound from above is minus that of ``-A``.

    Args:
        log_prob (Tensor): log-density of the stored action under ``pi'``, ``[*B]``.
        log_pi (Tensor): under ``pi``, which took it, ``[*B]``.
        advantage (Tensor): of ``pi``, ``[*B]``.
        clip_epsilon (float): in (0, 1).

    Returns:
        The surrogate, to be maximised, a scalar in the unit of the advantage.

    Raises:
        ValueError: if shapes disagree or ``clip_epsilon`` is outside (0, 1).

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives.functional import clipped_surrogate
        >>> log_pi, log_prob = torch.tensor([0.5]).log(), torch.tensor([0.75]).log()
        >>> clipped_surrogate(log_prob, log_pi, torch.tensor([2.0]), clip_epsilon=0.25)
        tensor(2.5000)
        >>> -clipped_surrogate(log_prob, log_pi, -torch.tensor([2.0]), clip_epsilon=0.25)
        tensor(3.)
    """
    for name, tensor in (("log_pi", log_pi), ("advantage", advantage)):
        check_shape(name, tensor, log_prob.shape, "that of log_prob")
    if not 0 < clip_epsilon < 1:
        raise ValueError(f"clip_epsilon must be in (0, 1), got {clip_epsilon}.")
    ratio = (log_prob - log_pi).exp()
    clipped = ratio.clamp(1 - clip_epsilon, 1 + clip_epsilon)
    return torch.minimum(ratio * advantage, clipped * advantage).mean()


def focops_loss(
    log_prob: Tensor,
    log_pi: Tensor,
    divergence: Tensor,
    advantage: Tensor,
    *,
    kl_weight: float,
    max_kl: float,
) -> Tensor:
    r"""Loss of FOCOPS (Zhang, Vuong and Ross 2020, https://arxiv.org/abs/2002.06506).

    .. math::

        E\left[\mathbb 1\{\text{KL}_s(\pi' \,\|\, \pi) \le \delta\} \left(
            \text{KL}_s(\pi' \,\|\, \pi) - \frac{1}{\lambda} \frac{\pi'(a|s)}{\pi(a|s)} A(s, a)
        \right)\right]

    Where all states are inside the region, its gradient is that of the mean of
    ``KL(pi' || pi*)``: it projects the policy onto what solves the trust-region problem over all
    policies, :math:`\pi^*(a|s) \propto \pi(a|s) \exp(A(s, a) / \lambda)`. A state that has left the
    region adds nothing.

    Args:
        log_prob (Tensor): log-density of the stored action under ``pi'``, ``[*B]``.
        log_pi (Tensor): under ``pi``, which took it, ``[*B]``.
        divergence (Tensor): ``KL(pi' || pi)`` in the state, of the new policy to the old, ``[*B]``
            in nats.
        advantage (Tensor): of ``pi``: that of the Lagrangian, ``[*B]``.

    Keyword Args:
        kl_weight (float): ``lambda > 0``, in the unit of the advantage per nat.
        max_kl (float): ``delta > 0``, of a state, in nats.

    Returns:
        The loss, a scalar in nats.

    Raises:
        ValueError: if shapes disagree, or a number is not positive and finite.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives.functional import focops_loss
        >>> log_prob, advantage = torch.tensor([0.0, 0.0]), torch.tensor([1.0, 3.0])
        >>> divergence = torch.tensor([0.0, 0.5])  # the second state has gone too far
        >>> focops_loss(log_prob, log_prob, divergence, advantage, kl_weight=2.0, max_kl=0.1)
        tensor(-0.2500)
    """
    for name, tensor in (("log_pi", log_pi), ("divergence", divergence), ("advantage", advantage)):
        check_shape(name, tensor, log_prob.shape, "that of log_prob")
    check_number("kl_weight", kl_weight, positive=True)
    check_number("max_kl", max_kl, positive=True)
    gain = (log_prob - log_pi).exp() * advantage / kl_weight
    return (divergence - gain).masked_fill(divergence > max_kl, 0).mean()


def cup_loss(
    log_prob: Tensor,
    log_pi: Tensor,
    divergence: Tensor,
    advantage: Tensor,
    multiplier: Tensor,
    *,
    gamma: float,
    lmbda: float,
) -> Tensor:
    r"""Loss of CUP's projection (Yang et al. 2022, https://arxiv.org/abs/2209.07089).

    .. math::

        E\left[\text{KL}_s(\pi_{1/2} \,\|\, \pi') + \frac{1 - \gamma \lambda}{1 - \gamma}
            \frac{\pi'(a|s)}{\pi(a|s)} \sum_i \nu_i A_{C, i}(s, a)\right]

    ``pi_1/2`` is the policy after a step that followed the return alone. The projection takes back
    of it what costs more than it is worth at prices ``nu``. The factor is that of the paper's bound
    on the change of a discounted sum by generalised advantages of trace decay ``lambda``.

    Args:
        log_prob (Tensor): log-density of the stored action under ``pi'``, ``[*B]``.
        log_pi (Tensor): under ``pi``, which took it, ``[*B]``.
        divergence (Tensor): ``KL(pi_1/2 || pi')`` in the state, ``[*B]`` in nats.
        advantage (Tensor): of the costs, under ``pi``, ``[*B, m]``.
        multiplier (Tensor): ``nu >= 0``, ``[m]`` in nats per unit of a discounted cost. No gradient
            flows to it.

    Keyword Args:
        gamma (float): discount, in [0, 1).
        lmbda (float): trace decay of the advantages, in [0, 1].

    Returns:
        The loss, a scalar in nats.

    Raises:
        ValueError: if shapes disagree, or a coefficient is out of its range.

    Examples:
        >>> import torch
        >>> from torchrl_safe.objectives.functional import cup_loss
        >>> log_prob, divergence = torch.zeros(2), torch.tensor([0.0, 0.5])
        >>> advantage, multiplier = torch.tensor([[1.0], [3.0]]), torch.tensor([0.25])
        >>> cup_loss(log_prob, log_prob, divergence, advantage, multiplier, gamma=0.75, lmbda=1.0)
        tensor(0.7500)
    """
    shape = log_prob.shape
    for name, tensor in (("log_pi", log_pi), ("divergence", divergence)):
        check_shape(name, tensor, shape, "that of log_prob")
    expected = (*shape, *multiplier.shape[-1:])
    check_shape("advantage", advantage, expected, "as log_prob and multiplier say")
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma must be in [0, 1), got {gamma}.")
    if not 0 <= lmbda <= 1:
        raise ValueError(f"lmbda must be in [0, 1], got {lmbda}.")
    price = (advantage * multiplier.detach()).sum(-1) * (1 - gamma * lmbda) / (1 - gamma)
    return (divergence + (log_prob - log_pi).exp() * price).mean()


def check_entropic_index(entropic_index: float) -> None:
    """Raise a ``ValueError`` unless ``entropic_index`` is a positive finite number."""
    check_number("entropic_index", entropic_index, positive=True)


def check_cost_limit(cost_limit: float) -> None:
    """Raise a ``ValueError`` unless ``cost_limit`` is a finite number of at least 0."""
    check_number("cost_limit", cost_limit, least=0)


def check_risk_level(risk_level: float) -> None:
    """Raise a ``ValueError`` unless ``risk_level`` is in (0, 1]."""
    is_number = isinstance(risk_level, Real) and not isinstance(risk_level, bool)
    if not (is_number and 0 < risk_level <= 1):
        raise ValueError(f"risk_level must be in (0, 1], got {risk_level!r}.")


def check_regression(loss_function: str, reduction: str) -> None:
    """Raise a ``ValueError`` unless TorchRL has such a loss of a critic."""
    for name, value, allowed in (
        ("loss_function", loss_function, ("l1", "l2", "smooth_l1")),
        ("reduction", reduction, ("none", "mean", "sum")),
    ):
        if value not in allowed:
            raise ValueError(
                f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}."
            )
