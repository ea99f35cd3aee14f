"""Records what Safety-Gymnasium 1.0.0 does: the fixtures of ``tests/envs/test_safety_tasks.py``.

It runs in a Python of its own (see the README of this folder), not in that of this project::

    python benchmarks/suite/record_reference.py tests/envs/reference

Per task there are a few short episodes. In each the robot is put in front of another kind of object
and driven at it, so that costs, contacts and reached goals are among the steps. What walks is
thrown at it. With ``--layouts`` there are no episodes, but where things are after many resets, of
all other robots in one file, to a thousandth of a metre.
"""

import argparse
from pathlib import Path

import mujoco
import numpy as np
import safety_gymnasium

TASKS = ("Goal0", "Goal1", "Goal2", "Circle0", "Circle1", "Circle2", "Run0")
TASKS += ("Button0", "Button1", "Button2", "Push0", "Push1", "Push2")
ROBOTS = ("Point", "Car", "Ant", "Doggo", "Racecar")
THROWN = {"Ant": 2.0, "Doggo": 1.0}  # metres per second
# How far from an object's centre a robot is put, metres.
NEAR = {"gremlins": 0.26, "push_box": 0.6, "": 0.42}
WALKERS_NEAR = {"goal": 0.35, "hazards": 0.25, "vases": 0.3, "pillars": 0.45, "push_box": 0.6}
WALKERS_NEAR[""] = 0.35
RACECAR_NEAR = {"pillars": 0.55, "push_box": 0.8, "": 0.45}
STEPS = 20
LAYOUTS = {
    "Button1": 60,
    "Button2": 40,
}  # 200 of other tasks, of which only the positions are kept, for the statistics
COSTS = ("hazards", "vases_contact", "vases_velocity", "pillars", "gremlins", "buttons")
COSTS += ("out_of_boundary",)
# Objects that move are found in the simulation, others in the layout.
FREE = (("vases", "vase{}"), ("gremlins", "gremlin{}obj"), ("push_box", "push_box"))
FIXED = (("goal", "goal"), ("hazards", "hazard{}"), ("pillars", "pillar{}"))
FIXED += (("buttons", "button{}"),)


def names(task, kind, pattern):
    """Bodies of one kind in a task's model."""
    if not hasattr(task, kind):
        return []
    return [pattern.format(i) for i in range(getattr(getattr(task, kind), "num", 1))]


def turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def base(task):
    """Where Point's joints count from: its world coordinates are these plus its joints'."""
    body = task.model.body("agent")
    return body.pos[:2], 2.0 * np.arctan2(body.quat[3], body.quat[0])


def put(task, position, yaw):
    """Puts the robot somewhere, at rest; whatever remembers where it was is told."""
    data = task.data
    data.qvel[:] = 0.0
    data.qvel[:2] = THROWN.get(task.agent_name, 0.0) * turn(yaw)[:, 0]
    if task.agent_name == "Point":
        origin, start = base(task)
        data.qpos[:2] = turn(start).T @ (position - origin)
        data.qpos[2] = yaw - start
    else:
        data.qpos[:2] = position
        data.qpos[3:7] = np.cos(yaw / 2.0), 0.0, 0.0, np.sin(yaw / 2.0)
    mujoco.mj_forward(task.model, data)
    for memory, measure in (
        ("last_dist_goal", "dist_goal"),
        ("last_dist_box", "dist_box"),
        ("last_box_goal", "dist_box_goal"),
    ):
        if hasattr(task, memory):
            setattr(task, memory, getattr(task, measure)())
    if hasattr(task, "old_potential"):
        task.specific_reset()


