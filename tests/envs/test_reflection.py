"""Mirrors against the simulator: what happens in one is what happens on its other side."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_safe.envs import Reflection, SafeRobotEnv


def mirrored_world(state, nq, nv):
    """The state of environments in which left is right: y, yaw and what turns change signs."""
    state = {name: value.clone() for name, value in state.items()}
    for name in ("position", "heading", "goal", "hazards"):
        state[name][..., 1] *= -1
    physics = state["physics"]  # time, positions, velocities, ...
    position, velocity = physics[:, 1 : 1 + nq], physics[:, 1 + nq : 1 + nq + nv]
    if nq == 3:
        position[:, 1:] *= -1
        velocity[:, 1:] *= -1
    return state


def test_point_drives_the_same_in_the_mirror():
    """Step by step to rounding: reward, cost, violation and observation."""
    env, other = (
        SafeRobotEnv("point", num_envs=32, num_threads=1, seed=seed, episode_length=10**6)
        for seed in (3, 4)
    )
    mirror = env.reflection
    env.reset()
    other.reset()
    other.load_state_dict(mirrored_world(env.state_dict(), 3, 3))
    generator = torch.Generator().manual_seed(0)
    for _ in range(25):
        action = 2 * torch.rand(32, 2, generator=generator) - 1
        step = env.step(TensorDict(action=action, batch_size=[32]))
        seen = mirror(TensorDict(observation=step["next", "observation"], action=action))
        there = other.step(TensorDict(action=seen["action"], batch_size=[32]))["next"]
        same = ~step["next", "goal_met"].squeeze(-1)  # a new goal is drawn by another stream
        for name in ("reward", "cost"):
            torch.testing.assert_close(there[name], step["next", name], rtol=0, atol=1e-5)
        torch.testing.assert_close(
            there["observation"][same], seen["observation"][same], rtol=0, atol=2e-4
        )
        if not same.all():
            break


@pytest.mark.parametrize("robot", ["point", "car", "jackal"])
def test_twice_is_once(robot):
    env = SafeRobotEnv(robot, num_envs=2, num_threads=1)
    step = env.rand_step(env.reset())
    seen = env.reflection(env.reflection(step))
    for key in ("observation", "action"):
        assert seen[key].equal(step[key])
    assert not env.reflection(step)["observation"].equal(step["observation"])


@pytest.mark.parametrize("robot", ["doggo", "doggo_torques"])
def test_robots_without(robot):
    """Doggo's legs keep a clock: left and right are half a period apart."""
    assert SafeRobotEnv(robot, num_envs=1, num_threads=1).reflection is None


def test_half():
    mirror = Reflection([-1], [1])
    batch = TensorDict(observation=torch.ones(5, 1), action=torch.ones(5, 1), batch_size=[5])
    assert mirror.of_half(batch)["observation"].flatten().tolist() == [-1, -1, 1, 1, 1]
    assert batch["observation"].equal(torch.ones(5, 1))


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ([1, 3], "each of 2 entries once"),
        ([1, 1], "each of 2 entries once"),
        ([2, 3, 1], "done twice, must change nothing"),
        ([2, -1], "done twice, must change nothing"),
        ([0], "each of 1 entries once"),
    ],
)
def test_no_mirror(observation, message):
    with pytest.raises(ValueError, match=message):
        Reflection(observation, [1])


def test_another_size():
    mirror = Reflection([1, -2], [1])
    step = TensorDict(observation=torch.ones(3), action=torch.ones(1))
    with pytest.raises(ValueError, match="'observation' must have 2 entries"):
        mirror(step)
    assert np.allclose(step["observation"], 1)
