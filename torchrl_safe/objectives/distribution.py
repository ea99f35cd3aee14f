"""Distributions of a discounted cost as quantiles: one pure function per equation.

N quantiles are N equally likely values, those at the levels ``(i + 1/2) / N``. A risk measure of
them is a weighted sum of their sorted values.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from torchrl_safe._checks import check_count, check_number, check_shape
from torchrl_safe.objectives.functional import check_risk_level

__all__ = [
    "calibration_scales",
    "cvar_distortion",
    "draw_from_quantiles",
    "project_to_quantiles",
    "quantile_cvar",
    "quantile_levels",
    "quantile_loss",
    "realised_risk",
    "rescale_quantiles",
    "spectral_risk",
    "spectral_weights",
]


def quantile_levels(num_quantiles: int, like: Tensor | None = None) -> Tensor:
    r"""Levels of N quantiles, :math:`(i + 1/2) / N` (https://arxiv.org/abs/1710.10044, lemma 2).

    Args:
        num_quantiles (int): N, at least 1.
        like (Tensor, optional): of whose dtype and device the levels are.

    Returns:
        Tensor: ``[N]``, rising, in (0, 1).

    Raises:
        ValueError: if ``num_quantiles`` is not a positive integer.

    Examples:
        >>> quantile_levels(4)
        tensor([0.1250, 0.3750, 0.6250, 0.8750])
    """
    check_count("num_quantiles", num_quantiles)
    like = torch.zeros(()) if like is None else like
    return (torch.arange(num_quantiles, dtype=like.dtype, device=like.device) + 0.5) / num_quantiles


def quantile_loss(
    quantiles: Tensor, samples: Tensor, weights: Tensor | None = None, *, kappa: float = 0.0
) -> Tensor:
    r"""Quantile regression against weighted samples.

    .. math::

        \frac{1}{N} \sum_i \sum_j w_j\, \left|\tau_i - 1[u_{ij} < 0]\right|
            \frac{L_\kappa(u_{ij})}{\kappa},
        \qquad u_{ij} = z_j - q_i

    with Huber's loss :math:`L_\kappa` (QR-DQN, https://arxiv.org/abs/1710.10044, (10)). Its limit
    :math:`\kappa = 0` is :math:`|u|`: then the minimum is at the quantiles themselves, where a
    ``kappa`` of the size of their spread draws them together.

    Weights may be negative, as those of distributional Retrace: the gradient then is, in
    expectation, that of the regression against the signed measure
    (Tang et al. 2022, https://arxiv.org/abs/2207.07570).

    Args:
        quantiles (Tensor): :math:`q`, ``[*B, N]``, in any order.
        samples (Tensor): :math:`z`, ``[*B, M]``. No gradient is needed of them.
        weights (Tensor, optional): :math:`w`, ``[*B, M]``, of sum 1. Defaults to ``1 / M``.

    Keyword Args:
        kappa (float): where Huber's loss turns from a square into a line, at least 0, in the unit
            of the quantiles. Defaults to 0.

    Returns:
        Tensor: the loss, ``[*B]``, in the unit of the quantiles.

    Raises:
        ValueError: if shapes disagree, or ``kappa`` is negative or not finite.

    Examples:
        The median of 0 and 2 may be anything between them:

        >>> import torch
        >>> samples = torch.tensor([0.0, 2.0])
        >>> quantile_loss(torch.tensor([[0.5], [1.5], [3.0]]), samples.expand(3, 2))
        tensor([0.5000, 0.5000, 1.0000])
    """
    check_number("kappa", kappa, least=0)
    _check_batch("samples", samples, quantiles)
    error = samples.unsqueeze(-2) - quantiles.unsqueeze(-1)
    level = quantile_levels(quantiles.shape[-1], quantiles).unsqueeze(-1)
    if kappa == 0:
        loss = level * error + torch.relu(-error)
    else:
        huber = torch.nn.functional.huber_loss(
            error, torch.zeros_like(error), reduction="none", delta=kappa
        )
        loss = torch.where(error < 0, 1 - level, level) * huber / kappa
    if weights is None:
        return loss.mean((-2, -1))
    check_shape("weights", weights, samples.shape, "that of samples")
    return (loss.mean(-2) * weights).sum(-1)


def cvar_distortion(level: Tensor, risk_level: float) -> Tensor:
    r"""Distortion whose spectral risk is the CVaR: :math:`\max(0, 1 - (1 - u) / \alpha)`.

    Args:
        level (Tensor): :math:`u` in [0, 1], ``[*B]``.
        risk_level (float): share of worst outcomes that are averaged, in (0, 1].

    Returns:
        Tensor: ``[*B]``, in [0, 1].

    Raises:
        ValueError: if ``risk_level`` is outside (0, 1].

    Examples:
        >>> import torch
        >>> cvar_distortion(torch.tensor([0.5, 0.75, 1.0]), risk_level=0.5)
        tensor([0.0000, 0.5000, 1.0000])
    """
    check_risk_level(risk_level)
    return (1 - (1 - level) / risk_level).clamp(min=0)


def spectral_weights(num_quantiles: int, distortion: Callable[[Tensor], Tensor]) -> Tensor:
    r"""Weights of N sorted quantiles in a spectral risk measure.

    A spectral risk measure weighs outcomes by a rising spectrum :math:`\sigma` of their rank,
    :math:`\int_0^1 \sigma(u) F^{-1}(u) du` (Acerbi 2002; SRCPO,
    https://arxiv.org/abs/2405.18698). A quantile stands for its N-th of the ranks, so its weight is
    what the spectrum has there:

    .. math::

        w_i = g\left(\tfrac{i + 1}{N}\right) - g\left(\tfrac{i}{N}\right), \qquad
        g(u) = \int_0^u \sigma(v) dv.

    With the integral :math:`g`, the distortion, that is exact also where the spectrum jumps within
    a cell, as the CVaR's does if ``N * risk_level`` is no integer.

    Args:
        num_quantiles (int): N, at least 1.
        distortion (callable): :math:`g`, of a float64 tensor of levels ``[N + 1]``. It is convex
            and rises from 0 to 1: ``lambda u: u`` is the mean, ``lambda u: u**2`` the expected
            larger one of two outcomes, :func:`cvar_distortion` the CVaR.

    Returns:
        Tensor: ``[N]``, float64, rising, at least 0 and of sum 1.

    Raises:
        ValueError: if ``num_quantiles`` is not a positive integer, or ``distortion`` is not such a
            function.

    Examples:
        The worst .375 of four outcomes are the worst one and half of the next:

        >>> from functools import partial
        >>> spectral_weights(4, partial(cvar_distortion, risk_level=0.375))
        tensor([0.0000, 0.0000, 0.3333, 0.6667], dtype=torch.float64)
    """
    check_count("num_quantiles", num_quantiles)
    edges = torch.arange(num_quantiles + 1, dtype=torch.float64) / num_quantiles
    values = distortion(edges)
    if values.shape != edges.shape:
        raise ValueError(
            f"distortion must return one value per level, {tuple(edges.shape)}, got "
            f"{tuple(values.shape)}."
        )
    weights = values.diff()
    rising = (weights[:1] >= -1e-9).all() and (weights.diff() >= -1e-9).all()
    if not (abs(values[0]) < 1e-9 and abs(values[-1] - 1) < 1e-9 and rising):
        raise ValueError(
            f"distortion must be convex and rise from 0 to 1, got {values.tolist()} at "
            f"{edges.tolist()}."
        )
    return weights


def spectral_risk(quantiles: Tensor, weights: Tensor) -> Tensor:
    """Spectral risk of N equally likely values.

    Args:
        quantiles (Tensor): ``[*B, N]``, in any order: networks let them cross.
        weights (Tensor): ``[N]``, of the sorted values, see :func:`spectral_weights`.

    Returns:
        Tensor: the risk, ``[*B]``, in the unit of the quantiles. Differentiable.

    Raises:
        ValueError: if there are not as many weights as quantiles.

    Examples:
        The expected larger one of two draws from 0 and 4:

        >>> import torch
        >>> spectral_risk(torch.tensor([4.0, 0.0]), spectral_weights(2, torch.square))
        tensor(3.)
    """
    check_shape("weights", weights, quantiles.shape[-1:], "one per quantile")
    return quantiles.sort(-1).values @ weights.to(quantiles)


def quantile_cvar(quantiles: Tensor, risk_level: float) -> Tensor:
    """CVaR of N equally likely values: the mean of the worst share, to a fraction of a value.

    Args:
        quantiles (Tensor): ``[*B, N]``, in any order.
        risk_level (float): share of worst outcomes that are averaged, in (0, 1]; 1 is the mean.

    Returns:
        Tensor: the CVaR, ``[*B]``, in the unit of the quantiles. Differentiable.

    Raises:
        ValueError: if ``risk_level`` is outside (0, 1].

    Examples:
        >>> import torch
        >>> quantile_cvar(torch.tensor([3.0, 0.0, 1.0, 2.0]), risk_level=0.375)  # (3 + 2 / 2) / 1.5
        tensor(2.6667)
    """
    check_risk_level(risk_level)
    weights = spectral_weights(quantiles.shape[-1], lambda u: cvar_distortion(u, risk_level))
    return spectral_risk(quantiles, weights)


def realised_risk(sums: Tensor, quantiles: Tensor, weights: Tensor) -> Tensor:
    r"""Spectral risk of sums that really followed, of one outcome per state and action.

    What a state's distribution is cannot be seen in one outcome. A threshold can be had from
    predicted quantiles, and what exceeds it from the outcome
    (Rockafellar and Uryasev 2000; for spectra SRCPO, https://arxiv.org/abs/2405.18698):

    .. math::

        \sum_i \eta_i \left(\left(1 - \tfrac{i}{N}\right) b_i + (z - b_i)_+\right), \qquad
        \eta_i = N (w_i - w_{i - 1}), \quad b_i = \tfrac{1}{2} (q_{i - 1} + q_i)

    The CVaR is the case of one threshold, its value at risk :math:`b`:
    :math:`b + (z - b)_+ / \alpha`. The expectation over outcomes is the risk of what really
    happens where the thresholds are right, and more than it otherwise: wrong quantiles cannot hide
    cost. On the quantiles' own values it is :func:`spectral_risk` of them.

    Args:
        sums (Tensor): outcomes :math:`z`, ``[*B, K]``, equally likely.
        quantiles (Tensor): predicted :math:`q`, ``[*B, N]``, in any order.
        weights (Tensor): ``[N]``, of the sorted quantiles, see :func:`spectral_weights`.

    Returns:
        Tensor: ``[*B]``, to be averaged over states, in the unit of the sums.

    Raises:
        ValueError: if shapes disagree.

    Examples:
        The outcomes 0 and 4, with the value at risk known (2) and not known:

        >>> import torch
        >>> weights = torch.tensor([0.0, 1.0])  # the CVaR at .5
        >>> sums, quantiles = torch.tensor([[0.0, 4.0]] * 2), torch.tensor([[0.0, 4.0], [9.0, 9.0]])
        >>> realised_risk(sums, quantiles, weights)
        tensor([4., 9.])
    """
    num_quantiles = quantiles.shape[-1]
    _check_batch("sums", sums, quantiles)
    check_shape("weights", weights, (num_quantiles,), "one per quantile")
    weights = weights.to(quantiles)
    threshold, steps, share = _thresholds(quantiles, weights)
    excess = torch.relu(sums.unsqueeze(-1) - threshold.unsqueeze(-2)).mean(-2)
    tail = (steps * (share * threshold + excess)).sum(-1)
    return num_quantiles * weights[0] * sums.mean(-1) + tail


def rescale_quantiles(
    quantiles: Tensor, mean_scale: float | Tensor, spread_scale: float | Tensor
) -> Tensor:
    r"""Quantiles of a distribution with another mean and spread, of the same shape.

    .. math::

        q'_i = s_m \bar q + s_s (q_i - \bar q)

    Args:
        quantiles (Tensor): :math:`q`, ``[*B, N]``, in any order.
        mean_scale (float or Tensor): :math:`s_m`, a scalar.
        spread_scale (float or Tensor): :math:`s_s`, a scalar.

    Returns:
        Tensor: ``[*B, N]``, in the same order.

    Examples:
        >>> import torch
        >>> rescale_quantiles(torch.tensor([1.0, 3.0]), 2.0, 3.0)
        tensor([1., 7.])
    """
    mean = quantiles.mean(-1, keepdim=True)
    return mean_scale * mean + spread_scale * (quantiles - mean)


def stretch_quantiles(quantiles: Tensor, slope: float | Tensor, centre: float | Tensor) -> Tensor:
    r"""Quantiles of states that stand further apart, or closer together, than they were.

    .. math::

        q'_i = q_i \left(\bar q / c\right)^{b}

    A distribution whose mean is the centre :math:`c` stays. With a positive slope :math:`b` worse
    ones become worse, and better ones better.

    Args:
        quantiles (Tensor): :math:`q`, ``[*B, N]``, in any order. A mean below a millionth of the
            centre counts as that.
        slope (float or Tensor): :math:`b`, a scalar.
        centre (float or Tensor): :math:`c`, a positive scalar.

    Returns:
        Tensor: ``[*B, N]``, in the same order.

    Examples:
        >>> import torch
        >>> stretch_quantiles(torch.tensor([[1.0, 3.0], [4.0, 4.0]]), 0.5, 4.0).round(decimals=3)
        tensor([[0.7070, 2.1210],
                [4.0000, 4.0000]])
    """
    relative = quantiles.mean(-1, keepdim=True) / centre
    return quantiles * relative.clamp(min=1e-6) ** slope


def calibration_scales(
    quantiles: Tensor, sums: Tensor, weights: Tensor, *, low: float = 0.125, high: float = 8.0
) -> tuple[float, float]:
    """What quantiles must be rescaled by until they are right on average over states.

    A critic is right about the outcomes that it has learned, and its tail is too light for others:
    what tells two outcomes apart is easily learned by heart. Outcomes that it has not learned show
    by how much. With the scales, the mean prediction of the mean is the mean outcome, and that of
    the risk is the mean :func:`realised_risk`, whose thresholds are rescaled, too. It is the
    recalibration of regression (Kuleshov et al. 2018, https://arxiv.org/abs/1807.00263) in the two
    numbers that a constraint on risk reads.

    Args:
        quantiles (Tensor): predicted, ``[B, N]``, in any order.
        sums (Tensor): outcomes that the critic has not learned, ``[B, K]``, equally likely.
        weights (Tensor): ``[N]``, of the sorted quantiles, see :func:`spectral_weights`.

    Keyword Args:
        low (float): smallest scale, positive. Defaults to 1 / 8.
        high (float): largest scale. Defaults to 8.

    Returns:
        tuple of float: scale of the mean and of the spread, for :func:`rescale_quantiles`. That of
        the spread is 1 where there is none, or the risk is the mean.

    Raises:
        ValueError: if shapes disagree, there is no state, or not ``0 < low <= high``.

    Examples:
        Outcomes 0 or 4, predicted as .5 or 1.5, and the mean of the larger half:

        >>> import torch
        >>> quantiles, sums = torch.tensor([[0.5, 1.5]]), torch.tensor([[0.0, 4.0]])
        >>> mean_scale, spread_scale = calibration_scales(quantiles, sums, torch.tensor([0.0, 1.0]))
        >>> mean_scale, round(spread_scale, 6)
        (2.0, 4.0)
    """
    if not 0 < low <= high:
        raise ValueError(f"low and high must be 0 < low <= high, got {low} and {high}.")
    quantiles, sums, weights = _outcomes(quantiles, sums, weights)
    mean = quantiles.mean(-1)
    outcome = sums.mean()
    scale = 1.0
    if mean.mean() > 0:
        scale = float((outcome / mean.mean()).clamp(low, high))
    threshold, steps, share = _thresholds(quantiles, weights)
    centre = scale * mean
    excess = spectral_risk(quantiles, weights).mean() - mean.mean()
    if not excess > 1e-9 * mean.abs().mean():
        return scale, 1.0
    constant = quantiles.shape[-1] * weights[0] * outcome

    def too_low(spread: float) -> bool:
        """Whether the risk predicted with a spread is less than what is realised beyond it."""
        at = centre.unsqueeze(-1) + spread * (threshold - mean.unsqueeze(-1))
        beyond = torch.relu(sums.unsqueeze(-1) - at.unsqueeze(-2)).mean(-2)
        realised = constant + (steps * (share * at + beyond)).sum(-1).mean()
        return bool(centre.mean() + spread * excess < realised)

    # Thresholds that rise with the spread leave less beyond them: there is one root.
    below, above = low, high
    for _ in range(30):
        middle = (below * above) ** 0.5
        below, above = (middle, above) if too_low(middle) else (below, middle)
    return scale, (below * above) ** 0.5


def project_to_quantiles(
    samples: Tensor, num_quantiles: int, weights: Tensor | None = None
) -> Tensor:
    r"""Quantiles of weighted samples, :math:`q_i = \inf\{z : F(z) \ge \tau_i\}`.

    The closest N equally likely values in Wasserstein-1 distance (QR-DQN,
    https://arxiv.org/abs/1710.10044, lemma 2). With the generalised inverse it also is the
    projection of signed measures, whose :math:`F` may fall
    (Tang et al. 2022, https://arxiv.org/abs/2207.07570).

    Args:
        samples (Tensor): ``[*B, M]``, in any order.
        num_quantiles (int): N, at least 1.
        weights (Tensor, optional): ``[*B, M]``, of any sign and of sum 1. Defaults to ``1 / M``.

    Returns:
        Tensor: ``[*B, N]``, rising.

    Raises:
        ValueError: if shapes disagree or ``num_quantiles`` is not a positive integer.

    Examples:
        The second sample takes back most of the first:

        >>> import torch
        >>> samples, weights = torch.tensor([1.0, 2.0, 3.0]), torch.tensor([0.6, -0.5, 0.9])
        >>> project_to_quantiles(samples, 2, weights)
        tensor([1., 3.])
    """
    check_count("num_quantiles", num_quantiles)
    if weights is None:
        weights = torch.full_like(samples, 1 / samples.shape[-1])
    check_shape("weights", weights, samples.shape, "that of samples")
    samples, order = samples.sort(-1)
    function = weights.double().gather(-1, order).cumsum(-1)
    # Equal samples are one step of F, whatever the signs of their weights.
    step = torch.searchsorted(samples, samples, right=True) - 1
    # Where F falls, the largest value before is what a level is first reached by.
    reached = function.gather(-1, step).cummax(-1).values
    # Sums of weights that are a level but for their rounding have reached it.
    level = quantile_levels(num_quantiles, reached) - 1e-6
    index = torch.searchsorted(reached, level.expand(*samples.shape[:-1], -1).contiguous())
    return samples.gather(-1, index.clamp(max=samples.shape[-1] - 1))


def draw_from_quantiles(
    quantiles: Tensor, num_samples: int, *, generator: torch.Generator | None = None
) -> Tensor:
    """Stratified draws of N equally likely values: one from every K-th of the sorted ones.

    Each value is drawn as often as the next on average; the K draws together spread over the
    distribution more evenly than independent ones.

    Args:
        quantiles (Tensor): ``[*B, N]``, in any order.
        num_samples (int): K, at least 1.

    Keyword Args:
        generator (torch.Generator, optional): of the draws.

    Returns:
        Tensor: ``[*B, K]``, rising.

    Raises:
        ValueError: if ``num_samples`` is not a positive integer.

    Examples:
        >>> import torch
        >>> draw_from_quantiles(torch.tensor([3.0, 1.0, 2.0]), 3)  # as many as there are
        tensor([1., 2., 3.])
    """
    check_count("num_samples", num_samples)
    shape = (*quantiles.shape[:-1], num_samples)
    # In double precision: (K - 1 + u) / K rounds to 1 in single.
    within = torch.rand(shape, generator=generator, dtype=torch.float64, device=quantiles.device)
    stratum = torch.arange(num_samples, device=quantiles.device)
    num_quantiles = quantiles.shape[-1]
    index = ((stratum + within) / num_samples * num_quantiles).long()
    return quantiles.sort(-1).values.gather(-1, index.clamp(max=num_quantiles - 1))


def calibration_slope(
    quantiles: Tensor, sums: Tensor, weights: Tensor, *, low: float = -0.5, high: float = 1.0
) -> tuple[float, float]:
    """How quantiles of states must be stretched until good and bad states are judged alike.

    Scales make predictions right on average over states (:func:`calibration_scales`). They can
    still be too high for states that are judged better than most, and too low for the others. With
    the slope, and scales that are found after it, predicted over realised risk is the same for the
    half of the states that is judged better and for the other.

    Args:
        quantiles (Tensor): predicted, ``[B, N]``, in any order.
        sums (Tensor): outcomes that the critic has not learned, ``[B, K]``, equally likely.
        weights (Tensor): ``[N]``, of the sorted quantiles, see :func:`spectral_weights`.

    Keyword Args:
        low (float): smallest slope. Defaults to -1 / 2.
        high (float): largest slope. Defaults to 1.

    Returns:
        tuple of float: slope and centre, for :func:`stretch_quantiles`; 0 and 1 where there is
        nothing to learn: all predictions are alike, or nothing happened to one of the halves.

    Raises:
        ValueError: if shapes disagree, there is no state, or not ``low < high``.

    Examples:
        Means 1 and 4 were predicted, of states whose costs are 1 and 16:

        >>> import torch
        >>> quantiles = torch.tensor([[1.0, 1.0], [4.0, 4.0]])
        >>> sums = torch.tensor([[1.0], [16.0]])
        >>> slope, centre = calibration_slope(quantiles, sums, torch.tensor([0.5, 0.5]), high=2.0)
        >>> round(slope, 3), centre
        (1.0, 2.5)
    """
    if not low < high:
        raise ValueError(f"low must be less than high, got {low} and {high}.")
    quantiles, sums, weights = _outcomes(quantiles, sums, weights)
    mean = quantiles.mean(-1)
    centre = mean.mean().item()
    if not centre > 0 or len(mean) < 2 or mean.min() == mean.max():
        return 0.0, 1.0
    order = mean.argsort()
    better, worse = order[: len(order) // 2], order[len(order) // 2 :]
    if not (sums[better].mean() > 0 and sums[worse].mean() > 0):
        return 0.0, 1.0

    def too_low(slope: float) -> bool:
        """Whether the better half is still judged too high, beside the worse one."""
        stretched = stretch_quantiles(quantiles, slope, centre)
        judged = rescale_quantiles(stretched, *calibration_scales(stretched, sums, weights))
        predicted, realised = spectral_risk(judged, weights), realised_risk(sums, judged, weights)
        shares = [predicted[half].mean() / realised[half].mean() for half in (better, worse)]
        return bool(shares[0] > shares[1])

    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if too_low(middle) else (low, middle)
    return (low + high) / 2, centre


def _thresholds(quantiles: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the spectrum rises: values there ``[*B, J]``, by how much, and the share above."""
    num_quantiles = quantiles.shape[-1]
    steps = num_quantiles * weights.diff()
    # The CVaR's spectrum is one step or two; what does not rise costs nothing.
    index = steps.nonzero().squeeze(-1)
    ordered = quantiles.sort(-1).values
    threshold = (ordered[..., index] + ordered[..., index + 1]) / 2
    share = 1 - (index + 1).to(weights) / num_quantiles
    return threshold, steps[index], share


def _outcomes(quantiles: Tensor, sums: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Predictions, outcomes and the risk's weights, checked, in double precision."""
    _check_batch("sums", sums, quantiles)
    check_shape("weights", weights, quantiles.shape[-1:], "one per quantile")
    if not len(quantiles):
        raise ValueError("quantiles must be of at least one state, got none.")
    return quantiles.double(), sums.double(), weights.double()


def _check_batch(name: str, tensor: Tensor, quantiles: Tensor) -> None:
    if tensor.shape[:-1] != quantiles.shape[:-1] or tensor.ndim != quantiles.ndim:
        raise ValueError(
            f"{name} must have the batch shape of quantiles, {tuple(quantiles.shape[:-1])}, and a "
            f"last dimension of its own, got {tuple(tensor.shape)}."
        )
