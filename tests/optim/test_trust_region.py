from __future__ import annotations

import copy
import math
import pickle

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import nn

from torchrl_safe import TrustRegionSafeOptimizer
from torchrl_safe.optim import TrustRegionReport
from torchrl_safe.optim.subproblem import MAX_CONSTRAINTS, solve_subproblem


def euclidean(old, new):
    return 0.5 * (new - old).square().sum()


def parameter(*values):
    return nn.Parameter(torch.tensor(values, dtype=torch.float64))


class Recorder:
    """A closure that counts its calls and can fail at one of them."""

    def __init__(self, x, objective, constraint=None, fail_at=None, statistics=None):
        self.x, self.objective, self.constraint = x, objective, constraint
        self.fail_at, self.calls, self.grad_modes = fail_at, 0, []
        self.statistics = statistics or (lambda x: x * 1.0)

    def __call__(self):
        self.calls += 1
        self.grad_modes.append(torch.is_grad_enabled())
        if self.fail_at == self.calls:
            raise RuntimeError("the closure failed")
        out = {"objective": self.objective(self.x), "statistics": self.statistics(self.x)}
        if self.constraint is not None:
            out["constraint"] = self.constraint(self.x)
        return TensorDict(out)


def optimizer(x, **kwargs):
    params = [x] if isinstance(x, torch.Tensor) else x
    kwargs = {"damping": 0.0, "statistics_kl": euclidean, "max_kl": 0.02, "cg_iters": 10} | kwargs
    return TrustRegionSafeOptimizer(params, **kwargs)


# -- analytic optima


def spd(n, seed=0):
    a = np.random.default_rng(seed).normal(size=(n, n))
    return torch.tensor(a @ a.T + 0.2 * np.eye(n))


@pytest.mark.parametrize("form", ["statistics", "kl"])
@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_without_constraints_a_step_is_trpo(form, damping):
    h = spd(6)
    x = nn.Parameter(torch.randn(6, dtype=torch.float64))
    start = x.detach().clone()
    g = torch.randn(6, dtype=torch.float64)

    def kl(old, new):
        return 0.5 * (new - old) @ h @ (new - old)

    def closure():
        return TensorDict({"objective": g @ x, "statistics": x * 1.0, "kl": kl(start, x)})

    optim = optimizer(x, damping=damping, statistics_kl=kl if form == "statistics" else None)
    report = optim.step(closure)
    natural = torch.linalg.solve(h + damping * torch.eye(6, dtype=torch.float64), g)
    expected = start + math.sqrt(2 * 0.02 / (g @ natural)) * natural
    torch.testing.assert_close(x.detach(), expected)
    assert (report.case, report.accepted, report.reason) == ("unconstrained", True, "")
    assert report.objective_predicted == pytest.approx((g @ (expected - start)).item())
    assert report.objective_change == pytest.approx(report.objective_predicted)
    if damping == 0.0:
        assert report.backtracks == 0
        assert report.kl == pytest.approx(0.02, rel=1e-9)
    assert report.cg_residual < 1e-8
    assert x.grad is None


@pytest.fixture(autouse=True)
def _seed():
    torch.manual_seed(0)


def test_an_active_constraint_is_met_and_the_rest_of_the_region_serves_the_objective():
    x = parameter(0.0, 0.0)
    optim = optimizer(x, max_kl=0.5)  # radius 1
    report = optim.step(Recorder(x, lambda x: x.sum(), lambda x: x[:1] - 0.3))
    torch.testing.assert_close(x.detach(), torch.tensor([0.3, math.sqrt(1 - 0.09)]).double())
    assert report.case == "feasible"
    assert report.constraint == (-0.3,)
    assert report.constraint_change[0] == pytest.approx(0.3)
    assert report.constraint_predicted[0] == pytest.approx(0.3)
    assert report.objective_change == pytest.approx(0.3 + math.sqrt(1 - 0.09))


def test_a_constraint_out_of_reach_is_inert():
    x = parameter(0.0, 0.0)
    report = optimizer(x).step(Recorder(x, lambda x: x.sum(), lambda x: x[:1] - 5.0))
    assert report.case == "inert"
    assert report.objective_change == pytest.approx(math.sqrt(2 * 2 * 0.02))


def test_recovery_lowers_the_constraint_until_it_holds():
    x = parameter(2.0, 0.0)
    optim = optimizer(x, max_kl=0.5)
    closure = Recorder(x, lambda x: x.sum(), lambda x: x[:1] - 0.3)
    report = optim.step(closure)
    assert report.case == "infeasible"
    torch.testing.assert_close(x.detach(), torch.tensor([1.0, 0.0]).double(), atol=1e-5, rtol=0)
    report = optim.step(closure)
    assert report.case == "recoverable"
    expected = torch.tensor([0.3, math.sqrt(1 - 0.49)]).double()
    torch.testing.assert_close(x.detach(), expected, atol=1e-5, rtol=0)
    assert optim.step(closure).constraint[0] == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize("ratio", [0.3, 0.8])
