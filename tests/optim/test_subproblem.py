from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.optimize import minimize, nnls

from torchrl_safe.optim.subproblem import MAX_CONSTRAINTS, project_step, solve_subproblem


class Problem:
    """A random subproblem in n dimensions: ``max g'x, c + B x <= 0, x'Hx <= 2 delta``."""

    def __init__(self, rng, m, n=4, violation=None):
        a = rng.normal(size=(n, n))
        self.h = a @ a.T + 0.1 * np.eye(n)
        self.g = rng.normal(size=n) * 10 ** rng.uniform(-3, 3)
        self.b = rng.normal(size=(m, n)) * 10 ** rng.uniform(-3, 3, size=(m, 1))
        self.delta = 10 ** rng.uniform(-4, 0)
        inverse = np.linalg.inv(self.h)
        self.inverse = inverse
        self.q = self.g @ inverse @ self.g
        self.r = self.b @ inverse @ self.g
        self.s = self.b @ inverse @ self.b.T
        self.reach = np.sqrt(2 * self.delta * np.diag(self.s))
        distance = rng.uniform(-1.5, 1.5, size=m) if violation is None else violation
        self.c = distance * self.reach

    def solve(self, recovery_ratio=1.0):
        return solve_subproblem(self.q, self.r, self.s, self.c, self.delta, recovery_ratio)

    def step(self, solution):
        weighted = solution.objective_weight * self.g - solution.constraint_weight @ self.b
        return self.inverse @ weighted

    def assert_inside(self, x):
        assert x @ self.h @ x <= 2 * self.delta * (1 + 1e-6)


def table(q, r, s, c, delta):
    """The closed form of CPO's dual, from its two branches of multipliers: (lam, nu, case).

    The step is ``(H^-1 g - nu H^-1 b) / lam``; written from the literature's supplementary
    material, where minimising ``g'x`` has the sign of g turned.
    """
    a, b = q - r**2 / s, 2 * delta - c**2 / s
    if c < 0 and b < 0:
        return math.sqrt(q / (2 * delta)), 0.0, "inert"
    if b < 0:
        return None, math.sqrt(2 * delta / s), "infeasible"
    rr = -r  # of the minimisation of -g'x

    def dual_active(lam):
        return -0.5 * (a / lam + b * lam) - rr * c / s

    def dual_inactive(lam):
        return -0.5 * (q / lam + 2 * delta * lam)

    # nu = (lam c - rr) / s > 0 on one side of lam = rr / c.
    bound = rr / c
    ranges = [(0.0, bound), (bound, math.inf)] if c < 0 else [(bound, math.inf), (0.0, bound)]
    project = lambda v, lo, hi: min(max(v, lo, 1e-300), max(hi, 1e-300))  # noqa: E731
    lam_active = project(math.sqrt(a / b), *ranges[0])
    lam_inactive = project(math.sqrt(q / (2 * delta)), *ranges[1])
    empty = [hi <= max(lo, 0.0) for lo, hi in ranges]
    values = [dual_active(lam_active), dual_inactive(lam_inactive)]
    values = [-math.inf if e else v for e, v in zip(empty, values, strict=True)]
    lam = (lam_active, lam_inactive)[int(np.argmax(values))]
    nu = max(lam * c - rr, 0.0) / s
    return lam, nu, "feasible" if c < 0 else "recoverable"


def test_one_constraint_matches_the_closed_form_of_the_literature():
    rng = np.random.default_rng(0)
    cases = dict.fromkeys(("inert", "feasible", "recoverable", "infeasible"), 0)
    for _ in range(4000):
        p = Problem(rng, 1)
        q, r, s, c = p.q, p.r[0], p.s[0, 0], p.c[0]
        lam, nu, case = table(q, r, s, c, p.delta)
        solution = p.solve()
        assert solution.case == case
        cases[case] += 1
        if case == "infeasible":
            expected = -nu * p.inverse @ p.b[0]
        else:
            expected = p.inverse @ (p.g - nu * p.b[0]) / lam
        x = p.step(solution)
        # In the metric; values are flat near an optimum, points are not.
        error = math.sqrt((x - expected) @ p.h @ (x - expected) / (2 * p.delta))
        assert error < 1e-6, (case, error)
    assert min(cases.values()) > 300, cases


