"""Pictures of the environments: a MuJoCo model of their own, with the task's objects in it."""

from __future__ import annotations

import atexit
import os
import sys
import warnings
import weakref
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from torchrl_safe.envs._process import keep_forever
from torchrl_safe.envs._robot import RobotCore
from torchrl_safe.envs.robots import Array
from torchrl_safe.envs.tasks import Prop

_RED = (1.0, 0.10, 0.10, 0.90)
_YELLOW = (1.0, 0.95, 0.20, 1.0)
_RAY = (0.95, 0.75, 0.10, 0.60)
_RAY_HEIGHT = 0.12  # metres above the floor
_ELEVATION = -70.0  # degrees, of the camera
_MAX_GEOMS = 1000


class SceneRenderer:
    """Draws environments of a core, one at a time, from above.

    It shows the robot, the task's objects, the lidar's rays to what they hit, the cost of the last
    step, and whether it violated the constraint; the nearest hazard turns red while it does.

    What it draws with is opened at the first picture. Copies and pickles open their own.

    Args:
        core (RobotCore): the environments.
        width (int): pixels, W.
        height (int): pixels, H.
        window (bool): draw in a window instead of in memory.

    Raises:
        ValueError: if the size is not positive.
    """

    def __init__(self, core: RobotCore, width: int, height: int, *, window: bool = False) -> None:
        if width < 1 or height < 1:
            raise ValueError(f"width and height must be positive, got {width} and {height}.")
        self.size = (width, height)
        self._core = core
        self._window = window
        self._canvas: _Canvas | None = None

    def draw(self, index: int) -> NDArray[np.uint8] | None:
        """A picture of environment ``index``, [H, W, 3]; ``None`` if it went to a window.

        Raises:
            RuntimeError: if a window is asked for and there is no display, or if this process was
                forked from one that has drawn.
        """
        check_not_forked()
        if self._canvas is None:
            self._canvas = _Canvas(self._core, *self.size, window=self._window)
        return self._canvas.draw(index)

    def close(self) -> None:
        """Frees the GL context: while it lives, another renderer's pictures can be black."""
        if self._canvas is not None:
            self._canvas.free()
            self._canvas = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_canvas": None}


class _Canvas:
    """An open OpenGL context and the scene it shows."""

    def __init__(self, core: RobotCore, width: int, height: int, *, window: bool) -> None:
        self._size = (width, height)
        self._core = core
        self._window = window
        self._scene = Scene(core, width, height)
        self._option = mujoco.MjvOption()
        self._option.flags[mujoco.mjtVisFlag.mjVIS_ACTUATOR] = False
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        self._camera.azimuth, self._camera.elevation = 90.0, _ELEVATION
        self._camera.distance = _camera_distance(core)
        self._view = mujoco.MjvScene(self._scene.model, maxgeom=_MAX_GEOMS)
        buffer = mujoco.mjtFramebuffer
        with _visit():
            self._gl = _Window(width, height) if window else _offscreen_context(width, height)
            self._gl.make_current()
            font = mujoco.mjtFontScale.mjFONTSCALE_100
            self._context = mujoco.MjrContext(self._scene.model, font)
            target = buffer.mjFB_WINDOW if window else buffer.mjFB_OFFSCREEN
            mujoco.mjr_setBuffer(target, self._context)
        self.free = weakref.finalize(self, _free, self._gl, self._context)
        self.free.atexit = False  # see _leave_canvases
        _CANVASES.add(self)

    def leave(self) -> None:
        """Never frees what is open, whatever happens to this object."""
        if self.free.detach():
            keep_forever(self._gl)
            keep_forever(self._context)

    def draw(self, index: int) -> NDArray[np.uint8] | None:
        """See :meth:`SceneRenderer.draw`."""
        scene, core = self._scene, self._core
        scene.show(index)
        # The square stays in view until the robot leaves it; then the camera goes with it.
        robot, extent = core.layout(index)["robot"], core.task.extent
        self._camera.lookat[:2] = robot - np.clip(robot, -extent, extent)
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            scene.model, scene.data, self._option, None, self._camera, everything, self._view
        )
        for end in scene.ray_ends(index):
            self._add_ray(np.array([*robot, _RAY_HEIGHT]), np.array([*end, _RAY_HEIGHT]))
        width, height = self._gl.framebuffer_size if self._window else self._size
        viewport = mujoco.MjrRect(0, 0, width, height)
        with _visit():
            self._gl.make_current()
            mujoco.mjr_render(viewport, self._view, self._context)
            cost, violation = core.frame.cost[index].sum(), core.frame.violation[index].any()
            mujoco.mjr_overlay(
                mujoco.mjtFont.mjFONT_NORMAL,
                mujoco.mjtGridPos.mjGRID_TOPLEFT,
                viewport,
                "cost\nviolation",
                f"{cost:.2f}\n{'yes' if violation else 'no'}",
                self._context,
            )
            if self._window:
                self._gl.show()
                return None
            picture = np.empty((height, width, 3), np.uint8)
            mujoco.mjr_readPixels(picture, None, viewport, self._context)
        return np.flipud(picture).copy()

    def _add_ray(self, start: Array, end: Array) -> None:
        view, line = self._view, mujoco.mjtGeom.mjGEOM_LINE
        geom = view.geoms[view.ngeom]
        blank, turn = np.zeros(3), np.eye(3).ravel()
        mujoco.mjv_initGeom(geom, line, blank, blank, turn, np.array(_RAY, np.float32))
        mujoco.mjv_connector(geom, line, 2.0, start, end)
        view.ngeom += 1


