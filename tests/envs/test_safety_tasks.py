"""Safety-Gymnasium's tasks against what Safety-Gymnasium does, step by step.

``benchmarks/suite/record_reference.py`` recorded the files in ``reference``. Every step starts from
the recorded state, so that what two versions of MuJoCo do differently does not add up.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from torchrl_safe.envs._core import Core, make_core
from torchrl_safe.envs.tasks import SAFETY_TASKS, SafetyTask, get_task
from torchrl_safe.envs.tasks.bodies import own_size, read_sensors

REFERENCE = Path(__file__).parent / "reference"
NAMES = sorted(path.stem for path in REFERENCE.glob("*.npz"))


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


def put(core: Core, name: str, state: dict[str, np.ndarray]) -> None:
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


def replay(name: str, after: bool = False) -> Core:
    robot, task = get_task(name)
    num_envs = len(steps(name, "reward"))
    core = make_core(
        robot, task, num_envs=num_envs, num_threads=1, seed=0, episode_length=task.episode_length
    )
    core.reset()
    put(core, name, states(name, after))
    return core


@pytest.mark.parametrize("name", NAMES)
class TestEquality:
    def test_a_state_is_seen_as_theirs(self, name):
        core = replay(name, after=True)
        motion, objects = core._robots.motion, core._objects
        sensed = core.task.sense(core.robot, motion, objects)
        observation = core.task.observe(core.robot, motion, objects, sensed.scan)
        theirs = recorded(name)["observation"][:, 1:].reshape(observation.shape)
        size = own_size(core.robot)
        np.testing.assert_allclose(observation[:, size:], theirs[:, size:], atol=1e-6)
        # All but the accelerometer are functions of the state.
        np.testing.assert_allclose(observation[:, 3:size], theirs[:, 3:size], atol=1e-6)

    def test_a_step_is_theirs(self, name):
        core = replay(name)
        before = dict(core._objects)
        frame = core.step(steps(name, "action"))
        size = own_size(core.robot)
        theirs = recorded(name)["observation"][:, 1:].reshape(frame.observation.shape)
        reward = steps(name, "reward")
        bad = np.flatnonzero(np.abs(frame.reward - reward) > 1e-5)
        print(name, "reward", np.abs(frame.reward - reward).max(), bad)
        err = np.abs(frame.observation[:, :size] - theirs[:, :size])
        print("sensors", err.max(0).round(5))
        for key in ("hazards", "vases_contact", "vases_velocity", "pillars", "gremlins", "buttons", "out_of_boundary"):
            want = steps(name, f"cost_{key}")
            want = np.where(np.isnan(want), 0, want)
            objects = before
            r = read_sensors(core.robot, core.task.bodies, core._robots.motion.proprioception)
            got = core.task.costs(r, objects).get(key, np.zeros(len(want)))
            if (want != got).any():
                print("cost", key, np.flatnonzero(want != got), want.sum(), got.sum())
        if (frame.goal_met != steps(name, "goal_met")).any(): print("goal", frame.goal_met.sum(), steps(name, "goal_met").sum())
