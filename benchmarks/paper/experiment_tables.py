"""The tables of ``docs/experiments.md`` and its kin, from the curves that are kept.

``benchmarks/write_pages.py`` puts them into the pages.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean

from prediction_error import prediction_error
from result_tables import RESULTS, level, mean, pair, seeds, spread, table

SWEEP = RESULTS / "sweep"
Curves = list[dict[str, float]]

TARGETS = {
    "lag": "once per update; variance reward as in (18)",
    "td_error": "once per update; variance reward is the squared TD error",
    "rounds": "eight times per update",
}
EPISODES = {
    "rounds": "200 x 20, episodes of 200",
    "envs400_len500": "400 x 10, 500",
    "envs1000_len1000": "1,000 x 4, 1,000",
    "envs1000_level": "1,000 x 4, 1,000, level measured",
    "base": "400 x 20, 250, level measured",
    "level_recovery95": "as `base`, 200 steps, `recovery_ratio` .95",
    "len1000": "as `base`, 1,000",
    "mixed_lengths": "as `base`, half 250, half 1,000",
    "max_kl_001": "as `base`, 500, `max_kl` .01",
    "half_critics": "as `base`, 8,000 transitions a round",
    "limit3": "as `base`, limit 3",
    "len1000_alpha0003": "as `len1000`, alpha .003",
}
LENGTHS = {
    "short_only": "250 steps",
    "base_then_len1000": "`base`, then 1,000 steps",
    "late_long": "the same on newer code",
    "shrinking_seed0": "also, `max_kl` falls from .02 to .005",
    "shrinking_seed1": "the same, seed 1",
}
FALLING = {
    "rounds8_seed0": "limit 15 to 5",
    "rounds8_seed1": "the same, seed 1",
    "anneal_15_to_5": "on older code",
    "anneal_15_to_5_then_7": "its run continued at limit 7",
    "anneal_15_to_5_then_7_gamma_997": "continued with `loss.gamma=0.997`",
    "gamma_997": "`loss.gamma=0.997` from the start",
    "gamma_997_len500": "also, 500 steps",
    "gamma_997_len125": "also, 125 steps",
    "gamma_997_4000_frames": "also, 4,000 frames per update",
    "implicit": "implicit gradients, one component",
    "unconstrained": "`loss.cost_limit=1000`",
}
CRITICS = {
    "../point/seed_0/curves": "16 rounds of 15,000, seed 0",
    "../point/seed_1/curves": "seed 1",
    "../point/seed_2/curves": "seed 2",
    "rounds8_seed0": "8 rounds, seed 0",
    "rounds8_seed1": "8 rounds, seed 1",
    "rounds32_seed0": "32 rounds, seed 0",
    "rounds16_half_frames": "16 rounds of 7,500",
    "rounds16_half_minibatch_seed0": "also, minibatches of 512, seed 0",
    "rounds16_half_minibatch_seed1": "seed 1",
    "cells64": "critics of 64 x 64",
    "cells96": "critics of 96 x 96",
    "cells256": "critics of 256 x 256, 8 rounds",
    "one_qvalue_two_passes_seed0": "one reward critic, two passes, seed 0",
    "one_qvalue_two_passes_seed1": "seed 1",
}
RENEWALS = {"rounds2_lmbda0.97": "lambda .97", "rounds2_lmbda0": "lambda 0"}
POINT_GOAL = {
    "pieces_61": "125 steps",
    "pieces_limit_12_71": "125 steps, limit 12",
    "pieces_250_limit_16_71": "250 steps, limit 16",
    "whole_61": "whole",
    "standardized_71": "whole, observations standardised",
    "standardized_mirror_71": "the same, with the mirror image",
}
LINEAGE = {
    "lineage_like_600k": "the lineage's setting",
    "../long/seed_0/curves": "400 environments, seed 0",
    "../long/seed_1/curves": "seed 1",
    "../long/seed_2/curves": "seed 2",
}
MULTIPLIERS = {
    "safetac_lagrangian_falling_limit": "Lagrange multiplier",
    "safetac_pid_falling_limit": "PID multiplier",
    "sac_lagrangian_falling_limit": "SAC-Lagrangian",
    "wcsac_falling_limit": "WCSAC",
    "cpo_falling_limit": "CPO",
    "trc_falling_limit_seed0": "TRC, seed 0",
    "trc_falling_limit_seed1": "TRC, seed 1",
}
BASELINES = {
    "cpo_a": "limit 5 throughout, 100 environments, 20,000 frames, `lmbda` .97, damping .01",
    "cpo_b": "and damping .1",
    "cpo_c": "400 environments, `lmbda` .5, damping 1, `max_kl` .01",
    "cpo_d": "400 environments, 40,000 frames, `lmbda` .9, damping .1",
    "cpo_e": "and a policy of 64 and 32 units",
    "cpo_f": "20,000 frames, `lmbda` .9, damping .1, limit 2.5",
    "sac_lagrangian_fast_multiplier": "limit 5 throughout, `lagrangian.lr=0.2`",
    "sac_lagrangian_falling_limit_fast_multiplier": "limit falling from 15",
}
SOFT = {
    ("5", "`implicit`"): "paper/point/safetac_k5",
    ("5", "`gumbel_softmax`"): "soft_draws/k5",
    ("3", "`implicit`"): "paper/point/safetac_k3",
    ("3", "`gumbel_softmax`"): "soft_draws/k3",
    ("1", "the same"): "paper/point/safetac_q12",
}
DISTANCES = {
    "safetac_q12": ("1", "the same"),
    "safetac_k5": ("5", "`moment_matched`"),
    "safetac_k5_matched": ("5", "`matched_bound`"),
}


def curves(path: Path) -> Curves:
    """The rows of a file of curves, without what was not logged."""
    with path.open(newline="") as file:
        return [
            {name: float(value) for name, value in row.items() if value}
            for row in csv.DictReader(file)
        ]


def windows(names: Mapping[str, str]) -> str:
    """Return and CV in training over two windows of frames, and violations at the first's end."""
    rows = []
    for name, label in names.items():
        logged = curves(SWEEP / f"{name}.csv")
        cells = []
        for first, last in ((120e3, 176e3), (176e3, 300e3)):
            part = [row for row in logged if first < row["frames"] <= last]
            part = [row for row in part if "train/reward_per_1000" in row]
            enough = part and logged[-1]["frames"] >= first + 0.4 * (last - first)
            returns, violations = (
                fmean(row[key] for row in part) if enough else 0.0
                for key in ("train/reward_per_1000", "train/cv_rate")
            )
            cells.append(f"{returns:.1f} / {violations:.3f}" if enough else "")
        so_far = [row["train/total_cvs"] for row in logged if row["frames"] <= 176e3]
        cells.append(f"{so_far[-1]:,.0f}" if cells[0] else "")
        rows.append([f"`{name}`", label, *cells])
    head = ["run", "", "120,000 to 176,000 frames", "to 300,000", "violations at 176,000"]
    return table(head, rows)


