"""Pictures: every robot and face, several renderers at once, windows, and how long one takes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import textwrap
import time

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.passive_env_checker import env_render_passive_checker

from torchrl_safe.envs import ROBOTS, GymGoalEnv, SafeGoalEnv, suite
from torchrl_safe.envs._core import make_core
from torchrl_safe.envs._render import Scene


def seeded_core(robot: str):
    core = make_core(robot, num_envs=2, num_threads=1, seed=1, episode_length=1000)
    core.reset()
    return core


@pytest.fixture(scope="module")
def opengl():
    env = SafeGoalEnv(num_envs=1, num_threads=1)
    env.reset()
    try:
        env.render(0, 16, 16)
    except Exception as error:  # whatever a machine without OpenGL raises
        pytest.skip(f"no OpenGL: {error}")
    env.close()


@pytest.mark.parametrize("robot", ROBOTS)
class TestScene:
    """What is drawn, without drawing."""

    def test_rays_end_on_what_they_hit(self, robot):
        core = seeded_core(robot)
        scene, layout = Scene(core), core.layout(0)
        ends = scene.ray_ends(0)
        angles, lengths = core.task.rays(core.scan(0))
        assert len(ends) == len(angles) > 0
        offset = ends - layout["robot"]
        np.testing.assert_allclose(np.hypot(*offset.T), lengths)
        # Angles are counted to the left from ahead.
        cosine, sine = (
            layout["heading"] @ offset.T,
            layout["heading"] @ (offset @ [[0, -1], [1, 0]]).T,
        )
        np.testing.assert_allclose(
            np.angle(np.exp(1j * (np.arctan2(sine, cosine) - angles))), 0, atol=1e-9
        )

    def test_objects_are_where_the_layout_says(self, robot):
        core = seeded_core(robot)
        scene = Scene(core)
        for index in range(2):
            scene.show(index)
            layout = core.layout(index)
            places = scene.data.geom_xpos[:, :2]
            for prop in core.task.props:
                if isinstance(prop.objects, str):
                    for place in layout[prop.objects].reshape(-1, 2):
                        assert np.hypot(*(places - place).T).min() < 1e-9
            assert (scene.data.qpos == core.qpos(index)).all()

    def test_picture(self, robot, opengl):
        env = SafeGoalEnv(robot, num_envs=1, num_threads=1, seed=1)
        env.reset()
        picture = env.render()
        assert picture.shape == (360, 480, 3)
        assert picture.std() > 15
        green = picture.astype(int)
        assert (
            (green[..., 1] > green[..., 0] + 40) & (green[..., 1] > green[..., 2] + 40)
        ).sum() > 50
        env.close()

    def test_gymnasium(self, robot, opengl):
        name = f"torchrl_safe/{robot.title().replace('_', '')}Goal-v0"
        env = gymnasium.make(name, render_mode="rgb_array", width=64, height=48)
        env.reset(seed=0)
        env_render_passive_checker(env.unwrapped)  # warns, which is an error here
        assert env.render().shape == (48, 64, 3)
        seconds = ROBOTS[robot].timestep * ROBOTS[robot].substeps
        assert env.metadata["render_fps"] == round(1 / seconds)
        env.close()
        env.close()


class TestTogether:
    def test_the_cost_is_shown(self, opengl):
        """The corner changes with the cost and nothing else does."""
        env = SafeGoalEnv(num_envs=1, num_threads=1, seed=0)
        env.reset()
        before = env.render()
        state = env.state_dict()
        state["frame_cost"][:] = 0.77
        env.load_state_dict(state)
        changed = (env.render() != before).any(-1)
        assert changed.any()
        assert not changed[60:].any()
        assert not changed[:, 130:].any()
        env.close()

    def test_vector(self, opengl):
        envs = gymnasium.make_vec(
            "torchrl_safe/PointGoal-v0", num_envs=3, num_threads=1, render_mode="rgb_array"
        )
        envs.reset(seed=0)
        first, *others = envs.render()
        assert len(others) == 2
        assert all((picture != first).any() for picture in others)
        envs.close()

    def test_renderers_do_not_disturb_each_other(self, opengl):
        """Also dm_control's, which draws whether or not its context is the current one."""
        one, two = (SafeGoalEnv(num_envs=1, num_threads=1, seed=seed) for seed in (0, 1))
        other = suite.load("point", random=2)
        other.reset()
        for env in (one, two):
            env.reset()

        def draw_other():
            return other.physics.render(120, 160, camera_id="overview")

        first, second, third = one.render(), two.render(), draw_other()
        assert third.std() > 15
        assert (one.render() == first).all()
        assert (draw_other() == third).all()
        two.close()
        assert (draw_other() == third).all()
        assert (one.render() == first).all()
        assert (two.render() == second).all()
        one.close()
        two.close()
        assert (draw_other() == third).all()
        other.physics.free()

    def test_left_open(self, opengl):
        """Whoever forgets to close gets no traceback at the end of the program."""
        code = """
            from torchrl_safe.envs import SafeGoalEnv
            env = SafeGoalEnv(num_envs=1, num_threads=1)
            env.reset()
            env.render()
        """
        done = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True
        )
        assert done.returncode == 0
        assert "Traceback" not in done.stderr


