"""Where things are put at the start: apart from each other, by rejection, over a batch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array
from torchrl_safe.envs.tasks.base import length

_CANDIDATES = 32  # positions tried for one object before its layout is started again
_ATTEMPTS = 200  # layouts started before giving up
_GOAL_CANDIDATES = 256  # positions tried for one that moves during an episode


def scatter(
    keepout: Array, extent: float, streams: RandomStreams, rows: NDArray[np.integer]
) -> Array:
    """Draws positions whose keepout discs do not overlap.

    Objects are drawn one after the other, uniformly in the square shrunk by their keepout, and
    redrawn until their discs do not overlap the earlier ones; an object that finds no place starts
    its layout again.

    Args:
        keepout (array): [K], radii of the discs, metres.
        extent (float): half the side of the square.
        streams (RandomStreams): one stream per environment, advanced in place.
        rows (array): [n], the environments to draw for.

    Returns:
        array: [n, K, 2].

    Raises:
        ValueError: if a disc does not fit the square, or some environment found no layout.
    """
    count, half = len(keepout), extent - keepout
    if half.min() < 0.0:
        raise ValueError(f"a keepout of {keepout.max()} does not fit an extent of {extent}.")
    gap = keepout[:, None] + keepout
    # Positions are complex numbers here: a distance is one absolute value.
    layout = np.empty((len(rows), count), complex)
    pending = np.arange(len(rows))
    for _ in range(_ATTEMPTS):
        draws = streams.uniform(rows[pending], count * _CANDIDATES * 2) * 2.0 - 1.0
        candidates = draws.view(complex).reshape(-1, count, _CANDIDATES) * half[:, None]
        placed = candidates[:, :, 0].copy()
        legal = np.ones(len(pending), bool)
        index = np.arange(len(pending))
        for j in range(1, count):
            distance = np.abs(candidates[:, j, :, None] - placed[:, None, :j])
            free = (distance >= gap[j, :j]).all(-1)
            first = free.argmax(-1)
            legal &= free[index, first]
            placed[:, j] = candidates[index, j, first]
        layout[pending[legal]] = placed[legal]
        pending = pending[~legal]
        if not pending.size:
            return layout.view(float).reshape(-1, count, 2)
    raise ValueError(
        f"no legal layout found in {_ATTEMPTS} attempts for {count} objects in an extent of "
        f"{extent}: use fewer hazards or other objects, smaller keepouts or a larger extent."
    )


def place_goal(
    keepout: float,
    extent: float,
    others: Array,
    other_keepouts: Array,
    streams: RandomStreams,
    rows: NDArray[np.integer],
) -> Array:
    """Draws a goal clear of everything else.

    The first legal one of 256 uniform candidates is taken. Where there is none, the candidate with
    the most clearance is, so the draw always ends.

    Args:
        keepout (float): radius of the goal's disc, metres.
        extent (float): half the side of the square.
        others (array): [n, K, 2].
        other_keepouts (array): [K].
        streams (RandomStreams): one stream per environment, advanced in place.
        rows (array): [n], the environments to draw for.

    Returns:
        array: [n, 2].
    """
    draws = streams.uniform(rows, 2 * _GOAL_CANDIDATES).reshape(-1, _GOAL_CANDIDATES, 2)
    candidates = (draws * 2.0 - 1.0) * (extent - keepout)
    gaps = length(candidates[:, :, None] - others[:, None]) - other_keepouts
    clearance = gaps.min(-1)
    legal = clearance >= keepout
    choice = np.where(legal.any(-1), legal.argmax(-1), clearance.argmax(-1))
    return candidates[np.arange(len(rows)), choice]