def evaluations(names: Mapping[str, str], thousands: Sequence[int]) -> str:
    """Score / CV of sampled actions at frame counts."""
    rows = []
    for name, label in names.items():
        evaluated = [row for row in curves(SWEEP / f"{name}.csv") if "eval/score" in row]
        cells = []
        for mark in thousands:
            near = [row for row in evaluated if abs(row["frames"] - 1e3 * mark) <= 20e3]
            cells.append(pair(near[-1:]) if near else "")
        rows.append([label, *cells])
    return table(["thousand frames", *(f"{mark:,}" for mark in thousands)], rows)


def ends(names: Mapping[str, str]) -> str:
    """The last evaluation of runs, and the level of their last tenth."""
    rows = []
    for name, label in names.items():
        last = [row for row in curves(SWEEP / f"{name}.csv") if "eval/score" in row][-1]
        cells = [f"{last['frames']:,.0f}", pair([last]), pair([last], "eval/det/")]
        rows.append([f"`{name}`", label, *cells, f"{level(SWEEP / f'{name}.csv'):.1f}"])
    head = ["run", "", "frames", "score / CV, sampled", "deterministic", "level at the end"]
    return table(head, rows)


def finals(folder: Path) -> str:
    """The final evaluation of each seed, with intervals over its episodes."""
    rows = []
    for number, run in enumerate(seeds(folder)):
        rows.append(
            [
                f"seed {number}",
                f"{run['eval/score']:.1f} ({run['eval/score_low']:.1f} to "
                f"{run['eval/score_high']:.1f})",
                f"{run['eval/cv_rate']:.4f}",
                f"{run['eval/det/score']:.1f} ({run['eval/det/score_low']:.1f} to "
                f"{run['eval/det/score_high']:.1f})",
                f"{run['eval/det/cv_rate']:.4f}",
                f"{run['eval/return']:.1f}",
                f"{run['total_cvs']:,}",
            ]
        )
    head = ["", "score, sampled", "CV", "deterministic", "CV", "return", "violations in training"]
    return table(head, rows)