class TestHuman:
    def test_no_display(self, monkeypatch):
        monkeypatch.delenv("DISPLAY", raising=False)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        if sys.platform != "linux":
            pytest.skip("elsewhere there always is a display")
        env = GymGoalEnv(render_mode="human")
        with pytest.raises(RuntimeError, match=r'no display .* use render_mode="rgb_array"'):
            env.reset(seed=0)
        env.close()

    def test_no_mode(self):
        env = GymGoalEnv()
        env.reset(seed=0)
        with pytest.warns(UserWarning, match=r"render\(\) draws nothing"):
            assert env.render() is None

    @pytest.mark.slow
    @pytest.mark.skipif(shutil.which("Xvfb") is None, reason="needs Xvfb, a display in memory")
    def test_window(self):
        """Gymnasium's whole checker, which also opens a window; in real time, not faster."""
        code = """
            import time
            import warnings

            import gymnasium
            from gymnasium.utils.env_checker import check_env

            import torchrl_safe.envs

            warnings.simplefilter("error")
            check_env(gymnasium.make("torchrl_safe/PointGoal-v0").unwrapped)
            env = gymnasium.make("torchrl_safe/PointGoal-v0", render_mode="human")
            env.reset(seed=0)
            start = time.monotonic()
            for _ in range(25):
                env.step(env.action_space.sample())
            assert env.render() is None
            assert time.monotonic() - start > 25 * 0.02
            env.close()
        """
        display = f":{90 + os.getpid() % 1000}"
        server = subprocess.Popen(
            ["Xvfb", display, "-screen", "0", "640x480x24"], stderr=subprocess.DEVNULL
        )
        try:
            time.sleep(1.5)
            done = subprocess.run(
                [sys.executable, "-c", textwrap.dedent(code)],
                env=os.environ | {"DISPLAY": display, "MUJOCO_GL": ""},
                capture_output=True,
                text=True,
            )
        finally:
            server.terminate()
            server.wait()
        assert done.returncode == 0, done.stderr


def test_real_time(opengl):
    """Processor time, as the clock on the wall measures what else the machine does."""
    env = SafeGoalEnv(num_envs=1, num_threads=1, seed=0)
    td = env.reset()
    env.render()
    start = time.process_time()
    for _ in range(10):
        for _ in range(2):  # 25 frames of 50 steps are a second
            td["action"] = torch.ones(1, 2)
            td = env.step(td)["next"]
        env.render()
    env.close()
    assert (time.process_time() - start) / 10 < 1 / 25
