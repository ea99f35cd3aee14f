"""The policy of a run as one file, for a robot that has neither this library nor its configuration.

python examples/export.py runs/safetac_point/seed_0           # policy.pt2: needs torch to run
python examples/export.py runs/safetac_point/seed_0 --onnx    # policy.onnx: needs an ONNX runtime
"""

from __future__ import annotations

import argparse
from pathlib import Path

from utils import load_policy, load_run, make_env

from torchrl_safe.modules import export_policy


def main(run_dir: Path, onnx: bool) -> Path:
    """Write the file into the run's folder."""
    cfg, _ = load_run(run_dir)
    path = run_dir.expanduser() / ("policy.onnx" if onnx else "policy.pt2")
    export_policy(load_policy(run_dir), path, make_env(cfg, num_envs=1, seed=0).reset())
    print(path)
    return path


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run_dir", type=Path)
    parser.add_argument("--onnx", action="store_true")
    main(**vars(parser.parse_args()))
