"""Safety-Gymnasium's tasks against what Safety-Gymnasium does, step by step.

``benchmarks/suite/record_reference.py`` recorded the files in ``reference``. Every step starts from
the recorded state, so that what two versions of MuJoCo do differently does not add up.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from scipy.stats import ks_2samp, kstest

from torchrl_safe.envs import SafeRobotEnv, check_safe_env
from torchrl_safe.envs._random import RandomStreams
from torchrl_safe.envs._robot import RobotCore, make_core
from torchrl_safe.envs.tasks import SAFETY_TASKS, SafetyGoalTask, SafetyTask, get_task
from torchrl_safe.envs.tasks.bodies import own_size, read_sensors

SOURCES = ("hazards", "vases_contact", "vases_velocity", "pillars", "gremlins", "buttons")
SOURCES += ("out_of_boundary",)
SENSORS = 1e-3  # how far sensors may be apart after a step
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
    if robot != "car":
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
    for kind, places in readings.positions.items():
        core._objects[kind] = places[..., :2].copy()
    core._objects |= task.begin(readings.position, core._objects)
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


def pushed(name: str) -> np.ndarray:
    """Whether anything moves that was pushed, before a step or after it, [N]."""
    out = np.zeros(len(steps(name, "reward")), bool)
    for key in ("vases_qvel", "push_box_qvel"):
        for state in (states(name, after=False), states(name, after=True)):
            if key in state:
                out |= (np.abs(state[key]) > 0.01).any((1, 2))
    return out


def settled(core: RobotCore, name: str) -> np.ndarray:
    """The steps whose outcome is settled by where they start, [N].

    In the others a wheel or a foot grazes something. There, the original's own sensors change by
    more than the tolerance when its start changes by a ten-millionth. Point touches no floor.
    """
    if core.robot.name == "point":
        return np.ones(core.num_envs, bool)
    return steps(name, "sensitivity") < SENSORS


@pytest.mark.parametrize("name", NAMES)
class TestEquality:
    def test_a_state_is_seen_and_judged_as_theirs(self, name):
        core = replay(name, after=True)
        task, motion, objects = core.task, core._robots.motion, core._objects
        scan = task.sense(core.robot, motion, objects).scan
        observation = task.observe(core.robot, motion, objects, scan)
        theirs = recorded(name)["observation"][:, 1:].reshape(observation.shape)
        # All but the accelerometer and what feels a touch are functions of the state.
        forces = [0, 1, 2, *range(12, 12 + len(core.robot.instruments.touch))]
        ours, theirs = (np.delete(seen, forces, 1) for seen in (observation, theirs))
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)
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
        touched = touching(core) | pushed(name)
        frame = core.step(steps(name, "action"))
        touched |= touching(core)
        # Between two looks there may be a touch as well.
        for _ in range(3):
            touched = touched | np.roll(touched, 1) | np.roll(touched, -1)
        compared = settled(core, name)
        apart, size = compared & ~touched, own_size(core.robot)
        assert apart.mean() > 0.15
        theirs = recorded(name)["observation"][:, 1:].reshape(frame.observation.shape)
        off = np.abs(frame.observation - theirs)[:, :size].max(1)
        wrong = np.abs(frame.reward - steps(name, "reward"))
        met = frame.goal_met != steps(name, "goal_met")
        late = frame.cost != steps(name, "cost")
        ends = steps(name, "terminated") if core.robot.lowest > 0.0 else False
        late |= frame.terminated != ends
        if core.robot.name in ("point", "car"):
            assert off[apart].max() < SENSORS
            assert wrong[apart].max() < 1e-6
            # What pushes against something is pushed back a little differently.
            assert wrong[compared].max() < 5e-3
            assert not met[compared].any()
            assert not late[apart].any()
            for source, cost in core.sources(frame).items():
                expected = steps(name, "cost" if source == "cost_sum" else source)
                np.testing.assert_array_equal(cost[apart], np.nan_to_num(expected)[apart])
        else:
            # Some touch between two looks all the same; and Racecar, whose wheels are shallow in
            # the floor, bounces.
            metres = 60.0 if "Run" in name else 1.0
            good = (off < SENSORS) & (wrong < 1e-5 * metres) & ~met & ~late
            share = 0.9 if core.robot.name == "racecar" else 0.97
            assert good[apart].mean() > share
            assert np.mean(wrong[compared] < 5e-3) > 0.9
            assert not (met | late)[apart].any()


def test_the_recorded_episodes_have_what_matters():
    for source in SOURCES:
        assert sum(np.nansum(recorded(name)[f"cost_{source}"]) for name in NAMES) > 0, source
    for family in ("Goal", "Button"):
        assert sum(recorded(name)["goal_met"].sum() for name in NAMES if family in name) > 0


def recorded_layouts() -> dict[str, tuple[np.ndarray, list[str]]]:
    """Positions [n, K, 2] after resets of Safety-Gymnasium and what they are of, by task."""
    found = {}
    for name in NAMES:
        if "layouts" in recorded(name) and name != "SafetyPointGoal0":
            found[name] = recorded(name)["layouts"], list(recorded(name)["layout_names"])
    with np.load(REFERENCE / "layouts.npz") as file:
        for name in file.files:
            if name != "same" and not name.endswith("_names"):
                found[name] = file[name].astype(float), list(file[f"{name}_names"])
        # Most robots have the very layouts of another one.
        found |= {str(name): found[other] for name, other in file["same"]}
    return found


@pytest.mark.parametrize("name", recorded_layouts())
def test_layouts_are_distributed_as_theirs(name):
    robot, task = get_task(name)
    theirs, names = recorded_layouts()[name]
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
            ("SafetyAntGoal1", 88),
            ("SafetyDoggoCircle2", 72),
            ("SafetyRacecarButton1", 76),
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
        assert info["cost_sum" if get_task(name)[1].sources else "cost"] == info["cost"]
        env.close()

    def test_actions_are_in_their_units(self):
        env = gymnasium.make("torchrl_safe/SafetyRacecarGoal1-v0")
        np.testing.assert_allclose(env.action_space.high, (20.0, 0.785), rtol=1e-6)
        np.testing.assert_allclose(env.action_space.low, (-20.0, -0.785), rtol=1e-6)
        env.close()

    def test_unknown(self):
        with pytest.raises(ValueError, match=r"SafetyPointGoal1.*'SafetyPointGoal3'"):
            get_task("SafetyPointGoal3")

    @pytest.mark.parametrize("level", [3, -1, True])
    def test_levels(self, level):
        with pytest.raises(ValueError, match="level must be one of"):
            SafetyGoalTask(level)


@pytest.mark.parametrize("name", ["SafetyPointGoal2", "SafetyCarButton2", "SafetyRacecarRun0"])
class TestSourcesOfCost:
    def test_in_gymnasium(self, name):
        """The same, alone and together; a reset brings none."""
        task = get_task(name)[1]
        single = gymnasium.make(f"torchrl_safe/{name}-v0")
        several = gymnasium.make_vec(f"torchrl_safe/{name}-v0", num_envs=2, num_threads=1)
        _, info = single.reset(seed=3)
        several.reset(seed=[3, 4])
        keys = [f"cost_{source}" for source in task.sources] + ["cost_sum"]
        assert [info[key] for key in keys] == [0.0] * len(keys)
        for action in np.random.default_rng(0).uniform(-1, 1, (20, *single.action_space.shape)):
            *_, info = single.step(action.astype(np.float32))
            *_, infos = several.step(np.stack((action, action)).astype(np.float32))
            assert info["cost_sum"] == max(info[key] for key in keys) == info["cost"]
            for key in keys:
                assert infos[key][0] == info[key]
                assert infos[f"_{key}"].all()
        single.close()
        several.close()

    def test_as_costs_of_their_own(self, name):
        robot, task = get_task(name)
        apart = replace(task, separate_costs=True)
        assert apart.cost_names == task.sources
        one, each = (
            SafeRobotEnv(robot, task=which, num_envs=16, num_threads=1) for which in (task, apart)
        )
        check_safe_env(each)
        for env in (one, each):
            env.set_seed(0)
        td = one.reset()
        each.reset()
        td["action"] = one.full_action_spec["action"].high.clone()
        total = 0.0
        for _ in range(60):
            together = one.step(td.clone())["next"]
            alone = each.step(td.clone())["next"]
            costs = torch.cat([alone[f"{source}_cost"] for source in task.sources], -1)
            assert "cost" not in alone.keys()
            assert torch.equal(costs.amax(-1, keepdim=True), together["cost"])
            assert torch.equal(alone["violation"], together["violation"])
            total += costs.sum().item()
        assert total > 0.0


def test_costs_are_named_in_the_order_of_their_sources():
    for name, (robot, task) in SAFETY_TASKS.items():
        core = make_core(robot, task, num_envs=2, num_threads=1, seed=0, episode_length=9)
        core.reset()
        assert tuple(due(core, core._objects)) == task.sources, name


def test_separate_costs_that_do_not_exist():
    with pytest.raises(ValueError, match="separate_costs must be False at level 0"):
        SafetyGoalTask(0, separate_costs=True)
    with pytest.raises(TypeError, match="separate_costs must be a bool, got 1"):
        SafetyGoalTask(1, separate_costs=1)


@pytest.mark.parametrize("name", ["SafetyAntGoal2", "SafetyDoggoButton2", "SafetyRacecarPush2"])
def test_random_steps_stay_finite(name):
    robot, task = get_task(name)
    core = make_core(robot, task, num_envs=16, num_threads=1, seed=0, episode_length=100)
    core.reset()
    low, high = core.action_range
    rng = np.random.default_rng(0)
    for _ in range(150):
        frame = core.step(rng.uniform(low, high, (16, len(low))))
        assert np.isfinite(frame.observation).all()
        assert np.isfinite(frame.reward).all()
        core.reset(frame.terminated | frame.truncated)
    assert core.instabilities == 0


def test_an_ant_starts_with_its_feet_down_more_or_less():
    robot, task = get_task("SafetyAntCircle1")
    num = 400
    core = make_core(robot, task, num_envs=num, num_threads=1, seed=0, episode_length=9)
    core.reset()
    joints = core.physics()["qpos"][:, 7:]
    bend = joints - np.tile((0.0, 1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0), (num, 1)) * np.pi / 2
    assert kstest(bend.ravel(), "uniform", (-0.1, 0.2)).pvalue > 1e-4
    assert (np.abs(np.corrcoef(bend.T) - np.eye(8)) < 0.25).all()


def test_a_robot_without_a_site_is_refused():
    with pytest.raises(ValueError, match="has no site 'robot'"):
        SafeRobotEnv("jackal", task=SafetyGoalTask(1), num_envs=1, num_threads=1)
