"""Runs the speed benchmarks and writes their tables as one page of the documentation.

    python benchmarks/report.py  # about ten minutes on two idle cores; writes docs/benchmarks.md

Each part is a command of its own, shown above its table. A part that fails or takes too long is
named on the page and makes the exit status 1; the others are there all the same.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shlex
import signal
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "benchmarks.md"
PACKAGES = ("torch", "torchrl", "tensordict", "mujoco", "numpy")
TIMEOUT = 300  # seconds of one part
PYTEST = "pytest -c benchmarks/pytest.ini benchmarks/"
# Processor time, so that a program beside it does not count as the benchmark's; only where one
# thread works, because the time of several would be added up.
ONE_THREAD = " --benchmark-timer=time.process_time"


class Part(NamedTuple):
    """A section of the page."""

    title: str
    command: str  # what a reader types; it prints Markdown, or is pytest-benchmark's
    text: str


PARTS = [
    Part(
        "Training",
        "python benchmarks/bench_training.py num_threads=2",
        "The whole loop with the example's defaults, two threads of torch and of the simulator. "
        "CPO of OmniSafe is another algorithm with its own defaults: the ratio says how long a "
        "user waits for a frame, not how fast each learns.",
    ),
    Part("Training, one thread", "python benchmarks/bench_training.py num_threads=1", ""),
    Part(
        "Training, compiled",
        "python benchmarks/bench_training.py num_threads=2 optim.compile=true",
        "The critics' targets and losses by `torch.compile`, whose time is not in it: half a "
        "minute, once.",
    ),
    Part("Profile of an update", "python benchmarks/profile_training.py", ""),
    Part(
        "Targets",
        PYTEST + "bench_retrace.py" + ONE_THREAD,
        "Targets of B x T steps, 1 % of which end a trajectory: Retrace as it is here, as a Python "
        "loop over time, and TorchRL's vectorised TD(lambda), which has no ratios to handle.",
    ),
    Part(
        "Critics",
        PYTEST + "bench_critics.py" + ONE_THREAD,
        "One pass of gradient steps of four networks over replayed frames with their targets.",
    ),
    Part(
        "Trust-region step",
        PYTEST + "bench_trust_region.py" + ONE_THREAD,
        "Five Gaussians, one active constraint, ten conjugate-gradient iterations. Gauss-Newton is "
        "the optimizer with `statistics`, double backward with `kl`; rebuilt is what most CPO code "
        "does, the KL and its gradient anew for every product; a quarter of the "
        "states is `curvature_statistics`.",
    ),
    Part(
        "Robots and interfaces",
        "python benchmarks/bench_interfaces.py",
        "Frames per second, and in brackets the share of the floor: the physics of the same model "
        "on as many threads, nothing else. Medians of rounds in which all rows take turns.",
    ),
]


def run(command: str, arguments: Iterable[str] = ()) -> str:
    """What a command prints.

    Raises:
        RuntimeError: if it fails, with the end of what it said, or takes too long.
    """
    program, *words = shlex.split(command)
    start = [sys.executable] if program == "python" else [sys.executable, "-m", program]
    env = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    with subprocess.Popen(
        [*start, *words, *arguments],
        cwd=ROOT,
        env=env,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,  # so that what it has started can be ended with it
    ) as process:
        try:
            out, error = process.communicate(timeout=TIMEOUT)
        except BaseException as interruption:
            os.killpg(process.pid, signal.SIGKILL)
            if isinstance(interruption, subprocess.TimeoutExpired):
                raise RuntimeError(f"took more than {TIMEOUT} seconds") from interruption
            raise
    if process.returncode:
        failed = [line for line in out.splitlines() if line.startswith("FAILED ")]  # pytest's
        lines = failed or (error or out).strip().splitlines() or ["no output"]
        raise RuntimeError(f"exit status {process.returncode}: {lines[-1]}")
    return out.strip()


def tables(report: Mapping[str, Any]) -> str:
    """pytest-benchmark's results, a table per group, in units of the group's first row."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for benchmark in report["benchmarks"]:
        groups.setdefault(benchmark["group"] or "", []).append(benchmark)
    out = []
    for group, benchmarks in groups.items():
        extra = list(dict.fromkeys(name for each in benchmarks for name in each["extra_info"]))
        head = [group, "median", "ratio", "fastest", "rounds", *extra]
        lines = [head, ["---", *["---:"] * (len(head) - 1)]]
        unit = benchmarks[0]["stats"]["median"]
        for each in benchmarks:
            stats = each["stats"]
            name = each["name"].partition("[")
            lines.append(
                [
                    f"`{name[2].rstrip(']') or name[0]}`",
                    milliseconds(stats["median"]),
                    f"{stats['median'] / unit:.2f}",
                    milliseconds(stats["min"]),
                    str(stats["rounds"]),
                    *(str(each["extra_info"].get(key, "")) for key in extra),
                ]
            )
        out.append("\n".join(f"| {' | '.join(line)} |" for line in lines))
    return "\n\n".join(out)


