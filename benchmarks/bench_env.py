"""A step of N environments beside its floor: the physics of the same compiled model alone."""

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
from torchrl_safe.envs.robots import get_robot

NUM_ENVS = [1, 16, 64, 256]
ROBOT = get_robot("point")


def compiled_model() -> mujoco.MjModel:
    model = mujoco.MjModel.from_xml_path(str(ROBOT.asset_path))
    model.opt.timestep = ROBOT.timestep
    return model


def random_actions(num_envs: int) -> cycle[np.ndarray]:
    rng = np.random.default_rng(0)
    return cycle(rng.uniform(-1, 1, (64, num_envs, ROBOT.action_dim)).astype(np.float32))


def mj_step(num_envs: int, num_threads: int) -> Callable[[], object]:
    """Physics in a Python loop, a simulation after the other."""
    model, actions = compiled_model(), random_actions(num_envs)
    simulations = [mujoco.MjData(model) for _ in range(num_envs)]

    def step() -> None:
        for data, action in zip(simulations, next(actions), strict=True):
            data.ctrl = action
            mujoco.mj_step(model, data, nstep=ROBOT.substeps)

    return step


def batch(num_envs: int, num_threads: int) -> Callable[[], object]:
    """Physics on MuJoCo's thread pool."""
    actions = random_actions(num_envs)
    simulations = Batch(compiled_model(), num_envs, num_threads)
    ctrl = simulations.bind("ctrl")

    def step() -> None:
        ctrl[:] = next(actions)
        simulations.step(nstep=ROBOT.substeps)

    return step


def env(num_envs: int, num_threads: int) -> Callable[[], object]:
    """The environment as a collector steps it: goals, lidar, costs, tensors and resets."""
    actions = random_actions(num_envs)
    env = SafeGoalEnv(num_envs=num_envs, num_threads=num_threads, stagger=True)
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
def bench_step(
    benchmark: Any,
    num_envs: int,
    stepper: Callable[[int, int], Callable[[], object]],
    num_threads: int,
) -> None:
    benchmark.group = f"a step of {num_envs:3d} environments, {ROBOT.substeps} physics steps each"
    benchmark(stepper(num_envs, num_threads))
