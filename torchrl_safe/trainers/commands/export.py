"""The policy of a run as one file, for a robot that has neither this library nor its configuration.

torchrl-safe export runs/safetac_point/seed_0           # policy.pt2: needs torch to run
torchrl-safe export runs/safetac_point/seed_0 --onnx    # policy.onnx: needs an ONNX runtime
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tensordict import TensorDictBase

from torchrl_safe._files import expand, printable
from torchrl_safe.modules import export_policy
from torchrl_safe.trainers.commands import add_env_arguments, env_maker
from torchrl_safe.trainers.options import MethodOptions
from torchrl_safe.trainers.saved import from_newest
from torchrl_safe.trainers.saved_policies import Policy, saved_policy
from torchrl_safe.trainers.terminal import say


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of :func:`main`."""
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--onnx", action="store_true", help="as an ONNX file")
    add_env_arguments(parser)


def main(run_dir: Path, onnx: bool = False, env: str | None = None, trust: bool = False) -> Path:
    """Write the file into the run's folder.

    Args:
        run_dir (path): the run's folder.
        onnx (bool): whether it is an ONNX file, in place of torch's.
        env (str, optional): ``module:function`` that makes the environment.
        trust (bool): whether functions that the run's options name may be imported.

    Returns:
        Path: the file.
    """
    make = env_maker(env, trust)

    def load(options: MethodOptions, checkpoint: Path) -> tuple[Policy, TensorDictBase]:
        """The policy of a checkpoint, and an observation."""
        return saved_policy(options, checkpoint, make), make(options, 1, seed=0).reset()

    policy, example = from_newest(run_dir, load)
    path = expand(run_dir) / ("policy.onnx" if onnx else "policy.pt2")
    export_policy(policy, path, example)
    say(printable(path))
    return path