def milliseconds(seconds: float) -> str:
    """Three significant digits."""
    value = 1e3 * seconds
    return f"{value:,.0f} ms" if value >= 100 else f"{value:.3g} ms"


def output(part: Part, arguments: Iterable[str]) -> str:
    """A part's tables as Markdown."""
    if not part.command.startswith(PYTEST):
        return run(part.command, arguments)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "results.json")
        run(part.command, [f"--benchmark-json={path}", *arguments])
        return tables(json.loads(path.read_text()))


def machine() -> str:
    """Where and when, in a few lines."""
    commit = run_git("rev-parse", "--short=10", "HEAD") or "unknown"
    if run_git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs"):
        commit += " with changes"
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
    versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
    return (
        f"Commit {commit}, {datetime.now(timezone.utc):%Y-%m-%d}. {model}, {os.cpu_count()} cores, "
        f"{platform.system()}, Python {platform.python_version()}, {versions}. No GPU was used."
    )


def run_git(*words: str) -> str:
    """What git says, nothing where there is no repository."""
    try:
        return subprocess.check_output(["git", *words], cwd=ROOT, text=True).strip()
    except (OSError, subprocess.CalledProcessError):
        return ""


def wrap(text: str) -> str:
    """Lines of at most 100 characters."""
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


def write(page: Path, tiny: bool) -> int:
    """Run all parts and write the page; the number of parts that failed."""
    where, load = machine(), os.getloadavg()[0]
    sections, failures = [], 0
    for part in PARTS:
        print(f"{part.title}: {part.command}", file=sys.stderr, flush=True)
        lines = [f"## {part.title}", f"`{part.command}`", wrap(part.text)]
        try:
            lines.append(output(part, tiny_arguments(part) if tiny else ()))
        except RuntimeError as error:
            failures += 1
            lines.append(f"**No result**: {error}.")
            print(lines[-1], file=sys.stderr, flush=True)
        sections.append("\n\n".join(filter(None, lines)))
    head = "# Benchmarks\n\n" + wrap(
        "How fast this library is, part by part: training, an update's parts, targets, critics, "
        "the trust-region step, robots. Generated by `python benchmarks/report.py`: run it again "
        f"instead of editing this page. {where} Load average {load:.1f} before the first part: "
        "well above 0, read ratios within a table and nothing else. Ratios of pytest's tables are "
        "of medians, to the first row."
    )
    if tiny:
        head += "\n\n**Tiny sizes, to test the report: none of the numbers means anything.**"
    page.write_text("\n\n".join([head, *sections]) + "\n")
    return failures


TINY_BENCHMARKS = "5x200 or 64-64-plain or (bench_step and 128-gauss_newton_quarter)"
TINY = [
    *("env.num_envs=4", "env.episode_length=40", "collector.frames_per_batch=100"),
    *("collector.init_frames=0", "replay_buffer.size=2000", "replay_buffer.slice_len=10"),
    *("policy.num_cells=[8]", "critic.num_cells=[8]", "optim.critic_rounds=1"),
    *("optim.critic_frames=100", "optim.minibatch_size=100", "optim.policy_frames=50"),
    "optim.compile=false",  # not everywhere is a compiler
]


def tiny_arguments(part: Part) -> list[str]:
    """What makes a part end in seconds."""
    if part.command.startswith(PYTEST):
        return ["--benchmark-max-time=0.01", "--benchmark-warmup=off", "-k", TINY_BENCHMARKS]
    if "bench_interfaces" in part.command:
        return ["point", "--rounds", "1", "--seconds", "0.01"]
    return TINY


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=PAGE)
    parser.add_argument("--tiny", action="store_true", help="sizes that test the report itself")
    arguments = parser.parse_args()
    sys.exit(min(1, write(arguments.out, arguments.tiny)))


if __name__ == "__main__":
    main()
