"""How the cost of a frame grows with environments, workers, batch, width and replay.

    python benchmarks/scaling.py         # about 5 minutes on two idle cores
    python benchmarks/scaling.py --plot  # only draws the table there is

Writes ``benchmarks/results/scaling.csv`` and ``docs/images/scaling.png``. One option of the
Point example at a time is moved away from ``BASE``, the example's defaults with fewer rounds of
critics: read how cost grows, not what it is. Further arguments are options of the example.
"""

from __future__ import annotations

import argparse
import csv
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path

import numpy as np
from bench_training import SILENT, compose, warm_up_updates
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers import SafeTAC
from torchrl_safe.trainers.collectors import make_collector
from torchrl_safe.trainers.off_policy import make_slice_buffer, replayed

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "benchmarks" / "results" / "scaling.csv"
PICTURE = ROOT / "docs" / "images" / "scaling.png"
BASE = [
    *("num_threads=1", "optim.critic_rounds=2"),
    "replay_buffer.size=100_000",  # a run ends with a checkpoint of it
    "collector.init_frames=64_000",  # 1600 environments have slices to draw from by then
]
NUM_UPDATES = 3  # measured, after one that warms up
PARTS = ("collect and other", "targets", "critics", "policy")
COLOURS = dict(
    zip((*PARTS, "sample"), ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#888888"), strict=True)
)
AXES: dict[str, list[int]] = {
    "environments": [25, 100, 400, 1600],
    "worker processes": [1, 2, 4],
    "frames per update": [2000, 4000, 8000, 16_000],
    "width of the networks": [32, 64, 128, 256],
    "frames in the replay": [10_000, 100_000, 400_000, 1_000_000],
}


def overrides(axis: str, value: int) -> list[str]:
    """The options of the example that a point of an axis stands for."""
    if axis == "environments":
        return [f"env.num_envs={value}"]
    if axis == "worker processes":
        return ["collector.backend=multi_sync", f"collector.num_workers={value}"]
    if axis == "frames per update":
        return [f"collector.frames_per_batch={value}"]
    cells = f"num_cells=[{value},{value}]"
    return [f"policy.{cells}", f"critic.{cells}"]


def make_trainer(words: list[str], run_dir: str) -> SafeTAC:
    return SafeTAC(options=compose([*BASE, *words, *SILENT, f"run_dir={run_dir}"]))


def training_cost(words: list[str]) -> dict[str, float]:
    """Microseconds per frame of each part of an update, medians."""
    with tempfile.TemporaryDirectory() as run_dir:
        trainer = make_trainer(words, run_dir)
        options = trainer.options
        per_batch = options.collector.frames_per_batch
        options.collector.init_frames = 2 * options.replay_buffer.slice_len * options.env.num_envs
        updates = warm_up_updates(options) + NUM_UPDATES
        with redirect_stdout(sys.stderr):
            trainer.train(total_frames=updates * per_batch)
        metrics = read_metrics(Path(run_dir, "log"))

    def per_frame(seconds: np.ndarray) -> float:
        return 1e6 * float(np.median(seconds[-NUM_UPDATES:])) / per_batch

    parts = {name: per_frame(metrics[f"time/{name}"][1]) for name in PARTS[1:]}
    whole = per_frame(per_batch / metrics["time/frames_per_second"][1])
    return {PARTS[0]: whole - sum(parts.values()), **parts}


def replay_cost(words: list[str], frames: int) -> dict[str, float]:
    """Microseconds per replayed frame of drawing slices from that many frames."""
    sampled = f"optim.critic_frames={min(frames, 15_000)}"
    with tempfile.TemporaryDirectory() as run_dir:
        trainer = make_trainer([*words, f"replay_buffer.size={frames}", sampled], run_dir)
        options = trainer.options
        per_batch = options.collector.frames_per_batch
        make = partial(trainer.make_env, training=True)
        policy = trainer.make_policy(make(num_envs=1, seed=0))
        collector = make_collector(options, make, policy, seed=0, total_frames=per_batch)
        batch = next(iter(collector)).select(*replayed(trainer))
        collector.shutdown()
        buffer = make_slice_buffer(trainer)
        for number in range(-(-frames // per_batch)):
            batch = batch.clone()
            batch["collector", "traj_ids"] += number  # other trajectories than before
            buffer.extend(batch)
        seconds = []
        for _ in range(1 + NUM_UPDATES):
            start = time.perf_counter()
            buffer.sample(options.optim.critic_frames)
            seconds.append(time.perf_counter() - start)
    return {"sample": 1e6 * statistics.median(seconds[1:]) / options.optim.critic_frames}


def measure(options: list[str]) -> Iterator[tuple[str, int, str, float]]:
    for axis, values in AXES.items():
        for value in values:
            if axis == "frames in the replay":
                cost = replay_cost(options, value)
            else:
                cost = training_cost([*options, *overrides(axis, value)])
            print(f"{axis} {value}: {sum(cost.values()):.0f} us a frame", file=sys.stderr)
            for part, microseconds in cost.items():
                yield axis, value, part, microseconds


def plot() -> None:
    """A panel per axis, the parts stacked."""
    with TABLE.open() as file:
        rows = list(csv.DictReader(file))
    figure = Figure(figsize=(13, 3.2), layout="constrained")
    for axes, axis in zip(figure.subplots(1, len(AXES)), AXES, strict=True):
        mine = [row for row in rows if row["axis"] == axis]
        values = sorted({int(row["value"]) for row in mine})
        parts = list(dict.fromkeys(row["part"] for row in mine))
        bottom = np.zeros(len(values))
        for part in parts:
            cost = {int(row["value"]): float(row["us"]) for row in mine if row["part"] == part}
            height = np.array([cost[value] for value in values])
            names = [EngFormatter(sep="")(value) for value in values]
            axes.bar(names, height, 0.7, bottom, label=part, color=COLOURS[part])
            bottom += height
        axes.set_xlabel(axis)
        axes.spines[["top", "right"]].set_visible(False)
    first, *_, last = figure.axes
    first.set_ylabel("microseconds per frame")
    last.set_ylabel("per replayed frame")
    legend = first.get_legend_handles_labels()
    figure.legend(*legend, loc="outside upper center", ncols=len(PARTS), frameon=False)
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=120)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--plot", action="store_true", help="only draw the table there is")
    parser.add_argument("options", nargs="*", help="of the example, beside those of BASE")
    arguments = parser.parse_args()
    if not arguments.plot:
        rows = list(measure(arguments.options))  # whole, or the old table stays
        TABLE.parent.mkdir(parents=True, exist_ok=True)
        with TABLE.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(("axis", "value", "part", "us"))
            writer.writerows((*point, f"{us:.2f}") for *point, us in rows)
    plot()


if __name__ == "__main__":
    main()
