"""Plays trained Jackals on a robot that no training environment was: Table II's sim-to-real.

    python benchmarks/paper/run_table.py table_2 --robots jackal
    python benchmarks/paper/table_2.py runs/paper/jackal benchmarks/results/paper/jackal

Ten episodes of each run in ``<method>_randomized/seed_<n>`` on ``JACKAL_REAL``, by
``torchrl-safe evaluate``. The paper drove a real robot, and this is not one.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchrl_safe.trainers.commands import evaluate

NUM_EPISODES = 10
SUFFIX = "_randomized"
PAPER = {  # reward, violations, failures in ten episodes
    "safetac_q12": (21.403, 20.7, 0),
    "trc": (10.217, 10.0, 0),
    "wcsac": (1.900, 0.0, 0),
    "cpo": (7.381, 616.1, 8),
}


def table(results: Mapping[str, Mapping[str, float]]) -> str:
    """A row per run: reward, violations per episode, failures; the paper's beside."""
    head = ["run", "deterministic", "sampled", "paper"]
    lines = [
        "Reward / violations per episode / episodes that failed, of ten.\n",
        "| " + " | ".join(head) + " |",
        "|---" * len(head) + "|",
    ]
    for run, metrics in results.items():
        cells = [run]
        for prefix in ("det/", "sampled/"):
            failures = round(metrics[f"{prefix}failure_rate"] * NUM_EPISODES)
            reward, violations = (metrics[prefix + name] for name in ("return", "violations"))
            cells.append(f"{reward:.3g} / {violations:.1f} / {failures}")
        method = run.partition(SUFFIX)[0]
        cells.append("{:.3g} / {:.1f} / {}".format(*PAPER[method]) if method in PAPER else "-")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def main(argv: Sequence[str] | None = None) -> None:
    """Play, and write ``table_2.md``."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("root", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args(argv)
    runs = sorted(path.parent for path in args.root.glob(f"*{SUFFIX}/seed_*/results.json"))
    if not runs:
        parser.error(f"root={args.root} has no <method>{SUFFIX}/seed_<n>/results.json.")
    results = {
        f"{run.parent.name}, {run.name}": evaluate.main(
            run, NUM_EPISODES, seed=evaluate.SEED, film=False, randomization="jackal_real"
        )
        for run in runs
    }
    args.out.mkdir(parents=True, exist_ok=True)
    text = table(results)
    (args.out / "table_2.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