def state(task):
    """Everything the next step depends on, in world coordinates."""
    data, qpos, qvel = task.data, task.data.qpos, task.data.qvel
    if task.agent_name == "Point":
        origin, start = base(task)
        rotation = turn(start)
        robot = np.r_[origin + rotation @ qpos[:2], start + qpos[2]]
        speed = np.r_[rotation @ qvel[:2], qvel[2]]
    else:
        size = task.agent.body_info
        robot, speed = qpos[: size.nq].copy(), qvel[: size.nv].copy()
    out = {"robot_qpos": robot, "robot_qvel": speed, "time": np.array(data.time)}
    for kind, pattern in FREE:
        bodies = names(task, kind, pattern)
        if bodies:
            out[f"{kind}_qpos"] = np.array([data.joint(name).qpos for name in bodies])
            out[f"{kind}_qvel"] = np.array([data.joint(name).qvel for name in bodies], np.float32)
    for kind, pattern in FIXED:
        bodies = names(task, kind, pattern)
        if bodies:
            out[kind] = np.array([data.body(name).xpos[:2] for name in bodies])
    if hasattr(task, "gremlins"):
        mocaps = [task.model.body(f"gremlin{i}mocap").mocapid[0] for i in range(task.gremlins.num)]
        out["gremlins_mocap"] = data.mocap_pos[mocaps].copy()
        layout = task.world_info.layout
        out["gremlins_centre"] = np.array([layout[f"gremlin{i}"] for i in range(len(mocaps))])
        geoms = task.world_info.world_config_dict["free_geoms"]
        out["gremlins_yaw"] = np.array([geoms[f"gremlin{i}obj"]["rot"] for i in range(len(mocaps))])
    if hasattr(task, "buttons"):
        out["goal_button"] = np.array(task.buttons.goal_button)
        out["timer"] = np.array(task.buttons.timer)
    return out


def steer(task, rng, target):
    """Towards a target, not quite straight."""
    if task.agent_name in THROWN:
        return rng.uniform(-1.0, 1.0, task.agent.body_info.nu)
    ahead = np.array([0.0, -1.0] if task.agent_name == "Car" else [1.0, 0.0])
    mat, offset = task.agent.mat, np.r_[target - task.agent.pos[:2], 0.0]
    x, y = (offset @ mat)[:2]
    bearing = np.arctan2(ahead[0] * y - ahead[1] * x, ahead[0] * x + ahead[1] * y)
    bend = 2.0 * bearing
    if task.agent_name == "Car":
        action = np.array([0.6 + bend, 0.6 - bend])
    else:
        action = np.array([0.9, bend])
    limit = task.action_space.high
    return limit * np.clip(action + rng.normal(0.0, 0.15, 2), -1.0, 1.0)


def sensitivity(task, action, aside, rng):
    """How much the robot's sensors after a step change with the seventh digit of where it starts.

    Where a wheel grazes the floor they change by as much as anybody's rounding would change them.
    """
    outcomes = []
    for size in (0.0, *[1e-7] * 8):
        for name in ("qpos", "qvel", "qacc_warmstart", "mocap_pos", "mocap_quat"):
            getattr(aside, name)[:] = getattr(task.data, name)
        aside.qpos[: task.agent.body_info.nq] += size * rng.normal(size=task.agent.body_info.nq)
        aside.ctrl[:] = action
        mujoco.mj_step(task.model, aside, task.sim_conf.frameskip_binom_n)
        mujoco.mj_forward(task.model, aside)
        outcomes.append(aside.sensordata.copy())
    return np.abs(np.array(outcomes[1:]) - outcomes[0]).max()


def targets(task):
    """One object of each kind, [2] each, and None for an episode that starts where it starts."""
    found = [None]
    for kind, pattern in FREE + FIXED:
        bodies = names(task, kind, pattern)[:1]
        if kind == "buttons" and bodies:
            right = task.buttons.goal_button
            bodies = [pattern.format(i) for i in (right, (right + 1) % task.buttons.num)]
        found += [(name, kind) for name in bodies]
    if hasattr(task, "sigwalls"):
        found += [(None, "sigwalls")]
    return found


def stack(rows):
    return {key: np.stack([row[key] for row in rows]) for key in rows[0]}


