"""Where the time of an update goes: a Markdown table of its parts.

    python benchmarks/profile_training.py                      # defaults of the example, one thread
    python benchmarks/profile_training.py policy.num_components=5  # any option of it

The example runs as it is, with marks of torch.profiler around its parts. Of each part the table
says how much is inside torch's kernels (self time of ``aten`` operations and of what
``torch.compile`` fused), inside the simulator (``mujoco.batch``), and neither: Python, tensordict,
autograd's engine.

The profiler slows what it watches: by as much for every event, the table assumes, and takes that
off where the event was. An event inside a kernel's lengthens it, any other its part alone.
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
from torch._inductor import config as inductor
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
SIMULATOR = "simulator"
NUM_TIMED = 3  # updates without the profiler, after the warm-up


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


def attribute(events: list[FunctionEvent], slowdown: float) -> dict[str, Counter]:
    """Microseconds of each part, without those inside it, had the profiler not slowed it.

    Args:
        events (list of FunctionEvent): the profiler's.
        slowdown (float): microseconds that all of them cost together.

    Returns:
        dict: ``"time"``, and of it ``"kernels"`` and ``"simulator"``.
    """
    cost = slowdown / len(events)
    out: dict[str, Counter] = {name: Counter() for name in ("time", "kernels", "simulator")}
    for event in events:
        outer = list(ancestors(event.cpu_parent))
        part = next((e.name for e in outer if e.name in PARTS), None)
        out["time"][part] -= cost
        if event.name in PARTS:
            out["time"][event.name] += event.cpu_time_total
            if part is not None:
                out["time"][part] -= event.cpu_time_total
        elif event.name == SIMULATOR:
            out["simulator"][part] += event.cpu_time_total
        elif is_kernel(event):
            out["kernels"][part] += event.self_cpu_time_total
        if outer and is_kernel(outer[0]):
            out["kernels"][part] -= cost
    return out


def is_kernel(event: FunctionEvent) -> bool:
    return event.name.startswith("aten::") or "cpp_fused" in event.name


def ancestors(event: FunctionEvent | None) -> Iterable[FunctionEvent]:
    while event is not None:
        yield event
        event = event.cpu_parent


def main(overrides: list[str]) -> None:
    """Profile one update and print the table."""
    inductor.cpp.enable_kernel_profile = True
    events, profiled, plain = record(overrides)
    times = attribute(events, 1e6 * (profiled - plain))
    times["time"][None] = 1e6 * plain - sum(times["time"].values()) + times["time"][None]
    print("| part of an update | seconds | share | in torch's kernels | in MuJoCo | neither |")
    print("|---|---:|---:|---:|---:|---:|")
    sums = Counter()
    for part, text in {**PARTS, None: "logging and what is left"}.items():
        cells = {name: counter[part] for name, counter in times.items()}
        cells["neither"] = cells["time"] - cells["kernels"] - cells["simulator"]
        sums.update(cells)
        print(row(text, cells, plain))
    print(row("**whole update**", sums, plain))
    print()
    print(
        f"Shares are of the whole update, {plain:.2f} s (median of {NUM_TIMED}). It took "
        f"{profiled:.2f} s with the profiler, "
        f"{1e6 * (profiled - plain) / len(events):.1f} us per event more, which the table leaves "
        "out, wherever the events were."
    )


def row(text: str, cells: dict[str, float], seconds: float) -> str:
    shares = (f"{cells[name] / seconds / 1e6:.1%}" for name in ("time", "kernels", "simulator"))
    neither = f"{cells['neither'] / seconds / 1e6:.1%}"
    return f"| {text} | {cells['time'] / 1e6:.2f} | " + " | ".join([*shares, neither]) + " |"


if __name__ == "__main__":
    main(sys.argv[1:])