class Scene:
    """The model that is drawn: the robot's own, dressed with floor, light and the task's objects.

    Args:
        core (RobotCore): the environments.
        width (int): the widest picture, pixels.
        height (int): the highest picture, pixels.

    Attributes:
        model (mujoco.MjModel): positions of the objects are mocap bodies.
        data (mujoco.MjData): what :meth:`show` wrote.
    """

    def __init__(self, core: RobotCore, width: int = 640, height: int = 480) -> None:
        self._core = core
        spec, props, hazards = _scene_spec(core, width, height)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._mocap = [self.model.body(name).mocapid.item() for name in props]
        self._hazards = [self.model.geom(name).id for name in hazards]
        body = self.model.geom_bodyid
        self._robot = np.flatnonzero((body > 0) & (self.model.body_mocapid[body] < 0))
        self._robot_colours = self.model.geom_rgba[self._robot].copy()
        self._colours = self.model.geom_rgba[self._hazards].copy()

    def show(self, index: int) -> None:
        """Puts robot and objects where they are in environment ``index``."""
        core, model, data = self._core, self.model, self.data
        layout = core.layout(index)
        data.qpos[:] = core.qpos(index)
        data.mocap_pos[self._mocap, :2] = np.concatenate(
            [_places(prop, layout) for prop in core.task.props]
        )
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        if self._hazards:
            model.geom_rgba[self._hazards] = self._colours
            if core.frame.violation[index].any():
                offset = data.geom_xpos[self._hazards, :2] - layout["robot"]
                nearest = np.hypot(*offset.T).argmin()
                model.geom_rgba[self._hazards[nearest]] = _RED

    def highlight(self, share: float) -> None:
        """Colours the robot: 0 as in its file, 1 all yellow."""
        colours = (1.0 - share) * self._robot_colours + share * np.array(_YELLOW)
        self.model.geom_rgba[self._robot] = colours

    def ray_ends(self, index: int) -> Array:
        """Where the lidar's rays of environment ``index`` hit something: [K, 2]."""
        core, layout = self._core, self._core.layout(index)
        angle, distance = core.task.rays(core.scan(index))
        if hasattr(core.task, "bodies"):  # in the frame of the robot's site
            angle = angle + core.robot.frame_turn
        x, y = layout["heading"]
        ahead = np.stack((np.cos(angle), np.sin(angle)), -1) * distance[:, None]
        return layout["robot"] + ahead @ np.array([[x, y], [-y, x]])