def test_one_constraint_matches_a_dense_grid_over_the_disc():
    """In radii the solution lies in the plane of the two gradients: search it."""
    rng = np.random.default_rng(1)
    angles = np.linspace(0, 2 * np.pi, 7201)
    circle = np.stack([np.cos(angles), np.sin(angles)], -1)
    for _ in range(2000):
        cosine = rng.uniform(-1, 1)
        v0 = np.array([cosine, math.sqrt(1 - cosine**2)])  # and v1 = (1, 0)
        d = rng.uniform(-1.2, 0.999)
        solution = solve_subproblem(1.0, [cosine], [[1.0]], [d], max_kl=0.5)
        y = solution.objective_weight * v0 - solution.constraint_weight * np.array([1.0, 0.0])
        assert y @ y <= 1 + 1e-7
        assert y[0] + d <= 1e-7
        # A linear objective has its optimum on the boundary: the arc, and the chord's two ends.
        half = math.sqrt(max(1 - d * d, 0))
        chord = [(-d, half), (-d, -half)] if abs(d) <= 1 else []
        points = np.concatenate([circle[circle[:, 0] + d <= 0], np.array(chord).reshape(-1, 2)])
        best = (points @ v0).max()
        assert best - 1e-6 <= y @ v0 <= best + 1e-6


def in_radii(p):
    """Unit gradients, distances to go, and the factor of the metric, all in units of the radius."""
    chol = np.linalg.cholesky(p.h) / math.sqrt(2 * p.delta)  # y = chol' x
    v0 = np.linalg.solve(chol, p.g)
    v = np.linalg.solve(chol, p.b.T).T
    scale = np.linalg.norm(v, axis=1)
    return v0 / np.linalg.norm(v0), v / scale[:, None], p.c / scale, chol


def best_objective(v0, v, d):
    """A general solver's optimum from several starts; ``None`` if it finds no feasible point."""
    found = None
    for start in (np.zeros(len(v0)), -0.5 * v.sum(0) / len(v), 0.5 * v0):
        result = minimize(
            lambda y: -v0 @ y,
            start,
            jac=lambda y: -v0,
            method="SLSQP",
            constraints=[
                {"type": "ineq", "fun": lambda y: -(v @ y) - d, "jac": lambda y: -v},
                {"type": "ineq", "fun": lambda y: 1 - y @ y, "jac": lambda y: -2 * y},
            ],
            options={"maxiter": 200, "ftol": 1e-12},
        )
        y = result.x
        if y @ y <= 1 + 1e-7 and (v @ y + d <= 1e-7).all() and (found is None or v0 @ y > found):
            found = v0 @ y
    return found


@pytest.mark.parametrize(("m", "count"), [(1, 150), (2, 200), (3, 200)])
def test_feasible_problems_match_a_general_solver(m, count):
    rng = np.random.default_rng(m)
    solved = 0
    for _ in range(count):
        p = Problem(rng, m, n=5, violation=rng.uniform(-1.3, 0.4, size=m))
        solution = p.solve()
        v0, v, d, chol = in_radii(p)
        best = best_objective(v0, v, d)
        if best is None:
            assert solution.case in ("infeasible", "rejected")
            continue
        if solution.case in ("infeasible", "rejected"):
            raise AssertionError("the general solver found a feasible point")
        y = chol.T @ p.step(solution)
        assert y @ y <= 1 + 1e-6
        assert (v @ y + d <= 1e-6).all()
        assert abs(v0 @ y - best) < 2e-5
        solved += 1
    assert solved > 0.6 * count


def general_solver(objective, slope, v, d, radius, starts):
    """Least ``objective(y)`` under ``v y <= -d``, ``|y| <= radius``; ``None`` if none is found."""
    found = None
    for start in starts:
        result = minimize(
            objective,
            start,
            jac=slope,
            method="SLSQP",
            constraints=[
                {"type": "ineq", "fun": lambda y: -(v @ y) - d, "jac": lambda y: -v},
                {"type": "ineq", "fun": lambda y: radius**2 - y @ y, "jac": lambda y: -2 * y},
            ],
            options={"maxiter": 300, "ftol": 1e-14},
        )
        y = result.x
        inside = (v @ y + d <= 1e-7).all() and y @ y <= radius**2 + 1e-7
        if inside and (found is None or result.fun < found):
            found = result.fun
    return found


