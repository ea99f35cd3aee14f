"""Divergences of two policies, and what of a policy each of them compares.

A trust region measures a policy by a few numbers per state, its statistics: a :class:`Distance` is
the pair of a function that reads them off a distribution, and the divergence of two such readings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.distributions import Categorical, register_kl

from torchrl_safe._checks import check_shape
from torchrl_safe.modules.distributions import TanhGaussianMixture

__all__ = [
    "CATEGORICAL",
    "DISTANCES",
    "MATCHED_BOUND",
    "MOMENT_MATCHED",
    "Distance",
    "categorical_kl",
    "matched_bound_kl",
    "moment_matched_kl",
]

Statistics: TypeAlias = Mapping[str, Tensor] | TensorDictBase


def moment_matched_kl(
    old_mean: Tensor, old_cov: Tensor, new_mean: Tensor, new_cov: Tensor
) -> Tensor:
    """KL divergence between two Gaussians, the trust region's distance of mixtures (15).

    Given the moments of two mixtures it is the moment-matching approximation of Hershey and
    Olsen (2007); for single Gaussians it is exact.

    Args:
        old_mean (Tensor): ``[*B, D]``.
        old_cov (Tensor): full covariance, ``[*B, D, D]``.
        new_mean (Tensor): ``[*B, D]``.
        new_cov (Tensor): ``[*B, D, D]``.

    Returns:
        ``KL(old || new)`` in nats, ``[*B]``; float32 for half types.

    Raises:
        ValueError: if shapes disagree.

    Examples:
        >>> import torch
        >>> from torchrl_safe.modules.divergences import moment_matched_kl
        >>> mean, cov = torch.zeros(2), torch.eye(2)
        >>> moment_matched_kl(mean, cov, mean + 1.0, cov)
        tensor(1.)
    """
    mean_shape = tuple(old_mean.shape)
    cov_shape = (*mean_shape, *mean_shape[-1:])
    for name, tensor, shape in (
        ("old_cov", old_cov, cov_shape),
        ("new_mean", new_mean, mean_shape),
        ("new_cov", new_cov, cov_shape),
    ):
        check_shape(name, tensor, shape, f"as old_mean's {mean_shape} says")
    old_mean, old_cov, new_mean, new_cov = _at_least_float32(old_mean, old_cov, new_mean, new_cov)
    new_factor, old_factor = _cholesky(new_cov), _cholesky(old_cov)
    dim = range(old_mean.shape[-1])
    zero = torch.zeros_like(old_mean[..., 0])
    # With E = L'^-1 (L - L'), which is small for a small KL, nothing cancels in
    # KL = (|E|^2 + |L'^-1 (m' - m)|^2) / 2 + sum_i E_ii - log(1 + E_ii).
    columns = [[old_factor[i][j] - new_factor[i][j] if j <= i else zero for i in dim] for j in dim]
    shift = list((new_mean - old_mean).unbind(-1))
    solved = [_solve_lower(new_factor, b) for b in (*columns, shift)]
    squares = torch.stack([x.square() for column in solved for x in column]).sum(0)
    diagonal = torch.stack([solved[i][i] for i in dim])
    return 0.5 * squares + (diagonal - diagonal.log1p()).sum(0)


def matched_bound_kl(
    old_logits: Tensor,
    old_loc: Tensor,
    old_scale: Tensor,
    new_logits: Tensor,
    new_loc: Tensor,
    new_scale: Tensor,
) -> Tensor:
    r"""Upper bound of the KL divergence between two mixtures of diagonal Gaussians.

    .. math::

        \text{KL}(p \,\|\, p') \le \sum_k w_k \Big(\log \frac{w_k}{w'_k}
        + \text{KL}(\mathcal N_k \,\|\, \mathcal N'_k)\Big),

    the KL of component and value together (the matched bound of Hershey and Olsen 2007). For
    single Gaussians it is exact. A trust region that only sees the moments
    (:func:`moment_matched_kl`) lets components move at will as long as their moments stay; this one
    holds each of them. Squashing changes neither side: the KL is that of the actions.

    Args:
        old_logits (Tensor): unnormalized log-weights, ``[*B, K]``.
        old_loc (Tensor): means, ``[*B, K, D]``.
        old_scale (Tensor): standard deviations, ``[*B, K, D]``.
        new_logits (Tensor): ``[*B, K]``.
        new_loc (Tensor): ``[*B, K, D]``.
        new_scale (Tensor): ``[*B, K, D]``.

    Returns:
        The bound on ``KL(old || new)`` in nats, ``[*B]``; float32 for half types.

    Raises:
        ValueError: if shapes disagree.

    Examples:
        >>> import torch
        >>> from torchrl_safe.modules.divergences import matched_bound_kl
        >>> logits, loc, scale = torch.zeros(2), torch.tensor([[1.0], [-1.0]]), torch.ones(2, 1)
        >>> matched_bound_kl(logits, loc, scale, logits, loc + 1.0, scale)
        tensor(0.5000)
        >>> matched_bound_kl(logits, loc, scale, logits, -loc, scale)  # moments are the same
        tensor(2.)
    """
    shape = tuple(old_loc.shape)
    for name, tensor, expected in (
        ("old_logits", old_logits, shape[:-1]),
        ("old_scale", old_scale, shape),
        ("new_logits", new_logits, shape[:-1]),
        ("new_loc", new_loc, shape),
        ("new_scale", new_scale, shape),
    ):
        check_shape(name, tensor, expected, f"as old_loc's {shape} says")
    old_logits, old_loc, old_scale, new_logits, new_loc, new_scale = _at_least_float32(
        old_logits, old_loc, old_scale, new_logits, new_loc, new_scale
    )
    # Written in what changes, which is small for a small KL, so that nothing cancels.
    change = (old_scale - new_scale) / new_scale
    shift = (new_loc - old_loc) / new_scale
    component = 0.5 * (change.square() + shift.square()) + change - change.log1p()
    return _weighted_kl(old_logits, new_logits, component.sum(-1))


def categorical_kl(old_logits: Tensor, new_logits: Tensor) -> Tensor:
    r"""KL divergence between two categorical distributions.

    .. math::

        \text{KL}(p \,\|\, p') = \sum_k p_k \log \frac{p_k}{p'_k}

    Written in what changes, so that nothing cancels at the KL of a trust region, where torch's own
    has lost its digits. A logit of minus infinity in both is an action that is masked.

    Args:
        old_logits (Tensor): unnormalized log-probabilities, ``[*B, K]``.
        new_logits (Tensor): ``[*B, K]``.

    Returns:
        ``KL(old || new)`` in nats, ``[*B]``; float32 for half types.

    Raises:
        ValueError: if shapes disagree.

    Examples:
        >>> import torch
        >>> from torchrl_safe.modules.divergences import categorical_kl
        >>> categorical_kl(torch.tensor([0.5, 0.5]).log(), torch.tensor([0.25, 0.75]).log())
        tensor(0.1438)
    """
    check_shape("new_logits", new_logits, old_logits.shape, "that of old_logits")
    old_logits, new_logits = _at_least_float32(old_logits, new_logits)
    return _weighted_kl(old_logits, new_logits, torch.zeros_like(old_logits))


class Distance(NamedTuple):
    """What a trust region measures policies by, and how far two of them are apart.

    The statistics are what a closure returns under ``"statistics"``, and ``kl`` is the argument
    ``statistics_kl`` of :class:`~torchrl_safe.TrustRegionSafeOptimizer`.

    Attributes:
        statistics (callable): from the distribution of a policy on ``[*B]`` states to tensors by
            name.
        divergence (callable): from old and new statistics to the divergence in each state, ``[*B]``
            in nats, zero with zero gradient where they are the same.

    Examples:
        >>> import torch
        >>> from torch.distributions import Categorical
        >>> from torchrl_safe.modules import DISTANCES
        >>> distance = DISTANCES["categorical"]
        >>> old, new = (Categorical(torch.tensor([p, 1 - p])) for p in (0.5, 0.25))
        >>> distance.kl(distance.statistics(old), distance.statistics(new))
        tensor(0.1438)
    """

    statistics: Callable[[Any], dict[str, Tensor]]
    divergence: Callable[[Statistics, Statistics], Tensor]

    def kl(self, old: Statistics, new: Statistics) -> Tensor:
        """The mean divergence over states, a scalar in nats."""
        return self.divergence(old, new).mean()


def _moments(dist: TanhGaussianMixture) -> dict[str, Tensor]:
    mean, cov = dist.moments
    return {"mean": mean, "cov": cov}


def _moment_kl(old: Statistics, new: Statistics) -> Tensor:
    return moment_matched_kl(old["mean"], old["cov"], new["mean"], new["cov"])


def _mixture(dist: TanhGaussianMixture) -> dict[str, Tensor]:
    return {"logits": dist.logits, "loc": dist.loc, "scale": dist.scale}


def _mixture_kl(old: Statistics, new: Statistics) -> Tensor:
    names = ("logits", "loc", "scale")
    return matched_bound_kl(*(old[name] for name in names), *(new[name] for name in names))


def _logits(dist: Categorical) -> dict[str, Tensor]:
    return {"logits": dist.logits}


def _logits_kl(old: Statistics, new: Statistics) -> Tensor:
    return categorical_kl(old["logits"], new["logits"])


MOMENT_MATCHED = Distance(_moments, _moment_kl)
"""Mixtures by mean and covariance of the whole, (15) of SafeTAC."""

MATCHED_BOUND = Distance(_mixture, _mixture_kl)
"""Mixtures by every component and its weight; with one component the same as the moments."""

CATEGORICAL = Distance(_logits, _logits_kl)
"""Discrete policies by their probabilities; any distribution that has ``logits`` of one action."""

DISTANCES = {
    "moment_matched": MOMENT_MATCHED,
    "matched_bound": MATCHED_BOUND,
    "categorical": CATEGORICAL,
}
"""The distances by the names that options use."""


@register_kl(TanhGaussianMixture, TanhGaussianMixture)
def _kl_of_mixtures(p: TanhGaussianMixture, q: TanhGaussianMixture) -> Tensor:
    """KL of component and action together, which is at least that of the action, ``[*B]``."""
    if p.loc.shape[-2:] != q.loc.shape[-2:]:
        raise ValueError(
            "the bound on the KL pairs components, so that both mixtures need the same number of "
            f"them, got parameters [K, D] of {tuple(p.loc.shape[-2:])} and "
            f"{tuple(q.loc.shape[-2:])}"
        )
    if not (torch.equal(p.low, q.low) and torch.equal(p.high, q.high)):
        raise ValueError(
            "the KL is of two policies in one box, got "
            f"low={p.low.tolist()}, high={p.high.tolist()} and "
            f"low={q.low.tolist()}, high={q.high.tolist()}"
        )
    return matched_bound_kl(p.logits, p.loc, p.scale, q.logits, q.loc, q.scale)


def _weighted_kl(old_logits: Tensor, new_logits: Tensor, parts: Tensor) -> Tensor:
    """KL of weights, and of the parts that they are the weights of, ``[*B, K]`` each."""
    log_weight, new_log_weight = old_logits.log_softmax(-1), new_logits.log_softmax(-1)
    # Where there is no weight any gap will do, and that of two masked ones is NaN.
    gap = (new_log_weight - log_weight).masked_fill(log_weight == -torch.inf, 2.0)
    weight = log_weight.exp()
    # w' - w, which sums to zero; the first form cancels where they are close, the second overflows.
    tilt = torch.where(gap > 1, new_log_weight.exp() - weight, weight * gap.clamp(max=1).expm1())
    return (tilt + weight * (parts - gap)).sum(-1)


def _at_least_float32(*tensors: Tensor) -> tuple[Tensor, ...]:
    """Half types, which autocast makes, tell apart no KL of the size of a trust region."""
    return tuple(x.float() if torch.finfo(x.dtype).bits < 32 else x for x in tensors)


# Action spaces are small and batches large: unrolled over the action dimensions, products with
# the Hessian of the KL are ten times as fast as through batched LAPACK calls.


def _cholesky(cov: Tensor) -> list[list[Tensor]]:
    """Lower factor of ``[*B, D, D]``, as rows of entries ``[*B]``."""
    factor: list[list[Tensor]] = []
    for i in range(cov.shape[-1]):
        row: list[Tensor] = []
        for j in range(i + 1):
            entry = cov[..., i, j]
            for k in range(j):
                entry = entry - row[k] * (row[k] if i == j else factor[j][k])
            row.append(entry.sqrt() if i == j else entry / factor[j][j])
        factor.append(row)
    return factor


def _solve_lower(factor: list[list[Tensor]], b: list[Tensor]) -> list[Tensor]:
    """Forward substitution."""
    x: list[Tensor] = []
    for row, entry in zip(factor, b, strict=True):
        for coefficient, known in zip(row, x, strict=False):
            entry = entry - coefficient * known
        x.append(entry / row[-1])
    return x