def _scene_spec(
    core: RobotCore, width: int, height: int
) -> tuple[mujoco.MjSpec, list[str], list[str]]:
    """What is drawn, and the names of the objects' bodies and of the hazards' geoms.

    A robot's file may use any name, and defaults that would change what is added here.
    """
    spec = mujoco.MjSpec.from_file(str(core.robot.asset_path))
    spec.option.timestep = core.robot.timestep
    spec.compiler.discardvisual = False
    for key in list(spec.keys):
        spec.delete(key)  # they know nothing of the objects
    visual = spec.visual
    visual.global_.offwidth, visual.global_.offheight = width, height
    visual.global_.fovy = 45.0
    visual.headlight.ambient = (0.45,) * 3
    visual.headlight.diffuse = (0.35,) * 3
    # A software renderer spends most of its time on smooth edges and shadows.
    visual.quality.offsamples = 0
    visual.quality.shadowsize = 0
    texture = spec.add_texture(
        name=_unused("floor", spec.textures),
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.80, 0.80, 0.78),
        rgb2=(0.72, 0.72, 0.70),
        width=256,
        height=256,
    )
    material = spec.add_material(
        name=_unused("floor", spec.materials), texuniform=True, texrepeat=(2.0, 2.0)
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    world = spec.worldbody
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    floor = next((geom for geom in world.geoms if geom.type == plane), None)
    if floor is None:
        floor = world.add_geom(name=_unused("floor", spec.geoms), type=plane)
        floor.contype = floor.conaffinity = 0
    floor.size, floor.material, floor.rgba = (50.0, 50.0, 0.1), material.name, (1.0,) * 4
    floor.group = 0
    world.add_light(
        name=_unused("sun", spec.lights),
        pos=(0.0, -2.0, 5.0),
        dir=(0.0, 0.4, -1.0),
        diffuse=(0.4,) * 3,
    )
    distance, tilt = _camera_distance(core), np.deg2rad(-_ELEVATION)
    track = mujoco.mjtCamLight.mjCAMLIGHT_TRACK
    for body, name, mode, far in (
        (world, "overview", mujoco.mjtCamLight.mjCAMLIGHT_FIXED, distance),
        (world.first_body(), "follow", track, 1.5),
    ):
        body.add_camera(
            name=_unused(name, spec.cameras),
            mode=mode,
            pos=(0.0, -far * np.cos(tilt), far * np.sin(tilt)),
            xyaxes=(1.0, 0.0, 0.0, 0.0, np.sin(tilt), np.cos(tilt)),
        )
    layout = core.layout(0)
    shapes = {"disc": mujoco.mjtGeom.mjGEOM_CYLINDER, "box": mujoco.mjtGeom.mjGEOM_BOX}
    props, hazards = [], []
    for number, prop in enumerate(core.task.props):
        for i in range(len(_places(prop, layout))):
            name = f"{'hazard' if prop.hazard else 'prop'}{number}:{i}"
            # It stands on the floor.
            body = world.add_body(
                name=_unused(name, spec.bodies), mocap=True, pos=(0.0, 0.0, prop.size[-1])
            )
            geom = body.add_geom(
                name=_unused(name, spec.geoms),
                type=shapes[prop.shape],
                size=(*prop.size, 0.0)[:3],
                rgba=prop.colour,
                material="",
                group=0,
                contype=0,
                conaffinity=0,
            )
            props.append(body.name)
            if prop.hazard:
                hazards.append(geom.name)
    return spec, props, hazards


def _unused(name: str, elements: Iterable[Any]) -> str:
    """The name, with underscores behind it if one of the elements has it."""
    taken = {element.name for element in elements}
    while name in taken:
        name += "_"
    return name


def _places(prop: Prop, layout: dict[str, Array]) -> Array:
    """Positions [K, 2] of a prop's objects."""
    places = layout[prop.objects] if isinstance(prop.objects, str) else np.array(prop.objects)
    return places.reshape(-1, 2)


def _camera_distance(core: RobotCore) -> float:
    # Far enough to see the square and the objects at its rim.
    return 2.8 * core.task.extent


def has_display() -> bool:
    """Whether a window could be opened: a display that is named may lead nowhere."""
    displays = ("DISPLAY", "WAYLAND_DISPLAY")
    if sys.platform == "linux" and not any(os.environ.get(name) for name in displays):
        return False
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what it says is what we ask
        return bool(glfw.init())


def _offscreen_context(width: int, height: int) -> Any:
    """MuJoCo's context for ``MUJOCO_GL``; EGL on a Linux without it and without a display."""
    # MuJoCo chooses when it is imported, long before we know that anybody wants to draw.
    choice = os.environ.get("MUJOCO_GL", "").lower().strip()
    if sys.platform == "linux" and (choice == "egl" or (choice == "" and not has_display())):
        from mujoco.egl import GLContext
        from OpenGL import EGL

        context = GLContext(width, height)
        # It ends EGL at exit, for everybody: dm_control may not have freed its contexts by then.
        atexit.unregister(EGL.eglTerminate)
        return context
    from mujoco.gl_context import GLContext

    return GLContext(width, height)


class _Window:
    """An OpenGL context in a window; closing the window ends the drawing, not the program."""

    def __init__(self, width: int, height: int) -> None:
        if not has_display():
            raise RuntimeError(
                'there is no display to open a window on: use render_mode="rgb_array".'
            )
        import glfw

        self._glfw = glfw
        self._window = glfw.create_window(width, height, "torchrl_safe", None, None)
        if not self._window:
            raise RuntimeError('no window could be opened: use render_mode="rgb_array".')

    def make_current(self) -> None:
        self._glfw.make_context_current(self._window)

    @property
    def framebuffer_size(self) -> tuple[int, int]:
        return self._glfw.get_framebuffer_size(self._window)

    def show(self) -> None:
        if self._glfw.window_should_close(self._window):
            self._glfw.hide_window(self._window)
        self._glfw.swap_buffers(self._window)
        self._glfw.poll_events()

    def free(self) -> None:
        self._glfw.destroy_window(self._window)


def _free(gl: Any, context: mujoco.MjrContext) -> None:
    with _visit():
        # Freed while another context is current, it would take that one's textures with it.
        gl.make_current()
        context.free()
        gl.free()


_CANVASES: weakref.WeakSet[_Canvas] = weakref.WeakSet()


def _leave_canvases() -> None:
    """Leaves open what is open at exit, when dm_control or MuJoCo may already have ended EGL.

    Nor does a forked process free what belongs to the one that it was forked from.
    """
    for canvas in list(_CANVASES):
        canvas.leave()


atexit.register(_leave_canvases)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_canvases)

_drawing_process: int | None = None


def check_not_forked() -> None:
    """Raises a ``RuntimeError`` in processes that were forked from one that has drawn."""
    global _drawing_process
    if _drawing_process is None:
        _drawing_process = os.getpid()
    elif _drawing_process != os.getpid():
        raise RuntimeError(
            "this process was forked from one that has drawn pictures, which OpenGL does not "
            'survive: use the start method "spawn".'
        )


@contextmanager
def _visit() -> Iterator[None]:
    """Leaves current whichever EGL context was.

    MuJoCo's contexts stay current after use, and none is after one is opened or freed; dm_control
    draws without asking whether its own still is.
    """
    egl: Any = sys.modules.get("OpenGL.EGL")
    context = egl.eglGetCurrentContext() if egl else None
    if context:
        display = egl.eglGetCurrentDisplay()
        surfaces = [egl.eglGetCurrentSurface(end) for end in (egl.EGL_DRAW, egl.EGL_READ)]
    try:
        yield
    finally:
        egl = sys.modules.get("OpenGL.EGL")
        if context:
            egl.eglMakeCurrent(display, *surfaces, context)
        elif egl:
            egl.eglReleaseThread()
