from __future__ import annotations

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from torchrl_safe.envs import SafeRobotEnv, SafeVelocityEnv
from torchrl_safe.envs.tasks import get_task
from torchrl_safe.record import plot_trajectories, record_trajectories


@pytest.fixture
def env():
    return SafeRobotEnv("point", num_envs=3, num_threads=1, episode_length=40)


def ahead(td):
    action = torch.zeros(*td.batch_size, 2)
    action[..., 0] = 1.0
    return td.set("action", action)


def test_paths_are_those_of_the_environment(env):
    first, second = record_trajectories(env, ahead, num_steps=20, num_episodes=2, seed=3)
    env.set_seed(3)
    td = env.reset()
    for step in range(21):
        for index, trajectory in enumerate((first, second)):
            np.testing.assert_array_equal(trajectory["path"][step], env.layout(index)["robot"])
            assert trajectory["violation"][step] == td["violation"][index].item()
        td = env.step_mdp(env.step(ahead(td)))
    np.testing.assert_array_equal(first["hazards"], env.layout(0)["hazards"])
    assert first["path"].shape == (21, 2)


def test_the_next_episode_is_not_shown(env):
    (only,) = record_trajectories(env, ahead, num_steps=100, num_episodes=1)
    assert len(only["path"]) == 40
    assert np.abs(np.diff(only["path"], axis=0)).max() < 0.1  # no jump to a new layout


def test_goals_in_their_order(env):
    td = env.reset()
    state = env.state_dict()
    robot = env.layout(0)["robot"]
    state["goal"][0] = torch.tensor([robot[0] + 0.1, robot[1]])  # reached at the first step
    state["goal_distance"][0] = 0.1

    class Placed:
        """Resets to the state above."""

        batch_size = env.batch_size
        layout = staticmethod(env.layout)
        step_and_maybe_reset = staticmethod(env.step_and_maybe_reset)

        def reset(self):
            env.load_state_dict(state)
            return td

    (only,) = record_trajectories(Placed(), ahead, num_steps=3, num_episodes=1)
    np.testing.assert_allclose(only["goals"][0], [robot[0] + 0.1, robot[1]])
    assert len(only["goals"]) == 2
    np.testing.assert_array_equal(only["goals"][1], env.layout(0)["goal"])


def test_random_state_is_left_alone(env):
    before = torch.get_rng_state()
    record_trajectories(env, env.rand_action, num_steps=2, num_episodes=1)
    assert torch.equal(before, torch.get_rng_state())


def test_plot(env, tmp_path):
    trajectories = record_trajectories(env, ahead, num_steps=30, num_episodes=3)
    picture = imageio.imread(plot_trajectories(trajectories, tmp_path / "new" / "map.png"))
    assert picture.shape[0] > 600  # two rows of two
    assert picture[..., :3].std() > 5


def test_misuse(env, tmp_path):
    with pytest.raises(ValueError, match="num_steps must be at least 1, got 0"):
        record_trajectories(env, ahead, num_steps=0)
    with pytest.raises(ValueError, match=r"num_episodes must be in \[1, 3\], got 4"):
        record_trajectories(env, ahead, num_episodes=4)
    with pytest.raises(ValueError, match="at least one"):
        plot_trajectories([], tmp_path / "map.png")


def test_boxes(tmp_path):
    """A Jackal's room has boxes in place of hazards."""
    env = SafeRobotEnv("jackal", num_envs=1, num_threads=1, seed=0)
    (only,) = record_trajectories(env, env.rand_action, num_steps=3, num_episodes=1, seed=0)
    np.testing.assert_array_equal(only["boxes"], env.layout(0)["boxes"])
    assert only["boxes"].shape == (8, 2)
    assert only["hazards"].shape == (0, 2)
    assert plot_trajectories([only], tmp_path / "jackal.png").stat().st_size > 5_000


def test_a_task_without_goals_or_hazards(tmp_path):
    task = get_task("SafetyPointCircle0")[1]
    env = SafeRobotEnv("point", task=task, num_envs=2, num_threads=1)
    (only,) = record_trajectories(env, env.rand_action, num_steps=4, num_episodes=1)
    assert only["path"].shape == (5, 2)
    assert only["goals"].shape == (0, 2)
    assert plot_trajectories([only], tmp_path / "map.png").exists()


def test_an_environment_without_a_map():
    env = SafeVelocityEnv("hopper", num_envs=2, num_threads=1)
    with pytest.raises(TypeError, match=r"env must have layout\(index\), .* got SafeVelocityEnv"):
        record_trajectories(env, env.rand_action, num_steps=2, num_episodes=1)
