"""Two costs on the Jackal: beside the task with one, and beside the robot's own motion."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import GymEnv, TransformedEnv

from torchrl_safe.envs import (
    CostFunction,
    GymRobotVectorEnv,
    NavigationSpeedTask,
    SafeFrameSkip,
    SafeRobotEnv,
    check_safe_env,
    cost_keys,
)
from torchrl_safe.envs.interfaces import suite

OPTIONS = {"num_envs": 6, "num_threads": 1, "episode_length": 120, "seed": 3}


def drive(task, steps: int = 300):
    env = SafeRobotEnv("jackal", task=task, **OPTIONS)
    generator = torch.Generator().manual_seed(0)
    actions = torch.rand(steps // 10, 6, 2, generator=generator).mul(2).sub(1)
    actions = actions.repeat_interleave(10, 0)
    td, rows, places = env.reset(), [], [[env.layout(k)["robot"] for k in range(6)]]
    for action in actions:
        stepped, td = env.step_and_maybe_reset(td.set("action", action))
        rows.append(stepped["next"].clone())
        places.append([env.layout(k)["robot"] for k in range(6)])
    return torch.stack(rows), np.array(places)


def test_the_first_cost_is_the_task_with_one():
    two, places = drive("navigation_speed")
    one, _ = drive("navigation")
    for key in ("observation", "reward", "goal_met", "done", "terminated", "truncated"):
        assert torch.equal(two[key], one[key])
    for name in ("cost", "violation", "violations"):
        assert torch.equal(two[f"collision_{name}"], one[name])
    assert one["terminated"].any()  # contacts, and what they add, among them
    assert "cost" not in two.keys()
    assert (two["violation"] == (two["collision_violation"] | two["speed_violation"])).all()
    most = torch.maximum(two["collision_violations"], two["speed_violations"])
    assert torch.equal(two["violations"], most)
    # The second one is how far the robot came in a step, where nothing was reset in between.
    pace = np.linalg.norm(np.diff(places, axis=0), axis=-1) / (0.002 * 16)
    fast = two["speed_cost"].squeeze(-1).numpy() == 1.0
    sure = (np.abs(pace - 0.5) > 0.25) & ~two["done"].squeeze(-1).numpy()
    assert (fast == (pace > 0.5))[sure].all()
    assert 0.1 < fast[sure].mean() < 0.9
    assert torch.equal(two["speed_cost"] > 0, two["speed_violation"])


def test_keeps_the_contract():
    env, twin = (
        SafeRobotEnv("jackal", task="navigation_speed", num_envs=3, num_threads=n, episode_length=9)
        for n in (1, 2)
    )
    assert cost_keys(env) == ("collision_cost", "speed_cost")
    check_safe_env(env, twins=[twin], time_limit=9)


def test_the_contract_looks_at_each_cost():
    def costs(step):
        return {"good": step["action"].square(), "bad": step["action"]}

    env = TransformedEnv(GymEnv("Pendulum-v1"), CostFunction(costs))
    with pytest.raises(AssertionError, match="'bad_cost' must not be negative"):
        check_safe_env(env)


def test_interfaces():
    task = NavigationSpeedTask(speed_limit=0.2)
    names = {f"{cost}_{what}" for cost in task.cost_names for what in ("cost", "violation")}
    names |= {f"{cost}_violations" for cost in task.cost_names}
    names |= {"violation", "violations", "goal_met"}
    env = gymnasium.make("torchrl_safe/JackalGoal-v0", task=task)
    _, info = env.reset(seed=0)
    assert set(info) == names
    *_, info = env.step(np.array([1.0, 0.0], np.float32))
    assert info["speed_cost"] in (0.0, 1.0)
    vector = GymRobotVectorEnv("jackal", task=task, num_envs=2, num_threads=1)
    vector.reset(seed=0)
    *_, infos = vector.step(np.ones((2, 2), np.float32))
    assert infos["speed_cost"].shape == (2,)
    step = suite.load("jackal", task, random=0).reset()
    assert set(step.observation) == names | {"observation"}


def test_skipped_frames():
    task, actions = NavigationSpeedTask(speed_limit=0.2), torch.ones(40, 6, 2) * 0.5
    base = SafeRobotEnv("jackal", task=task, **OPTIONS)
    env = SafeRobotEnv("jackal", task=task, **OPTIONS).append_transform(SafeFrameSkip(4))
    td, plain = env.reset(), base.reset()
    for action in actions[:8]:
        stepped = env.step(td.set("action", action))["next"]
        costs = []
        for _ in range(4):
            costs.append(base.step(plain.set("action", action))["next"])
            plain = costs[-1].exclude("reward", "speed_cost", "collision_cost")
        assert torch.equal(stepped["speed_cost"], sum(cost["speed_cost"] for cost in costs))
        total = sum(cost["speed_violations"] for cost in costs)
        assert torch.equal(stepped["speed_violations"], -(-total // 4))
        td = stepped.exclude("reward", "speed_cost", "collision_cost")


def test_bad_input():
    with pytest.raises(ValueError, match="speed_limit must be positive and finite, got 0"):
        NavigationSpeedTask(speed_limit=0.0)
