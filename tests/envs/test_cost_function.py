"""CostFunction: the cost of a step by a function, on environments that know nothing of costs."""

from __future__ import annotations

from functools import partial

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import (
    FrameSkipTransform,
    GymEnv,
    ObservationNorm,
    ParallelEnv,
    SerialEnv,
    TransformedEnv,
)

from torchrl_safe.envs import (
    CostFunction,
    SafeFrameSkip,
    SafeRobotEnv,
    check_safe_env,
    cost_keys,
)


def speed(step):
    return step["next", "observation"][..., 2].abs() > 2.0


def both(step):
    return {"speed": speed(step), "torque": step["action"].square().sum(-1, keepdim=True)}


def pendulum(function=speed, **options) -> TransformedEnv:
    return TransformedEnv(GymEnv("Pendulum-v1"), CostFunction(function, **options))


def serial():
    return SerialEnv(2, pendulum)


def around_serial():
    return TransformedEnv(SerialEnv(2, partial(GymEnv, "Pendulum-v1")), CostFunction(speed))


def cart_pole():
    def off_centre(step):
        assert step["action"].dtype == torch.int64  # one-hot
        return step["next", "observation"][..., :1].abs()

    return TransformedEnv(GymEnv("CartPole-v1"), CostFunction(off_centre, violation_above=0.05))


def half_cheetah():
    def excess(step):
        return (step["next", "observation"][..., 8] - 0.1).clamp(min=0.0)

    return TransformedEnv(GymEnv("HalfCheetah-v5"), CostFunction(excess))


@pytest.mark.parametrize("make", [pendulum, serial, around_serial, cart_pole, half_cheetah])
def test_keeps_the_contract(make):
    check_safe_env(make())


@pytest.mark.parametrize("inside", [True, False])
def test_parallel(inside):
    """In each worker or around them: the same costs."""
    if inside:
        env = ParallelEnv(2, pendulum)
    else:
        env = TransformedEnv(ParallelEnv(2, partial(GymEnv, "Pendulum-v1")), CostFunction(speed))
    try:
        check_safe_env(env, num_steps=5)
    finally:
        env.close()


def test_is_the_function_of_the_steps_of_gymnasium():
    """Beside Gymnasium itself, put where each step starts."""
    env, plain = pendulum(both), gymnasium.make("Pendulum-v1")
    torch.manual_seed(0)
    env.set_seed(5)
    rollout = env.rollout(60)
    plain.reset()
    for step in rollout:
        cos, sin, velocity = step["observation"].tolist()
        plain.unwrapped.state = np.array([np.arctan2(sin, cos), velocity])
        observation, *_ = plain.step(step["action"].numpy())
        fast = abs(observation[2]) > 2.0
        assert step["next", "speed_cost"].item() == fast
        assert step["next", "speed_violation"].item() == fast
        assert step["next", "torque_cost"].item() == pytest.approx(step["action"].item() ** 2)
    assert rollout["next", "speed_cost"].any()
    assert not rollout["speed_violation"][0]


def test_several_costs():
    env = pendulum(both, violation_above={"speed": 0.0, "torque": 1.0})
    assert cost_keys(env) == ("speed_cost", "torque_cost")
    check_safe_env(env)
    step = env.rollout(50)["next"]
    assert (step["torque_violation"] == (step["torque_cost"] > 1.0)).all()
    assert cost_keys(serial()) == ("cost",)
    columns = pendulum(
        lambda step: torch.stack([both(step)[k].reshape(step.batch_size) for k in both(step)], -1),
        names=["speed", "torque"],
    )
    assert cost_keys(columns) == ("speed_cost", "torque_cost")
    check_safe_env(columns)


def test_what_info_says():
    env = GymEnv("HalfCheetah-v5").auto_register_info_dict()
    env = TransformedEnv(env, CostFunction(lambda step: step["next", "x_velocity"] > 0.5))
    step = env.rollout(20)["next"]
    assert (step["cost"].squeeze(-1) == (step["x_velocity"] > 0.5)).all()


