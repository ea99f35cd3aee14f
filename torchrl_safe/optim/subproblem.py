"""The trust-region subproblem: a linear objective, linear constraints, one quadratic constraint.

Equation (17) of SafeTAC, the step of CPO (arXiv 1705.10528), for any number
of constraints::

    maximise g'x   subject to   c + B x <= 0   and   x'H x / 2 <= max_kl

The solution lies in the span of ``H^-1 g`` and ``H^-1 b_i``, so it only needs their Gram matrix.
Everything here is double precision and has no more than ``1 + m`` dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

MAX_CONSTRAINTS = 10
"""The active sets are enumerated, all ``2**m`` of them at once."""

_FEASIBILITY = 5e-7  # of a constraint, in radii of the trust region
# Squared sine below which two gradients count as parallel: taken for one, they miss by the sine.
_DEPENDENT = 1e-14
_INDEFINITE = 1e-6  # least eigenvalue of unit vectors' products, below zero, that is no rounding

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Subproblem:
    """The solution ``x = H^-1 (objective_weight * g - B' constraint_weight)``.

    Attributes:
        case (str): ``"unconstrained"`` (no constraint), ``"inert"`` (none can become active inside
            the region), ``"feasible"`` (all hold now), ``"recoverable"`` (a violated one is
            repaired inside the region), ``"infeasible"`` (some violation stays) or ``"rejected"``
            (no step, see ``reason``).
        objective_weight (float): weight of ``H^-1 g``.
        constraint_weight (numpy.ndarray): weights of the ``H^-1 b_i``, shape [m].
        reason (str): why there is no step; empty otherwise.
    """

    case: str
    objective_weight: float
    constraint_weight: Array
    reason: str = ""


def solve_subproblem(
    q: float,
    r: ArrayLike,
    s: ArrayLike,
    c: ArrayLike,
    max_kl: float,
    recovery_ratio: float = 1.0,
) -> Subproblem:
    """Solves the trust-region subproblem from its Gram scalars.

    In units of the region's radius, with ``v_0 .. v_m`` the unit vectors along the gradients in
    the metric of ``H^-1``, the problem is to maximise ``v_0'y`` over ``|y| <= 1`` and
    ``v_i'y <= -d_i``, ``d_i = c_i / sqrt(2 max_kl s_ii)``. For a set of active constraints the best
    point is known in closed form, and the best feasible one over all sets is the optimum. With one
    constraint the two sets are the two branches of the closed form in the literature.

    Violations that cannot all be removed by a step of length ``recovery_ratio`` (in radii) are
    lowered in this order, while satisfied constraints keep holding and no violated one grows:

    1. Those are removed that can be, the one with the smallest ``d_i`` first: each is added if it
       can be removed together with those before it.
    2. The sum of the others' ``d_i + v_i'y`` is made as small as possible.
    3. The rest of the region serves the objective, with all these reductions kept.

    One that cannot be lowered, as its gradient is zero or opposed to that of another, thus leaves
    the region to the others. With one constraint the violation falls by
    ``recovery_ratio * sqrt(2 max_kl s)``, and ``recovery_ratio=1`` is the pure recovery step
    ``-sqrt(2 max_kl / s) H^-1 b``. If no violation can be lowered there is no step: the objective
    alone is not followed from where a constraint is violated.

    Args:
        q (float): ``g' H^-1 g``.
        r (array): ``b_i' H^-1 g``, shape [m].
        s (array): ``b_i' H^-1 b_j``, shape [m, m].
        c (array): value of the constraints, shape [m], in their own units; satisfied at ``<= 0``.
        max_kl (float): size of the region, in nats.
        recovery_ratio (float): share of the region's radius that recovery may use, in (0, 1].

    Returns:
        Subproblem: the weights of the step, and the case.

    Raises:
        ValueError: for more than 10 constraints, or shapes that do not fit each other.

    Examples:
        >>> solution = solve_subproblem(1.0, [1.0], [[1.0]], [-0.5], max_kl=0.5)
        >>> solution.case, float(solution.objective_weight), solution.constraint_weight.tolist()
        ('feasible', 0.0, [-0.5])
        >>> solve_subproblem(1.0, [0.0], [[1.0]], [3.0], max_kl=0.5).case
        'infeasible'
    """
    r, s, c = (np.asarray(value, dtype=np.float64) for value in (r, s, c))
    m = c.size
    if r.shape != (m,) or s.shape != (m, m) or c.shape != (m,):
        raise ValueError(
            f"r, s and c must have shapes [m], [m, m] and [m], got {r.shape}, {s.shape}, {c.shape}."
        )
    if m > MAX_CONSTRAINTS:
        raise ValueError(f"at most {MAX_CONSTRAINTS} constraints are supported, got {m}.")
    weight = np.zeros(m)
    variance = np.diag(s)
    if not all(np.isfinite(value).all() for value in (q, r, s, c, max_kl)):
        return Subproblem("rejected", 0.0, weight, "non-finite products of the gradients")
    unit = np.sqrt(np.clip([q, *variance], 0, None))
    unit[unit == 0] = 1.0
    gram = np.block([[np.full((1, 1), q), r[None]], [r[:, None], s]]) / np.outer(unit, unit)
    if q < 0 or (variance < 0).any() or np.linalg.eigvalsh(gram)[0] < -_INDEFINITE:
        return Subproblem("rejected", 0.0, weight, "the curvature is not positive definite")
    length = np.sqrt(2 * max_kl)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = c / (length * np.sqrt(variance))
    # A satisfied constraint whose boundary lies outside the region cannot become active.
    kept = np.flatnonzero((variance > 0) & (distance >= -1))
    objective_scale = length / unit[0] if q > 0 else 0.0
    flat = bool(((variance == 0) & (c > 0)).any())
    if not (kept.size or flat):
        return Subproblem("inert" if m else "unconstrained", objective_scale, weight)
    sets = _ActiveSets(gram[1:, 1:][np.ix_(kept, kept)])
    distance = distance[kept]
    case = "feasible"
    if flat or (distance > _FEASIBILITY).any():
        target, repaired = _recover(sets, distance, recovery_ratio)
        if not (target[distance > 0] > _FEASIBILITY).any():
            return Subproblem("rejected", 0.0, weight, "no step lowers a violated constraint")
        case = "recoverable" if repaired and not flat else "infeasible"
        distance = target
    along_objective, along_constraint = sets.best(distance, gram[0, 0], gram[0, 1:][kept])
    scale = unit[1:][kept]
    weight[kept] = along_constraint * length / scale
    return Subproblem(case, along_objective * objective_scale, weight)


class _ActiveSets:
    """The sets of constraints ``v_i'y <= -d_i`` that may hold with equality, each a flat of points.

    Args:
        gram (numpy.ndarray): ``v_i'v_j``, shape [m, m].
    """

    def __init__(self, gram: Array) -> None:
        m = len(gram)
        active = (np.arange(2**m)[:, None] >> np.arange(m)) & 1
        active = active[np.argsort(active.sum(1), kind="stable")].astype(bool)
        both = active[:, :, None] & active[:, None, :]
        restricted = np.where(both, gram, np.eye(m))
        # Linearly dependent gradients add nothing: an independent subset has the same flat.
        values, vectors = np.linalg.eigh(restricted)
        independent = (values > _DEPENDENT).all(-1)
        self.gram = gram
        self.active = active[independent]
        # Not multiplied out: what rounding does then stays along the gradients that nearly cancel.
        self.values, self.vectors = values[independent], vectors[independent]

    def _solve(self, rhs: Array) -> Array:
        """Weights ``G_A^-1 rhs_A`` of each set A, zero elsewhere, [sets, m]."""
        rhs = np.where(self.active, rhs, 0.0)[:, None, :] @ self.vectors / self.values[:, None, :]
        return np.where(self.active, (self.vectors @ rhs.swapaxes(1, 2))[..., 0], 0.0)

    def _nearest(self, distance: Array, radius: float) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Weights of the point of each flat nearest to the origin, [sets, m], and its norm^2.

        And whether that is within the radius.
        """
        weight = self._solve(distance)
        norm = weight @ distance
        return weight, norm, (norm >= -_FEASIBILITY) & (norm <= radius**2 * (1 + _FEASIBILITY))

    def _feasible(self, values: Array, distance: Array) -> NDArray[np.bool_]:
        return np.asarray((values + distance <= _FEASIBILITY).all(-1))

    def reaches(self, distance: Array, radius: float) -> bool:
        """Whether some point within ``radius`` of the origin satisfies all constraints."""
        weight, _, near = self._nearest(distance, radius)
        return bool((near & self._feasible(-weight @ self.gram, distance)).any())

    def best(
        self, distance: Array, unit: float, cosine: Array, radius: float = 1.0
    ) -> tuple[float, Array]:
        """The optimum ``y = a u - sum_i w_i v_i`` of ``u'y`` in a ball that the polyhedron reaches.

        Args:
            distance (numpy.ndarray): ``d_i``, shape [m].
            unit (float): squared length of ``u``: one, or zero when there is no objective.
            cosine (numpy.ndarray): ``v_i'u``, shape [m].
            radius (float): of the ball.

        Returns:
            tuple: ``a`` and ``w``, shape [m].
        """
        nearest, norm, near = self._nearest(distance, radius)
        slope = self._solve(cosine)
        free = unit - slope @ cosine
        # What is left of the objective along each flat, none where it is normal to it.
        free = np.where(free > _DEPENDENT, free, 0.0)
        room = np.sqrt(np.clip(radius**2 - norm, 0, None))
        along = np.divide(room, np.sqrt(free), out=np.zeros_like(room), where=free > 0)
        # Where a flat only touches the ball, rounding may leave no more than its nearest point.
        a = np.concatenate([along, np.zeros_like(along)])
        nearest, slope, free, near = (np.concatenate([x, x]) for x in (nearest, slope, free, near))
        weight = nearest + a[:, None] * slope
        valid = near & self._feasible(a[:, None] * cosine - weight @ self.gram, distance)
        # u'y; the part along the flat is a * free, without cancellation.
        objective = np.where(valid, a * free - nearest @ cosine, -np.inf)
        index = int(objective.argmax())
        return float(a[index]), weight[index]


def _recover(sets: _ActiveSets, distance: Array, radius: float) -> tuple[Array, bool]:
    """Distances to go when violations fall as :func:`solve_subproblem` says.

    Args:
        sets (_ActiveSets): of the constraints.
        distance (numpy.ndarray): ``d_i``, shape [m].
        radius (float): of the region that recovery may use.

    Returns:
        tuple: the distances, shape [m], and whether nothing is violated after them.
    """
    violated = distance > 0
    left, target = violated.copy(), np.where(violated, 0.0, distance)
    if sets.reaches(distance, radius):
        return distance, True
    for i in np.flatnonzero(violated)[np.argsort(distance[violated], kind="stable")]:
        more = target.copy()
        more[i] = distance[i]
        if sets.reaches(more, radius):
            left[i], target = False, more
    # What is left, lowered together: none of it could be removed, so there is none to stop at.
    down = -sets.gram @ left
    length = np.sqrt(max(-down @ left, 0.0))
    aligned = length > np.sqrt(_DEPENDENT)
    cosine = down / length if aligned else np.zeros_like(down)
    a, weight = sets.best(target, float(aligned), cosine, radius)
    fall = np.where(left, weight @ sets.gram - a * cosine, 0.0)
    # As found, or by as much less as rounding asks for: at the last slack nothing more has to fall.
    for slack in (0.0, *10.0 ** np.arange(-12, 1)):
        lowered = np.where(left, np.clip(fall - slack, 0, distance), target)
        if sets.reaches(lowered, radius):
            break
    return lowered, False