def test_recovery_ratio_shares_the_region(ratio):
    x = parameter(2.0, 0.0)
    optim = optimizer(x, max_kl=0.5, recovery_ratio=ratio)
    report = optim.step(Recorder(x, lambda x: x[1], lambda x: x[:1]))
    expected = torch.tensor([2.0 - ratio, math.sqrt(1 - ratio**2)]).double()
    torch.testing.assert_close(x.detach(), expected, atol=1e-7, rtol=0)
    assert report.case == "infeasible"


def test_several_constraints():
    x = parameter(0.0, 0.0, 0.0)
    optim = optimizer(x, max_kl=0.5)
    limits = torch.tensor([0.1, 0.2]).double()
    report = optim.step(Recorder(x, lambda x: x.sum(), lambda x: x[:2] - limits))
    expected = torch.tensor([0.1, 0.2, math.sqrt(1 - 0.05)]).double()
    torch.testing.assert_close(x.detach(), expected)
    assert report.constraint_change == pytest.approx((0.1, 0.2))


def test_a_projection_follows_the_objective_first():
    x = parameter(0.5, 0.0)
    optim = optimizer(x, max_kl=0.5, projection=True)
    closure = Recorder(x, lambda x: x.sum(), lambda x: x[:1] - 0.6)
    report = optim.step(closure)
    assert report.case == "feasible"
    # One radius up the diagonal, and straight back to the limit: the region is not used up.
    expected = torch.tensor([0.6, math.sqrt(0.5)]).double()
    torch.testing.assert_close(x.detach(), expected, atol=1e-6, rtol=0)
    assert report.kl == pytest.approx((0.1**2 + 0.5) / 2)


@pytest.mark.parametrize("m", [0, 1, 2])
@pytest.mark.parametrize("cg_iters", [1, 3])
def test_predictions_and_region_are_exact_however_few_the_cg_iterations(m, cg_iters):
    n = 20
    h = spd(n, seed=3)
    g = torch.randn(n, dtype=torch.float64)
    b = torch.randn(m, n, dtype=torch.float64)
    x = nn.Parameter(torch.zeros(n, dtype=torch.float64))
    # Inside, so that the constraints are active and the whole radius is used.
    c = -0.05 * torch.ones(m, dtype=torch.float64)
    optim = optimizer(x, cg_iters=cg_iters, statistics_kl=lambda o, w: 0.5 * (w - o) @ h @ (w - o))
    report = optim.step(Recorder(x, lambda x: g @ x, lambda x: c + b @ x))
    assert report.accepted
    assert report.cg_residual > 1e-3
    f = report.step_fraction
    step = x.detach() / f
    assert (0.5 * step @ h @ step).item() == pytest.approx(0.02, rel=1e-6)
    assert report.objective_predicted / f == pytest.approx((g @ step).item(), rel=1e-6)
    predicted = np.array(report.constraint_predicted) / f
    assert predicted == pytest.approx((b @ step).numpy(), abs=1e-7)
    assert (c.numpy() + predicted <= 1e-7).all()


# -- curvature of part of the batch


def linear_policy(seed=0, states=400, size=6):
    """Means ``A x`` of unit Gaussians in every state: the KL is quadratic, H is known."""
    g = torch.Generator().manual_seed(seed)
    a = torch.randn(states, size, generator=g, dtype=torch.float64)
    return a * torch.linspace(0.5, 2, size), torch.randn(size, generator=g, dtype=torch.float64)


def mean_kl(old, new):
    return 0.5 * (new - old).square().mean()


@pytest.mark.parametrize("part", [40, 400])
def test_curvature_statistics_replace_the_batch_in_the_direction_only(part):
    a, g = linear_policy()
    x = nn.Parameter(torch.zeros(6, dtype=torch.float64))

    def closure():
        return TensorDict(
            {"objective": g @ x, "statistics": a @ x, "curvature_statistics": a[:part] @ x}
        )

    report = optimizer(x, statistics_kl=mean_kl).step(closure)
    natural = torch.linalg.solve(a[:part].T @ a[:part] / part, g)
    full = report.step_fraction * math.sqrt(2 * 0.02 / (g @ natural)) * natural
    torch.testing.assert_close(x.detach(), full)
    # The region is that of the whole batch.
    assert report.kl == pytest.approx(0.5 * (a @ x.detach()).square().mean().item())
    assert report.accepted
    assert report.kl <= 0.0202
    assert (report.kl == pytest.approx(0.02)) == (part == 400)


def test_a_kl_alone_has_no_curvature_statistics():
    a, g = linear_policy()
    x = nn.Parameter(torch.zeros(6, dtype=torch.float64))

    def closure():
        kl = 0.5 * (a @ x).square().mean()
        return TensorDict({"objective": g @ x, "kl": kl, "curvature_statistics": a[:40] @ x})

    with pytest.raises(ValueError, match="'curvature_statistics' needs statistics_kl"):
        optimizer(x, statistics_kl=None).step(closure)
    assert (x == 0).all()


