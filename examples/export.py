"""The policy of a run as one file, for a robot that has neither this library nor its configuration.

python examples/export.py runs/safetac_point/seed_0           # policy.pt2: needs torch to run
python examples/export.py runs/safetac_point/seed_0 --onnx    # policy.onnx: needs an ONNX runtime
"""

from __future__ import annotations

import argparse
from pathlib import Path

from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl_safe.trainers.utils import make_env, saved_policy

from torchrl_safe import GMMTanhPolicy
from torchrl_safe._files import expand, printable
from torchrl_safe.modules import export_policy
from torchrl_safe.trainers.saved import from_newest


def load(cfg: DictConfig, checkpoint: Path) -> tuple[GMMTanhPolicy, TensorDictBase]:
    """The policy of a checkpoint, and an observation."""
    return saved_policy(cfg, checkpoint), make_env(cfg, num_envs=1, seed=0).reset()


def main(run_dir: Path, onnx: bool) -> Path:
    """Write the file into the run's folder."""
    policy, example = from_newest(run_dir, load)
    path = expand(run_dir) / ("policy.onnx" if onnx else "policy.pt2")
    export_policy(policy, path, example)
    print(printable(path))
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--onnx", action="store_true")
    main(**vars(parser.parse_args()))
