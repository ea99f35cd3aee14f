"""The limit's controller against plants whose bias is known."""

from __future__ import annotations

import math
from copy import deepcopy

import numpy as np
import pytest
import torch

from torchrl_safe.objectives import LimitController


class Plant:
    """A level that goes a share of the way to a biased limit at each update, measured with noise.

    The bias is that of training: a part that is always there, and one that grows with the level.
    """

    def __init__(self, lag=0.1, bias=0.3, share=0.1, noise=0.0, level=8.0):
        self.lag, self.bias, self.share, self.noise, self.level = lag, bias, share, noise, level
        self.rng = np.random.default_rng(0)

    def step(self, limit):
        self.level += self.lag * (limit * (1 + self.share) + self.bias - self.level)
        return self.level + self.noise * self.rng.normal()


def settle(controller, plant, allowed, updates=600):
    levels, used, measured = [], allowed, plant.level
    for _ in range(updates):
        used = controller.update(measured, allowed)
        measured = plant.step(used)
        levels.append(plant.level)
    return np.array(levels), used


class TestSettling:
    @pytest.mark.parametrize("allowed", [2.5, 5.0, 10.0])
    @pytest.mark.parametrize("kp", [0.0, 0.5])
    def test_the_level_is_the_limit(self, allowed, kp):
        biased, _ = settle(LimitController(ki=1e-9), Plant(), allowed)
        assert biased[-1] == pytest.approx(1.1 * allowed + 0.3)
        levels, used = settle(LimitController(kp=kp, ki=0.02), Plant(), allowed)
        assert levels[-1] == pytest.approx(allowed, rel=1e-3)
        assert used == pytest.approx((allowed - 0.3) / 1.1, rel=2e-3)

    def test_under_noise(self):
        levels, _ = settle(LimitController(ki=0.02), Plant(noise=1.0), 5.0, updates=2000)
        assert levels[1000:].mean() == pytest.approx(5.0, rel=0.02)
        assert levels[1000:].std() < 0.3

    def test_a_limit_that_falls(self):
        controller, plant = LimitController(ki=0.02), Plant(level=16.0)
        measured = plant.level
        for update in range(1200):
            allowed = max(15.0 - 0.02 * update, 5.0)
            measured = plant.step(controller.update(measured, allowed))
        assert measured == pytest.approx(5.0, rel=1e-3)

    def test_decay_is_the_gain(self):
        """Where the level follows at once, (1 - ki) to the number of updates is left."""
        controller, level = LimitController(ki=0.2), 5.5
        for update in range(10):
            assert level - 5 == pytest.approx(0.5 * 0.8**update)
            level = controller.update(level, 5.0) + 0.5


class TestWindup:
    @pytest.mark.parametrize("kp", [0.0, 1.0])
    def test_a_level_out_of_reach_winds_nothing_up(self, kp):
        controllers = [LimitController(kp=kp, ki=0.1) for _ in range(2)]
        for controller, updates in zip(controllers, (100, 100_000), strict=True):
            for _ in range(updates):
                assert controller.update(50.0, 5.0) >= 2.5
        short, long = (
            [controller.update(4.0, 5.0) for _ in range(30)] for controller in controllers
        )
        assert short == long
        assert long[-1] == 5.0  # 25 updates of .1 take the largest correction back

    def test_a_time_of_safety_loosens_nothing(self):
        controller = LimitController(ki=0.1)
        assert all(controller.update(0.0, 5.0) == 5.0 for _ in range(1000))
        assert controller.update(6.0, 5.0) == pytest.approx(4.9)

    def test_bounds(self):
        controller = LimitController(kp=100.0, ki=1.0, tighten=0.3, loosen=0.2)
        assert controller.update(100.0, 5.0) == pytest.approx(3.5)
        assert controller.update(0.0, 5.0) == pytest.approx(6.0)
        assert LimitController(kp=10.0, tighten=1.0).update(100.0, 5.0) == 0.0
        assert LimitController(kp=10.0).update(1.0, 0.0) == 0.0


def test_tensors_and_state_dict():
    controller, other = LimitController(ki=0.1), LimitController(ki=0.1)
    controller.update(torch.tensor(6.0), torch.tensor(5.0))
    other.load_state_dict(deepcopy(controller.state_dict()))
    assert other.update(6.0, 5.0) == controller.update(6.0, 5.0) == pytest.approx(4.8)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("kp", -1.0),
        ("ki", 0.0),
        ("ki", math.nan),
        ("tighten", 1.5),
        ("tighten", -0.1),
        ("loosen", -0.1),
        ("loosen", math.inf),
    ],
)
def test_bad_arguments(name, value):
    with pytest.raises(ValueError, match=rf"{name} must be a .*number.* got {value}"):
        LimitController(**{name: value})


@pytest.mark.parametrize(
    ("level", "limit", "name"),
    [(math.nan, 5.0, "level"), (math.inf, 5.0, "level"), (1.0, -1.0, "cost_limit")],
)
def test_bad_measurements_leave_the_state(level, limit, name):
    controller = LimitController()
    controller.update(6.0, 5.0)
    before = controller.integral.clone()
    with pytest.raises(ValueError, match=rf"{name} must be a finite number"):
        controller.update(level, limit)
    assert controller.integral == before
