"""The trust-region subproblem: a linear objective, linear constraints, one quadratic constraint.

Equation (17) of SafeTAC, the step of CPO (arXiv 1705.10528), for any number
of constraints::

    maximise g'x   subject to   c + B x <= 0   and   x'H x / 2 <= max_kl

or that of PCPO (arXiv 2010.03152), which follows the objective first and is then projected. Either
solution lies in the span of ``H^-1 g`` and ``H^-1 b_i``, so it only needs their Gram matrix.
Everything here is double precision and has no more than ``1 + m`` dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

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
    problem = _in_radii(q, r, s, c, max_kl)
    if isinstance(problem, Subproblem):
        return problem
    sets, distance, flat = problem.sets, problem.distance, problem.flat
    case = "feasible"
    if flat or (distance > _FEASIBILITY).any():
        target, repaired = _recover(sets, distance, recovery_ratio)
        if not (target[distance > 0] > _FEASIBILITY).any():
            return problem.rejected("no step lowers a violated constraint")
        case = "recoverable" if repaired and not flat else "infeasible"
        distance = target
    return problem.solution(case, *sets.best(distance, problem.unit, problem.cosine))


def project_step(q: float, r: ArrayLike, s: ArrayLike, c: ArrayLike, max_kl: float) -> Subproblem:
    r"""The step of PCPO (Yang et al. 2020, https://arxiv.org/abs/2010.03152), for m constraints.

    It is that of TRPO, ``x_r = sqrt(2 max_kl / q) H^-1 g``, moved to the nearest point, in the
    metric of ``H``, where the linearised constraints hold::

        minimise (x - x_r)'H (x - x_r) / 2   subject to   c + B x <= 0

    For one constraint, ``x = x_r - max(0, (b'x_r + c) / s) H^-1 b``. A point outside the trust
    region is drawn back to its boundary, on the straight line to where the step starts: there a
    violated constraint is still nearer to its limit, and a satisfied one satisfied.

    Args:
        q (float): ``g' H^-1 g``.
        r (array): ``b_i' H^-1 g``, shape [m].
        s (array): ``b_i' H^-1 b_j``, shape [m, m].
        c (array): value of the constraints, shape [m], in their own units; satisfied at ``<= 0``.
        max_kl (float): size of the region, in nats.

    Returns:
        Subproblem: the weights of the step, and the case. There is no step where no point satisfies
        all constraints.

    Raises:
        ValueError: for more than 10 constraints, or shapes that do not fit each other.

    Examples:
        >>> solution = project_step(1.0, [0.5], [[1.0]], [0.25], max_kl=0.5)
        >>> solution.case, float(solution.objective_weight), solution.constraint_weight.tolist()
        ('recoverable', 1.0, [0.75])
    """
    problem = _in_radii(q, r, s, c, max_kl, reach=np.inf)
    if isinstance(problem, Subproblem):
        return problem
    weight = None if problem.flat else problem.sets.nearest(problem.distance + problem.cosine)
    if weight is None:
        return problem.rejected("no step satisfies all constraints")
    square = problem.unit - 2 * weight @ problem.cosine + weight @ problem.sets.gram @ weight
    length = max(1.0, float(np.sqrt(square)))
    if (problem.distance > _FEASIBILITY).any():
        case = "recoverable" if length <= 1 + _FEASIBILITY else "infeasible"
    else:
        case = "feasible" if (problem.distance >= -1).any() else "inert"
    return problem.solution(case, problem.unit / length, weight / length)


def _in_radii(
    q: float, r: ArrayLike, s: ArrayLike, c: ArrayLike, max_kl: float, reach: float = 1.0
) -> _InRadii | Subproblem:
    """The problem in units of the region's radius; or what is known without solving it.

    A constraint is left out that no step of length ``reach`` can violate.
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
    kept = np.flatnonzero((variance > 0) & (distance >= -reach))
    objective_scale = length / unit[0] if q > 0 else 0.0
    flat = bool(((variance == 0) & (c > 0)).any())
    if not (kept.size or flat):
        return Subproblem("inert" if m else "unconstrained", objective_scale, weight)
    return _InRadii(
        sets=_ActiveSets(gram[1:, 1:][np.ix_(kept, kept)]),
        distance=distance[kept],
        unit=float(gram[0, 0]),
        cosine=gram[0, 1:][kept],
        flat=flat,
        kept=kept,
        num_constraints=m,
        objective_scale=objective_scale,
        constraint_scale=length / unit[1:][kept],
    )


class _InRadii(NamedTuple):
    """A subproblem in units of the region's radius, of the constraints within reach."""

    sets: _ActiveSets
    distance: Array  # d_i, [kept]
    unit: float  # squared length of v_0: one, or zero when there is no objective
    cosine: Array  # v_i'v_0, [kept]
    flat: bool  # whether a violated constraint has no gradient
    kept: NDArray[np.intp]
    num_constraints: int
    objective_scale: float
    constraint_scale: Array  # [kept]

    def solution(self, case: str, along_objective: float, along_constraint: Array) -> Subproblem:
        """The step ``a v_0 - sum_i w_i v_i`` in the problem's own units."""
        weight = np.zeros(self.num_constraints)
        weight[self.kept] = along_constraint * self.constraint_scale
        return Subproblem(case, along_objective * self.objective_scale, weight)

    def rejected(self, reason: str) -> Subproblem:
        """No step."""
        return Subproblem("rejected", 0.0, np.zeros(self.num_constraints), reason)


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

    def nearest(self, distance: Array) -> Array | None:
        """Weights of the polyhedron's point nearest to the origin, [m]; none if it is empty."""
        weight, norm, near = self._nearest(distance, np.inf)
        tolerance = _FEASIBILITY * (1 + np.abs(distance))
        valid = near & (distance - weight @ self.gram <= tolerance).all(-1)
        if not valid.any():
            return None
        return np.asarray(weight[np.where(valid, norm, np.inf).argmin()])

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
