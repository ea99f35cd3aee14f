"""The same seed and actions through every interface: the same numbers."""

from __future__ import annotations

import importlib
import importlib.util
import subprocess
import sys
import textwrap
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode
from tensordict import TensorDict

from torchrl_safe import envs
from torchrl_safe.envs import (
    ROBOTS,
    GymRobotEnv,
    GymRobotVectorEnv,
    GymVelocityEnv,
    Randomization,
    SafeRobotEnv,
    SafeVelocityEnv,
)
from torchrl_safe.envs.interfaces.registration import register_envs

LENGTH, STEPS, SEED = 17, 60, 3
NOISY = Randomization(sensor_noise=(0.01, 0.02), lidar_dropout=(0.1, 0.2), mass=(0.9, 1.1))
OPTIONS = [{}, {"randomization": NOISY}]
FACTS = ("observation", "reward", "cost", "violation", "violations", "goal_met")
ENDS = ("terminated", "truncated")

Step = dict[str, np.ndarray]


def actions(robot: str, num_envs: int) -> np.ndarray:
    """[T, N, A], float32, held for a while: noise alone goes nowhere."""
    size = (STEPS // 6, num_envs, ROBOTS[robot].action_dim)
    return np.random.default_rng(0).uniform(-1, 1, size).astype(np.float32).repeat(6, 0)


def torchrl_steps(robot: str, num_envs: int, **options) -> list[tuple[Step, Step]]:
    """Each step, and what the next one starts from."""
    env = SafeRobotEnv(
        robot, num_envs=num_envs, num_threads=1, seed=SEED, episode_length=LENGTH, **options
    )
    td = env.reset()
    steps = []
    for action in actions(robot, num_envs):
        td["action"] = torch.from_numpy(action)
        stepped, td = env.step_and_maybe_reset(td)
        steps.append((arrays(stepped["next"], (*FACTS, *ENDS)), arrays(td, ["observation"])))
    return steps


def arrays(td: TensorDict, keys) -> Step:
    return {k: td[k].numpy() if k == "observation" else td[k].squeeze(-1).numpy() for k in keys}


def gymnasium_steps(robot: str, **options) -> Iterator[tuple[Step, Step]]:
    env = GymRobotEnv(robot, episode_length=LENGTH, **options)
    env.reset(seed=SEED)
    for action in actions(robot, 1)[:, 0]:
        observation, reward, terminated, truncated, info = env.step(action)
        step = {"observation": observation, "reward": reward, **info}
        step |= {"terminated": terminated, "truncated": truncated}
        if terminated or truncated:
            observation, _ = env.reset()
        yield step, {"observation": observation}


def dm_control_steps(robot: str, **options) -> Iterator[tuple[Step, Step]]:
    suite = importlib.import_module("torchrl_safe.envs.interfaces.suite")
    env = suite.load(robot, random=SEED, episode_length=LENGTH, **options)
    env.reset()
    for action in actions(robot, 1)[:, 0]:
        time_step = env.step(action)
        over = time_step.last()
        step = {"reward": time_step.reward, **time_step.observation}
        step |= {
            "terminated": over and time_step.discount == 0.0,
            "truncated": over and time_step.discount == 1.0,
        }
        if over:
            time_step = env.reset()
        yield step, {"observation": time_step.observation["observation"]}


def assert_same(step: Step, expected: Step, *, rows=slice(None)) -> None:
    for name, value in expected.items():
        found = np.asarray(step[name])
        if value.dtype == np.float32:  # reward and cost are float64 before they are tensors
            found = found.astype(np.float32)
        assert (found.reshape(value.shape)[rows] == value[rows]).all(), name


@pytest.mark.parametrize("options", OPTIONS, ids=["plain", "noisy"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_single(robot, options):
    expected = torchrl_steps(robot, 1, **options)
    assert sum(bool(step["truncated"] | step["terminated"]) for step, _ in expected) >= 3
    interfaces = [gymnasium_steps]
    if importlib.util.find_spec("dm_control"):
        interfaces.append(dm_control_steps)
    for interface in interfaces:
        for (step, then), (expected_step, expected_then) in zip(
            interface(robot, **options), expected, strict=True
        ):
            # dm_control knows one end of an episode only: a termination hides a time limit.
            if expected_step["terminated"].any():
                expected_step = {k: v for k, v in expected_step.items() if k != "truncated"}
            assert_same(step, expected_step)
            assert_same(then, expected_then)


class TestVector:
    """Against the batched TorchRL environment, which resets at once."""

    @pytest.fixture(params=ROBOTS)
    def robot(self, request):
        return request.param

    @pytest.fixture(params=OPTIONS, ids=["plain", "noisy"])
    def case(self, request, robot):
        return robot, request.param

    @staticmethod
    def make(robot, mode, options) -> GymRobotVectorEnv:
        return gymnasium.make_vec(
            f"torchrl_safe/{robot.title().replace('_', '')}Goal-v0",
            num_envs=4,
            num_threads=1,
            episode_length=LENGTH,
            autoreset_mode=mode,
            **options,
        )

    def test_disabled(self, case):
        robot, options = case
        vector = self.make(robot, AutoresetMode.DISABLED, options)
        vector.reset(seed=SEED)
        for action, (expected, then) in zip(
            actions(robot, 4), torchrl_steps(robot, 4, **options), strict=True
        ):
            observation, reward, terminated, truncated, infos = vector.step(action)
            step = {"observation": observation, "reward": reward, **infos}
            assert_same(step | {"terminated": terminated, "truncated": truncated}, expected)
            over = terminated | truncated
            if over.any():
                observation, _ = vector.reset(options={"reset_mask": over})
            assert_same({"observation": observation}, then)

    def test_same_step(self, case):
        robot, options = case
        vector = self.make(robot, AutoresetMode.SAME_STEP, options)
        vector.reset(seed=SEED)
        for action, (expected, then) in zip(
            actions(robot, 4), torchrl_steps(robot, 4, **options), strict=True
        ):
            observation, reward, terminated, truncated, infos = vector.step(action)
            assert_same({"observation": observation}, then)
            step = {"reward": reward, "terminated": terminated, "truncated": truncated, **infos}
            over = terminated | truncated
            assert_same(step, {k: v for k, v in expected.items() if k != "observation"})
            assert ("final_obs" in infos) == over.any()
            if over.any():
                final = infos["final_info"]
                assert (infos["_final_obs"] == over).all()
                assert (infos["_final_info"] == over).all()
                assert (final["_cost"] == over).all()
                assert_same(final, {"cost": expected["cost"]}, rows=over)
                for row, last in enumerate(infos["final_obs"]):
                    if over[row]:
                        assert (last == expected["observation"][row]).all()
                    else:
                        assert last is None

    def test_next_step(self, case):
        """Each environment's own sequence: its resetting steps take no action of it."""
        robot, options = case
        table, reference = actions(robot, 4), torchrl_steps(robot, 4, **options)
        vector = self.make(robot, AutoresetMode.NEXT_STEP, options)
        vector.reset(seed=SEED)
        count, resetting = np.zeros(4, int), np.zeros(4, bool)
        resets = 0
        while count.max() < STEPS:
            action = table[count, np.arange(4)]
            observation, reward, terminated, truncated, infos = vector.step(action)
            step = {"observation": observation, "reward": reward, **infos}
            step |= {"terminated": terminated, "truncated": truncated}
            for row in range(4):
                mine = {name: value[row : row + 1] for name, value in step.items()}
                if resetting[row]:
                    then = reference[count[row] - 1][1]["observation"]
                    assert (mine["observation"][0] == then[row]).all()
                    assert reward[row] == 0.0
                    assert not (terminated | truncated)[row]
                    resets += 1
                else:
                    expected = reference[count[row]][0]
                    assert_same(mine, {k: v[row : row + 1] for k, v in expected.items()})
                    count[row] += 1
            resetting = terminated | truncated
        assert resets >= 8


class TestOldNames:
    """Names of version 0.1 still lead somewhere, and say where."""

    @pytest.mark.parametrize(
        ("module", "name", "new"),
        [
            ("goal", "SafeGoalEnv", SafeRobotEnv),
            ("gymnasium", "GymGoalEnv", GymRobotEnv),
            ("velocity", "SafeVelocityEnv", SafeVelocityEnv),
            ("velocity_gymnasium", "GymVelocityEnv", GymVelocityEnv),
            ("registration", "register_envs", register_envs),
        ],
    )
    def test_module(self, module, name, new):
        old = importlib.import_module(f"torchrl_safe.envs.{module}")
        with pytest.warns(DeprecationWarning, match=f"envs.{module}.{name} is deprecated: it is "):
            assert getattr(old, name) is new

    def test_suite(self, suite):
        self.test_module("suite", "load", suite.load)

    def test_from_the_package(self):
        with pytest.warns(DeprecationWarning, match=r"it is .*\.GymRobotVectorEnv now"):
            assert envs.GymGoalVectorEnv is GymRobotVectorEnv

    def test_safe_goal_env_is_the_same_class(self):
        assert envs.SafeGoalEnv is SafeRobotEnv


def test_without_dm_control():
    """Who has no dm_control learns how to get it; nobody else needs it."""
    code = """
        import sys

        sys.modules["dm_control"] = None
        import gymnasium
        from torchrl_safe.envs import SafeRobotEnv

        SafeRobotEnv("point", num_envs=1).rollout(2)
        gymnasium.make("torchrl_safe/SafetyHopperVelocity-v1").reset()
        try:
            from torchrl_safe.envs.interfaces import suite
        except ImportError as error:
            print(error)
    """
    command = [sys.executable, "-W", "ignore", "-c", textwrap.dedent(code)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said.startswith("the dm_control interface needs dm-control")
