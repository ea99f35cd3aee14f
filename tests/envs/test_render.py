"""Pictures of every robot and interface: several renderers at once, windows, how long one takes."""

from __future__ import annotations

import copy
import dataclasses
import gc
import os
import pickle
import shutil
import subprocess
import sys
import textwrap
import time
import weakref

import gymnasium
import mujoco
import numpy as np
import pytest
import torch
from gymnasium.utils.passive_env_checker import env_render_passive_checker

from torchrl_safe.envs import ROBOTS, GymRobotEnv, SafeRobotEnv, get_robot
from torchrl_safe.envs._render import Scene, SceneRenderer
from torchrl_safe.envs._robot import make_core


def seeded_core(robot):
    core = make_core(robot, num_envs=2, num_threads=1, seed=1, episode_length=1000)
    core.reset()
    return core


def pickled(thing):
    return pickle.loads(pickle.dumps(thing))


def run(code: str, **environ: str) -> subprocess.CompletedProcess:
    """In a process of its own, which is killed after two minutes."""
    return subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | environ,
        capture_output=True,
        text=True,
        timeout=120,
    )


@pytest.fixture(scope="module")
def opengl():
    env = SafeRobotEnv(num_envs=1, num_threads=1)
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
        env = SafeRobotEnv(robot, num_envs=1, num_threads=1, seed=1)
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


def dressed_point(tmp_path, *changes: tuple[str, str]):
    """Point with more in its file."""
    text = get_robot("point").asset_path.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    file = tmp_path / "point.xml"
    file.write_text(text)
    return dataclasses.replace(get_robot("point"), asset=str(file))


OUTSIDE = 'contype="0" conaffinity="0"'
FILES = {
    "assets": (
        "<worldbody>",
        '<asset><texture name="floor" type="2d" builtin="flat" width="9" height="9"/>'
        '<material name="floor" texture="floor"/></asset><worldbody>',
    ),
    "cameras and lights": (
        "<worldbody>",
        '<worldbody><camera name="overview" pos="0 0 3"/><camera name="follow" pos="0 0 3"/>'
        '<light name="sun"/>',
    ),
    "geoms": (
        "<worldbody>",
        f'<worldbody><geom name="floor" size=".01" {OUTSIDE}/>'
        f'<geom name="hazard1:0" size=".01" {OUTSIDE}/>',
    ),
    "mocap bodies": (
        "<worldbody>",
        f'<worldbody><body name="prop0:0" mocap="true"><geom size=".01" {OUTSIDE}/></body>',
    ),
    "keyframes": ("</mujoco>", '<keyframe><key name="rest" qpos="1 1 1"/></keyframe></mujoco>'),
    "what is not seen": ("<option>", '<compiler discardvisual="true"/><option>'),
    "defaults": (
        '<geom condim="6" density="1"',
        '<material rgba="1 0 0 1"/><geom group="4" density="1"',
    ),
}


class TestRobotsOfOnesOwn:
    """Any name in a file; what is drawn around the robot is the same."""

    @pytest.mark.parametrize("what", FILES)
    def test_scene(self, what, tmp_path):
        robot = dressed_point(tmp_path, FILES[what])
        core, plain = seeded_core(robot), seeded_core("point")
        scene, expected = Scene(core), Scene(plain)
        for each in (scene, expected):
            each.show(1)

        def objects(scene):
            model, data = scene.model, scene.data
            seen = model.geom_group < 3
            seen &= np.isin(model.geom_type, [mujoco.mjtGeom.mjGEOM_CYLINDER])
            return np.concatenate((data.geom_xpos[seen], model.geom_rgba[seen]), 1)

        assert len(objects(scene)) == 9
        np.testing.assert_allclose(objects(scene), objects(expected))

    @pytest.mark.parametrize("what", FILES)
    def test_dm_control(self, suite, what, tmp_path):
        env = suite.load(dressed_point(tmp_path, FILES[what]), random=0)
        env.reset()
        env.step(np.ones(2))
        assert env.physics.model.camera("overview").id >= 0

    def test_picture(self, tmp_path, opengl):
        pictures = []
        robots = ("point", dressed_point(tmp_path, *FILES.values()))
        for robot in robots:
            env = SafeRobotEnv(robot, num_envs=1, num_threads=1, seed=1)
            env.reset()
            pictures.append(env.render().astype(int))
            env.close()
        # But for two specks, and a light.
        assert np.abs(pictures[0] - pictures[1]).mean() < 20


