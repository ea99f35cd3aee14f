"""How fast an environment of ours is beside the floor: the physics that it makes, nothing else."""

from __future__ import annotations

import time
from collections.abc import Callable

import mujoco
from mujoco.batch import Batch

from torchrl_safe.envs import SafeRobotEnv, SafeVelocityEnv

BLOCK = 16  # steps that the physics repeat at once: caches stay warm
Clock = Callable[[], float]


def beside_the_floor(
    env: SafeRobotEnv | SafeVelocityEnv,
    model: mujoco.MjModel,
    substeps: int,
    num_threads: int,
    clock: Clock = time.perf_counter,
) -> Callable[[float], tuple[float, float]]:
    """What measures for some seconds the environment's steps per second and the floor's.

    The environment is stepped as a collector does it: tensors and resets. The floor starts each
    step from the same states and makes it under the same controls, on as many threads.
    """
    num_envs = env.batch_size.numel()
    floor = Batch(model, num_envs, num_threads)
    control = floor.bind("ctrl")
    td = env.reset()

    def measure(seconds: float) -> tuple[float, float]:
        nonlocal td
        steps, of_env, of_floor = 0, 0.0, 0.0
        while of_env < seconds:
            states = []
            for _ in range(BLOCK):
                td.update(env.full_action_spec.rand())
                states.append((env._core._robots.state.copy(), td["action"].numpy()))
                start = clock()
                _, td = env.step_and_maybe_reset(td)
                of_env += clock() - start
            for state, action in states:
                floor.state[:], control[:] = state, action
                start = clock()
                floor.step(nstep=substeps)
                of_floor += clock() - start
            steps += num_envs * BLOCK
        return steps / of_env, steps / of_floor

    return measure
