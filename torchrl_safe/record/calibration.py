"""Can a safety critic be trusted? Its predictions beside the costs that really followed.

A critic says of a state and an action what the discounted sum of the costs that follow will be: its
mean, its CVaR. Played out, every step of an episode has such a sum. Steps of similar predictions
form a bin, and in each bin the two are compared.
"""

from __future__ import annotations

import os
from pathlib import Path

import torch
from tensordict import TensorDict
from torch import Tensor

from torchrl_safe._extras import need
from torchrl_safe._files import expand, replacing

__all__ = ["calibrate", "discounted_sums", "plot_calibration"]

_NUM_RESAMPLES = 500


def discounted_sums(values: Tensor, gamma: float) -> Tensor:
    r"""Discounted sum of what follows every step, :math:`\sum_{k \ge t} \gamma^{k - t} c_k`.

    Args:
        values (Tensor): one value per step, time last, ``[*B, T]``.
        gamma (float): discount, in [0, 1].

    Returns:
        Tensor: float64, ``[*B, T]``. What comes after the last step counts as zero.

    Raises:
        ValueError: if ``gamma`` is outside [0, 1].

    Examples:
        >>> import torch
        >>> discounted_sums(torch.tensor([1.0, 0.0, 2.0]), 0.5)
        tensor([1.5000, 1.0000, 2.0000], dtype=torch.float64)
    """
    if not 0 <= gamma <= 1:
        raise ValueError(f"gamma must be in [0, 1], got {gamma}.")
    sums = values.double().clone()
    for t in range(sums.shape[-1] - 2, -1, -1):
        sums[..., t] += gamma * sums[..., t + 1]
    return sums


