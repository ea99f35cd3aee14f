"""The bridge to Safety-Gymnasium: with a stand-in for it here, with itself where there is one."""

from __future__ import annotations

import os
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from torchrl.envs import SerialEnv

from torchrl_safe.envs import check_safe_env
from torchrl_safe.envs.bridge import SafetyGymnasiumBridge

STAND_IN = """
    import numpy as np

    print("hello from a library")  # which must not be taken for an answer

    class Box:
        def __init__(self, low, high, shape):
            self.low, self.high, self.shape = np.full(shape, low), np.full(shape, high), shape

    class Env:
        observation_space, action_space = Box(-np.inf, np.inf, (3,)), Box(-1.0, 1.0, (2,))

        def __init__(self, length, hazard=0.5):
            self.length, self.hazard, self.random = length, hazard, np.random.default_rng(0)

        def reset(self, seed=None):
            if seed is not None:
                self.random = np.random.default_rng(seed)
            self.state, self.count = self.random.uniform(size=3), 0
            return self.state, {}

        def step(self, action):
            assert action.shape == (2,)
            self.count += 1
            self.state = self.state + np.append(action, 0.0)
            cost = abs(self.state[0]) > self.hazard
            over = self.state[1] > 3.0
            return self.state, np.float64(self.state[1]), cost, over, self.count == self.length, {}

    def make(id, **options):
        if id != "SafetyStandIn-v0":
            raise KeyError("no environment " + id)
        return Env(**options)
"""


@pytest.fixture
def make(tmp_path, monkeypatch):
    (tmp_path / "safety_gymnasium.py").write_text(textwrap.dedent(STAND_IN))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    made = []

    def make(name="SafetyStandIn-v0", python=sys.executable, **options):
        made.append(SafetyGymnasiumBridge(name, python=python, **{"length": 9, **options}))
        return made[-1]

    yield make
    for env in made:
        env.close(raise_if_closed=False)


def test_keeps_the_contract(make):
    check_safe_env(make(), time_limit=9)


def test_numbers_are_those_of_the_other_side(make):
    env = make(hazard=0.7)
    env.set_seed(4)
    rollout = env.rollout(9)
    state = rollout["observation"][0] + 0.0
    for step in rollout:
        state = state + torch.cat((step["action"], torch.zeros(1)))
        torch.testing.assert_close(step["next", "observation"], state)
        assert step["next", "reward"].item() == pytest.approx(state[1].item(), abs=1e-6)
        assert step["next", "cost"].item() == float(abs(state[0]) > 0.7)
        assert step["next", "violation"].item() == (abs(state[0]) > 0.7)
    assert rollout["next", "truncated"][-1]
    assert not rollout["next", "terminated"][:-1].any()


def test_several(make):
    env = SerialEnv(2, [make, make])
    assert env.rollout(5)["next", "cost"].shape == (2, 5, 1)
    env.close()


def test_its_process_ends_with_it(make):
    env = make()
    process = env._process
    assert process.poll() is None
    env.close()
    assert process.poll() is not None
    with pytest.raises(RuntimeError, match="closed"):
        env.reset()


class TestFailures:
    def test_no_python(self, make):
        with pytest.raises(ValueError, match=r"python must be the path of .*nowhere"):
            make(python="/nowhere/python")

    def test_no_safety_gymnasium(self, make, monkeypatch):
        monkeypatch.delenv("PYTHONPATH")
        with pytest.raises(RuntimeError, match=r"No module named 'safety_gymnasium'.*Its Python"):
            make(python=Path(sys.executable))

    def test_no_such_environment(self, make):
        with pytest.raises(RuntimeError, match=r"fails in 'make' with KeyError.*SafetyNowhere"):
            make("SafetyNowhere-v0")

    def test_action(self, make):
        env = make()
        td = env.reset()
        with pytest.raises(ValueError, match="action must be finite"):
            env.step(td.set("action", torch.tensor([0.0, float("nan")])))

    def test_a_process_that_dies(self, make):
        env = make()
        env.reset()
        env._process.kill()
        env._process.wait()
        with pytest.raises(RuntimeError, match=r"process is gone.*exit status -9"):
            env.rollout(3)


@pytest.mark.skipif(
    "SAFETY_GYMNASIUM_PYTHON" not in os.environ,
    reason="SAFETY_GYMNASIUM_PYTHON names no Python with safety-gymnasium",
)
def test_safety_gymnasium_itself():
    env = SafetyGymnasiumBridge("SafetyPointGoal1-v0", python=os.environ["SAFETY_GYMNASIUM_PYTHON"])
    check_safe_env(env)
    assert env.observation_spec["observation"].shape == (60,)
    env.close()
