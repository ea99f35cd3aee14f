"""Runs every example on a tiny budget, each into a folder of its own.

    python tests/reliability/determinism.py FOLDER

With the same seeds, every number of two such folders must be the same but for times.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

TESTS = Path(__file__).parents[1]
sys.path[:0] = [
    str(TESTS.parent / "examples"),
    str(TESTS.parent / "benchmarks"),
    *(str(TESTS / name) for name in ("trainers", "benchmarks", "reliability")),
]

import compose_constraint  # noqa: E402
import compose_retrace  # noqa: E402
import compose_trpo  # noqa: E402
import compose_tsallis  # noqa: E402
import numpy as np  # noqa: E402
import retrace_sac  # noqa: E402
import test_doggo_controller as doggo  # noqa: E402
import test_methods as methods  # noqa: E402
import tiny  # noqa: E402
import torch  # noqa: E402
from safetensors.numpy import load_file  # noqa: E402
from torchrl.envs import TransformedEnv  # noqa: E402
from torchrl.modules import MLP  # noqa: E402

from torchrl_safe import GMMTanhPolicy  # noqa: E402
from torchrl_safe.record import read_metrics  # noqa: E402
from torchrl_safe.trainers import cli  # noqa: E402

ENDS = ("terminated", "truncated", "running")
TIMES = {"seconds", "frames_per_second"}
SAFETAC = ["collector.total_frames=300", "lagrangian.minibatch_size=50"]
# Two updates; one evaluation and one checkpoint, in the end.
SHORT = ["collector.total_frames=800", "eval.interval=10000", "checkpoint.interval=10000"]


def baseline(name: str, folder: Path) -> None:
    method, overrides, _ = methods.CASES[name]
    methods.launch(method, folder, *overrides, *SHORT)


def run_retrace_sac(folder: Path) -> None:
    overrides = [
        f"run_dir={folder}",
        "collector.total_frames=300",
        "collector.init_frames=200",
        "replay_buffer.batch_size=32",
        "optim.updates_per_frame=0.05",
        "eval.interval=300",
        "eval.num_episodes=1",
    ]
    retrace_sac.main(cli.compose("retrace_sac", overrides))


def keep_episodes(train: Callable[..., list[tuple[int, float]]], folder: Path) -> None:
    episodes = train(seed=0, total_frames=1_100)
    folder.mkdir()
    (folder / "episodes.json").write_text(json.dumps(episodes))


def run_compose_trpo(folder: Path, limit: float | None = None) -> None:
    torch.manual_seed(0)
    env = compose_trpo.make_env(seed=0)
    policy = GMMTanhPolicy(MLP(3, 3, num_cells=[64, 64]), env.action_spec, num_components=1)
    if limit is None:
        stepper = compose_trpo.TRPOStepper(policy)
    else:
        env = TransformedEnv(env, compose_constraint.SpeedCost())
        stepper = compose_constraint.ConstrainedStepper(policy, limit)
    compose_trpo.make_trainer(env, stepper, 6_400, str(folder)).train()


CASES: dict[str, Callable[[Path], None]] = {
    "safetac": lambda folder: tiny.launch(folder, *SAFETAC),
    "safetac lagrangian": lambda folder: tiny.launch(folder, "update=lagrangian", *SAFETAC),
    "safetac pid": lambda folder: tiny.launch(folder, "update=pid", *SAFETAC),
    **{name: partial(baseline, name) for name in methods.CASES if not name.startswith("safetac")},
    "doggo_controller": doggo.launch,
    "retrace_sac": run_retrace_sac,
    "compose_tsallis": partial(keep_episodes, partial(compose_tsallis.train, entropic_index=1.4)),
    "compose_retrace": partial(keep_episodes, partial(compose_retrace.train, lmbda=0.9)),
    "compose_trpo": run_compose_trpo,
    "compose_constraint": partial(run_compose_trpo, limit=0.05),
    # Not one more example: what shows that a number can differ at all.
    "another seed": lambda folder: tiny.launch(folder, "seed=1", *SAFETAC),
}


def numbers(folder: Path) -> dict[str, np.ndarray]:
    """All that an example has logged or written as its result, but for times."""
    found = {}
    if (folder / "log").exists():
        for name, (steps, values) in read_metrics(folder / "log").items():
            # TorchRL's trainer times its hooks, in a table of the process that every logger reads.
            if not name.startswith(("time/", "hook/")):
                found |= {f"{name}, steps": steps, name: values}
    if (folder / "results.json").exists():
        results = json.loads((folder / "results.json").read_text())
        episodes = results.pop("episodes")
        found |= {n: np.array(v, float) for n, v in results.items() if n not in TIMES}
        for kind, played in episodes.items():
            for each in played:
                each["end"] = ENDS.index(each["end"])
            for name in played[0]:
                found[f"{kind}episodes, {name}"] = np.array([each[name] for each in played])
    if (folder / "curves.csv").exists():
        table = np.genfromtxt(folder / "curves.csv", delimiter=",", names=True)
        found |= {name: table[name] for name in table.dtype.names if name not in TIMES}
    if (folder / "episodes.json").exists():
        found["episodes"] = np.array(json.loads((folder / "episodes.json").read_text()))
    for file in folder.glob("*.safetensors"):
        found |= load_file(file)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--backwards", action="store_true", help="the last example first")
    args = parser.parse_args()
    for case in sorted(CASES, reverse=args.backwards):
        CASES[case](args.folder / case)
