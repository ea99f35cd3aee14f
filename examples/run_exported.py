"""Drive the simulator from an exported policy alone: what a robot would do.

    python examples/run_exported.py runs/safetac_point/seed_0/policy.onnx

Nothing of the policy's code is imported. The file maps observations ``[B, D]`` to actions
``[B, A]``, float32; on a robot, the loop below is all there is. A ``.pt2`` is a program that torch
partly unpickles: take it from no one but yourself. An ``.onnx`` runs nothing but its own operators.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from torchrl_safe._files import expand, printable
from torchrl_safe.envs import SafeRobotEnv

Controller = Callable[[NDArray[np.float32]], NDArray[np.float32]]


def load(path: Path) -> Controller:
    """The file as a function of arrays."""
    path = expand(path)
    if not path.is_file():
        raise FileNotFoundError(
            f"{printable(path)} is no file: torchrl-safe export writes one from a run."
        )
    if path.suffix == ".onnx":
        if find_spec("onnxruntime") is None:
            raise ModuleNotFoundError(
                f"{printable(path)} needs a runtime: pip install 'torchrl-safe[export]', or "
                "onnxruntime alone."
            )
        import onnxruntime

        session = onnxruntime.InferenceSession(path)
        return lambda observation: session.run(["action"], {"observation": observation})[0]
    module = torch.export.load(path).module()
    return lambda observation: module(torch.from_numpy(observation)).detach().numpy()


def main(path: Path, robot: str, steps: int, seed: int) -> tuple[int, int]:
    """Drive one episode, and return how many goals were met and how many steps violated."""
    act = load(path)
    env = SafeRobotEnv(robot, num_envs=1, num_threads=1, seed=seed, episode_length=steps)
    td = env.reset()
    goals = violations = 0
    for _ in range(steps):
        td["action"] = torch.from_numpy(act(td["observation"].numpy()))
        td = env.step(td)["next"]
        goals += int(td["goal_met"])
        violations += int(td["violation"])
    print(f"{steps} steps: {goals} goals, {violations} steps inside a hazard")
    return goals, violations


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path)
    parser.add_argument("--robot", default="point")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    main(**vars(parser.parse_args()))
