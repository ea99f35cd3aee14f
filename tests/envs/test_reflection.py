"""Mirrors against the simulator: what happens in one is what happens on its other side."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from torchrl_safe.envs import Reflection, SafeRobotEnv
from torchrl_safe.envs.tasks import get_task


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


AXIAL = torch.tensor([1.0, -1.0, -1.0])  # what turns, in a mirror that faces east


def turned_quaternion(quaternion):
    """Of a box whose east is its west."""
    return quaternion * torch.tensor([1.0, 1.0, -1.0, -1.0])


def mirrored_point(position, velocity):
    """East is west, and the robot's left its right."""
    position[:, 0] *= -1
    position[:, 2] = torch.pi - position[:, 2]
    velocity[:, [0, 2]] *= -1


def mirrored_car(position, velocity):
    """The same of a free base, two wheels that change places, and a ball between them."""
    position[:, 0] *= -1
    w, x, y, z = position[:, 3:7].clone().T
    position[:, 3:7] = torch.stack([z, -y, -x, w], 1)
    position[:, 7:9] = position[:, 7:9].flip(1)
    position[:, 9:13] *= torch.tensor([1.0, -1.0, 1.0, -1.0])
    velocity[:, 0] *= -1
    velocity[:, 3:6] *= torch.tensor([-1.0, 1.0, -1.0])
    velocity[:, 6:8] = velocity[:, 6:8].flip(1)
    velocity[:, 8:11] *= torch.tensor([-1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("task", "own", "sizes"),
    [
        ("SafetyPointGoal1", mirrored_point, (3, 3)),
        ("SafetyPointPush0", mirrored_point, (3, 3)),
        ("SafetyCarGoal1", mirrored_car, (13, 11)),
        ("SafetyCarGoal2", mirrored_car, (13, 11)),
    ],
)
def test_safety_tasks_in_the_mirror(task, own, sizes):
    """Sensors, lidars, reward and cost, with what can be pushed: east for west, since the magnetic
    field points north."""
    robot, of_robot = get_task(task)
    env, other = (
        SafeRobotEnv(robot, task=of_robot, num_envs=32, num_threads=1, seed=seed) for seed in (3, 4)
    )
    env.reset()
    other.reset()
    state = {name: value.clone() for name, value in env.state_dict().items()}
    for name in ("position", "heading", "goal", "hazards", "vases", "push_box"):
        if name in state:
            state[name][..., 0] *= -1
    movable = [body.count for body in of_robot.bodies if body.hold == "free"]
    nq, nv = (first + each * sum(movable) for first, each in zip(sizes, (7, 6), strict=True))
    position = state["physics"][:, 1 : 1 + nq]
    velocity = state["physics"][:, 1 + nq : 1 + nq + nv]
    own(position, velocity)
    for start in range(sizes[0], nq, 7):
        position[:, start] *= -1
        position[:, start + 3 : start + 7] = turned_quaternion(position[:, start + 3 : start + 7])
    for start in range(sizes[1], nv, 6):
        velocity[:, start] *= -1
        velocity[:, start + 3 : start + 6] *= AXIAL
    other.load_state_dict(state)
    mirror = env.reflection
    generator = torch.Generator().manual_seed(0)
    alike = torch.ones(32, dtype=torch.bool)  # until a new goal is drawn, by another stream
    for _ in range(20):
        action = 2 * torch.rand(32, 2, generator=generator) - 1
        step = env.step(TensorDict(action=action, batch_size=[32]))
        seen = mirror(TensorDict(observation=step["next", "observation"], action=action))
        there = other.step(TensorDict(action=seen["action"], batch_size=[32]))["next"]
        off = (there["observation"] - seen["observation"]).abs().amax(-1) > 0.02
        for name in ("reward", "cost"):
            off |= (there[name] - step["next", name]).squeeze(-1).abs() > 1e-3
        alike &= ~step["next", "goal_met"].squeeze(-1)
        # One that bumps into something may go either way: contacts blow rounding up.
        assert (off & alike).sum() <= 2
    assert alike.sum() > 20


@pytest.mark.parametrize(
    "task", ["SafetyPointButton1", "SafetyPointCircle1", "SafetyPointRun0", "SafetyAntGoal1"]
)
def test_tasks_without(task):
    """Gremlins and Circle's reward go round one way, Run leads along one axis."""
    robot, of_robot = get_task(task)
    assert SafeRobotEnv(robot, task=of_robot, num_envs=1, num_threads=1).reflection is None


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