# -- the line search


def test_backtracks_until_the_true_kl_fits():
    x = parameter(0.0)

    def kl(old, new):  # quartic beyond the model
        d = (new - old).square().sum()
        return 0.5 * d + 40 * d**2

    report = optimizer(x, statistics_kl=kl).step(Recorder(x, lambda x: x.sum()))
    assert report.accepted
    assert report.backtracks > 0
    assert report.step_fraction == pytest.approx(0.8**report.backtracks)
    radius = math.sqrt(0.04)
    tried = [kl(torch.zeros(1), torch.tensor([radius * 0.8**k])).item() for k in range(11)]
    assert report.backtracks == next(k for k, value in enumerate(tried) if value <= 0.0202)
    assert x.item() == pytest.approx(radius * report.step_fraction)
    assert report.kl == pytest.approx(tried[report.backtracks])
    assert report.objective_predicted == pytest.approx(x.item())


def test_a_kl_far_below_zero_is_not_accepted():
    x = parameter(1.0)
    start = x.detach().clone()

    def closure():
        d = (x - start).sum()
        return TensorDict({"objective": x.sum(), "kl": 0.5 * d**2 - 1e6 * d.abs() ** 3})

    before = x.detach().clone()
    report = optimizer(x, statistics_kl=None, max_backtracks=2).step(closure)
    assert not report.accepted
    assert "KL" in report.reason
    assert torch.equal(x.detach(), before)


def test_the_objective_may_fall_only_while_a_constraint_is_violated():
    wall = lambda x: x.sum() - 1e3 * x.square().sum()  # noqa: E731
    x = parameter(0.0)
    report = optimizer(x, max_backtracks=2).step(Recorder(x, wall))
    assert not report.accepted
    assert "the objective fell" in report.reason
    x = parameter(0.0)
    closure = Recorder(x, lambda x: -x.sum() * 1.0, lambda x: 1.0 - x)
    assert optimizer(x).step(closure).accepted
    assert x.item() > 0


def test_a_violated_constraint_may_not_grow():
    x = parameter(0.0)
    closure = Recorder(x, lambda x: x.sum(), lambda x: 1.0 - x + 1e4 * x.square())
    report = optimizer(x, max_backtracks=3).step(closure)
    assert (report.case, report.accepted) == ("infeasible", False)
    assert "constraint[0] went from 1.0 to" in report.reason
    assert x.item() == 0.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("start", [(0.0, 1.0), (0.0, 0.999), (0.0, 1.3), (-0.6, 0.3)])
def test_it_is_not_stuck_on_a_curved_boundary(start, dtype):
    """Maximise x_0 on the unit disc: every tangent leaves it, to second order."""
    x = nn.Parameter(torch.tensor(start, dtype=dtype))
    optim = optimizer(x, max_kl=1e-3, cg_iters=2)
    closure = Recorder(x, lambda x: x[0], lambda x: x.square().sum()[None] - 1)
    for _ in range(150):
        optim.step(closure)
    assert x[0].item() > 0.99
    # Within 1 % of what one step can do, 2 |x| sqrt(2 max_kl), or the last violated step's rest.
    assert x.detach().square().sum().item() - 1 < 0.05 * 2 * math.sqrt(2e-3)


@pytest.mark.parametrize("max_kl", [1e-4, 1e-2])
def test_it_is_not_stuck_on_a_straight_boundary(max_kl):
    x = parameter(0.0, 0.0)
    closure = Recorder(
        x, lambda x: x[0] - 0.3 * x.square().sum(), lambda x: x[:1] + 0.3 * x[1:] - 0.1
    )
    optim = optimizer(x, max_kl=max_kl, cg_iters=2)
    for _ in range(80):
        optim.step(closure)
    # On the line x = (0.1 - 0.3 t, t): the maximum of 0.1 - 0.3 t - 0.3 ((0.1 - 0.3 t)^2 + t^2).
    t = -(0.3 - 0.018) / (0.6 * 1.09)
    best = 0.1 - 0.3 * t - 0.3 * ((0.1 - 0.3 * t) ** 2 + t**2)
    assert closure()["objective"].item() == pytest.approx(best, rel=0.01)
    assert closure()["constraint"].item() <= 0.01 * math.sqrt(2 * max_kl * 1.09)


def bits(x):
    return x.detach().numpy().tobytes()


AWKWARD = (0.1, -0.0, 1e-310, 1 / 3, -7.7e200)


