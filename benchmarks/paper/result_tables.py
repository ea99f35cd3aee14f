"""The tables of ``docs/results.md`` and ``docs/experiments.md``, from the runs that are kept.

``benchmarks/write_pages.py`` puts them into the pages.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from statistics import fmean

from make_table import PAPER

RESULTS = Path(__file__).resolve().parents[1] / "results"

Run = Mapping[str, float]

POINT = {
    "safetac_k5": "SafeTAC, K = 5, q = 1.2",
    "safetac_k3": "SafeTAC, K = 3, q = 1.2",
    "safetac_q14": "SafeTAC, K = 1, q = 1.4",
    "safetac_q12": "SafeTAC, K = 1, q = 1.2",
    "safetac_q10": "SafeTAC, K = 1, q = 1",
    "safetac_lmbda0": "K = 1, q = 1, lambda = 0",
    "safetac_lagrangian": "K = 1, q = 1, Lagrange multiplier",
    "safetac_pid": "K = 1, q = 1, PID multiplier",
    "sac_lagrangian": "SAC-Lagrangian",
    "trc": "TRC",
    "wcsac": "WCSAC",
    "cpo": "CPO",
    "offpolicy_trc": "Off-policy TRC",
}
ROBOTS = {
    "safetac_q12": "SafeTAC, K = 1",
    "safetac_k5": "SafeTAC, K = 5, `moment_matched`",
    "safetac_k5_matched": "SafeTAC, K = 5, `matched_bound`",
    "trc": "TRC",
    "wcsac": "WCSAC",
    "cpo": "CPO",
}
BUDGET = {
    "safetac_k5/seed_0": "SafeTAC, K = 5, seed 0",
    "safetac_k5/seed_1": "SafeTAC, K = 5, seed 1",
    "safetac_k5/seed_2": "SafeTAC, K = 5, seed 2",
    "safetac_k5_hour/seed_0": "SafeTAC, K = 5, `optim.compile=true`",
    "safetac_k5_matched/seed_0": "SafeTAC, K = 5, `optim.kl=matched_bound`",
    "trc/seed_0": "TRC",
    "wcsac/seed_0": "WCSAC",
}
FRONTIER = {
    "safetac_q12": "SafeTAC, K = 1, q = 1.2",
    "sac_lagrangian": "SAC-Lagrangian",
    "trc": "TRC",
    "wcsac": "WCSAC",
    "cpo": "CPO",
}
RANDOMIZED = {
    "safetac_q12": "SafeTAC, K = 1, q = 1.2",
    "trc": "TRC",
    "wcsac": "WCSAC",
    "cpo": "CPO",
}


def seeds(folder: Path) -> list[Run]:
    """What came of each seed of a method."""
    return [json.loads(path.read_text()) for path in sorted(folder.glob("seed_*/results.json"))]


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown, the first column to the left and the others to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def mean(runs: Sequence[Run], name: str, digits: str) -> str:
    """Over seeds."""
    return format(fmean(run[name] for run in runs), digits)


def spread(runs: Sequence[Run], name: str, digits: str) -> str:
    """Mean, and lowest to highest seed in brackets where there are several."""
    values = [run[name] for run in runs]
    ends = f" ({min(values):{digits}} to {max(values):{digits}})" if len(values) > 1 else ""
    return mean(runs, name, digits) + ends


def pair(runs: Sequence[Run], kind: str = "eval/") -> str:
    """Score and violations per step."""
    return f"{mean(runs, kind + 'score', '.1f')} / {mean(runs, kind + 'cv_rate', '.4f')}"


def published(robot: str, method: str) -> str:
    """The paper's score and violations per step."""
    return "{:.4g} / {:.3f}".format(*PAPER[robot][method]) if method in PAPER[robot] else "-"


def level(curves: Path) -> float:
    """The quantity that is limited, in the last tenth of training."""
    with curves.open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row.get("update/constraint")]
    last = [row for row in rows if int(row["frames"]) > 0.9 * int(rows[-1]["frames"])]
    return fmean(float(row["update/constraint"]) for row in last)


def levels(folder: Path) -> str:
    """Of a method: lowest to highest seed."""
    values = [level(path) for path in sorted(folder.glob("seed_*/curves.csv"))]
    low, high = f"{min(values):.1f}", f"{max(values):.1f}"
    return low if low == high else f"{low} to {high}"


