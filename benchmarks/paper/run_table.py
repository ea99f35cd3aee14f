"""Runs the missing cells of one of the paper's tables, two at a time.

    python benchmarks/paper/run_table.py table_1 --robots point car --seeds 0 1 2
    python benchmarks/paper/run_table.py table_3 --seeds 0 1 2 --set collector.total_frames=1000000
    python benchmarks/paper/run_table.py frontier --seeds 0
    python benchmarks/paper/run_table.py table_2 --robots jackal
    python benchmarks/paper/run_table.py table_1 --dry-run

A cell is a method, a robot and a seed. Finished cells are skipped; an interrupted one goes on from
its checkpoint, so that the same command can be given again after any stop. Ctrl-C saves all cells
that are running. Hydra's multirun restarts every job of a sweep and its joblib launcher saw its
last release in 2022, so that cells are processes of their own here.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))
from side_by_side import Job, run_jobs

ROOT = Path(__file__).parents[2]

# The paper's method: a Gaussian safety critic, no mirror, no correction of the limit, which starts
# at 15 also where it ends at another one than the default.
FALLING = (
    "safetac_point",
    "safety_critic.kind=gaussian",
    "optim.mirror=false",
    "loss.limit_gain=0",
    "loss.initial_cost_limit=15",
)
SAFETAC = (*FALLING, "policy.num_components=1")
MIXTURE = (*FALLING, "loss.entropic_index=1.2")
# A limit that falls starves a multiplier, so theirs is the same throughout.
MULTIPLIER = (*SAFETAC, "loss.entropic_index=1.0", "loss.initial_cost_limit=${loss.cost_limit}")
METHODS: dict[str, tuple[str, ...]] = {
    "safetac_q14": (*SAFETAC, "loss.entropic_index=1.4"),
    "safetac_q12": (*SAFETAC, "loss.entropic_index=1.2"),
    "safetac_q10": (*SAFETAC, "loss.entropic_index=1.0"),
    "trc": ("trc",),
    "offpolicy_trc": ("offpolicy_trc",),
    "wcsac": ("wcsac",),
    "sac_lagrangian": ("sac_lagrangian",),
    "cpo": ("cpo",),
    "safetac_k3": (*MIXTURE, "policy.num_components=3", "optim.kl=moment_matched"),
    "safetac_k5": (*MIXTURE, "policy.num_components=5", "optim.kl=moment_matched"),
    "safetac_k5_matched": (*MIXTURE, "policy.num_components=5", "optim.kl=matched_bound"),
    "safetac_lmbda0": (*SAFETAC, "loss.entropic_index=1.0", "loss.lmbda=0"),
    "safetac_lagrangian": (*MULTIPLIER, "update=lagrangian"),
    "safetac_pid": (*MULTIPLIER, "update=pid"),
}
"""Script and overrides of each method; names are those of the folders in ``runs/paper``."""

EPISODE = "env.episode_length=250"
"""Of the paper's tables, where the default came to be shorter."""

LIMITS = (2.5, 10)
"""Cost limits of the frontier, beside the default that the other tables have."""

TABLES: dict[str, Sequence[str]] = {
    "table_1": [
        *("safetac_q14", "safetac_q12", "safetac_q10", "trc", "offpolicy_trc"),
        *("wcsac", "sac_lagrangian", "cpo"),
    ],
    "table_2": ["safetac_q12", "trc", "wcsac", "cpo"],
    "table_3": [
        *("safetac_q12", "safetac_k3", "safetac_k5", "safetac_k5_matched", "safetac_q10"),
        *("safetac_lmbda0", "safetac_lagrangian", "safetac_pid"),
    ],
    "frontier": ["safetac_q12", "trc", "wcsac", "sac_lagrangian", "cpo"],
}


class Cell(NamedTuple):
    """A run: its folder below the results' folder, its script and its overrides."""

    folder: Path
    script: str
    overrides: tuple[str, ...]


def cells(
    table: str, robots: Sequence[str], seeds: Sequence[int], methods: Sequence[str] | None = None
) -> list[Cell]:
    """All cells of a table, seed by seed: a table with few seeds is complete as early as it can."""
    variants: dict[str, tuple[str, ...]] = {"": ()}
    if table == "frontier":
        variants = {f"_limit{limit}": (f"loss.cost_limit={limit}",) for limit in LIMITS}
    elif table == "table_2":
        variants = {"_randomized": ("env.randomization=jackal_training",)}
    out = []
    for seed in seeds:
        for robot in robots:
            for method in methods or TABLES[table]:
                script, *overrides = METHODS[method]
                for suffix, more in variants.items():
                    options = (*overrides, *more, EPISODE, f"env.robot={robot}", f"seed={seed}")
                    folder = Path(robot, method + suffix, f"seed_{seed}")
                    out.append(Cell(folder, script, options))
    return out


def job(cell: Cell, root: Path, extra: Sequence[str]) -> Job:
    """What runs a cell, or goes on with it."""
    script = ROOT / "examples" / f"{cell.script}.py"
    line = (sys.executable, str(script), *cell.overrides, *extra)
    return Job(str(cell.folder), root / cell.folder, line)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the cells; the exit status is the number of those that failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("table", choices=TABLES)
    parser.add_argument("--robots", nargs="+", default=["point"])
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--methods", nargs="+", choices=METHODS, help="only these")
    parser.add_argument("--set", nargs="+", default=[], help="overrides for all cells")
    parser.add_argument("--root", type=Path, default=ROOT / "runs" / "paper")
    parser.add_argument("--jobs", type=int, default=2, help="cells at a time")
    parser.add_argument("--dry-run", action="store_true", help="print the commands")
    args = parser.parse_args(argv)

    extra = ["num_threads=1", "video.num_steps=0", *args.set]
    jobs = [
        job(cell, args.root, extra)
        for cell in cells(args.table, args.robots, args.seeds, args.methods)
    ]
    for each in jobs:
        print(f"{'finished' if each.finished else 'to run':10}{each.name}")
    if args.dry_run:
        for each in jobs:
            if not each.finished:
                print(shlex.join(each.line()))
        return 0
    return run_jobs(jobs, args.jobs)


if __name__ == "__main__":
    sys.exit(main())
