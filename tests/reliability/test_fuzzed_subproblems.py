"""Random and degenerate subproblems: always an answer, never a step that breaks a constraint.

The optimality conditions are checked from the vectors that a problem was made of, which the solver
does not see: in a convex problem they hold at the optimum of any solver and nowhere else. Hundreds
of problems are compared with scipy's general solver besides.
"""

from __future__ import annotations

import time
import warnings

import numpy as np
import pytest
from scipy.optimize import linprog, minimize, nnls

from torchrl_safe.optim.subproblem import project_step, solve_subproblem

CASES = ("unconstrained", "inert", "feasible", "recoverable", "infeasible", "rejected")


class Problem:
    """``max g'x`` under ``c + B x <= 0`` and ``x'x <= 2 delta``; the metric is the identity.

    That is no restriction: the solver sees products only, which are those of any metric.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        m, n = rng.integers(0, 5), rng.integers(1, 6)
        self.g = rng.normal(size=n) * 10.0 ** rng.uniform(-8, 8)
        self.b = rng.normal(size=(m, n)) * 10.0 ** rng.uniform(-8, 8, size=(m, 1))
        self.delta = 10.0 ** rng.uniform(-8, 2)
        # Degenerate in one way of many: parallel, opposite, zero, normal to each other.
        for i in range(m):
            kind = rng.integers(0, 12)
            if kind == 0:
                self.b[i] = self.g * rng.choice([-1, 1]) * 10.0 ** rng.uniform(-3, 3)
            elif kind == 1 and i:
                self.b[i] = self.b[i - 1] * rng.choice([-1, 1])
            elif kind == 2:
                self.b[i] = 0
            elif kind == 3:
                self.b[i, rng.integers(n) :] = 0
        if rng.integers(20) == 0:
            self.g = np.zeros(n)
        self.norm = np.linalg.norm(self.b, axis=1)
        self.radius = np.sqrt(2 * self.delta)
        distance = rng.uniform(-1.5, 1.5, size=m)
        distance[rng.random(m) < 0.1] = 0
        if rng.random() < 0.5:
            distance = -np.abs(distance)
        self.c = distance * np.where(self.norm > 0, self.norm * self.radius, 1)
        self.ratio = rng.choice([1.0, 0.7, 0.1])

    @property
    def products(self):
        return self.g @ self.g, self.b @ self.g, self.b @ self.b.T, self.c, self.delta

    def solve(self):
        return solve_subproblem(*self.products, self.ratio)

    def project(self):
        return project_step(*self.products)

    def step(self, solution) -> np.ndarray:
        """In radii of the region, [n]."""
        x = solution.objective_weight * self.g - solution.constraint_weight @ self.b
        return x / self.radius

    @property
    def scaled(self) -> tuple[np.ndarray, np.ndarray]:
        """Unit normals [m, n] and distances [m] in radii of the region; zero gradients drop out."""
        kept = self.norm > 0
        normals = self.b[kept] / self.norm[kept, None]
        return normals, self.c[kept] / (self.norm[kept] * self.radius)


def check(problem: Problem) -> str:
    """The properties that every answer has; returns its case."""
    solution = problem.solve()
    assert solution.case in CASES
    assert np.isfinite([solution.objective_weight, *solution.constraint_weight]).all()
    if solution.case == "rejected":
        assert solution.reason
        assert not solution.objective_weight
        assert not solution.constraint_weight.any()
        return solution.case
    x = problem.step(solution)
    normals, distance = problem.scaled
    assert np.linalg.norm(x) <= 1 + 1e-6
    after = distance + normals @ x
    if solution.case in ("unconstrained", "inert", "feasible"):
        assert (after <= 1e-6).all()
        assert problem.g @ x >= -1e-6 * np.linalg.norm(problem.g) or (distance > -1e-6).any()
        check_optimal(problem, x, after)
    else:
        violated = distance > 0
        assert violated.any()
        assert (after[~violated] <= 1e-6).all()
        assert (after[violated] <= distance[violated] + 1e-6).all()
        assert after.max() <= distance.max() + 1e-6
        if solution.case == "recoverable":
            assert (after <= 1e-6).all()
    return solution.case


def check_optimal(problem: Problem, x: np.ndarray, after: np.ndarray) -> None:
    """KKT: ``g = lam x + B'nu`` with ``lam, nu >= 0``, and nothing but active constraints in it.

    The multipliers are found anew: those of parallel gradients are not unique.
    """
    length = np.linalg.norm(problem.g)
    if length == 0:
        return
    normals, _ = problem.scaled
    on_boundary = [x] if np.linalg.norm(x) >= 1 - 1e-5 else [np.zeros_like(x)]
    columns = np.column_stack([*on_boundary, *normals[np.abs(after) <= 1e-5]])
    _, residual = nnls(columns, problem.g / length)
    assert residual <= 1e-5


@pytest.mark.parametrize("count", [2000, pytest.param(100_000, marks=pytest.mark.long)])
def test_every_answer_is_safe_and_optimal(count):
    rng = np.random.default_rng(0)
    seen = dict.fromkeys(CASES, 0)
    slowest = 0.0
    for _ in range(count):
        problem = Problem(rng)
        start = time.process_time()
        seen[check(problem)] += 1
        slowest = max(slowest, time.process_time() - start)
    assert all(number > count // 200 for number in seen.values()), seen
    assert slowest < 1.0  # of this process's own time: no hang


@pytest.mark.parametrize("count", [2000, pytest.param(100_000, marks=pytest.mark.long)])
def test_every_projection_is_safe(count):
    """And there is one wherever a linear program finds a point that satisfies all constraints."""
    rng = np.random.default_rng(2)
    seen = dict.fromkeys(CASES, 0)
    for _ in range(count):
        problem = Problem(rng)
        solution = problem.project()
        seen[solution.case] += 1
        x = problem.step(solution)
        normals, distance = problem.scaled
        if solution.case == "rejected":
            flat = problem.c[problem.norm == 0] > 0
            none = linprog(np.zeros_like(x), normals, -distance - 1e-6, bounds=(None, None))
            assert flat.any() or none.status == 2
            assert not x.any()
            continue
        after = distance + normals @ x
        assert np.linalg.norm(x) <= 1 + 1e-6
        assert (after <= np.maximum(distance, 0) + 1e-6).all()
        if solution.case == "infeasible":
            assert np.linalg.norm(x) >= 1 - 1e-6
        else:
            assert (after <= 1e-5).all()
    assert all(number > count // 200 for number in seen.values()), seen


def test_no_answer_is_worse_than_a_general_solver_s():
    """Which sees the vectors, knows nothing of active sets, and starts from several points."""
    rng, compared = np.random.default_rng(1), 0
    while compared < 200:
        problem = Problem(rng)
        solution = problem.solve()
        length = np.linalg.norm(problem.g)
        if solution.case not in ("inert", "feasible") or length == 0:
            continue
        normals, distance = problem.scaled
        best = problem.g @ problem.step(solution) / length
        rules = [
            {"type": "ineq", "fun": lambda y: 1 - y @ y, "jac": lambda y: -2 * y},
            {
                "type": "ineq",
                "fun": lambda y, n=normals, d=distance: -d - n @ y,
                "jac": lambda y, n=normals: -n,
            },
        ]
        direction = problem.g / length
        for start in (np.zeros_like(direction), 0.5 * direction, problem.step(solution)):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of starts outside
                found = minimize(
                    lambda y, d=direction: -d @ y,
                    start,
                    jac=lambda y, d=direction: -d,
                    constraints=rules,
                    method="SLSQP",
                    options={"ftol": 1e-12, "maxiter": 200},
                )
            y = found.x
            if y @ y <= 1 + 1e-8 and (distance + normals @ y <= 1e-8).all():
                assert direction @ y <= best + 1e-4
        compared += 1