def test_sees_what_the_policy_saw():
    """Behind a transform of the observation, before and after the step."""
    env = TransformedEnv(GymEnv("Pendulum-v1"), ObservationNorm(0.0, 2.0, ["observation"]))

    def change(step):
        return (step["next", "observation"] - step["observation"]).abs().sum(-1)

    env.append_transform(CostFunction(change))
    rollout = env.rollout(20)
    expected = (rollout["next", "observation"] - rollout["observation"]).abs().sum(-1, True)
    torch.testing.assert_close(rollout["next", "cost"], expected)
    assert (rollout["observation"][1:] == rollout["next", "observation"][:-1]).all()


def test_frames_that_are_skipped_behind_it():
    env = TransformedEnv(
        GymEnv("Pendulum-v1"), CostFunction(lambda step: torch.ones(step.batch_size))
    )
    env.append_transform(SafeFrameSkip(4))
    assert (env.rollout(10)["next", "cost"] == 4.0).all()


def test_a_cost_of_ours_beside_the_own():
    env = SafeRobotEnv(num_envs=3, num_threads=1)
    env = TransformedEnv(env, CostFunction(lambda step: {"haste": step["action"].norm(dim=-1)}))
    step = env.rollout(5)["next"]
    assert step["haste_cost"].shape == step["cost"].shape == (3, 5, 1)


class TestBadInput:
    @pytest.mark.parametrize(
        ("function", "error", "says"),
        [
            (lambda step: torch.zeros(3), ValueError, r"of shape \(\) or \(1,\), got \(3,\)"),
            (lambda step: 1.0, TypeError, "must return a tensor of numbers, got float 1.0"),
            (lambda step: torch.zeros(1) * 1j, TypeError, "got torch.complex64"),
            (lambda step: {}, ValueError, "must name at least one cost"),
            (lambda step: {1: torch.zeros(1)}, ValueError, "by strings"),
            (lambda step: {"a": torch.zeros(2)}, ValueError, "cost 'a', must return one number"),
            (lambda step: step["next", "pace"], RuntimeError, "fails on a step of zeros .*pace"),
            (lambda step: {"x": torch.zeros(2, 1)}, ValueError, r"got \(2, 1\)"),
        ],
    )
    def test_result(self, function, error, says):
        with pytest.raises(error, match=says):
            pendulum(function).full_reward_spec  # noqa: B018

    def test_not_finite(self):
        def late(step):
            return (
                step["next", "observation"][..., 0].abs().where(speed(step).logical_not(), np.nan)
            )

        env = TransformedEnv(SerialEnv(3, partial(GymEnv, "Pendulum-v1")), CostFunction(late))
        with pytest.raises(ValueError, match=r"late.*'cost' must be finite, it is not at \[\["):
            env.rollout(100)

    def test_arguments(self):
        with pytest.raises(TypeError, match="function must be callable, got 'speed'"):
            CostFunction("speed")
        with pytest.raises(ValueError, match="violation_above must be a number, got nan"):
            CostFunction(speed, violation_above=float("nan"))
        with pytest.raises(ValueError, match=r"must be for \['speed', 'torque'\], got \['speed'\]"):
            pendulum(both, violation_above={"speed": 1.0}).full_reward_spec  # noqa: B018
        with pytest.raises(ValueError, match=r"a column for each of \['a', 'b'\]"):
            pendulum(speed, names=["a", "b"]).full_reward_spec  # noqa: B018

    def test_environment(self):
        env = SafeRobotEnv(num_envs=2, num_threads=1)
        with pytest.raises(ValueError, match=r"entries \['cost', 'violation'\] of its own"):
            TransformedEnv(env, CostFunction(lambda s: s["action"].sum(-1))).full_reward_spec  # noqa: B018
        env = TransformedEnv(GymEnv("Pendulum-v1"), FrameSkipTransform(2))
        with pytest.raises(ValueError, match="frame_skip=2 loses the costs"):
            env.append_transform(CostFunction(speed)).full_reward_spec  # noqa: B018
        with pytest.raises(RuntimeError, match="must be appended to a TransformedEnv"):
            CostFunction(speed)._found  # noqa: B018

    def test_costs_that_change(self):
        def fickle(step):
            return both(step) if step["next", "observation"].any() else {"speed": speed(step)}

        with pytest.raises(ValueError, match="must return the same costs at every step"):
            pendulum(fickle).rollout(3)