@pytest.mark.parametrize("backtracks", [0, 4])
def test_an_exhausted_line_search_restores_every_bit_and_is_bounded(backtracks):
    x = parameter(*AWKWARD)
    before = bits(x)
    first = x.detach().clone()

    def objective(x):  # any move away is a fall, though the gradient promises a rise
        return x[0] - 1e12 * (x - first)[0].abs()

    closure = Recorder(x, objective, statistics=lambda x: x[0] * 1.0)
    report = optimizer(x, max_backtracks=backtracks).step(closure)
    assert not report.accepted
    assert report.reason.startswith("the line search is exhausted: ")
    assert report.backtracks == backtracks + 1
    assert closure.calls == backtracks + 2
    assert closure.grad_modes == [True] + [False] * (backtracks + 1)
    assert bits(x) == before
    assert report.kl == report.objective_change == report.step_fraction == 0.0


@pytest.mark.parametrize("what", ["objective", "constraint", "statistics"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("when", ["start", "candidates"])
def test_numbers_that_are_not_finite_move_nothing(what, bad, when):
    x = parameter(0.1, -0.2, 1 / 3)
    before, start = bits(x), x.detach().clone()

    def spoil(name, value):
        if what == name and (when == "start" or not torch.equal(x.detach(), start)):
            return value + bad * (1 + 0 * x.sum())
        return value

    def closure():
        return TensorDict(
            {
                "objective": spoil("objective", x.sum()),
                "constraint": spoil("constraint", x[:1] - 1),
                "statistics": spoil("statistics", x * 1.0),
            }
        )

    report = optimizer(x).step(closure)
    assert not report.accepted
    assert report.case == ("rejected" if when == "start" else "inert")
    assert bits(x) == before
    assert "nan" in report.reason or "inf" in report.reason or "not finite" in report.reason
    assert all(isinstance(v, float) for v in report.to_dict().values())


def test_a_gradient_that_is_not_finite_moves_nothing():
    x = parameter(0.0, 1.0)
    report = optimizer(x).step(Recorder(x, lambda x: x.abs().sqrt().sum() * x[0].abs().sqrt()))
    assert (report.case, report.accepted) == ("rejected", False)
    assert "not finite" in report.reason
    assert x.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("at", [1, 2, 5])
def test_an_exception_in_the_closure_restores_every_bit(at):
    x = parameter(*AWKWARD)
    before, first = bits(x), x.detach().clone()
    closure = Recorder(
        x,
        lambda x: x[0] - 1e12 * (x - first)[0].abs(),
        fail_at=at,
        statistics=lambda x: x[0] * 1.0,
    )
    with pytest.raises(RuntimeError, match="the closure failed"):
        optimizer(x).step(closure)
    assert closure.calls == at
    assert bits(x) == before


def test_an_interrupt_restores_as_well():
    x = parameter(0.5)
    calls = []

    def closure():
        calls.append(0)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return TensorDict({"objective": x.sum(), "statistics": x * 1.0})

    with pytest.raises(KeyboardInterrupt):
        optimizer(x).step(closure)
    assert x.item() == 0.5


def test_an_indefinite_curvature_is_rejected():
    x = parameter(1.0, 1.0)
    start = x.detach().clone()

    def closure():
        d = x - start
        return TensorDict({"objective": x.sum(), "kl": d[0] ** 2 - 5 * d[1] ** 2})

    report = optimizer(x, statistics_kl=None).step(closure)
    assert (report.case, report.accepted) == ("rejected", False)
    assert "positive definite" in report.reason


def test_a_flat_curvature_needs_damping():
    x = parameter(1.0, 1.0)
    closure = Recorder(x, lambda x: x[0], statistics=lambda x: x[1] * 1.0)
    report = optimizer(x).step(closure)
    assert not report.accepted
    assert "more damping may help" in report.reason
    assert optimizer(x, damping=0.1).step(closure).accepted


def test_a_stationary_point_is_reported_as_such():
    x = parameter(0.0, 0.0)
    report = optimizer(x).step(Recorder(x, lambda x: -x.square().sum()))
    assert not report.accepted
    assert "the best step is none" in report.reason


# -- parameters


def test_frozen_and_unused_parameters():
    frozen, unused, used = parameter(1.0), parameter(2.0), parameter(3.0)
    frozen.requires_grad_(False)
    optim = optimizer([frozen, unused, used], damping=0.1)

    def closure():
        x = used * frozen
        return TensorDict({"objective": x.sum(), "statistics": x})

    report = optim.step(closure)
    assert report.accepted
    assert (frozen.item(), unused.item()) == (1.0, 2.0)
    assert used.item() > 3.0
    frozen.requires_grad_(True)  # thawed between two steps
    optim.step(closure)
    assert frozen.item() > 1.0


def test_step_works_without_outer_gradients_and_leaves_the_mode_and_grads_alone():
    x = parameter(0.0)
    x.grad = torch.full_like(x, 7.0)
    with torch.no_grad():
        assert optimizer(x).step(Recorder(x, lambda x: x.sum())).accepted
        assert not torch.is_grad_enabled()
    assert torch.is_grad_enabled()
    assert x.grad.item() == 7.0
    assert x.is_leaf
    assert x.requires_grad


# -- a torch optimizer


def module_kl(old, new):
    return 0.5 * (new - old).square().sum()


def test_state_dict_pickle_and_deepcopy_keep_settings_and_the_kl():
    x = parameter(0.0)
    optim = optimizer(x, statistics_kl=module_kl, max_kl=0.07, recovery_ratio=0.5, projection=True)
    other = optimizer(parameter(1.0))
    other.load_state_dict(optim.state_dict())
    assert other.param_groups[0]["max_kl"] == 0.07
    assert other.param_groups[0]["recovery_ratio"] == 0.5
    for clone in (pickle.loads(pickle.dumps(optim)), copy.deepcopy(optim)):
        assert clone.statistics_kl is module_kl
        assert clone.projection
        y = clone.param_groups[0]["params"][0]
        assert clone.step(Recorder(y, lambda x: x.sum())).accepted
        assert y.item() == pytest.approx(math.sqrt(0.14))
        assert x.item() == 0.0


def test_max_kl_can_be_scheduled():
    x = parameter(0.0)
    optim = optimizer(x)
    for max_kl in (0.02, 0.005):
        optim.param_groups[0]["max_kl"] = np.float64(max_kl)
        report = optim.step(Recorder(x, lambda x: x.sum()))
        assert report.objective_change == pytest.approx(math.sqrt(2 * max_kl))
    optim.param_groups[0]["max_kl"] = math.nan
    with pytest.raises(ValueError, match="max_kl must be a positive finite number, got nan"):
        optim.step(Recorder(x, lambda x: x.sum()))


def test_hooks_of_torch_optimizers_run():
    x = parameter(0.0)
    optim, seen = optimizer(x), []
    optim.register_step_post_hook(lambda *_: seen.append(x.item()))
    optim.step(Recorder(x, lambda x: x.sum()))
    assert seen == [x.item()]


@pytest.mark.parametrize("m", [0, 1, 2])
def test_report_to_dict(m):
    x = parameter(0.0, 0.0)
    constraint = None if m == 0 else lambda x: x[:m] - 0.01
    report = optimizer(x).step(Recorder(x, lambda x: x.sum(), constraint))
    assert isinstance(report, TrustRegionReport)
    numbers = report.to_dict()
    scalars = {
        "case_code",
        "accepted",
        "kl",
        "step_fraction",
        "backtracks",
        "objective",
        "objective_change",
        "objective_predicted",
        "cg_residual",
    }
    suffixes = [[], [""], ["_0", "_1"]][m]
    vectors = {
        f"{name}{suffix}"
        for name in ("constraint", "constraint_change", "constraint_predicted")
        for suffix in suffixes
    }
    assert set(numbers) == {f"update/{name}" for name in scalars | vectors}
    assert all(type(value) is float for value in numbers.values())
    assert numbers["update/kl"] == report.kl
    assert numbers["update/accepted"] == 1.0
    if m:
        assert numbers[f"update/constraint_change{suffixes[-1]}"] == report.constraint_change[-1]
    assert set(report.to_dict(prefix="")) == scalars | vectors


# -- linear problems: the whole step, to the optimum


def linear(rng, m, dtype, kind, n=12):
    """Factors of a metric, gradients and values of a random linear problem, and its size."""
    a = rng.normal(size=(n, n))
    h = a @ a.T / n + 0.1 * np.eye(n)
    g, b = rng.normal(size=n), rng.normal(size=(m, n))
    if kind == "parallel":
        b[1::2] = b[: len(b[1::2])] * rng.choice([-1, 1])
    elif kind == "flat":
        b[0] = 0.0
    g *= 10.0 ** rng.uniform(-3, 3)
    b *= 10.0 ** rng.uniform(-3, 3, size=(m, 1))
    max_kl = 10.0 ** rng.uniform(-4, -1)
    reach = np.sqrt(2 * max_kl * np.einsum("ij,jk,ik->i", b, np.linalg.inv(h), b))
    low, high = {"feasible": (-1, 0), "far": (1e3, 1e6), "flat": (0.1, 2)}.get(kind, (-0.3, 2.5))
    c = rng.uniform(low, high, size=m) * np.where(reach > 0, reach, 1.0)
    return *(torch.tensor(x, dtype=dtype) for x in (h, g, b, c)), max_kl


@pytest.mark.parametrize("kind", ["feasible", "infeasible", "parallel", "flat", "far"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_every_linear_problem_takes_its_whole_step(kind, dtype):
    rng = np.random.default_rng(0)
    for m in (1, 2, 3, 5, 8, 10):
        for _ in range(3):
            h, g, b, c, max_kl = linear(rng, m, dtype, kind)
            x = nn.Parameter(torch.zeros(len(g), dtype=dtype))
            optim = optimizer(
                x,
                max_kl=max_kl,
                cg_iters=30,
                statistics_kl=lambda o, w, h=h: 0.5 * (w - o) @ h @ (w - o),
            )
            report = optim.step(Recorder(x, lambda x, g=g: g @ x, lambda x, b=b, c=c: c + b @ x))
            if kind == "flat" and m == 1:
                assert report.reason == "no step lowers a violated constraint"
                continue
            if kind == "parallel" and not report.accepted:
                assert report.reason == "no step lowers a violated constraint"
                continue
            assert report.accepted, (m, report.reason)
            assert report.step_fraction == 1.0
            # The step is the subproblem's solution from the exact Gram matrix.
            exact = [v.double().numpy() for v in (h, g, b, c)]
            inverse = np.linalg.inv(exact[0])
            solution = solve_subproblem(
                exact[1] @ inverse @ exact[1],
                exact[2] @ inverse @ exact[1],
                exact[2] @ inverse @ exact[2].T,
                exact[3],
                max_kl,
            )
            if kind == "parallel":  # whose weights are not unique to the last digits
                continue
            weighted = solution.objective_weight * exact[1]
            step = inverse @ (weighted - solution.constraint_weight @ exact[2])
            error = x.detach().double().numpy() - step
            assert math.sqrt(error @ exact[0] @ error / (2 * max_kl)) < 5e-3
            assert report.case == solution.case


@pytest.mark.parametrize(("growth", "accepted"), [(0.5, True), (1.5, False)])
def test_a_violated_constraint_has_the_slack_of_one_that_holds(growth, accepted):
    """A hundredth of what one step can lower it by, ``|b| sqrt(2 max_kl)``."""
    reach = math.sqrt(2 * 0.02)

    def constraint(x):  # the second one can only be held, because of the third, and bends upwards
        bend = 0.01 * growth * reach * (x[2] / reach).square() / 0.99
        return torch.stack([0.1 * reach + x[0], 0.5 * reach + x[1] + bend, -x[1]])

    x = parameter(0.0, 0.0, 0.0)
    report = optimizer(x, max_backtracks=0).step(Recorder(x, lambda x: x[2], constraint))
    assert report.case == "infeasible"
    assert report.accepted is accepted
    if accepted:
        expected = torch.tensor([-0.1, 0.0, math.sqrt(0.99)], dtype=torch.float64) * reach
        torch.testing.assert_close(x.detach(), expected, atol=1e-5 * reach, rtol=0)


# -- what a failed update leaves


class Failure(Exception):
    pass


@pytest.mark.parametrize("error", [Failure, KeyboardInterrupt])
@pytest.mark.parametrize("at", [1, 2])
def test_a_closure_that_fails_after_a_backward_pass_leaves_gradients_and_state(error, at):
    x, y = parameter(*AWKWARD[:2]), parameter(1.0)
    x.grad = torch.full_like(x, 7.0)
    kept, optim, calls = x.grad, optimizer([x, y]), []
    before, state = bits(x), copy.deepcopy(optim.state_dict())

    def closure():
        calls.append(0)
        with torch.enable_grad():
            (x.sum() + y.sum()).backward()
        if len(calls) == at:
            raise error
        return TensorDict({"objective": x.sum(), "statistics": x * 1.0})

    with pytest.raises(error):
        optim.step(closure)
    assert bits(x) == before
    assert x.grad is kept
    assert kept.tolist() == [7.0, 7.0]
    assert y.grad is None
    assert optim.state_dict() == state


@pytest.mark.parametrize("give", [list, tuple, iter])
def test_a_parameter_given_twice(give):
    x = parameter(0.0)
    with pytest.raises(ValueError, match="params must hold every parameter once"):
        optimizer(give([x, x]))
    with pytest.raises(ValueError, match="at least one parameter, got none"):
        optimizer([{"params": []}])


# -- schedules, checkpoints, compilation


def test_schedulers_of_torch_scale_the_region():
    x = parameter(0.0)
    optim = optimizer(x, max_kl=0.02)
    scheduler = torch.optim.lr_scheduler.LambdaLR(optim, lambda n: 0.25**n)
    for size in (0.02, 0.005, 0.00125):
        report = optim.step(Recorder(x, lambda x: x.sum()))
        assert report.objective_change == pytest.approx(math.sqrt(2 * size))
        scheduler.step()
    assert optim.param_groups[0]["max_kl"] == 0.02


@pytest.mark.parametrize("lr", [0.0, -1.0, math.nan, math.inf, None])
def test_a_schedule_out_of_range_moves_nothing(lr):
    x = parameter(0.0)
    optim = optimizer(x)
    optim.param_groups[0]["lr"] = lr
    with pytest.raises(ValueError, match=f"lr must be a positive finite number, got {lr}"):
        optim.step(Recorder(x, lambda x: x.sum()))
    assert x.item() == 0.0


def test_settings_written_after_loading_a_checkpoint_are_those_of_the_next_step():
    x = parameter(0.0)
    saved = optimizer(x, max_kl=0.07).state_dict()
    del saved["param_groups"][0]["lr"]  # as in a checkpoint from before there was one
    optim = optimizer(x, max_kl=0.3)
    optim.load_state_dict(saved)
    for max_kl in (0.07, 0.005):
        optim.param_groups[0]["max_kl"] = max_kl
        report = optim.step(Recorder(x, lambda x: x.sum()))
        assert report.objective_change == pytest.approx(math.sqrt(2 * max_kl))
    optim.param_groups[0]["max_kl"] = math.nan
    with pytest.raises(ValueError, match="max_kl must be a positive finite number, got nan"):
        optim.step(Recorder(x, lambda x: x.sum()))


def test_a_compiled_step_is_the_eager_one():
    ends = []
    for wrap in (lambda f: f, lambda f: torch.compile(f, backend="eager")):
        torch.manual_seed(1)
        net, data = nn.Linear(3, 2), torch.randn(16, 3)
        optim = TrustRegionSafeOptimizer(net.parameters(), max_kl=1e-2)
        old = net(data).detach()

        def closure(net=net, data=data, old=old):
            y = net(data)
            kl = 0.5 * (y - old).square().sum(-1).mean()
            return TensorDict({"objective": y.mean(), "kl": kl})

        report = wrap(optim.step)(closure)
        assert report.accepted
        ends.append((report, net.weight.detach().clone()))
    assert ends[0][0] == ends[1][0]
    assert torch.equal(ends[0][1], ends[1][1])


# -- misuse


@pytest.mark.parametrize(
    ("name", "value", "allowed"),
    [
        (name, value, allowed)
        for name, allowed, values in (
            ("max_kl", "a positive finite number", (0, -1.0, math.nan, math.inf, "1e-3", None)),
            ("damping", "a finite number, at least 0", (-1e-9, math.nan, math.inf, None)),
            ("cg_iters", "an integer, at least 1", (0, 2.5, math.nan, "ten")),
            ("backtrack_ratio", "in (0, 1)", (0.0, 1.0, 1.5, math.nan, None)),
            ("max_backtracks", "an integer, at least 0", (-1, 1.0, None)),
            ("recovery_ratio", "in (0, 1]", (0.0, 1.1, math.nan, None)),
        )
        for value in values
    ],
)
def test_settings_out_of_range(name, value, allowed):
    with pytest.raises(ValueError) as error:
        optimizer(parameter(0.0), **{name: value})
    assert str(error.value) == f"{name} must be {allowed}, got {value!r}."
    x = parameter(0.0)
    optim = optimizer(x)
    optim.param_groups[0][name] = value
    with pytest.raises(ValueError, match=f"{name} must be"):
        optim.step(Recorder(x, lambda x: x.sum()))
    assert x.item() == 0.0


def test_misuse_of_the_constructor():
    a, b = parameter(0.0), parameter(0.0)
    with pytest.raises(ValueError, match="params must be one group"):
        optimizer([{"params": [a]}, {"params": [b]}])
    optim = optimizer(a)
    with pytest.raises(ValueError, match="params must be one group"):
        optim.add_param_group({"params": [b]})
    assert len(optim.param_groups) == 1
    with pytest.raises(ValueError, match=r"one floating-point dtype .* got \['torch.float32 on"):
        optimizer([a, nn.Parameter(torch.zeros(1))])
    with pytest.raises(ValueError, match="floating-point"):
        optimizer(nn.Parameter(torch.zeros(1, dtype=torch.int64), requires_grad=False))
    with pytest.raises(TypeError, match="statistics_kl must be callable or None, got 3"):
        optimizer(a, statistics_kl=3)
    with pytest.raises(ValueError, match="max_kl must be a positive finite number, got -1"):
        optimizer([{"params": [a], "max_kl": -1}])
    with pytest.raises(ValueError, match="empty"):
        optimizer([])


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"objective": None}, KeyError, "lacks 'objective'; it has"),
        ({"statistics": None}, KeyError, "lacks 'statistics'; it has"),
        ({"objective": lambda x: x}, ValueError, r"'objective' must be a scalar, got shape \(2,\)"),
        ({"constraint": lambda x: x.sum()}, ValueError, r"'constraint' must have shape \[m\]"),
        ({"constraint": lambda x: x[None]}, ValueError, r"got shape \(1, 2\)"),
        (
            {"constraint": lambda x: x.sum().expand(MAX_CONSTRAINTS + 1)},
            ValueError,
            f"at most {MAX_CONSTRAINTS}",
        ),
        ({"objective": lambda x: x.sum().detach()}, ValueError, "'objective' must depend on"),
        ({"constraint": lambda x: x.detach()}, ValueError, r"'constraint\[0\]' must depend on"),
        ({"statistics": lambda x: x.detach()}, ValueError, "'statistics' must depend on"),
        (
            {"objective": lambda x: nn.Parameter(torch.zeros(())) * 1},
            ValueError,
            "'objective' must depend on the optimizer's parameters",
        ),
    ],
)
def test_misuse_of_the_closure(change, error, message):
    x = parameter(0.0, 1.0)
    entries = {"objective": lambda x: x.sum(), "statistics": lambda x: x * 1.0} | change

    def closure():
        return TensorDict({key: f(x) for key, f in entries.items() if f is not None})

    with pytest.raises(error, match=message):
        optimizer(x).step(closure)
    assert x.tolist() == [0.0, 1.0]


