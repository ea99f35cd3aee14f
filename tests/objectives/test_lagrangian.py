"""Lagrange multipliers against hand-computed steps and problems whose multiplier is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from torchrl_safe.objectives import (
    LagrangeMultiplier,
    PIDMultiplier,
    exact_penalty,
    lagrangian,
)


class TestLagrangian:
    def test_gradient_is_a_convex_combination(self):
        x = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)
        multiplier = torch.tensor([3.0, 0.5], dtype=torch.float64)
        objective, constraint = (2 * x).sum(), torch.stack([x[0].square(), x[1] - 1])
        lagrangian(objective, constraint, multiplier).backward()
        shares = [1 / 4.5, 3 / 4.5, 0.5 / 4.5]
        expected = [shares[0] * 2 - shares[1] * 2 * 1.0, shares[0] * 2 - shares[2]]
        torch.testing.assert_close(x.grad, torch.tensor(expected, dtype=torch.float64))

    def test_of_several_is_that_of_each(self):
        rng = np.random.default_rng(0)
        objective, constraint = rng.normal(size=(2, 4)), rng.normal(size=(2, 4, 3))
        multiplier = rng.random(3)
        expected = [
            [
                (objective[i, j] - sum(constraint[i, j] * multiplier)) / (1 + sum(multiplier))
                for j in range(4)
            ]
            for i in range(2)
        ]
        actual = lagrangian(*map(torch.tensor, (objective, constraint, multiplier)))
        np.testing.assert_allclose(actual, expected)

    def test_no_gradient_reaches_the_multiplier(self):
        multiplier = LagrangeMultiplier()
        x = torch.ones(1, requires_grad=True)
        lagrangian(x.sum(), x, multiplier()).backward()
        assert multiplier.multiplier.grad is None

    @pytest.mark.parametrize("value", [-0.5, math.inf, math.nan])
    def test_a_multiplier_that_is_none(self, value):
        with pytest.raises(ValueError, match=r"multiplier must be finite and at least 0, got \["):
            lagrangian(torch.zeros(()), torch.zeros(2), torch.tensor([1.0, value]))

    @pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
    def test_a_constraint_that_is_no_number(self, value):
        with pytest.raises(ValueError, match=r"constraint must be finite, got \["):
            lagrangian(torch.zeros(()), torch.tensor([value]), torch.zeros(1))

    @pytest.mark.parametrize(
        ("objective", "constraint", "multiplier"),
        [((1,), (1,), (1,)), ((), (), ()), ((), (2,), (1,))],
    )
    def test_shapes(self, objective, constraint, multiplier):
        with pytest.raises(ValueError, match="must have shapes"):
            lagrangian(torch.zeros(objective), torch.zeros(constraint), torch.zeros(multiplier))


class TestExactPenalty:
    @pytest.mark.parametrize(("penalty", "best"), [(0.5, 1.25), (1.05, 1.0), (20.0, 1.0)])
    def test_is_exact_above_the_multiplier(self, penalty, best):
        """3 x - x^2 below 1, where its slope, the multiplier, is 1; the second one never binds."""
        grid = torch.linspace(0, 3, 601, dtype=torch.float64)
        values = [
            exact_penalty(3 * x - x.square(), torch.stack([x - 1, x / 2 - 2]), penalty)
            for x in grid
        ]
        assert grid[torch.stack(values).argmax()].item() == pytest.approx(best)

    def test_violations_add_up(self):
        x = torch.tensor([2.0, -1.0, 0.5], requires_grad=True)
        value = exact_penalty(x.sum(), x, 3.0)
        assert value.item() == pytest.approx(1.5 - 3 * 2.5)
        value.backward()
        assert x.grad.tolist() == [-2.0, 1.0, -2.0]

    @pytest.mark.parametrize(("objective", "constraint"), [((1,), (1,)), ((), ())])
    def test_shapes(self, objective, constraint):
        with pytest.raises(ValueError, match="must have shapes"):
            exact_penalty(torch.zeros(objective), torch.zeros(constraint), 1.0)

    @pytest.mark.parametrize("penalty", [0.0, math.inf, math.nan])
    def test_a_penalty_that_is_none(self, penalty):
        with pytest.raises(ValueError, match=f"penalty must be .*, got {penalty}"):
            exact_penalty(torch.zeros(()), torch.zeros(1), penalty)


class TestLagrangeMultiplier:
    @pytest.mark.parametrize("init", [0, 1e-6, 0.5, 50.0])
    def test_starts_where_it_is_told(self, init):
        multiplier = LagrangeMultiplier(2, init=init)
        torch.testing.assert_close(multiplier(), torch.full((2,), float(init)), rtol=0, atol=0)

    def test_a_violation_raises_the_price(self):
        multiplier = LagrangeMultiplier(2)
        multiplier.loss(torch.tensor([1.0, -2.0])).backward()
        torch.optim.SGD(multiplier.parameters(), lr=0.1).step()
        high, low = multiplier().tolist()
        assert high > 1 > low > 0

    def test_state_dict(self):
        multiplier, other = LagrangeMultiplier(2, init=3.0), LagrangeMultiplier(2)
        other.load_state_dict(multiplier.state_dict())
        assert torch.equal(other(), multiplier())

    @pytest.mark.parametrize("init", [-1.0, math.nan, math.inf, True, "1"])
    def test_bad_init(self, init):
        with pytest.raises(ValueError, match="init must be a finite number, at least 0, got"):
            LagrangeMultiplier(init=init)


OPTIMIZERS = {
    "momentum": (torch.optim.SGD, {"momentum": 0.9}),
    "nesterov": (torch.optim.SGD, {"momentum": 0.99, "nesterov": True}),
    "adam": (torch.optim.Adam, {}),
    "adam, one memory": (torch.optim.Adam, {"betas": (0.9, 0.9)}),
    "adamw": (torch.optim.AdamW, {}),
    "rmsprop": (torch.optim.RMSprop, {}),
    "rprop": (torch.optim.Rprop, {}),
}


class TestNoWindUp:
    """After any time of safety a violation is priced as projected dual ascent does."""

    @pytest.mark.parametrize("scale", [0.1, 30.0])
    def test_gradient_descent_is_projected_dual_ascent(self, scale):
        rng, lr = np.random.default_rng(0), 0.05
        constraints = scale * rng.normal(-0.5, 1.0, (3000, 2))
        constraints[1000:2000] = -scale
        multiplier, expected = LagrangeMultiplier(2), np.ones(2)
        optim = torch.optim.SGD(multiplier.parameters(), lr=lr)
        for constraint in constraints:
            step(multiplier, optim, constraint)
            expected = np.maximum(0.0, expected + lr * constraint)
            np.testing.assert_allclose(multiplier().tolist(), expected, rtol=1e-4, atol=1e-4)

    @pytest.mark.parametrize("depth", [0.5, 25.0])
    @pytest.mark.parametrize("feasible", [300, 3000])
    @pytest.mark.parametrize("name", OPTIMIZERS)
    def test_a_price_after_safety(self, name, feasible, depth):
        """However long and deep it was, a violation of 1 costs 0.5 after some 0.5 / lr steps."""
        kind, options = OPTIMIZERS[name]
        multiplier, lr = LagrangeMultiplier(), 0.02
        optim = kind(multiplier.parameters(), lr=lr, **options)
        for _ in range(feasible):
            step(multiplier, optim, [-depth])
        assert multiplier().item() == 0
        count = 0
        while multiplier().item() < 0.5:
            step(multiplier, optim, [1.0])
            count += 1
            assert count <= 10 * 0.5 / lr

    @pytest.mark.parametrize("depth", [0.5, 25.0])
    @pytest.mark.parametrize("feasible", [300, 3000])
    def test_adam_with_one_memory_steps_as_its_rate_says(self, feasible, depth):
        multiplier, lr = LagrangeMultiplier(), 0.02
        optim = torch.optim.Adam(multiplier.parameters(), lr=lr, betas=(0.9, 0.9))
        for _ in range(feasible):
            step(multiplier, optim, [-depth])
        prices = [0.0]
        for _ in range(100):
            step(multiplier, optim, [1.0])
            prices.append(multiplier().item())
        rises = np.diff(prices)
        assert (rises > 0).all()
        assert rises.max() < lr * 1.01
        assert prices[-1] == pytest.approx(100 * lr, rel=0.1)

    def test_one_at_rest_does_not_hold_another(self):
        multiplier = LagrangeMultiplier(2, init=0.0)
        multiplier.loss(torch.tensor([-3.0, 2.0])).backward()
        assert multiplier.multiplier.grad.tolist() == [0.0, -2.0]

    def test_pid_unwinds_as_projected_ascent(self):
        rng, ki = np.random.default_rng(1), 0.05
        multiplier, expected = PIDMultiplier(kp=0.0, ki=ki), 0.0
        for constraint in rng.normal(-0.3, 2.0, 500):
            multiplier.update([constraint])
            expected = max(0.0, expected + ki * constraint)
            assert multiplier().item() == pytest.approx(expected, abs=1e-4)


def step(multiplier, optim, constraint):
    optim.zero_grad()
    multiplier.loss(torch.tensor(constraint, dtype=torch.float32)).backward()
    optim.step()


@pytest.mark.parametrize(
    ("multiplier", "options"),
    [
        (LagrangeMultiplier(2), "num_constraints=2"),
        (PIDMultiplier(kp=0.5, ki=0.25, kd=0.0), "num_constraints=1, kp=0.5, ki=0.25, kd=0.0"),
    ],
)
def test_repr_tells_the_options(multiplier, options):
    assert repr(multiplier) == f"{type(multiplier).__name__}({options})"


class TestPIDMultiplier:
    def test_algorithm_2_by_hand(self):
        multiplier = PIDMultiplier(kp=1.0, ki=0.5, kd=2.0)
        # error, integral, rise -> p + i + d
        for error, expected in [
            (1.0, 1.0 + 0.5 * 1.0),
            (3.0, 3.0 + 0.5 * 4.0 + 2.0 * 2.0),
            (-2.0, max(0.0, -2.0 + 0.5 * 2.0)),
            (-9.0, 0.0),
            (1.0, 1.0 + 0.5 * 1.0 + 2.0 * 10.0),
        ]:
            assert multiplier.update(torch.tensor([error])).item() == pytest.approx(expected)

    def test_finds_a_known_multiplier(self):
        # max -x^2 subject to x >= 1: the multiplier is 2.
        x, multiplier = torch.zeros(1), PIDMultiplier(kp=0.5, ki=0.05, kd=0.5)
        for _ in range(2000):
            price = multiplier.update(1 - x)
            x = x + 0.05 * (price - 2 * x) / (1 + price)
        assert x.item() == pytest.approx(1.0, abs=1e-2)
        assert multiplier().item() == pytest.approx(2.0, abs=5e-2)

    def test_resumes_exactly(self):
        first = PIDMultiplier(2, kp=1.0, ki=0.1, kd=1.0)
        first.update(torch.tensor([1.0, -1.0]))
        second = PIDMultiplier(2, kp=1.0, ki=0.1, kd=1.0)
        second.load_state_dict(first.state_dict())
        error = torch.tensor([2.0, 0.5])
        assert torch.equal(first.update(error), second.update(error))

    def test_holds_no_tensor_of_the_caller(self):
        """The last constraint is remembered as it was, whatever becomes of the caller's tensor."""
        constraint, multiplier = torch.tensor([1.0]), PIDMultiplier(kp=0.0, ki=0.0, kd=1.0)
        multiplier.update(constraint)
        constraint.fill_(-100.0)
        assert multiplier.update(torch.tensor([3.0])).item() == 2.0  # the rise from 1
        multiplier.load_state_dict(PIDMultiplier(kp=0.0, ki=0.0, kd=1.0).state_dict())
        assert constraint.item() == -100.0

    @pytest.mark.parametrize(
        "bad", [torch.tensor([math.nan]), torch.zeros(2), torch.tensor([3.4e38])]
    )
    def test_a_bad_constraint_changes_nothing(self, bad):
        multiplier = PIDMultiplier(kp=10.0, ki=0.1)
        multiplier.update(torch.tensor([1.0]))
        before = {key: value.clone() for key, value in multiplier.state_dict().items()}
        with pytest.raises(ValueError, match="constraint must"):
            multiplier.update(bad)
        for key, value in multiplier.state_dict().items():
            assert torch.equal(value, before[key])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"kp": -1.0, "ki": 0.0}, "kp must be a finite number, at least 0"),
            ({"kp": 0.0, "ki": 0.0}, "must be positive"),
            ({"kp": 1.0, "ki": 0.0, "init": 1.0}, "needs a positive ki"),
            ({"kp": 1.0, "ki": float("nan")}, "ki must be a finite number, at least 0"),
            (
                {"num_constraints": 0, "kp": 1.0, "ki": 0.1},
                "num_constraints must be an integer, at least 1, got 0",
            ),
        ],
    )
    def test_bad_arguments(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            PIDMultiplier(**arguments)
