"""Records steps of Safety-Gymnasium's own velocity tasks, for the tests to step from.

It runs where Safety-Gymnasium does, which this package does not: Python 3.10 with

    safety-gymnasium==1.0.0 gymnasium==0.28.1 mujoco==2.3.3 numpy==1.23.5

    python benchmarks/suite/record_velocity.py tests/envs/reference/velocity.npz

For each robot: some starts, drawn as the environment draws them and pushed along x, each followed
by random actions. The state before every step is kept, so that errors of two versions of MuJoCo do
not add up: whoever compares starts each step from it.
"""

from __future__ import annotations

import argparse

import numpy as np
import safety_gymnasium

STEPS = 16  # from each start
STARTS = {"HalfCheetah": 7, "Hopper": 7, "Walker2d": 7, "Ant": 7, "Humanoid": 3, "Swimmer": 7}


def position(env, robot: str) -> np.ndarray:
    """What the velocity is the velocity of: x, or x and y of the torso or the centre of mass."""
    data, masses = env.data, env.model.body_mass
    if robot == "Ant":
        return data.body("torso").xpos[:2].copy()
    if robot == "Humanoid":
        return (masses @ data.xipos / masses.sum())[:2]
    return data.qpos[:1].copy()


def record(robot: str) -> dict[str, np.ndarray]:
    env = safety_gymnasium.make(f"Safety{robot}Velocity-v1")
    unwrapped = env.unwrapped
    rng = np.random.default_rng(0)
    threshold = unwrapped._velocity_threshold
    rows = []
    for start in range(STARTS[robot]):
        env.reset(seed=start)
        data = unwrapped.data
        qvel = data.qvel.copy()
        qvel[0] += rng.uniform(-0.5, 2.5) * threshold
        unwrapped.set_state(data.qpos.copy(), qvel)
        for _ in range(STEPS):
            before = {
                "qpos": data.qpos.copy(),
                "qvel": data.qvel.copy(),
                "qacc_warmstart": data.qacc_warmstart.copy(),
                "position": position(unwrapped, robot),
            }
            action = rng.uniform(unwrapped.action_space.low, unwrapped.action_space.high)
            observation, reward, cost, terminated, _, _ = unwrapped.step(action)
            after = {
                "action": action,
                "observation": observation.astype(np.float32),
                "reward": reward,
                "cost": cost,
                "terminated": terminated,
            }
            rows.append({**before, **after})
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", help="the file to write, .npz")
    path = parser.parse_args().path
    records = {robot: record(robot) for robot in STARTS}
    arrays = {
        f"{robot}/{name}": value
        for robot, steps in records.items()
        for name, value in steps.items()
    }
    np.savez_compressed(path, **arrays)


if __name__ == "__main__":
    main()
