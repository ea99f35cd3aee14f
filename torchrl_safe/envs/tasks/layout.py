"""Where things are put at the start: apart from each other, by rejection, over a batch."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs.robots import Array
from torchrl_safe.envs.tasks.base import length

_ATTEMPTS = 2000  # layouts started before giving up
_AT_ONCE = 512  # attempts that are made at once, or one for each environment
_FIRST, _SECOND = 6, 24  # candidates looked at first and then: mostly one of them will do
_BLOCK = 32_768  # candidates compared at once: they stay in the processor's cache
_FEW = 5  # discs that a candidate is compared with first: mostly it is too near to one of them
_SMALL = 8192  # comparisons that are not worth such care
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
    layout = np.empty((len(rows), count, 2))
    pending, made, at_once = np.arange(len(rows)), 0, 1
    numbers = 2 * count * candidates  # of one attempt, whether it needs them or not
    while made < _ATTEMPTS:
        owner = np.repeat(pending, at_once)
        attempt = np.tile(np.arange(at_once), len(pending))
        placed, legal = _attempt(keepout, half, streams, rows[owner], attempt * numbers, candidates)
        # The first legal attempt counts, as if each had waited for the one before it.
        whose = owner[legal]
        first = legal[np.append(True, whose[1:] != whose[:-1])[: len(whose)]]
        found = owner[first]
        layout[found] = placed[:, :, first].T
        streams.skip(rows[found], (attempt[first] + 1) * numbers)
        pending = _without(pending, found, len(rows))
        if not pending.size:
            return layout
        streams.skip(rows[pending], at_once * numbers)
        made, at_once = made + at_once, max(1, min(4 * at_once, _AT_ONCE // len(pending)))
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
) -> tuple[Array, NDArray[np.intp]]:
    """Layouts [2, K, n] of the numbers ``ahead`` [n], and which of them are legal."""
    objects = np.arange(len(keepout))
    placed = np.empty((2, len(keepout), len(rows)))

    def draw(which: NDArray[np.integer], start: int, end: int, some: NDArray[np.integer]) -> Array:
        """Candidates [2, k, c, n] of the objects ``which`` in some of the attempts."""
        number = 2 * (which[:, None] * candidates + np.arange(start, end))
        places = streams.peek(rows[some], np.stack((number, number + 1))[..., None], ahead[some])
        places *= 2.0
        places -= 1.0
        places *= half[which, None, None]
        return places

    def settle(j: int, places: Array, some: NDArray[np.integer]) -> NDArray[np.integer]:
        """Puts an object on the first legal one of the places [2, c, n]; who has none is left."""
        others = placed[:, :j] if len(some) == len(rows) else placed[:, :j].take(some, -1)
        free = _clear(places, others, keepout[j] + keepout[:j])
        first, each = free.argmax(0), np.arange(len(some))
        found = free[first, each]
        placed[:, j, some] = places[:, first, each]
        return some[~found]

    legal = np.arange(len(rows))
    at_first = draw(objects, 0, _FIRST, legal)
    for j in range(len(keepout)):
        nowhere = settle(j, at_first[:, j].take(legal, -1), legal)
        if not nowhere.size:
            continue
        for start, end in pairwise((_FIRST, _SECOND, candidates)):
            ends = range(_BLOCK // (end - start), len(nowhere), _BLOCK // (end - start))
            parts = np.split(nowhere, ends)
            left = [settle(j, draw(objects[[j]], start, end, part)[:, 0], part) for part in parts]
            nowhere = np.concatenate(left)
        legal = _without(legal, nowhere, len(rows))
    return placed, legal


def _without(
    some: NDArray[np.integer], others: NDArray[np.integer], count: int
) -> NDArray[np.intp]:
    """Those of some numbers below ``count`` that are not among others."""
    left = np.zeros(count, bool)
    left[some] = True
    left[others] = False
    return np.flatnonzero(left)


def _clear(places: Array, others: Array, gaps: Array) -> NDArray[np.bool_]:
    """Which of the places [2, c, n] are as far as ``gaps`` [K] from the others [2, K, n]."""
    gaps = gaps**2
    if len(gaps) * places.size < _SMALL:
        return _apart(places, others[:, :, None], gaps[:, None, None])
    # Those that keep most away come first: they leave few candidates to the others.
    order = np.argsort(-gaps, kind="stable")
    few, rest = order[:_FEW], order[_FEW:]
    free = _apart(places, others[:, few, None], gaps[few, None, None])
    if rest.size:
        where = np.flatnonzero(free)
        left = places.reshape(2, -1).take(where, -1)
        others = others[:, rest].take(where % free.shape[1], -1)
        free.reshape(-1)[where] = _apart(left, others, gaps[rest, None])
    return free


def _apart(places: Array, others: Array, gaps: Array) -> NDArray[np.bool_]:
    """Which of the places [2, ...] are far enough from all others [2, K, ...]."""
    square, other = others - places[:, None]
    # In place: memory that is asked for anew costs more than the arithmetic.
    square *= square
    other *= other
    square += other
    return np.asarray((square >= gaps).all(0))


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
        draws = streams.peek(rows[nowhere, None], np.arange(2 * count))
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