def record(name, seed):
    env = safety_gymnasium.make(name).unwrapped
    task, rng, noise = env.task, np.random.default_rng(seed), np.random.default_rng(seed)
    env.reset(seed=seed)
    episodes = []
    for number in range(len(targets(task))):
        env.reset(seed=seed + number)
        target = targets(task)[number]
        if target is not None:
            body, kind = target
            goal = task.data.body(body).xpos[:2].copy() if body else None
            if kind == "sigwalls":
                start = np.array([task.sigwalls.locate_factor - 0.15, task.agent.pos[1] * 0.9])
                goal = start + np.array([1.0, 0.0])
            else:
                angle = rng.uniform(0.0, 2.0 * np.pi)
                if kind == "gremlins":  # there it will be, and near
                    goal += [0.0, task.gremlins.travel]
                near = NEAR if task.agent_name in ("Point", "Car") else WALKERS_NEAR
                near = RACECAR_NEAR if task.agent_name == "Racecar" else near
                near = near.get(kind, near[""])
                start = goal + near * turn(angle)[0]
            x, y = goal - start
            # Not straight ahead: for an angle just below zero their lidar has no bin.
            yaw = 0.05 + np.arctan2(y, x) + (np.pi / 2.0 if task.agent_name == "Car" else 0.0)
            put(task, start, yaw)
        states, steps, aside = [state(task)], [], mujoco.MjData(task.model)
        observations = [task.obs().astype(np.float32)]
        for _ in range(STEPS):
            if target is not None and target[0]:
                goal = task.data.body(target[0]).xpos[:2].copy()
            limit = task.action_space.high
            action = (
                limit * rng.uniform(-1.0, 1.0, len(limit))
                if target is None
                else steer(task, rng, goal)
            )
            sensitive = sensitivity(task, action, aside, noise)
            observation, reward, cost, terminated, _, info = env.step(action)
            env.terminated = False  # the episode goes on after a fall
            observations.append(observation.astype(np.float32))
            states.append(state(task))
            step = {"action": action, "reward": reward, "cost": cost}
            step["goal_met"] = info.get("goal_met", False)
            step["terminated"] = terminated
            step["sensitivity"] = np.float32(sensitive)
            step |= {f"cost_{key}": info.get(f"cost_{key}", np.nan) for key in COSTS}
            steps.append({key: np.asarray(value) for key, value in step.items()})
        episodes.append(
            {"observation": np.stack(observations)}
            | {f"state_{key}": value for key, value in stack(states).items()}
            | stack(steps)
        )
    return stack(episodes)


def layouts(name, count):
    """Positions of robot and objects after as many resets, in single precision."""
    env = safety_gymnasium.make(name).unwrapped
    task, rows = env.task, []
    env.reset(seed=0)
    for seed in range(count):
        env.set_seed(seed)
        layout = task.random_generator.build_layout()
        task.world_info.layout = layout
        if "Button" not in name and "goal" in layout:
            del layout["goal"]
            if not any(task.random_generator.sample_goal_position() for _ in range(10000)):
                continue  # a reset fails here
        rows.append(np.array([layout[key] for key in sorted(layout)], np.float32))
    return np.stack(rows), np.array(sorted(layout))


def record_layouts(folder, robots, tasks):
    """Layouts of other robots than Point, and who has the same as another one of the same seeds."""
    rows, same = {}, []
    for task in tasks:
        with np.load(folder / f"SafetyPoint{task}.npz") as file:
            known = {f"SafetyPoint{task}": file["layouts"].astype(np.float16)}
        for robot in robots:
            name = f"Safety{robot}{task}"
            if name in known:
                continue
            positions, names = layouts(f"{name}-v0", min(LAYOUTS.get(task, 150), 150))
            positions = positions.astype(np.float16)
            equal = [
                other
                for other in known
                if np.array_equal(known[other][: len(positions)], positions)
            ]
            if equal:
                same.append((name, equal[0]))
            else:
                rows[name], rows[f"{name}_names"] = positions, names
                known[name] = positions
            print(name, positions.shape, *equal)
    np.savez_compressed(folder / "layouts.npz", same=np.array(same), **rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tasks", nargs="*", default=TASKS)
    parser.add_argument("--robots", nargs="*", default=ROBOTS)
    parser.add_argument("--layouts", action="store_true")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.layouts:
        record_layouts(args.folder, args.robots, args.tasks)
        return
    for robot in args.robots:
        for task in args.tasks:
            name = f"Safety{robot}{task}"
            rows = record(f"{name}-v0", seed=7)
            if robot == "Point":
                rows["layouts"], rows["layout_names"] = layouts(
                    f"{name}-v0", LAYOUTS.get(task, 200)
                )
            path = args.folder / f"{name}.npz"
            np.savez_compressed(path, **rows)
            events = {
                key: float(np.nansum(value))
                for key, value in rows.items()
                if key.startswith("cost") or key == "goal_met"
            }
            print(name, rows["observation"].shape, path.stat().st_size, events)


if __name__ == "__main__":
    main()