def recovery(v, d, radius):
    """Which violations are removed, nearest first, and the least sum of changes of the others."""
    origin = np.zeros(v.shape[1])
    goal, left = np.where(d > 0, 0.0, d), d > 0
    for i in np.argsort(d):
        if d[i] > 0:
            more = goal.copy()
            more[i] = d[i]
            shortest = general_solver(lambda y: y @ y, lambda y: 2 * y, v, more, 10.0, [origin])
            if shortest is not None and shortest <= radius**2:
                goal, left[i] = more, False
    down = v[left].sum(0)
    starts = (origin, -0.3 * down)
    return ~left, general_solver(lambda y: down @ y, lambda y: down, v, goal, radius, starts)


@pytest.mark.parametrize("ratio", [0.6, 1.0])
@pytest.mark.parametrize("m", [2, 3, 6])
def test_recovery_removes_what_it_can_and_lowers_the_sum_of_the_rest(m, ratio):
    rng = np.random.default_rng(10 + m)
    checked = removed_some = 0
    for _ in range(60):
        p = Problem(rng, m, n=8, violation=rng.uniform(-0.3, 2.0, size=m))
        solution = p.solve(ratio)
        if solution.case != "infeasible":
            continue
        _, v, d, chol = in_radii(p)
        y = chol.T @ p.step(solution)
        removed, least = recovery(v, d, ratio)
        assert y @ y <= 1 + 1e-6
        assert (v @ y + np.where(d > 0, 0, d) <= 1e-6).all()
        assert (v @ y + d)[removed].max(initial=0.0) <= 1e-6
        # No more than the least; less only where the objective, in its part, asks for it.
        change = v[~removed].sum(0) @ y
        assert change <= least + 2e-5
        if ratio == 1.0:
            assert change == pytest.approx(least, abs=2e-5)
        removed_some += bool((removed & (d > 0)).any())
        checked += 1
    assert checked > 10
    assert removed_some > 3


def blocked(rng, kind, n=8):
    """Unit gradients [3, n]: the first, or the first two, cannot be followed."""
    v = np.linalg.qr(rng.normal(size=(n, 3)))[0].T
    if kind == "flat":
        v[0] = 0.0
    elif kind == "opposed":
        v[1] = -v[0]
    elif kind == "nearly opposed":
        v[1] = -v[0] + 1e-3 * v[1]
    elif kind == "weak":
        v[0] *= 1e-12
    return v


@pytest.mark.parametrize("kind", ["flat", "opposed", "nearly opposed", "weak"])
@pytest.mark.parametrize("ratio", [0.7, 1.0])
def test_what_cannot_be_repaired_does_not_stop_the_repair_of_the_rest(kind, ratio):
    rng = np.random.default_rng(11)
    for _ in range(20):
        g, b = rng.normal(size=8), blocked(rng, kind)
        c = np.array([0.9, 0.9 if "opposed" in kind else -0.1, rng.uniform(0.1, 0.6)])
        solution = solve_subproblem(g @ g, b @ g, b @ b.T, c, 0.5, ratio)
        y = solution.objective_weight * g - solution.constraint_weight @ b
        assert solution.case == "infeasible"
        assert y @ y <= 1 + 1e-6
        after = c + b @ y
        assert after[2] <= 1e-6
        assert (after <= np.clip(c, 0, None) + 1e-6).all()


@pytest.mark.parametrize("ratio", [0.25, 0.5, 0.95, 1.0])
def test_recovery_ratio_caps_the_reduction_and_gives_the_rest_to_the_objective(ratio):
    rng = np.random.default_rng(5)
    for _ in range(200):
        distance = rng.uniform(0.01, 3.0)
        p = Problem(rng, 1, violation=np.array([distance]))
        solution = p.solve(ratio)
        x = p.step(solution)
        p.assert_inside(x)
        predicted = p.b[0] @ x / p.reach[0]
        if distance > ratio:
            assert solution.case == "infeasible"
        else:
            assert solution.case == "recoverable"
        cut = min(distance, ratio)
        # At least the cut; more only where the objective itself asks for it.
        unconstrained = p.inverse @ p.g * math.sqrt(2 * p.delta / p.q)
        wanted = p.b[0] @ unconstrained / p.reach[0]
        assert predicted == pytest.approx(min(-cut, wanted), abs=1e-6)
        # The rest: the best objective on the chord, by the angle between the gradients.
        cosine = p.r[0] / math.sqrt(p.q * p.s[0, 0])
        best = 1.0 if wanted <= -cut else -cut * cosine + math.sqrt((1 - cut**2) * (1 - cosine**2))
        assert p.g @ x / math.sqrt(2 * p.delta * p.q) == pytest.approx(best, abs=1e-6)


