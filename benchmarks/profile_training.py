"""Where the time of an update goes: a Markdown table of its parts.

    python benchmarks/profile_training.py                      # defaults of the example, one thread
    python benchmarks/profile_training.py policy.num_components=5  # any option of it

The example runs as it is, with marks of torch.profiler around its parts. Of each part the table
says how much is inside torch's kernels (self time of ``aten`` operations), inside the simulator
(``mujoco.batch``), and neither: Python, tensordict, autograd's engine, and the profiler itself.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))

import collectors
import critics
import safetac_point
import utils
from bench_training import SILENT, compose, warm_up_updates
from torch.autograd.profiler_util import FunctionEvent
from torch.profiler import ProfilerActivity, profile, record_function
from torchrl._utils import timeit

from torchrl_safe.envs import _core

PARTS = {
    "collect": "collect: policy, environment, tensordicts",
    "replay": "replay: store and sample slices",
    "time/targets": "targets: networks and Retrace",
    "time/critics": "critics: gradient steps",
    "time/policy": "trust-region step",
}
UPDATE, SIMULATOR = "update", "simulator"
NUM_TIMED = 1  # updates without the profiler, after the warm-up


def marked(name: str, call: Callable[..., Any]) -> Callable[..., Any]:
    """The same function, seen by the profiler under a name."""

    def wrapper(*args: Any, **kwargs: Any) -> Any:
        with record_function(name):
            return call(*args, **kwargs)

    return wrapper


class MarkedTimer(timeit):
    """The example's timer, seen by the profiler too."""

    def __enter__(self) -> MarkedTimer:
        self._mark = record_function(self.name)
        self._mark.__enter__()
        return super().__enter__()

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        self._mark.__exit__(*error)


def mark_parts() -> None:
    """Put marks where the example, its replay and the environment do their work."""
    critics.timeit = safetac_point.timeit = MarkedTimer
    rollout = collectors.ResumableCollector.rollout
    collectors.ResumableCollector.rollout = marked("collect", rollout)
    _core.Batch.step = marked(SIMULATOR, _core.Batch.step)
    make_buffer = safetac_point.make_buffer

    def make_marked_buffer(cfg: Any) -> Any:
        buffer = make_buffer(cfg)
        for name in ("extend", "sample"):
            setattr(buffer, name, marked("replay", getattr(buffer, name)))
        return buffer

    safetac_point.make_buffer = make_marked_buffer


def record(overrides: list[str]) -> tuple[list[FunctionEvent], float, float]:
    """Run the example until one update is profiled.

    Returns:
        tuple: the profiler's events, seconds of the profiled update, and of one without profiler.
    """
    cfg = compose(["num_threads=1", *overrides, *SILENT])
    updates = warm_up_updates(cfg) + NUM_TIMED + 1  # the last one is profiled
    cfg.collector.total_frames = updates * cfg.collector.frames_per_batch
    profiler = profile(activities=[ProfilerActivity.CPU])
    ended: list[float] = []
    begun: list[float] = []
    log = utils.Run.log

    def log_and_watch(run: utils.Run, metrics: dict[str, float]) -> None:
        log(run, metrics)  # the last thing an update does
        ended.append(time.perf_counter())
        if len(ended) == updates - 1:
            profiler.start()
        elif len(ended) == updates:
            profiler.stop()
        begun.append(time.perf_counter())

    utils.Run.log = log_and_watch
    mark_parts()
    with tempfile.TemporaryDirectory() as run_dir:
        cfg.run_dir = run_dir
        with redirect_stdout(sys.stderr):
            safetac_point.main.__wrapped__(cfg)
    spans = [end - begin for begin, end in zip(begun, ended[1:updates], strict=False)]
    return profiler.events(), spans[-1], statistics.median(spans[-1 - NUM_TIMED : -1])


def attribute(events: Iterable[FunctionEvent]) -> tuple[Counter, Counter, Counter]:
    """Microseconds of each part alone, without parts inside it; in kernels; in the simulator."""
    total, kernels, simulator = Counter(), Counter(), Counter()
    for event in events:
        part = next((e.name for e in ancestors(event.cpu_parent) if e.name in PARTS), None)
        if event.name in PARTS:
            total[event.name] += event.cpu_time_total
            if part is not None:
                total[part] -= event.cpu_time_total
        elif event.name == SIMULATOR:
            simulator[part] += event.cpu_time_total
        elif event.name.startswith("aten::"):
            kernels[part] += event.self_cpu_time_total
    return total, kernels, simulator


def ancestors(event: FunctionEvent | None) -> Iterable[FunctionEvent]:
    while event is not None:
        yield event
        event = event.cpu_parent


def main(overrides: list[str]) -> None:
    """Profile one update and print the table."""
    events, profiled, plain = record(overrides)
    total, kernels, simulator = attribute(events)
    total[None] = 1e6 * profiled - sum(total.values())
    print("| part of an update | seconds | share | in torch's kernels | in MuJoCo | neither |")
    print("|---|---:|---:|---:|---:|---:|")
    rows = {**PARTS, None: "logging and what is left"}
    sums = Counter()
    for part, text in rows.items():
        cells = {
            "time": total[part],
            "kernels": kernels[part],
            "simulator": simulator[part],
            "neither": total[part] - kernels[part] - simulator[part],
        }
        sums.update(cells)
        print(row(text, cells, profiled))
    print(row("**whole update**", sums, profiled))
    print()
    print(
        "Shares are of the whole update. An update took "
        f"{profiled:.2f} s with the profiler, whose own cost counts as neither, and "
        f"{plain:.2f} s without. If the profiler slows neither kernels nor simulator, "
        f"{1 - (sums['kernels'] + sums['simulator']) / 1e6 / plain:.0%} of an update without it "
        "is neither."
    )


def row(text: str, cells: dict[str, float], seconds: float) -> str:
    shares = (f"{cells[name] / seconds / 1e6:.1%}" for name in ("time", "kernels", "simulator"))
    neither = f"{cells['neither'] / seconds / 1e6:.1%}"
    return f"| {text} | {cells['time'] / 1e6:.2f} | " + " | ".join([*shares, neither]) + " |"


if __name__ == "__main__":
    main(sys.argv[1:])