def soft_draws() -> str:
    """Implicit gradients beside soft draws."""
    rows = []
    for (components, relaxation), name in SOFT.items():
        folder = RESULTS / name
        runs = seeds(folder)
        entropies = [
            min(row["train/entropy"] for row in curves(path) if "train/entropy" in row)
            for path in sorted(folder.glob("seed_*/curves.csv"))
        ]
        rows.append(
            [
                components,
                relaxation,
                str(len(runs)),
                spread(runs, "eval/score", ".1f"),
                mean(runs, "eval/cv_rate", ".4f"),
                pair(runs, "eval/det/"),
                f"{min(entropies):.1f}",
            ]
        )
    head = ["components", "`policy.relaxation`", "seeds", "score", "CV", "deterministic"]
    return table([*head, "least entropy"], rows)


def distances() -> str:
    """How well the linear model of the constraint predicts, under each distance."""
    rows = []
    for robot in ("point", "car", "doggo", "jackal"):
        for name, (components, distance) in DISTANCES.items():
            folder = RESULTS / "paper" / robot / name / "seed_0"
            if robot == "point" and name == "safetac_k5_matched":
                logged = curves(SWEEP / "matched_bound.csv")
                evaluated = [row for row in logged if "eval/score" in row][-1:]
                error, entropy = prediction_error(SWEEP / "matched_bound.csv")
            else:
                evaluated = seeds(folder.parent)[:1]
                error, entropy = prediction_error(folder / "curves.csv")
            rows.append(
                [
                    robot.capitalize(),
                    components,
                    distance,
                    f"{error:.0%}",
                    f"{entropy:.1f}",
                    pair(evaluated),
                    pair(evaluated, "eval/det/"),
                ]
            )
    head = ["robot", "components", "`optim.kl`", "error of the prediction", "least entropy"]
    return table([*head, "score / CV", "deterministic"], rows)


def retrace_sac() -> str:
    """TorchRL's SAC with either estimator: return of the episodes that ended, seed by seed."""
    rows = []
    for first in (1000, 2000, 3000):
        cells = []
        for name in ("retrace", "td0"):
            parts = [
                [
                    row["train_return"]
                    for row in curves(path)
                    if first < row["frames"] <= first + 1e3
                ]
                for path in sorted((RESULTS / "retrace_sac" / name).glob("seed_*.csv"))
            ]
            cells.append(", ".join(f"{fmean(part):.1f}" for part in parts))
        rows.append([f"{first:,} to {first + 1000:,}", *cells])
    return table(["frames", "Retrace", "TD(0)"], rows)


def point_goal() -> str:
    """Runs on SafetyPointGoal1: how fast they learn, and where they end."""
    rows = []
    for name, title in POINT_GOAL.items():
        folder = RESULTS / "point_goal1" / name
        early = [
            row["train/reward_per_1000"]
            for row in curves(folder / "curves.csv")
            if 100_000 < row["frames"] <= 200_000
        ]
        ends = json.loads((folder / "results.json").read_text())
        sampled, certain = (
            f"{ends[f'{kind}return']:.1f} / {ends[f'{kind}cost']:.1f}"
            for kind in ("eval/", "eval/det/")
        )
        rows.append([title, f"{fmean(early):.1f}", sampled, certain])
    head = ["episodes in training", "return at 100,000 to 200,000 frames", "return / cost", "det."]
    return table(head, rows)


PARTS: dict[str, Callable[[], str]] = {
    "log targets": lambda: windows(TARGETS),
    "log episodes": lambda: windows(EPISODES),
    "log lengths": lambda: evaluations(LENGTHS, (200, 400, 600, 800, 1000)),
    "log falling limit": lambda: evaluations(FALLING, (400, 800, 1200, 1600, 2000, 2400)),
    "log critics": lambda: evaluations(CRITICS, (600, 800, 1000, 1200, 1400, 1600)),
    "log renewals": lambda: evaluations(RENEWALS, (600, 800, 1000)),
    "log multipliers": lambda: evaluations(MULTIPLIERS, (600, 800, 1000)),
    "log lineage": lambda: evaluations(LINEAGE, (600,)),
    "log baselines": lambda: ends(BASELINES),
    "log point": lambda: finals(RESULTS / "point"),
    "log long": lambda: finals(RESULTS / "long"),
    "retrace sac": retrace_sac,
    "log soft draws": soft_draws,
    "log distances": distances,
    "log point goal": point_goal,
}