def calibrate(
    mean: Tensor,
    cvar: Tensor,
    cost: Tensor,
    *,
    gamma: float,
    risk_level: float,
    num_bins: int = 10,
    tail: float = 0.05,
) -> TensorDict:
    r"""Predicted mean and CVaR of the discounted cost, bin by bin, beside the realised ones.

    The realised CVaR of a bin is the mean of its worst ``risk_level`` share of sums. Steps near
    the end of an episode are left out: the share of their discounted weight that lies beyond it,
    :math:`\gamma^{T - t}`, may be at most ``tail``. Each bin holds as many steps as the next.

    Args:
        mean (Tensor): predicted mean at every step of N episodes, ``[N, T]``.
        cvar (Tensor): predicted CVaR, ``[N, T]``.
        cost (Tensor): cost of every step, ``[N, T]``. Episodes of a time limit, not of a
            termination: costs beyond ``T`` are cut, not absent.

    Keyword Args:
        gamma (float): discount of the critic, in [0, 1).
        risk_level (float): share of worst outcomes in the CVaR, in (0, 1].
        num_bins (int): bins, M. Defaults to 10.
        tail (float): largest discounted weight beyond the episode. Defaults to 0.05.

    Returns:
        TensorDict: batch size [M], float64, rising in prediction: ``predicted_mean``,
        ``realised_mean``, ``predicted_cvar``, ``realised_cvar``, and 95 % intervals
        ``realised_mean_low`` and so on, from resampling whole episodes: steps of one episode
        are not independent.

    Raises:
        ValueError: if shapes differ, an option is out of range, or the episodes are too short to
            have a step of which enough is known.

    Examples:
        >>> import torch
        >>> cost = torch.ones(8, 500)
        >>> truth = torch.full((8, 500), 10.0)  # 1 / (1 - 0.9), up to the end's share
        >>> bins = calibrate(truth, truth, cost, gamma=0.9, risk_level=0.5, num_bins=2)
        >>> bins["realised_mean"].round(decimals=1).tolist()
        [10.0, 10.0]
    """
    if mean.ndim != 2 or not mean.shape == cvar.shape == cost.shape:
        raise ValueError(
            "mean, cvar and cost must have one shape [N, T], got "
            f"{tuple(mean.shape)}, {tuple(cvar.shape)} and {tuple(cost.shape)}."
        )
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma must be in [0, 1), got {gamma}.")
    if not 0 < risk_level <= 1:
        raise ValueError(f"risk_level must be in (0, 1], got {risk_level}.")
    if num_bins < 1:
        raise ValueError(f"num_bins must be at least 1, got {num_bins}.")
    if not 0 < tail < 1:
        raise ValueError(f"tail must be in (0, 1), got {tail}.")
    episodes, steps = cost.shape
    known = gamma ** torch.arange(steps, 0, -1, dtype=torch.float64) <= tail
    if int(known.sum()) * episodes < num_bins:
        raise ValueError(
            f"cost has {steps} steps per episode; at gamma={gamma}, no more than {tail:g} of a sum "
            f"may lie beyond the end: {num_bins} bins need longer episodes, or more of them."
        )
    realised = discounted_sums(cost, gamma)[:, known]
    mean, cvar = mean[:, known].double(), cvar[:, known].double()
    rank = mean.flatten().argsort(stable=True).argsort()
    bin_of = (rank * num_bins // rank.numel()).reshape(mean.shape)
    generator = torch.Generator().manual_seed(0)
    samples = torch.randint(episodes, (_NUM_RESAMPLES, episodes), generator=generator)
    # How often each episode is in each resample: [R, N].
    weights = torch.zeros(_NUM_RESAMPLES, episodes, dtype=torch.float64)
    weights.scatter_add_(1, samples, torch.ones_like(samples, dtype=torch.float64))
    whole = torch.ones(1, episodes, dtype=torch.float64)
    bins = []
    for index in range(num_bins):
        member = bin_of == index
        owner = member.nonzero()[:, 0]
        outcome, order = realised[member].sort(descending=True)
        owner = owner[order]
        row = {"predicted_mean": mean[member].mean(), "predicted_cvar": cvar[member].mean()}
        for name, share in (("mean", 1.0), ("cvar", risk_level)):
            row[f"realised_{name}"] = _worst_mean(outcome, whole[:, owner], share)[0]
            spread = _worst_mean(outcome, weights[:, owner], share)
            low, high = spread[spread.isfinite()].quantile(spread.new_tensor([0.025, 0.975]))
            row[f"realised_{name}_low"], row[f"realised_{name}_high"] = low, high
        bins.append(TensorDict(row))
    return torch.stack(bins)


def plot_calibration(bins: TensorDict, path: str | os.PathLike[str]) -> Path:
    """Draws what :func:`calibrate` returned; on the diagonal, the critic is right.

    Points below the diagonal are predictions that were too high, hence on the safe side.

    Args:
        bins (TensorDict): batch size [M].
        path (path): the picture; its suffix picks the format. Missing parents are made.

    Returns:
        Path: the picture.

    Examples:
        >>> import tempfile, torch
        >>> x = torch.rand(4, 400)
        >>> bins = calibrate(x, x, x, gamma=0.9, risk_level=0.5, num_bins=3)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_calibration(bins, f"{folder}/calibration.png").name
        'calibration.png'
    """
    need("a plot", "train", "matplotlib")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4.4), layout="constrained")
    for axes, name, title in zip(
        figure.subplots(1, 2), ("mean", "cvar"), ("Mean", "CVaR"), strict=True
    ):
        predicted, realised = bins[f"predicted_{name}"], bins[f"realised_{name}"]
        low, high = bins[f"realised_{name}_low"], bins[f"realised_{name}_high"]
        end = 1.05 * float(torch.cat((predicted, high)).max())
        axes.plot([0, end], [0, end], color="#999999", ls="--", lw=1)
        axes.errorbar(
            predicted.numpy(),
            realised.numpy(),
            yerr=torch.stack((realised - low, high - realised)).clamp(min=0).numpy(),
            fmt="o",
            ms=4,
            color="#0072B2",
            capsize=2,
        )
        axes.set(title=f"{title} of the discounted cost", xlabel="predicted", ylabel="realised")
        axes.set(xlim=(0, end), ylim=(0, end))
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    path = expand(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        figure.savefig(draft, dpi=150)
    return path


def _worst_mean(outcome: Tensor, weights: Tensor, share: float) -> Tensor:
    """Mean of the largest ``share`` of falling outcomes [S], each counted ``weights`` [R, S]."""
    budget = share * weights.sum(-1, keepdim=True)
    before = weights.cumsum(-1) - weights
    taken = (budget - before).clamp(min=0).minimum(weights)
    return (taken * outcome).sum(-1) / taken.sum(-1)
