"""Is the safety number true? What runs predicted, and what then happened on new layouts.

    python benchmarks/safety_number.py runs/safetac/point/seed_* --episodes 1000
    python benchmarks/safety_number.py

Measures each run's final policy and critic, and adds a row to
``benchmarks/results/safety_number/runs.csv``; then writes all rows into ``docs/safety_number.md``
and draws them into ``docs/images/safety_number.png``. The layouts are others than
those of training and of the run's evaluations. Predictions are those of the first 100 steps of an
episode, what followed them is summed over 400 steps more; actions are sampled, as in training.

``ratio`` is predicted over realised mean CVaR, over tenths of the predictions; ``lowest`` and
``highest`` are the tenths that are furthest off. Within a tenth states differ, so that the worst
eighth of its outcomes costs more than the states' own worst eighths: a critic that is right shows
.95 to 1.0 here. ``level`` is the mean of ``update/cost_level`` over the last tenth of training.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from matplotlib.figure import Figure
from torchrl.envs.utils import ExplorationType

from torchrl_safe.record import calibrate, evaluate, read_metrics, summarize
from torchrl_safe.record.metrics import acting
from torchrl_safe.trainers.commands import env_maker
from torchrl_safe.trainers.commands.evaluate import load
from torchrl_safe.trainers.saved import from_newest
from torchrl_safe.trainers.streams import stream_seed

PAGE = Path(__file__).parents[1] / "docs" / "safety_number.md"
MARK = "<!-- From here on written by benchmarks/safety_number.py. -->"
PICTURE = Path(__file__).parents[1] / "docs" / "images" / "safety_number.png"
TABLE = Path(__file__).parent / "results" / "safety_number" / "runs.csv"
JUDGED, FOLLOWED = 100, 400  # steps
COLUMNS = {
    "run": "run",
    "limit": "limit",
    "level": "level",
    "ratio": "ratio",
    "lowest": "lowest",
    "highest": "highest",
    "score": "score",
    "score_det": "det.",
    "cost": "cost",
    "cv": "CV",
    "p99": "p99",
    "no_goal": "rests",
    "total_cvs": "violations",
}


def measure(run_dir: Path, episodes: int) -> dict[str, str | float]:
    """The row of a run."""
    make = env_maker(None, trust=False)
    options, policy, losses = from_newest(run_dir, partial(load, make=make))
    (loss,) = losses.values()
    seed = stream_seed("safety number", 9)
    envs = make(options, episodes, seed, episode_length=options.eval.num_steps)
    with acting(ExplorationType.RANDOM):
        envs.set_seed(seed)
        torch.manual_seed(seed)
        steps = envs.rollout(JUDGED + FOLLOWED, policy, break_when_any_done=False)
        mean, _ = loss.predict(steps, steps["action"])
        cvar = loss.cvar(steps, steps["action"])
    gamma = float(loss.value_estimator.gamma)
    bins = calibrate(
        mean,
        cvar,
        steps["next", "cost"].squeeze(-1),
        gamma=gamma,
        risk_level=loss.risk_level,
        tail=gamma**FOLLOWED + 1e-9,
    )
    predicted, realised = bins["predicted_cvar"], bins["realised_cvar"]
    shares = predicted / realised
    played = {
        kind.name: evaluate(
            envs,
            policy,
            num_steps=options.eval.num_steps,
            exploration_type=kind,
            seed=seed,
            cost_gamma=gamma,
        )
        for kind in (ExplorationType.RANDOM, ExplorationType.DETERMINISTIC)
    }
    envs.close()
    sampled, det = (summarize(episodes, "") for episodes in played.values())
    log = read_metrics(run_dir / "log")
    frames, levels = log["update/cost_level"]
    return {
        "run": f"{options.env.robot} {options.safety_critic.kind} {options.seed}",
        "limit": options.loss.cost_limit,
        "level": levels[frames > 0.9 * frames[-1]].mean(),
        "ratio": (predicted.mean() / realised.mean()).item(),
        "lowest": shares.min().item(),
        "highest": shares.max().item(),
        "score": sampled["score"],
        "score_det": det["score"],
        "cost": sampled["discounted_cost"],
        "cv": sampled["cv_rate"],
        "p99": sampled["violations_p99"],
        "no_goal": (played["RANDOM"]["goals"] == 0).double().mean().item(),
        "total_cvs": log["train/total_cvs"][1][-1],
        "frames": float(frames[-1]),
        "episodes": float(episodes),
        "commit": commit(run_dir),
        "predicted": " ".join(f"{value:.4g}" for value in predicted.tolist()),
        "realised": " ".join(f"{value:.4g}" for value in realised.tolist()),
    }


def commit(run_dir: Path) -> str:
    """Of the code that trained the run, where it noted it."""
    for line in (run_dir / "history.jsonl").read_text().splitlines():
        if found := json.loads(line).get("commit"):
            return str(found)
    return ""


def draw(rows: Sequence[dict[str, str]]) -> None:
    """Predicted beside realised CVaR, a line for each run, one panel for each kind of critic."""
    kinds = {"gaussian": "Gaussian, Retrace", "quantiles": "quantiles, recalibrated"}
    figure = Figure(figsize=(9, 4.4), layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, (kind, title) in zip(panels, kinds.items(), strict=True):
        axes.plot([0, 25], [0, 25], color="#999999", ls="--", lw=1)
        for row in rows:
            if row["run"].startswith(f"point {kind}") and float(row["limit"]) == 5.0:
                points = (
                    [float(x) for x in row[name].split()] for name in ("predicted", "realised")
                )
                axes.plot(*points, "o-", ms=3, lw=1, color="#0072B2", alpha=0.7)
        axes.set(title=title, xlabel="predicted CVaR", xlim=(0, 25), ylim=(0, 25))
        axes.grid(alpha=0.25)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("realised on new layouts")
    figure.savefig(PICTURE, dpi=130)


def table(rows: Sequence[dict[str, str]]) -> str:
    """The rows as a table, kinds together."""
    rows = sorted(rows, key=lambda row: (float(row["limit"]) != 5.0, row["run"]))
    lines = [
        "| " + " | ".join(COLUMNS.values()) + " |",
        "|---" + "|---:" * (len(COLUMNS) - 1) + "|",
    ]
    for row in rows:
        cells = [row["run"], *(number(float(row[name])) for name in list(COLUMNS)[1:])]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def number(value: float) -> str:
    """Four digits, and all of a large whole number."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def main() -> None:
    """Measure, keep, and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="*")
    parser.add_argument("--episodes", type=int, default=1000)
    arguments = parser.parse_args()
    for run_dir in arguments.runs:
        row = measure(run_dir, arguments.episodes)
        new = not TABLE.exists()
        TABLE.parent.mkdir(parents=True, exist_ok=True)
        with TABLE.open("a", newline="") as file:
            writer = csv.DictWriter(file, list(row), lineterminator="\n")
            if new:
                writer.writeheader()
            writer.writerow(row)
    with TABLE.open(newline="") as file:
        rows = list(csv.DictReader(file))
    PAGE.write_text(PAGE.read_text().partition(MARK)[0] + f"{MARK}\n\n{table(rows)}\n")
    draw(rows)


if __name__ == "__main__":
    main()