def test_ratio_one_is_the_pure_recovery_step():
    p = Problem(np.random.default_rng(6), 1, violation=np.array([1.7]))
    solution = p.solve()
    assert solution.objective_weight == pytest.approx(0.0, abs=1e-6 * abs(p.q) ** -0.5)
    expected = math.sqrt(2 * p.delta / p.s[0, 0])
    assert solution.constraint_weight[0] == pytest.approx(expected)


def test_without_constraints_it_is_the_natural_gradient_step():
    solution = solve_subproblem(4.0, [], np.zeros((0, 0)), [], max_kl=0.02)
    assert solution.case == "unconstrained"
    assert solution.objective_weight == pytest.approx(math.sqrt(2 * 0.02 / 4.0))


@pytest.mark.parametrize(
    ("q", "r", "s", "c", "case", "objective", "constraint"),
    [
        (1.0, 0.0, 1.0, 0.0, "feasible", 1.0, 0.0),  # c = 0, orthogonal
        (1.0, 1.0, 1.0, 0.0, "feasible", 0.0, 0.0),  # c = 0, the objective raises the constraint
        (1.0, -1.0, 1.0, 0.0, "feasible", 1.0, 0.0),  # c = 0, it lowers it
        (1.0, 0.0, 0.0, -1.0, "inert", 1.0, 0.0),  # b = 0, satisfied
        (1.0, 0.0, 0.0, 0.0, "inert", 1.0, 0.0),  # b = 0 and c = 0
        (0.0, 0.0, 1.0, -0.5, "feasible", 0.0, 0.0),  # g = 0, satisfied: stay
        (0.0, 0.0, 1.0, 0.5, "recoverable", 0.0, 0.5),  # g = 0, violated: repair
        (0.0, 0.0, 1.0, 2.0, "infeasible", 0.0, 1.0),
        (1.0, 1.0, 1.0, -2.0, "inert", 1.0, 0.0),
        (1.0, 0.0, 1.0, 1e-17, "feasible", 1.0, 0.0),  # rounding is no violation
    ],
)
def test_edge_cases(q, r, s, c, case, objective, constraint):
    solution = solve_subproblem(q, [r], [[s]], [c], max_kl=0.5)
    assert solution.case == case
    assert solution.objective_weight == pytest.approx(objective, abs=1e-8)
    assert solution.constraint_weight[0] == pytest.approx(constraint, abs=1e-8)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("d", [-1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5])
@pytest.mark.parametrize("noise", [0.0, 1e-14, 1e-9, -1e-14])
def test_parallel_and_antiparallel_gradients(sign, d, noise):
    solution = solve_subproblem(1.0, [sign * (1 + noise)], [[1.0]], [d], max_kl=0.5)
    # On the line: x in [-1, 1], maximise x with sign x <= -d; as far as it goes when impossible.
    low, high = (-1.0, min(1.0, -d)) if sign > 0 else (max(-1.0, d), 1.0)
    expected = high if low <= high else -sign
    x = solution.objective_weight - sign * solution.constraint_weight[0]
    # The two gradients are not quite parallel, which rounding of sqrt(1e-9) in the angle shows.
    assert x == pytest.approx(expected, abs=1e-4)


def assert_rejected(solution, reason):
    assert solution.case == "rejected"
    assert solution.reason == reason
    assert solution.objective_weight == 0
    assert (solution.constraint_weight == 0).all()
    assert solution.constraint_weight.dtype == np.float64


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["q", "r", "s", "c", "max_kl"])
def test_numbers_that_are_not_finite_are_rejected(bad, where):
    values = {"q": 1.0, "r": [0.5], "s": [[1.0]], "c": [0.1], "max_kl": 0.5}
    values[where] = np.full(np.shape(values[where]), bad)[()]
    assert_rejected(solve_subproblem(**values), "non-finite products of the gradients")


