"""Others' trainings and simulators beside ours, on one machine, in turns: a Markdown table.

    python benchmarks/peers/run.py                      # half an hour; a venv in runs/peers/venv
    python benchmarks/peers/run.py --only ours --rounds 1

A figure is what a frame costs at the margin: a process runs for few frames and one for more, and
start, imports and compilation are in both. Processor time is that of the process and its children,
as the system counts it; one thread each. All rows take turns in every round; medians and ratios
are of the rounds. Writes ``benchmarks/results/peers.json``.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "peers.json"


class Row(NamedTuple):
    """What is measured: who, with which Python, and at how many frames twice."""

    title: str
    kind: str  # a function of measure.py
    name: str
    few: int
    many: int

    @property
    def is_ours(self) -> bool:
        """Whether it runs in the environment that runs this."""
        return self.kind in ("ours", "ours_stepping", "torchrl_sac")


ROWS = [
    *(
        Row(f"OmniSafe {name}, training", "omnisafe", name, 20_000, 40_000)
        for name in ("CPO", "PPOLag", "TRPOLag")
    ),
    Row("OmniSafe SACLag, training", "omnisafe", "SACLag", 2_000, 4_000),
    Row("TorchRL SAC, an update of 256 a frame", "torchrl_sac", "-", 200, 1_200),
    Row("SafeTAC, training", "ours", "safetac", 24_000, 56_000),
    Row("our CPO, training", "ours", "cpo", 24_000, 88_000),
    Row("Safety-Gymnasium, steps", "stepping", "safety_gymnasium", 1_000, 5_000),
    Row("Gymnasium's HalfCheetah, steps", "stepping", "HalfCheetah-v4", 1_000, 11_000),
    Row("SafeRobotEnv, N = 1, steps", "ours_stepping", "1", 1_000, 11_000),
    Row("SafeRobotEnv, N = 64, steps", "ours_stepping", "64", 6_400, 134_400),
    Row("SafeRobotEnv, N = 400, steps", "ours_stepping", "400", 40_000, 240_000),
]
# What a ratio is of: its first is compared to its second, by frames per second.
RATIOS = [
    ("SafeTAC, training", "OmniSafe CPO, training"),
    ("SafeTAC, training", "OmniSafe SACLag, training"),
    ("our CPO, training", "OmniSafe CPO, training"),
    ("our CPO, training", "OmniSafe PPOLag, training"),
    ("our CPO, training", "OmniSafe TRPOLag, training"),
    ("SafeTAC, training", "TorchRL SAC, an update of 256 a frame"),
    ("SafeRobotEnv, N = 1, steps", "Safety-Gymnasium, steps"),
    ("SafeRobotEnv, N = 64, steps", "Safety-Gymnasium, steps"),
    ("SafeRobotEnv, N = 400, steps", "Safety-Gymnasium, steps"),
]


def make_venv(folder: Path, python: str) -> Path:
    """The peers' interpreter; sets the environment up at first."""
    interpreter = folder / "bin" / "python"
    if not (folder / "complete").exists():
        subprocess.run([python, "-m", "venv", folder], check=True)
        requirements = ["-r", HERE / "requirements.txt"]
        subprocess.run([interpreter, "-m", "pip", "install", *requirements], check=True)
        (folder / "complete").touch()
    return interpreter


def cost(interpreter: Path, row: Row, frames: int) -> tuple[float, float]:
    """Seconds of the processor and of the wall that a process took."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | threads
    if row.is_ours:
        environment["PYTHONPATH"] = str(ROOT)
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder, "output")
        command = [interpreter, HERE / "measure.py", row.kind, row.name, str(frames), folder]
        with output.open("w") as file:
            start = time.perf_counter()
            process = subprocess.Popen(command, env=environment, stdout=file, stderr=file)
            _, status, usage = os.wait4(process.pid, 0)
            wall = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if status:
            raise RuntimeError(f"{row.title}:\n{output.read_text()[-2000:]}")
    return usage.ru_utime + usage.ru_stime, wall


def marginal(interpreter: Path, row: Row) -> dict[str, float]:
    """Frames per second of the processor and of the wall, from few frames to many."""
    few, many = cost(interpreter, row, row.few), cost(interpreter, row, row.many)
    frames = row.many - row.few
    return {
        name: frames / (more - less)
        for name, less, more in zip(("processor", "wall"), few, many, strict=True)
    }


def report(rates: dict[str, list[dict[str, float]]]) -> str:
    """Medians, then medians of the ratios within a round."""
    lines = ["| frames per second | of the processor | of the wall |", "|---|---:|---:|"]
    for title, rounds in rates.items():
        cells = [statistics.median(each[clock] for each in rounds) for clock in rounds[0]]
        lines.append(f"| {title} | {' | '.join(f'{cell:,.0f}' for cell in cells)} |")
    lines += ["", "| times as fast as | of the processor | of the wall |", "|---|---:|---:|"]
    for mine, other in RATIOS:
        if mine in rates and other in rates:
            pairs = list(zip(rates[mine], rates[other], strict=True))
            cells = [statistics.median(a[c] / b[c] for a, b in pairs) for c in pairs[0][0]]
            cells_text = " | ".join(f"{cell:.1f}" for cell in cells)
            lines.append(f"| {mine} beside {other} | {cells_text} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--venv", type=Path, default=ROOT / "runs" / "peers" / "venv")
    parser.add_argument("--python", default="python3.10", help="makes the peers' environment")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--only", nargs="*", default=[""], help="rows whose titles have one of it")
    parser.add_argument("--results", type=Path, default=RESULTS)
    arguments = parser.parse_args()
    peers = make_venv(arguments.venv, arguments.python)
    rows = [row for row in ROWS if any(word in row.title for word in arguments.only)]
    load = os.getloadavg()[0]
    rates: dict[str, list[dict[str, float]]] = {row.title: [] for row in rows}
    for turn in range(arguments.rounds):
        for row in rows:
            interpreter = Path(sys.executable) if row.is_ours else peers
            rates[row.title].append(marginal(interpreter, row))
            print(f"round {turn + 1}: {row.title}", file=sys.stderr, flush=True)
    machine = {
        "cores": os.cpu_count(),
        "load_average_before": load,
    }
    arguments.results.parent.mkdir(parents=True, exist_ok=True)
    arguments.results.write_text(json.dumps({**machine, "rounds": rates}, indent=2) + "\n")
    print(report(rates))


if __name__ == "__main__":
    main()
