"""Lagrange multipliers against hand-computed steps and problems whose multiplier is known."""

from __future__ import annotations

import pytest
import torch

from torchrl_safe.objectives import LagrangeMultiplier, PIDMultiplier, lagrangian


class TestLagrangian:
    def test_gradient_is_a_convex_combination(self):
        x = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)
        multiplier = torch.tensor([3.0, 0.5], dtype=torch.float64)
        objective, constraint = (2 * x).sum(), torch.stack([x[0].square(), x[1] - 1])
        lagrangian(objective, constraint, multiplier).backward()
        shares = [1 / 4.5, 3 / 4.5, 0.5 / 4.5]
        expected = [shares[0] * 2 - shares[1] * 2 * 1.0, shares[0] * 2 - shares[2]]
        torch.testing.assert_close(x.grad, torch.tensor(expected, dtype=torch.float64))

    def test_no_gradient_reaches_the_multiplier(self):
        multiplier = LagrangeMultiplier()
        x = torch.ones(1, requires_grad=True)
        lagrangian(x.sum(), x, multiplier()).backward()
        assert multiplier.weight.grad is None

    @pytest.mark.parametrize(
        ("objective", "constraint", "multiplier"),
        [((1,), (1,), (1,)), ((), (), ()), ((), (2,), (1,))],
    )
    def test_shapes(self, objective, constraint, multiplier):
        with pytest.raises(ValueError, match="must have shapes"):
            lagrangian(torch.zeros(objective), torch.zeros(constraint), torch.zeros(multiplier))


class TestLagrangeMultiplier:
    @pytest.mark.parametrize("init", [1e-6, 0.5, 50.0])
    def test_starts_where_it_is_told(self, init):
        multiplier = LagrangeMultiplier(2, init=init)
        torch.testing.assert_close(multiplier(), torch.full((2,), init), rtol=1e-4, atol=1e-7)

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

    @pytest.mark.parametrize("init", [0.0, -1.0, float("nan"), float("inf")])
    def test_bad_init(self, init):
        with pytest.raises(ValueError, match="init must be positive and finite"):
            LagrangeMultiplier(init=init)


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

    @pytest.mark.parametrize("bad", [torch.tensor([float("nan")]), torch.zeros(2)])
    def test_a_bad_constraint_changes_nothing(self, bad):
        multiplier = PIDMultiplier(kp=1.0, ki=0.1)
        multiplier.update(torch.tensor([1.0]))
        before = {key: value.clone() for key, value in multiplier.state_dict().items()}
        with pytest.raises(ValueError, match="constraint must"):
            multiplier.update(bad)
        for key, value in multiplier.state_dict().items():
            assert torch.equal(value, before[key])

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ({"kp": -1.0, "ki": 0.0}, "kp must be at least 0"),
            ({"kp": 0.0, "ki": 0.0}, "must be positive"),
            ({"kp": 1.0, "ki": 0.0, "init": 1.0}, "needs a positive ki"),
            ({"kp": 1.0, "ki": float("nan")}, "ki must be at least 0"),
            (
                {"num_constraints": 0, "kp": 1.0, "ki": 0.1},
                "num_constraints, an integer, must be at least 1, got 0",
            ),
        ],
    )
    def test_bad_arguments(self, arguments, message):
        with pytest.raises(ValueError, match=message):
            PIDMultiplier(**arguments)
