"""The dm_control face: the suite's manners, TorchRL's wrapper, drawing, bad input."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from dm_control.rl import control
from dm_env import StepType
from torchrl.envs import DMControlWrapper
from torchrl.envs.utils import check_env_specs

from torchrl_safe.envs import ROBOTS, GoalTask, NavigationTask, suite


def forward(robot: str) -> np.ndarray:
    """Straight ahead at full speed."""
    return np.eye(1, ROBOTS[robot].action_dim)[0]


@pytest.mark.parametrize("robot", ROBOTS)
class TestEveryRobot:
    def test_specs(self, robot):
        env = suite.load(robot)
        assert isinstance(env, control.Environment)
        spec = env.observation_spec()  # before the first reset
        assert list(spec) == ["observation", "cost", "violation", "violations", "goal_met"]
        for time_step in (env.reset(), env.step(forward(robot))):
            for name, part in spec.items():
                part.validate(time_step.observation[name])
        seconds = ROBOTS[robot].timestep * ROBOTS[robot].substeps
        assert env.control_timestep() == pytest.approx(seconds)
        assert env.physics.time() == pytest.approx(seconds)

    def test_torchrl(self, robot):
        env = DMControlWrapper(suite.load(robot, random=0, episode_length=5))
        check_env_specs(env)
        rollout = env.rollout(20)["next"]
        assert len(rollout) <= 5
        assert (rollout["truncated"] | rollout["terminated"])[-1].all()
        env.set_seed(4)
        first = env.reset()["observation"]
        env.set_seed(4)
        assert torch.equal(env.reset()["observation"], first)
        env.set_seed(5)
        assert not torch.equal(env.reset()["observation"], first)


class TestEpisodes:
    def test_time_limit_has_discount_one(self):
        env = suite.load("point", random=0, episode_length=3)
        steps = [env.reset()] + [env.step(forward("point")) for _ in range(4)]
        assert [s.step_type for s in steps] == [
            StepType.FIRST,
            StepType.MID,
            StepType.MID,
            StepType.LAST,
            StepType.FIRST,
        ]
        assert steps[3].discount == 1.0

    def test_collision_has_discount_zero(self):
        env = suite.load("jackal", random=0)
        time_step = env.reset()
        while not time_step.last():
            time_step = env.step(forward("jackal"))
        assert time_step.discount == 0.0
        assert time_step.observation["violation"]
        assert time_step.observation["cost"] > 1.0

    def test_random(self):
        def starts(random):
            env = suite.load("point", random=random)
            return np.array([env.reset().observation["observation"] for _ in range(2)])

        assert (starts(1) == starts(1)).all()
        assert (starts(1) != starts(2)).any()
        states = (np.random.RandomState(1) for _ in range(2))
        assert (starts(next(states)) == starts(next(states))).all()
        assert (starts(None) != starts(None)).any()

    def test_physics_follows(self):
        env = suite.load("point", random=0)
        env.reset()
        start = env.physics.position()
        for _ in range(10):
            env.step(np.array([0.04, 0.5]))
        assert np.hypot(*(env.physics.position() - start)[:2]) > 0.01
        assert (env.physics.control() == (0.04, 0.5)).all()
        goal = env.physics.named.data.geom_xpos["prop0:0"][:2]
        distance = np.hypot(*(goal - env.physics.position()[:2]))
        shown = env.step(np.zeros(2)).observation["observation"][2] * 0.6 + 1.5
        assert shown == pytest.approx(distance, abs=0.05)

    def test_options(self):
        env = suite.load("point", GoalTask(lidar_bins=5))
        assert env.observation_spec()["observation"].shape == (13,)
        env = suite.load("jackal", NavigationTask(num_boxes=2))
        assert len(env.physics.named.model.geom_rgba[:]) >= 2


class TestBadInput:
    def test_load(self):
        with pytest.raises(ValueError, match="task must be 'goal' or a Task, got 'walk'"):
            suite.load("point", "walk")
        with pytest.raises(ValueError, match="robot must be one of"):
            suite.load("tank")
        with pytest.raises(ValueError, match="episode_length must be an integer >= 1"):
            suite.load("point", episode_length=0)

    def test_action(self):
        env = suite.load("point", random=0)
        env.reset()
        before = env.physics.position()
        with pytest.raises(ValueError, match=r"action must have shape \(2,\), got \(3,\)"):
            env.step(np.zeros(3))
        with pytest.raises(ValueError, match="action must be finite"):
            env.step(np.array([0.0, np.nan]))
        assert (env.physics.position() == before).all()

    def test_part_of_a_step(self):
        env = suite.load("point", random=0)
        env.reset()
        with pytest.raises(ValueError, match="nstep must be 10, got 1"):
            env.physics.step()