class TestTogether:
    def test_the_cost_is_shown(self, opengl):
        """The corner changes with the cost and nothing else does."""
        env = SafeRobotEnv(num_envs=1, num_threads=1, seed=0)
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

    def test_renderers_do_not_disturb_each_other(self, suite, opengl):
        """Also dm_control's, which draws whether or not its context is the current one."""
        one, two = (SafeRobotEnv(num_envs=1, num_threads=1, seed=seed) for seed in (0, 1))
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
        two = SafeRobotEnv(num_envs=1, num_threads=1, seed=1)
        two.reset()
        assert (two.render() == second).all()
        one.close()
        two.close()
        assert (draw_other() == third).all()
        other.physics.free()

    @pytest.mark.parametrize("order", ["alone", "before dm_control", "after dm_control"])
    def test_left_open(self, order, opengl):
        """Whoever forgets to close gets no traceback at the end of the program.

        dm_control ends EGL at exit, for everybody, sooner or later than we do.
        """
        picture = """
            env = SafeRobotEnv(num_envs=1, num_threads=1)
            env.reset()
            env.render()
        """
        other = """
            from torchrl_safe.envs.interfaces import suite
            other = suite.load()
            other.reset()
            other.physics.render(48, 64)
        """
        if order != "alone":
            pytest.importorskip("dm_control")
        parts = {
            "alone": picture,
            "before dm_control": picture + other,
            "after dm_control": other + picture,
        }
        done = run("from torchrl_safe.envs import SafeRobotEnv\n" + textwrap.dedent(parts[order]))
        assert done.returncode == 0
        assert "Exception ignored" not in done.stderr
        assert "Traceback" not in done.stderr

    def test_left_to_the_garbage_collector(self, opengl):
        env = SafeRobotEnv(num_envs=1, num_threads=1)
        env.reset()
        env.render(0, 16, 16)
        canvas = weakref.ref(env._renderer._canvas)
        finalizer = canvas().free
        del env
        gc.collect()
        assert canvas() is None
        assert not finalizer.alive

    @pytest.mark.parametrize("robot", ROBOTS)
    @pytest.mark.parametrize("duplicate", [copy.copy, copy.deepcopy, pickled])
    def test_copies_draw_for_themselves(self, robot, duplicate, opengl):
        core = seeded_core(robot)
        renderer = SceneRenderer(core, 64, 48)
        for _ in range(2):  # before it has drawn, and after
            twin = duplicate(renderer)
            pictures = np.array([twin.draw(1), renderer.draw(1)], int)
            assert pictures.std((1, 2, 3)).min() > 5
            assert np.abs(pictures[0] - pictures[1]).mean() < 5
            twin.close()
        renderer.close()
        assert renderer.draw(1).std() > 5  # closed is not broken
        renderer.close()

    @pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
    def test_a_forked_process_does_not_draw(self, opengl):
        """Nor does it free, at exit, what belongs to its parent."""
        code = """
            import os
            from torchrl_safe.envs import SafeRobotEnv
            env = SafeRobotEnv(num_envs=1, num_threads=1)
            env.reset()
            before = env.render()
            if not os.fork():
                try:
                    env.render()
                except RuntimeError as error:
                    assert "forked" in str(error)
                    raise SystemExit(0)
                raise SystemExit(1)
            _, status = os.wait()
            assert status == 0
            assert (env.render() == before).all()
        """
        done = run(textwrap.dedent(code))
        assert done.returncode == 0, done.stderr
        assert "Exception ignored" not in done.stderr

    @pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there always is a display")
    @pytest.mark.parametrize("interface", ["SafeRobotEnv", "dm_control"])
    def test_a_display_that_leads_nowhere(self, interface, opengl):
        if interface == "dm_control":
            pytest.importorskip("dm_control")
        code = {
            "SafeRobotEnv": """
                from torchrl_safe.envs import SafeRobotEnv
                env = SafeRobotEnv(num_envs=1, num_threads=1)
                env.reset()
                assert env.render().std() > 5
            """,
            "dm_control": """
                from torchrl_safe.envs.interfaces import suite
                env = suite.load()
                env.reset()
                assert env.physics.render(48, 64, camera_id="overview").std() > 5
            """,
        }[interface]
        done = run(textwrap.dedent(code), DISPLAY=":7891", MUJOCO_GL="")
        assert done.returncode == 0, done.stderr


class TestHuman:
    def test_no_display(self, monkeypatch):
        monkeypatch.delenv("DISPLAY", raising=False)
        monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
        if sys.platform != "linux":
            pytest.skip("elsewhere there always is a display")
        env = GymRobotEnv(render_mode="human")
        with pytest.raises(RuntimeError, match=r'no display .* use render_mode="rgb_array"'):
            env.reset(seed=0)
        env.close()

    def test_no_mode(self):
        env = GymRobotEnv()
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
    env = SafeRobotEnv(num_envs=1, num_threads=1, seed=0)
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