@pytest.mark.parametrize(
    ("q", "s", "c", "reason"),
    [
        (-1.0, 1.0, -1.0, "the curvature is not positive definite"),
        (1.0, -1.0, -1.0, "the curvature is not positive definite"),
        (1.0, 0.0, 1.0, "no step lowers a violated constraint"),
    ],
)
def test_rejections(q, s, c, reason):
    assert_rejected(solve_subproblem(q, [0.0], [[s]], [c], max_kl=0.5), reason)


def test_no_objective_and_nothing_to_repair():
    for c, case in (([-5.0], "inert"), ([], "unconstrained")):
        m = len(c)
        solution = solve_subproblem(0.0, np.zeros(m), np.eye(m), np.array(c), max_kl=0.5)
        assert (solution.case, solution.objective_weight) == (case, 0.0)


def test_a_constraint_beyond_the_largest_number_is_inert():
    assert solve_subproblem(1.0, [0.0], [[1e-300]], [-1e300], max_kl=0.5).case == "inert"


def test_products_that_no_vectors_have_are_rejected():
    """A curvature that is not positive definite gives them, each diagonal entry positive."""
    r, s = [0.4, 0.8], [[1.0, -0.55], [-0.55, 1.0]]
    gram = np.block([[np.ones((1, 1)), np.array([r])], [np.array([r]).T, np.array(s)]])
    assert np.linalg.eigvalsh(gram)[0] < -0.1
    solution = solve_subproblem(1.0, r, s, [-0.8, -0.2], max_kl=0.5)
    assert_rejected(solution, "the curvature is not positive definite")


@pytest.mark.parametrize(
    ("s", "c"),
    [
        ([[1, -1], [-1, 1]], [0.5, 0.5]),  # opposed to each other
        ([[1, -1], [-1, 1]], [0.5, 0.0]),  # opposed to one that holds and has no room
        ([[0, 0], [0, 1]], [0.5, 0.0]),  # without gradient, beside one that holds
    ],
)
def test_violations_that_no_step_lowers_are_rejected(s, c):
    solution = solve_subproblem(1, [0, 0], s, c, max_kl=0.5)
    assert_rejected(solution, "no step lowers a violated constraint")


def test_a_repeated_constraint_changes_nothing():
    rng = np.random.default_rng(7)
    for _ in range(100):
        p = Problem(rng, 1)
        twice = solve_subproblem(
            p.q, p.r.repeat(2), np.full((2, 2), p.s[0, 0]), p.c.repeat(2), p.delta
        )
        once = p.solve()
        assert twice.case == once.case
        scale = math.sqrt(2 * p.delta / p.s[0, 0])
        assert twice.objective_weight == pytest.approx(once.objective_weight, rel=1e-6)
        assert twice.constraint_weight.sum() == pytest.approx(
            once.constraint_weight[0], abs=1e-6 * scale
        )


def test_the_most_constraints_are_solved():
    rng = np.random.default_rng(8)
    p = Problem(rng, MAX_CONSTRAINTS, n=12, violation=rng.uniform(-0.5, 0, MAX_CONSTRAINTS))
    solution = p.solve()
    x = p.step(solution)
    p.assert_inside(x)
    assert ((p.c + p.b @ x) / p.reach <= 1e-6).all()
    assert p.g @ x > 0


def test_units_do_not_matter():
    p = Problem(np.random.default_rng(9), 2, violation=np.array([-0.2, 0.3]))
    x = p.step(p.solve())
    for _ in range(2):
        p.g, p.q, p.r = 1e6 * p.g, 1e12 * p.q, 1e6 * p.r
        assert np.allclose(p.step(p.solve()), x, rtol=1e-6, atol=1e-9 * np.abs(x).max())
        unit = np.array([1e-8, 1e8])
        p.b, p.c, p.r = unit[:, None] * p.b, unit * p.c, unit * p.r
        p.s, p.reach = np.outer(unit, unit) * p.s, unit * p.reach
        assert np.allclose(p.step(p.solve()), x, rtol=1e-6, atol=1e-9 * np.abs(x).max())


def test_single_precision_is_solved_in_double():
    p = Problem(np.random.default_rng(0), m=3)
    arguments = [x.astype(np.float32) for x in (p.r, p.s, p.c)]
    single = solve_subproblem(p.q, *arguments, p.delta)
    double = solve_subproblem(p.q, *(x.astype(np.float64) for x in arguments), p.delta)
    assert single.objective_weight == double.objective_weight
    assert (single.constraint_weight == double.constraint_weight).all()


