"""Safety-Gymnasium's tasks against what Safety-Gymnasium does, step by step.

``benchmarks/suite/record_reference.py`` recorded the files in ``reference``. Every step starts from
the recorded state, so that what two versions of MuJoCo do differently does not add up.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from scipy.stats import ks_2samp

from torchrl_safe.envs import SafeRobotEnv
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs._robot import RobotCore, make_core
from torchrl_safe.envs.tasks import SafetyGoalTask, SafetyTask, get_task
from torchrl_safe.envs.tasks.bodies import own_size, read_sensors

SOURCES = ("hazards", "vases_contact", "vases_velocity", "pillars", "gremlins", "buttons")
SOURCES += ("out_of_boundary",)
REFERENCE = Path(__file__).parent / "reference"
NAMES = sorted(path.stem for path in REFERENCE.glob("Safety*.npz"))


@cache
def recorded(name: str) -> dict[str, np.ndarray]:
    with np.load(REFERENCE / f"{name}.npz") as file:
        return {key: file[key] for key in file.files}


def states(name: str, after: bool) -> dict[str, np.ndarray]:
    """The states before or after each step, one row for each step of each episode."""
    which = slice(1, None) if after else slice(None, -1)
    return {
        key.removeprefix("state_"): value[:, which].reshape(-1, *value.shape[2:])
        for key, value in recorded(name).items()
        if key.startswith("state_")
    }


def steps(name: str, key: str) -> np.ndarray:
    value = recorded(name)[key]
    return value.reshape(-1, *value.shape[2:])


def turned(quaternion: np.ndarray, by: float) -> np.ndarray:
    """Quaternions [N, 4] times a turn about z."""
    w, x, y, z = quaternion.T
    c, s = np.cos(by / 2), np.sin(by / 2)
    return np.stack((w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s), 1)


def in_our_frame(vector: np.ndarray) -> np.ndarray:
    """What Safety-Gymnasium's Car says in its frame, which drives along -y, in that of ours."""
    return vector[:, (1, 0, 2)] * (-1.0, 1.0, 1.0)


