"""Pictures of the goal task: its own MuJoCo model, with hazards, goal, floor and light."""

from __future__ import annotations

import os
import sys
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs.robots import Array, Robot
from torchrl_safe.envs.tasks import GoalTask

_GOAL = (0.15, 0.75, 0.30, 0.45)
_HAZARD = (0.20, 0.35, 0.90, 0.55)
_HAZARD_ENTERED = (1.0, 0.10, 0.10, 0.90)


class SceneRenderer:
    """Draws one environment from above; hazards turn red while the robot is inside one.

    Shadows and reflections are off: they halve the frame rate of a software renderer.

    Args:
        robot (Robot): the robot.
        task (GoalTask): the options of the task.
        width (int): pixels, W.
        height (int): pixels, H.

    Raises:
        ValueError: if the size is not positive.
    """

    def __init__(self, robot: Robot, task: GoalTask, width: int, height: int) -> None:
        if width < 1 or height < 1:
            raise ValueError(f"width and height must be positive, got {width} and {height}.")
        self.size = (width, height)
        self._extent = task.extent
        self._model = _scene(robot, task, width, height)
        self._data = mujoco.MjData(self._model)
        self._hazards = [self._model.geom(f"hazard{i}").id for i in range(task.num_hazards)]
        self._option = mujoco.MjvOption()
        self._option.flags[mujoco.mjtVisFlag.mjVIS_ACTUATOR] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth, self._camera.elevation = 90.0, -70.0
        # Far enough to see the square and the objects at its rim.
        self._camera.distance = 2.8 * task.extent
        self._scene = mujoco.MjvScene(self._model, maxgeom=200 + task.num_hazards)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        self._gl = _gl_context(width, height)
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)

    def draw(self, qpos: Array, layout: dict[str, Array], violation: bool) -> NDArray[np.uint8]:
        """A picture of the robot at ``qpos`` [nq] in a layout: [H, W, 3]."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        data.mocap_pos[:, :2] = np.concatenate((layout["goal"][None], layout["hazards"]))
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if self._hazards:
            model.geom_rgba[self._hazards] = _HAZARD
            if violation:
                nearest = np.linalg.norm(layout["hazards"] - layout["robot"], axis=-1).argmin()
                model.geom_rgba[self._hazards[nearest]] = _HAZARD_ENTERED
        # The square stays in view until the robot leaves it; then the camera goes with it.
        inside = np.clip(layout["robot"], -self._extent, self._extent)
        self._camera.lookat[:2] = layout["robot"] - inside
        mujoco.mjv_updateScene(
            model, data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self._scene
        )
        width, height = self.size
        picture = np.empty((height, width, 3), np.uint8)
        viewport = mujoco.MjrRect(0, 0, width, height)
        self._gl.make_current()
        mujoco.mjr_render(viewport, self._scene, self._context)
        mujoco.mjr_readPixels(picture, None, viewport, self._context)
        return np.flipud(picture).copy()

    def close(self) -> None:
        """Frees the GL context: while it lives, another renderer's pictures can be black."""
        self._context.free()
        self._gl.free()


def _scene(robot: Robot, task: GoalTask, width: int, height: int) -> mujoco.MjModel:
    """The robot's model, dressed: mocap bodies in the order goal, hazards."""
    spec = mujoco.MjSpec.from_file(str(robot.asset_path))
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.headlight.ambient = (0.45,) * 3
    spec.visual.headlight.diffuse = (0.35,) * 3
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.85, 0.90, 0.95),
        rgb2=(0.60, 0.70, 0.80),
        width=64,
        height=384,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.80, 0.80, 0.78),
        rgb2=(0.72, 0.72, 0.70),
        width=256,
        height=256,
    )
    floor = spec.add_material(name="floor", texuniform=True, texrepeat=(2.0, 2.0))
    floor.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    world = spec.worldbody
    white = (1.0, 1.0, 1.0, 1.0)
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    world.add_geom(type=plane, size=(50.0, 50.0, 0.1), material="floor", rgba=white)
    world.add_light(pos=(0.0, -2.0, 5.0), dir=(0.0, 0.4, -1.0), diffuse=(0.4,) * 3)
    discs = [("goal", task.goal_radius, _GOAL)]
    discs += [(f"hazard{i}", task.hazard_radius, _HAZARD) for i in range(task.num_hazards)]
    for name, radius, colour in discs:
        body = world.add_body(name=name, mocap=True, pos=(0.0, 0.0, 0.01))
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=(radius, 0.01, 0.0),
            rgba=colour,
        )
    return spec.compile()


def _gl_context(width: int, height: int) -> Any:
    """MuJoCo's context for ``MUJOCO_GL``; EGL on a Linux without it and without a display."""
    # MuJoCo chooses when it is imported, long before we know that anybody wants to draw.
    headless = sys.platform == "linux" and not os.environ.get("DISPLAY")
    if headless and not os.environ.get("MUJOCO_GL"):
        from mujoco.egl import GLContext
    else:
        from mujoco.gl_context import GLContext
    return GLContext(width, height)
