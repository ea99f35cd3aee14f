"""A step of N environments beside its floor, the physics of the same model alone; resets."""

from __future__ import annotations

from collections.abc import Callable
from itertools import cycle
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from mujoco.batch import Batch

from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.envs.robots import Robot, get_robot

ROBOTS = ["point", "jackal"]
NUM_ENVS = [1, 16, 64, 256]


def compiled_model(robot: Robot) -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_path(str(robot.asset_path))
    model.opt.timestep = robot.timestep
    return model


def random_actions(robot: Robot, num_envs: int) -> cycle[np.ndarray]:
    rng = np.random.default_rng(0)
    return cycle(rng.uniform(-1, 1, (64, num_envs, robot.action_dim)).astype(np.float32))


def mj_step(robot: Robot, num_envs: int, num_threads: int) -> Callable[[], object]:
    """Physics in a Python loop, a simulation after the other."""
    model, actions = compiled_model(robot), random_actions(robot, num_envs)
    simulations = [mujoco.MjData(model) for _ in range(num_envs)]
    for data in simulations:
        data.qpos = robot.place(np.zeros((1, 2)), np.zeros(1))[0]

    def step() -> None:
        for data, action in zip(simulations, next(actions), strict=True):
            data.ctrl = robot.control(
                action[None], data.qpos[None], data.qvel[None], np.array([data.time])
            )[0]
            mujoco.mj_step(model, data, nstep=robot.substeps)

    return step


def batch(robot: Robot, num_envs: int, num_threads: int) -> Callable[[], object]:
    """Physics on MuJoCo's thread pool."""
    actions = random_actions(robot, num_envs)
    simulations = Batch(compiled_model(robot), num_envs, num_threads)
    qpos, qvel = simulations.bind("qpos"), simulations.bind("qvel")
    qpos[:] = robot.place(np.zeros((num_envs, 2)), np.zeros(num_envs))
    time, ctrl = simulations.bind("time"), simulations.bind("ctrl")

    def step() -> None:
        ctrl[:] = robot.control(next(actions), qpos, qvel, time)
        simulations.step(nstep=robot.substeps)

    return step


def env(robot: Robot, num_envs: int, num_threads: int) -> Callable[[], object]:
    """The environment as a collector steps it: task, tensors and resets."""
    actions = random_actions(robot, num_envs)
    env = SafeGoalEnv(robot.name, num_envs=num_envs, num_threads=num_threads, stagger=True)
    state = env.reset()

    def step() -> None:
        nonlocal state
        state["action"] = torch.from_numpy(next(actions))
        _, state = env.step_and_maybe_reset(state)

    return step


@pytest.mark.parametrize(
    ("stepper", "num_threads"),
    [(mj_step, 1), (batch, 1), (batch, 2), (env, 1), (env, 2)],
    ids=lambda value: getattr(value, "__name__", value),
)
@pytest.mark.parametrize("num_envs", NUM_ENVS, ids="N{}".format)
@pytest.mark.parametrize("name", ROBOTS)
def bench_step(
    benchmark: Any,
    name: str,
    num_envs: int,
    stepper: Callable[[Robot, int, int], Callable[[], object]],
    num_threads: int,
) -> None:
    robot = get_robot(name)
    benchmark.group = f"a step of {num_envs:3d} {name}s, {robot.substeps} physics steps each"
    benchmark(stepper(robot, num_envs, num_threads))


@pytest.mark.parametrize("name", ROBOTS)
def bench_reset(benchmark: Any, name: str) -> None:
    env = SafeGoalEnv(name, num_envs=64, num_threads=2)
    env.reset()
    benchmark.group = "a reset of 64 environments"
    benchmark(env.reset)