def robot_state(robot: str, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    if robot == "point":
        return qpos, qvel
    ball = qpos[:, 9:13]
    ball = np.concatenate((ball[:, :1], in_our_frame(ball[:, 1:])), 1)
    base = turned(qpos[:, 3:7], -np.pi / 2)
    turning, rolling = in_our_frame(qvel[:, 3:6]), in_our_frame(qvel[:, 8:11])
    return (
        np.concatenate((qpos[:, :3], base, qpos[:, 7:9], ball), 1),
        np.concatenate((qvel[:, :3], turning, qvel[:, 6:8], rolling), 1),
    )


def put(core: RobotCore, name: str, state: dict[str, np.ndarray]) -> None:
    """Puts all environments where the recorded ones were."""
    robots, objects = core._robots, dict(core._objects)
    batch, task = robots.batch, core.task
    assert isinstance(task, SafetyTask)
    qpos, qvel = robot_state(core.robot.name, state["robot_qpos"], state["robot_qvel"])
    for kind in task.kinds:
        if kind.name in state:
            objects[kind.name] = state[kind.name].reshape(core.num_envs, kind.count, 2)
        elif f"{kind.name}_qpos" in state:
            objects[kind.name] = state[f"{kind.name}_qpos"][:, :, :2]
    if "gremlins_centre" in state:
        objects["gremlins"] = state["gremlins_centre"]
        objects["gremlins_yaw"] = state["gremlins_yaw"]
    objects["goal_button"] = state.get("goal_button", np.zeros(0)).astype(float)
    objects["timer"] = state.get("timer", np.zeros(0)).astype(float)
    core._objects = {key: objects[key] for key in core._objects}
    robots.place(np.arange(core.num_envs), qpos[:, :2], qpos[:, 2], core._objects)
    batch.bind("qpos")[:, : qpos.shape[1]] = qpos
    batch.bind("qvel")[:, : qvel.shape[1]] = qvel
    batch.bind("time")[:] = state["time"].reshape(batch.bind("time").shape)
    first, speed = qpos.shape[1], qvel.shape[1]
    for body in task.bodies:
        if body.hold != "fixed":
            size = body.count
            ours = batch.bind("qpos")[:, first : first + 7 * size]
            ours[:] = state[f"{body.name}_qpos"].reshape(core.num_envs, -1)
            ours = batch.bind("qvel")[:, speed : speed + 6 * size]
            ours[:] = state[f"{body.name}_qvel"].reshape(core.num_envs, -1)
            first, speed = first + 7 * size, speed + 6 * size
    if "gremlins_centre" in state:
        where = robots._addresses[-1]["mocap"]
        offset = state["gremlins_mocap"]
        centre = np.insert(state["gremlins_centre"], 2, 0.0, axis=2)
        batch.bind("mocap_pos")[:, where] = centre + offset
    robots.perceive(np.arange(core.num_envs))
    readings = read_sensors(core.robot, task.bodies, robots.motion.proprioception)
    here = readings.position[:, :2]
    for kind, places in readings.positions.items():
        core._objects[kind] = places[..., :2].copy()
    core._objects |= task.begin(here, core._objects)
    if "push_box" in core._objects:
        core._objects |= task._distances(
            readings.position, readings.positions["push_box"][:, 0], core._objects["goal"]
        )


def replay(name: str, after: bool = False) -> RobotCore:
    robot, task = get_task(name)
    num_envs = len(steps(name, "reward"))
    core = make_core(
        robot, task, num_envs=num_envs, num_threads=1, seed=0, episode_length=task.episode_length
    )
    core.reset()
    put(core, name, states(name, after))
    return core


def due(core: RobotCore, objects: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    task, motion = core.task, core._robots.motion
    assert isinstance(task, SafetyTask)
    readings = read_sensors(core.robot, task.bodies, motion.proprioception)
    return task.costs(readings, objects)


def touching(core: RobotCore) -> np.ndarray:
    """Whether the robot touches anything, [N]."""
    task, motion = core.task, core._robots.motion
    assert isinstance(task, SafetyTask)
    touched = read_sensors(core.robot, task.bodies, motion.proprioception).touched
    none = np.zeros((core.num_envs, 1), bool)
    return np.concatenate([none, *touched.values()], 1).any(1)


def first_steps(core: RobotCore, name: str) -> np.ndarray:
    """Car's first of each episode: its wheels are at distance zero from the floor, where rounding
    decides whether they touch."""
    length = recorded(name)["reward"].shape[1]
    return (np.arange(core.num_envs) % length == 0) & (core.robot.name == "car")


@pytest.mark.parametrize("name", NAMES)
class TestEquality:
    def test_a_state_is_seen_and_judged_as_theirs(self, name):
        core = replay(name, after=True)
        task, motion, objects = core.task, core._robots.motion, core._objects
        scan = task.sense(core.robot, motion, objects).scan
        observation = task.observe(core.robot, motion, objects, scan)
        theirs = recorded(name)["observation"][:, 1:].reshape(observation.shape)
        # All but the accelerometer are functions of the state.
        np.testing.assert_allclose(observation[:, 3:], theirs[:, 3:], rtol=1e-6, atol=1e-6)
        # Which button was the right one, and whether any counted, was settled before the step.
        before = states(name, after=False)
        if "timer" in before:
            objects = objects | {key: before[key] for key in ("timer", "goal_button")}
        ours = due(core, objects)
        for source in SOURCES:
            expected = np.nan_to_num(steps(name, f"cost_{source}"))
            np.testing.assert_array_equal(ours.get(source, np.zeros(core.num_envs)), expected)
        total = np.any([*ours.values(), np.zeros(core.num_envs)], axis=0)
        np.testing.assert_array_equal(total, steps(name, "cost"))

    def test_a_step_is_theirs(self, name):
        core = replay(name)
        touched = touching(core)
        frame = core.step(steps(name, "action"))
        touched |= touching(core)
        # Between two looks there may be a touch as well, and what was pushed rocks for a while.
        for _ in range(3):
            touched = touched | np.roll(touched, 1) | np.roll(touched, -1)
        compared = ~first_steps(core, name)
        apart, size = compared & ~touched, own_size(core.robot)
        assert apart.mean() > 0.2
        reward, theirs = steps(name, "reward"), recorded(name)["observation"][:, 1:]
        seen, theirs = frame.observation, theirs.reshape(frame.observation.shape)
        np.testing.assert_allclose(frame.reward[apart], reward[apart], atol=1e-6)
        np.testing.assert_allclose(seen[apart, :size], theirs[apart, :size], atol=1e-3)
        # What pushes against something is pushed back a little differently.
        np.testing.assert_allclose(frame.reward[compared], reward[compared], atol=5e-3)
        met = steps(name, "goal_met")
        np.testing.assert_array_equal(frame.goal_met[compared], met[compared])
        np.testing.assert_array_equal(frame.cost[apart], steps(name, "cost")[apart])


def test_the_recorded_episodes_have_what_matters():
    for source in SOURCES:
        assert sum(np.nansum(recorded(name)[f"cost_{source}"]) for name in NAMES) > 0, source
    for family in ("Goal", "Button"):
        assert sum(recorded(name)["goal_met"].sum() for name in NAMES if family in name) > 0


@pytest.mark.parametrize(
    "name", [name for name in NAMES if "layouts" in recorded(name) and name != "SafetyPointGoal0"]
)
def test_layouts_are_distributed_as_theirs(name):
    robot, task = get_task(name)
    theirs, names = recorded(name)["layouts"], list(recorded(name)["layout_names"])
    num = 300
    position, yaw, objects = task.sample(robot, RandomStreams(0, num), np.arange(num))
    assert 0.0 <= yaw.min() <= yaw.max() < 2 * np.pi
    pairs = [(position[:, None], theirs[:, [names.index("agent")]])]
    for kind in task.kinds:
        # The Button tasks move the goal to a button, which their layout does not show.
        if kind.name != "circle" and not (kind.name == "goal" and "Button" in name):
            single = kind.name in ("goal", "push_box")
            own = [kind.name] if single else [f"{kind.name[:-1]}{i}" for i in range(kind.count)]
            pairs.append((objects[kind.name], theirs[:, [names.index(n) for n in own]]))
    for ours, others in pairs:
        for measure in (
            lambda places: places[..., 0].ravel(),
            lambda places: places[..., 1].ravel(),
            lambda places: np.hypot(*places[:, 0].T),
        ):
            assert ks_2samp(measure(ours), measure(others)).pvalue > 1e-4
    # And relative to the robot.
    for ours, others in pairs[1:]:
        gaps = [
            np.linalg.norm(places - first, axis=-1).min(1)
            for places, first in ((ours, pairs[0][0]), (others, pairs[0][1]))
        ]
        assert ks_2samp(*gaps).pvalue > 1e-4


class TestNames:
    @pytest.mark.parametrize(
        ("name", "size"),
        [
            ("SafetyPointGoal0", 28),
            ("SafetyPointGoal1", 60),
            ("SafetyCarGoal1", 72),
            ("SafetyPointCircle1", 28),
            ("SafetyPointRun0", 12),
            ("SafetyPointButton1", 76),
            ("SafetyCarPush2", 88),
        ],
    )
    def test_in_gymnasium(self, name, size):
        env = gymnasium.make(f"torchrl_safe/{name}-v0")
        observation, _ = env.reset(seed=0)
        assert observation.shape == (size,)
        assert env.spec is not None
        assert env.spec.max_episode_steps == get_task(name)[1].episode_length
        *_, info = env.step(env.action_space.sample())
        assert info["cost"] in (0.0, 1.0)
        env.close()

    def test_unknown(self):
        with pytest.raises(ValueError, match=r"SafetyPointGoal1.*'SafetyPointGoal3'"):
            get_task("SafetyPointGoal3")

    @pytest.mark.parametrize("level", [3, -1, True])
    def test_levels(self, level):
        with pytest.raises(ValueError, match="level must be one of"):
            SafetyGoalTask(level)


def test_a_robot_without_a_site_is_refused():
    with pytest.raises(ValueError, match="has no site 'robot'"):
        SafeRobotEnv("jackal", task=SafetyGoalTask(1), num_envs=1, num_threads=1)