@pytest.mark.parametrize(("r", "s"), [((2,), (1, 1)), ((1,), (2, 2)), ((1,), (1,))])
def test_shapes(r, s):
    with pytest.raises(ValueError, match=r"shapes \[m\], \[m, m\] and \[m\], got \(") as info:
        solve_subproblem(1.0, np.zeros(r), np.ones(s), [0.0], 0.5)
    assert f"got {r}, {s}, (1,)." in str(info.value)


def test_misuse():
    m = MAX_CONSTRAINTS + 1
    with pytest.raises(ValueError, match=f"at most {MAX_CONSTRAINTS} constraints .* got {m}"):
        solve_subproblem(1.0, np.zeros(m), np.eye(m), np.zeros(m), 0.5)


class TestProjection:
    """PCPO's step, in the space of the parameters."""

    def project(self, p):
        return project_step(p.q, p.r, p.s, p.c, p.delta)

    def radii(self, p, x):
        """The length of a step, of which the region has 1."""
        return math.sqrt(x @ p.h @ x / (2 * p.delta))

    def test_one_constraint_matches_the_papers_closed_form(self):
        rng = np.random.default_rng(0)
        cases = dict.fromkeys(("inert", "feasible", "recoverable", "infeasible"), 0)
        for _ in range(1000):
            p = Problem(rng, 1)
            up = math.sqrt(2 * p.delta / p.q) * p.inverse @ p.g
            beyond = max(0.0, (p.b[0] @ up + p.c[0]) / p.s[0, 0])
            expected = up - beyond * p.inverse @ p.b[0]
            length = self.radii(p, expected)
            solution = self.project(p)
            cases[solution.case] += 1
            assert (solution.case == "infeasible") == (length > 1 + 1e-6 and p.c[0] > 0)
            assert self.radii(p, p.step(solution) - expected / max(1, length)) < 1e-9
        assert min(cases.values()) > 100, cases

    @pytest.mark.parametrize("m", [2, 3])
    def test_several_constraints_match_least_distance_programming(self, m):
        rng = np.random.default_rng(m)
        moved = 0
        for _ in range(200):
            p = Problem(rng, m)
            v0, v, d, chol = in_radii(p)
            # Lawson and Hanson's least distance: z nearest to 0 with -v z >= d + v v0.
            system, target = np.vstack([-v.T, d + v @ v0]), np.eye(len(v0) + 1)[-1]
            weights, _ = nnls(system, target)
            residual = system @ weights - target
            shift = -residual[:-1] / residual[-1]
            moved += np.linalg.norm(shift) > 0.1
            expected = (v0 + shift) / max(1, np.linalg.norm(v0 + shift))
            actual = chol.T @ p.step(self.project(p))
            np.testing.assert_allclose(actual, expected, atol=1e-6)
        assert moved > 100

    def test_a_step_from_where_all_hold_does_not_lower_the_objective(self):
        rng = np.random.default_rng(5)
        for _ in range(500):
            p = Problem(rng, 3, violation=rng.uniform(-1, 0, size=3))
            x = p.step(self.project(p))
            assert p.g @ x >= 0
            assert (p.b @ x + p.c <= 1e-6 * p.reach).all()

    @pytest.mark.parametrize(
        ("r", "s", "c"),
        [
            ([0.0, 0.0], [[1.0, -1.0], [-1.0, 1.0]], [0.5, 0.5]),  # opposed
            ([0.0], [[0.0]], [0.5]),  # without a gradient
        ],
    )
    def test_constraints_that_nothing_satisfies(self, r, s, c):
        solution = project_step(1.0, r, s, c, max_kl=0.5)
        assert solution.case == "rejected"
        assert solution.reason == "no step satisfies all constraints"
        assert solution.objective_weight == 0
        assert not solution.constraint_weight.any()

    def test_a_violation_far_outside_the_region_is_followed(self):
        solution = project_step(1.0, [0.0], [[1e-12]], [1e6], max_kl=0.5)
        assert solution.case == "infeasible"
        assert solution.constraint_weight[0] * 1e-6 == pytest.approx(1.0)
        assert solution.objective_weight == pytest.approx(0.0, abs=1e-6)
