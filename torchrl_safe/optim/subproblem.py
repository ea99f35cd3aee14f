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

_FEASIBILITY = 1e-9  # of a constraint, in radii of the trust region
_DEPENDENT = 1e-12  # squared sine below which two gradients count as parallel
_BISECTIONS = 60

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Subproblem:
    """The solution ``x = H^-1 (objective_weight * g - B' constraint_weight)``.

    Attributes:
        case (str): ``"unconstrained"`` (no constraint), ``"inert"`` (none can become active inside
            the region), ``"feasible"`` (all hold now), ``"recoverable"`` (a violated one is
            repaired inside the region), ``"infeasible"`` (the violation is only reduced) or
            ``"rejected"`` (no step, see ``reason``).
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

    A violation that cannot be removed is shared out as follows. The largest scaled violation
    ``t = max_i (d_i + v_i'y)``, over the violated constraints, is made as small as a step of
    length ``recovery_ratio`` (in radii) can make it, while satisfied constraints keep holding and
    no violated one grows; the rest of the region then serves the objective, with that reduction
    kept. With one constraint this caps the violation at ``recovery_ratio * sqrt(2 max_kl s)``, and
    ``recovery_ratio=1`` is the pure recovery step ``-sqrt(2 max_kl / s) H^-1 b``.

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
    if q < 0 or (variance < 0).any():
        return Subproblem("rejected", 0.0, weight, "the curvature is not positive definite")
    if ((variance == 0) & (c > 0)).any():
        return Subproblem("rejected", 0.0, weight, "a violated constraint has no gradient")

    length = np.sqrt(2 * max_kl)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        distance = c / (length * np.sqrt(variance))
    # A satisfied constraint whose boundary lies outside the region cannot become active.
    kept = np.flatnonzero((variance > 0) & (distance >= -1))
    objective_scale = length / np.sqrt(q) if q > 0 else 0.0
    if not kept.size:
        return Subproblem("inert" if m else "unconstrained", objective_scale, weight)
    scale = np.sqrt(variance[kept])
    cosine = r[kept] / (np.sqrt(q) * scale) if q > 0 else np.zeros(kept.size)
    faces = _Faces(float(q > 0), cosine, s[np.ix_(kept, kept)] / np.outer(scale, scale))

    distance = distance[kept]
    case = "feasible"
    if distance.max() > _FEASIBILITY:
        cut = _reachable_reduction(faces, distance, recovery_ratio)
        if cut <= _FEASIBILITY:
            return Subproblem("rejected", 0.0, weight, "no direction lowers the largest violation")
        case = "recoverable" if cut == distance.max() else "infeasible"
        distance = _relax(distance, cut)
    best = faces.best(distance)
    if best is None:
        return Subproblem("rejected", 0.0, weight, "the curvature is not positive definite")
    along_objective, along_constraint = best
    weight[kept] = along_constraint * length / scale
    return Subproblem(case, along_objective * objective_scale, weight)


class _Faces:
    """The faces of the polyhedron ``v_i'y <= -d_i`` under a fixed set of unit vectors.

    Args:
        unit (float): squared length of ``v_0``: one, or zero when there is no objective.
        cosine (numpy.ndarray): ``v_i'v_0``, shape [m].
        gram (numpy.ndarray): ``v_i'v_j``, shape [m, m].
    """

    def __init__(self, unit: float, cosine: Array, gram: Array) -> None:
        m = cosine.size
        active = (np.arange(2**m)[:, None] >> np.arange(m)) & 1
        active = active[np.argsort(active.sum(1), kind="stable")].astype(bool)
        both = active[:, :, None] & active[:, None, :]
        restricted = np.where(both, gram, np.eye(m))
        # Linearly dependent gradients add nothing: an independent subset has the same face.
        independent = np.linalg.eigvalsh(restricted)[:, 0] > _DEPENDENT
        both, restricted = both[independent], restricted[independent]
        self.cosine, self.gram = cosine, gram
        self.inverse = np.where(both, np.linalg.inv(restricted), 0.0)  # [sets, m, m]
        self.slope = self.inverse @ cosine  # [sets, m]
        free = unit - self.slope @ cosine
        # What is left of the objective along each face, none where it is normal to the face.
        self.free = np.where(free > _DEPENDENT, free, 0.0)

    def _nearest(self, distance: Array) -> tuple[Array, Array]:
        """Weights of the point of each face nearest to the origin, [sets, m], and its norm^2."""
        weight = self.inverse @ distance
        return weight, weight @ distance

    def _feasible(self, values: Array, distance: Array) -> NDArray[np.bool_]:
        return np.asarray((values + distance <= _FEASIBILITY).all(-1))

    def reaches(self, distance: Array, radius: float) -> bool:
        """Whether some point within ``radius`` of the origin satisfies all constraints."""
        weight, norm = self._nearest(distance)
        near = (norm >= -_FEASIBILITY) & (norm <= radius**2 * (1 + _FEASIBILITY))
        return bool((near & self._feasible(-weight @ self.gram, distance)).any())

    def best(self, distance: Array) -> tuple[float, Array] | None:
        """The optimum ``y = a v_0 - sum_i w_i v_i`` in the unit ball, as ``a`` and ``w`` [m]."""
        nearest, norm = self._nearest(distance)
        room = np.sqrt(np.clip(1 - norm, 0, None))
        a = np.divide(room, np.sqrt(self.free), out=np.zeros_like(room), where=self.free > 0)
        weight = nearest + a[:, None] * self.slope
        values = a[:, None] * self.cosine - weight @ self.gram
        valid = (norm >= -_FEASIBILITY) & (norm <= 1 + _FEASIBILITY)
        valid &= self._feasible(values, distance)
        if not valid.any():
            return None
        # v_0'y; the part along the face is a * free, without cancellation.
        objective = np.where(valid, a * self.free - nearest @ self.cosine, -np.inf)
        index = int(objective.argmax())
        return float(a[index]), weight[index]


def _relax(distance: Array, cut: float) -> Array:
    """Distances to go when the largest violation falls by ``cut`` and no other one grows."""
    return np.where(distance > 0, np.clip(distance - distance.max() + cut, 0, None), distance)


def _reachable_reduction(faces: _Faces, distance: Array, radius: float) -> float:
    """The largest fall of the largest violation within ``radius``, both in radii of the region."""
    low, high = 0.0, min(radius, float(distance.max()))
    if faces.reaches(_relax(distance, high), radius):
        return high
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        if faces.reaches(_relax(distance, middle), radius):
            low = middle
        else:
            high = middle
    return low
