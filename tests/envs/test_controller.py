"""What moves Doggo's legs: the network in numpy, and the one that is shipped."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from tensordict import TensorDict
from torch import nn

from torchrl_safe.envs import GoalTask, SafeGoalEnv, get_robot
from torchrl_safe.envs._controller import LegController
from torchrl_safe.envs.robots import to_robot_frame

SHIPPED = get_robot("doggo").asset_path.with_name("doggo_controller.safetensors")


@pytest.fixture
def network() -> nn.Sequential:
    torch.manual_seed(0)
    return nn.Sequential(
        nn.Linear(8, 32), nn.ReLU(), nn.Linear(32, 16), nn.ReLU(), nn.Linear(16, 3), nn.Tanh()
    )


def controller_of(network: nn.Sequential) -> LegController:
    return LegController(
        [(m.weight.detach().numpy(), m.bias.detach().numpy()) for m in network[::2]]
    )


class TestLegController:
    def test_is_the_network(self, network):
        rng = np.random.default_rng(0)
        goal, readings = rng.normal(size=(50, 2)), rng.normal(size=(50, 5))
        rows = [
            (*g / math.hypot(*g), min(math.hypot(*g), 1.0), *r)
            for g, r in zip(goal, readings, strict=True)
        ]
        expected = network(torch.tensor(np.array(rows), dtype=torch.float32)).detach().numpy()
        torques = controller_of(network)(goal, readings)
        assert torques.shape == (50, 3)
        assert torques.dtype == np.float64
        np.testing.assert_allclose(torques, expected, atol=1e-5)
        assert 10 < (np.hypot(*goal.T) > 1).sum() < 40

    def test_a_goal_further_than_one_is_as_one(self, network):
        controller, readings = controller_of(network), np.zeros((1, 5))
        near, far, half = (
            controller(np.array([goal]), readings) for goal in ([0.6, 0.8], [3.0, 4.0], [0.3, 0.4])
        )
        np.testing.assert_allclose(near, far, atol=1e-6)
        assert np.abs(near - half).max() > 1e-3

    def test_no_goal(self, network):
        readings = np.ones((1, 5))
        none, tiny = (
            controller_of(network)(np.array([goal]), readings) for goal in ([0, 0], [1e-9, 0])
        )
        np.testing.assert_allclose(none, tiny, atol=1e-6)

    def test_load(self, network, tmp_path):
        tensors = {}
        for i, layer in enumerate(network[::2]):
            tensors |= {f"weight{i}": layer.weight.half(), f"bias{i}": layer.bias.half()}
        save_file(tensors, tmp_path / "network.safetensors")
        goal, readings = np.array([[1.0, 0.0]]), np.ones((1, 5))
        loaded = LegController.load(tmp_path / "network.safetensors")(goal, readings)
        rounded = network.half().float()
        np.testing.assert_allclose(loaded, controller_of(rounded)(goal, readings), atol=1e-6)


def speeds(lengths: list[float], turns: np.ndarray, steps: int = 100) -> np.ndarray:
    """m/s along fixed directions, ``turns`` to the left of where the robots stood: [L, n].

    The local goal, ``lengths`` long, is shown in the robots' frame of the moment.
    """
    length = np.repeat(lengths, len(turns))[:, None]
    n = len(length)
    env = SafeGoalEnv(num_envs=n, num_threads=2, task=GoalTask(num_hazards=0), robot="doggo")
    env.reset()

    def where() -> np.ndarray:
        layouts = [env.layout(i) for i in range(n)]
        return np.array([[layout["robot"], layout["heading"]] for layout in layouts])

    start, heading = where().swapaxes(0, 1)
    angle = np.tile(turns, len(lengths)) + np.arctan2(heading[:, 1], heading[:, 0])
    direction = np.stack((np.cos(angle), np.sin(angle)), 1)
    for _ in range(steps):
        local = to_robot_frame(length * direction, where()[:, 1])
        env.step(TensorDict({"action": torch.from_numpy(local).float()}, [n]))
    moved = where()[:, 0] - start
    return (moved * direction).sum(1).reshape(len(lengths), -1) / (steps * 0.1)


class TestShipped:
    def test_file(self):
        assert SHIPPED.stat().st_size < 2e6
        with safe_open(SHIPPED, "numpy") as file:
            assert file.metadata()["command"].startswith("python examples/doggo_controller.py")
            assert file.get_slice("weight0").get_shape()[1] == 48
            assert file.get_slice("bias2").get_shape() == [12]

    def test_walks_every_way(self):
        """Faster than the .15 m/s of the authors' controller, in ten seconds from standing."""
        turns = np.arange(12) * (2 * math.pi / 12)
        full, half, none = speeds([1.0, 0.5, 0.0], turns)
        assert full.min() > 0.2
        assert full.mean() > 0.25
        # The length of the local goal is the speed.
        assert 0.3 * full.mean() < half.mean() < 0.8 * full.mean()
        assert np.abs(none).max() < 0.05