def methods(robot: str, names: Mapping[str, str]) -> str:
    """A row for each method on a robot."""
    rows = []
    for name, label in names.items():
        folder = RESULTS / "paper" / robot / name
        if not (runs := seeds(folder)):
            continue
        rows.append(
            [
                label,
                str(len(runs)),
                spread(runs, "eval/score", ".1f"),
                mean(runs, "eval/cv_rate", ".4f"),
                pair(runs, "eval/det/"),
                mean(runs, "eval/return", ".1f"),
                levels(folder),
                mean(runs, "total_cvs", ",.0f"),
                published(robot, name),
            ]
        )
    head = ["method", "seeds", "score", "CV", "deterministic", "return", "level"]
    return table([*head, "violations", "paper"], rows)


def draws() -> str:
    """The same three seeds, from two states of the code."""
    rows = []
    for label, folder in {
        "in the table": RESULTS / "paper" / "point" / "safetac_k5",
        "again": RESULTS / "draws",
    }.items():
        runs = seeds(folder)
        rows.append([label, *(pair([run]) for run in runs), pair(runs)])
    return table(["", "seed 0", "seed 1", "seed 2", "mean"], rows)


def claims() -> str:
    """What make_table.py has written of the paper's claims."""
    return (RESULTS / "paper" / "point" / "claims.md").read_text().strip()


def budget() -> str:
    """The long runs, each with the interval over its episodes."""
    rows = []
    for name, label in BUDGET.items():
        run = json.loads((RESULTS / "paper_budget" / name / "results.json").read_text())
        rows.append(
            [
                label,
                f"{run['frames']:,}",
                f"{run['eval/score']:.1f} ({run['eval/score_low']:.1f} to "
                f"{run['eval/score_high']:.1f})",
                f"{run['eval/cv_rate']:.4f}",
                pair([run], "eval/det/"),
                f"{run['eval/return']:.1f}",
                f"{run['total_cvs']:,}",
                published("point", name.partition("/")[0]),
            ]
        )
    head = ["run", "frames", "score (95 %)", "CV", "deterministic", "return", "violations"]
    return table([*head, "paper"], rows)


def marks(millions: Sequence[int] = (1, 2, 4, 6, 8, 10, 20)) -> str:
    """Evaluations of the long runs, each the mean of those in the half million frames before."""
    rows = []
    for name, label in BUDGET.items():
        with (RESULTS / "paper_budget" / name / "curves.csv").open(newline="") as file:
            evaluated = [row for row in csv.DictReader(file) if row["eval/score"]]
        cells = []
        for mark in millions:
            near = [row for row in evaluated if mark - 0.5 < int(row["frames"]) / 1e6 <= mark]
            runs = [{key: float(row[key]) for key in row if row[key]} for row in near]
            whole = near and int(evaluated[-1]["frames"]) >= 0.99e6 * mark
            cells.append(pair(runs) if whole else "")
        rows.append([label, *cells])
    return table(["million frames", *map(str, millions)], rows)


def frontier() -> str:
    """Each method under three limits."""
    rows = []
    for limit in ("2.5", "5", "10"):
        cells = []
        for name in FRONTIER:
            ending = "" if limit == "5" else f"_limit{limit}"
            runs = seeds(RESULTS / "paper" / "point" / (name + ending))
            cells.append(pair(runs) + (f" ({len(runs)} seeds)" if len(runs) > 1 else ""))
        rows.append([limit, *cells])
    return table(["limit", *FRONTIER.values()], rows)


def sim_to_real() -> str:
    """What table_2.py has written, with the methods' names."""
    lines = (RESULTS / "paper" / "jackal" / "table_2.md").read_text().splitlines()
    cells = {
        name.partition("_randomized")[0]: rest
        for name, *rest in (
            [cell.strip() for cell in line.strip("|").split("|")] for line in lines if "|" in line
        )
    }
    rows = [[label, *cells[name]] for name, label in RANDOMIZED.items()]
    return table(["", "deterministic", "sampled", "paper, real robot"], rows)


def nominal() -> str:
    """The same agents on the robot without randomisation."""
    rows = []
    for name, label in RANDOMIZED.items():
        runs = seeds(RESULTS / "paper" / "jackal" / f"{name}_randomized")
        paper = published("jackal", name)
        rows.append([label, pair(runs), mean(runs, "total_cvs", ",.0f"), paper])
    return table(["", "score / CV, sampled", "violations in training", "paper"], rows)


PARTS: dict[str, Callable[[], str]] = {
    "point": lambda: methods("point", POINT),
    "car": lambda: methods("car", ROBOTS),
    "doggo": lambda: methods("doggo", ROBOTS),
    "jackal": lambda: methods("jackal", ROBOTS),
    "draws": draws,
    "claims": claims,
    "budget": budget,
    "marks": marks,
    "frontier": frontier,
    "sim to real": sim_to_real,
    "nominal": nominal,
}
