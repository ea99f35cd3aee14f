"""Where things are put at the start: apart from each other, by rejection, over a batch."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array
from torchrl_safe.envs.tasks.base import length

_ATTEMPTS = 2000  # layouts started before giving up
_AT_ONCE = 16  # most attempts that are made at once for an environment
_FIRST = 6  # candidates looked at first: mostly one of them will do
_GOAL_CANDIDATES = 256  # positions tried for one that moves during an episode


def scatter(
    keepout: Array,
    extent: float,
    streams: RandomStreams,
    rows: NDArray[np.integer],
    candidates: int = 32,
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
        candidates (int): positions tried for one object before its layout is started again.

    Returns:
        array: [n, K, 2].

    Raises:
        ValueError: if a disc does not fit the square, or some environment found no layout.
    """
    count, half = len(keepout), extent - keepout
    if half.min() < 0.0:
        raise ValueError(f"a keepout of {keepout.max()} does not fit an extent of {extent}.")
    layout = np.empty((len(rows), count), complex)
    pending, made, at_once = np.arange(len(rows)), 0, 1
    numbers = 2 * count * candidates  # of one attempt, whether it needs them or not
    while made < _ATTEMPTS:
        owner = np.repeat(pending, at_once)
        attempt = np.tile(np.arange(at_once), len(pending))
        placed, legal = _attempt(keepout, half, streams, rows[owner], attempt * numbers, candidates)
        # The first legal attempt counts, as if each had waited for the one before it.
        found, first = np.unique(owner[legal], return_index=True)
        layout[found] = placed[legal[first]]
        streams.skip(rows[found], (attempt[legal[first]] + 1) * numbers)
        pending = np.setdiff1d(pending, found, assume_unique=True)
        if not pending.size:
            return layout.view(float).reshape(-1, count, 2)
        streams.skip(rows[pending], at_once * numbers)
        made, at_once = made + at_once, min(2 * at_once, _AT_ONCE)
    raise ValueError(
        f"no legal layout found in {_ATTEMPTS} attempts for {count} objects in an extent of "
        f"{extent}: use fewer hazards or other objects, smaller keepouts or a larger extent."
    )


def _attempt(
    keepout: Array,
    half: Array,
    streams: RandomStreams,
    rows: NDArray[np.integer],
    ahead: NDArray[np.integer],
    candidates: int,
) -> tuple[NDArray[np.complex128], NDArray[np.intp]]:
    """Layouts [n, K] as complex numbers, of the numbers ``ahead`` [n], and which are legal."""
    # A distance of complex numbers is one absolute value.
    placed = np.empty((len(rows), len(keepout)), complex)
    legal = np.arange(len(rows))
    for j in range(len(keepout)):
        nowhere = legal
        for start, end in ((0, _FIRST), (_FIRST, candidates)):
            skipped = ahead[nowhere] + 2 * (j * candidates + start)
            draws = streams.peek(rows[nowhere], skipped, 2 * (end - start)) * 2.0 - 1.0
            places = draws.view(complex) * half[j]
            distance = np.abs(places[:, :, None] - placed[nowhere, None, :j])
            free = (distance >= keepout[j] + keepout[:j]).all(-1)
            found = free.any(-1)
            placed[nowhere[found], j] = places[found, free[found].argmax(-1)]
            nowhere = nowhere[~found]
            if not nowhere.size:
                break
        legal = np.setdiff1d(legal, nowhere, assume_unique=True)
    return placed, legal


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
    goal = np.empty((len(rows), 2))
    nowhere = np.arange(len(rows))
    for count in (_FIRST, _GOAL_CANDIDATES):
        draws = streams.peek(rows[nowhere], np.zeros(len(nowhere), np.int64), 2 * count)
        places = (draws.reshape(-1, count, 2) * 2.0 - 1.0) * (extent - keepout)
        gaps = length(places[:, :, None] - others[nowhere, None]) - other_keepouts
        clearance = gaps.min(-1)
        legal = clearance >= keepout
        best = np.where(legal.any(-1), legal.argmax(-1), clearance.argmax(-1))
        goal[nowhere] = places[np.arange(len(nowhere)), best]
        nowhere = nowhere[~legal.any(-1)]
        if not nowhere.size:
            break
    streams.skip(rows, 2 * _GOAL_CANDIDATES)
    return goal