def test_misuse_of_step():
    x = parameter(0.0)
    optim = optimizer(x)
    with pytest.raises(TypeError, match="step needs a closure that returns a TensorDict, got None"):
        optim.step(None)
    with pytest.raises(TypeError, match="must return a TensorDict, got dict"):
        optim.step(lambda: {"objective": x.sum()})
    x.requires_grad_(False)
    with pytest.raises(ValueError, match="requires a gradient, got none"):
        optim.step(Recorder(x, lambda x: x.sum()))
    x.requires_grad_(True)
    with pytest.raises(ValueError, match=r"statistics_kl\(old, new\) must return a scalar|scalar"):
        optimizer(x, statistics_kl=lambda o, n: (n - o) ** 2).step(Recorder(x, lambda x: x.sum()))
    optim = optimizer(x, statistics_kl=None)
    with pytest.raises(KeyError, match="lacks 'kl'"):
        optim.step(Recorder(x, lambda x: x.sum()))
    with pytest.raises(ValueError, match="'kl' must be zero at the parameters the step starts"):
        optim.step(lambda: TensorDict({"objective": x.sum(), "kl": (x - 1).square().sum()}))
    with pytest.raises(ValueError, match="'kl' must depend on"):
        optim.step(lambda: TensorDict({"objective": x.sum(), "kl": torch.zeros(()).double()}))
    sizes = iter([1, 2])
    with pytest.raises(ValueError, match="'constraint' must keep its shape"):
        optimizer(x).step(Recorder(x, lambda x: x.sum(), lambda x: x.expand(next(sizes)) - 9))
    assert x.item() == 0.0


# -- learning


@pytest.mark.parametrize("start", ["feasible", "infeasible"])
@pytest.mark.parametrize("recovery_ratio", [1.0, 0.9])
def test_a_constrained_bandit_is_learnt(start, recovery_ratio):
    """Gaussian policy per state; reward and cost are quadratic, so their expectations are known.

    In state s: reward -(a - 2)^2, cost a^2, mean cost at most 1 over states. With a ~ N(mu_s, e^2l)
    the optimum has l -> its lower bound and mu = sqrt(1 - var) in every state.
    """
    g = torch.Generator().manual_seed(0)
    states = torch.randn(64, 3, generator=g, dtype=torch.float64)
    noise = torch.randn(64, 32, generator=g, dtype=torch.float64)
    noise = (noise - noise.mean(1, keepdim=True)) / noise.std(1, correction=0, keepdim=True)
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, 2)).double()
    with torch.no_grad():
        net[-1].bias.copy_(torch.tensor([-0.2 if start == "feasible" else 3.0, -1.0]))
    floor = -2.0

    def moments():
        mean, log_std = net(states).unbind(-1)
        return TensorDict({"mean": mean, "log_std": floor + nn.functional.softplus(log_std)})

    def kl(old, new):
        ratio = (2 * (old["log_std"] - new["log_std"])).exp()
        shift = ((new["mean"] - old["mean"]) / new["log_std"].exp()).square()
        return 0.5 * (ratio + shift - 1 - ratio.log()).mean()

    def closure():
        policy = moments()
        action = policy["mean"][:, None] + policy["log_std"].exp()[:, None] * noise
        return TensorDict(
            {
                "objective": -(action - 2).square().mean(),
                "constraint": (action.square().mean() - 1)[None],
                "statistics": policy,
            }
        )

    optim = TrustRegionSafeOptimizer(
        net.parameters(),
        max_kl=0.05,
        damping=1e-3,
        recovery_ratio=recovery_ratio,
        statistics_kl=kl,
    )
    reports = [optim.step(closure) for _ in range(100)]
    assert (reports[0].constraint[0] > 0) == (start == "infeasible")
    # E[-(a - 2)^2] = -(E[a^2] - 4 mu + 4), so the best has E[a^2] = 1 and mu^2 = 1 - var.
    best = -(1 - 4 * math.sqrt(1 - math.exp(2 * floor)) + 4)
    last = closure()
    assert last["objective"].item() == pytest.approx(best, rel=0.05)
    assert last["constraint"].item() < 0.05
    assert sum(report.accepted for report in reports) > 20
    assert all(report.kl <= 0.0505 for report in reports)
    if start == "feasible":  # and it stays so on the way, up to the line search's tolerance
        assert max(report.constraint[0] for report in reports) < 0.05
