"""Metrics of safe agents, learning curves, tables and videos.

They work on any TorchRL environment that writes ``reward``, ``cost`` and ``violation`` under
``"next"``, or ``<name>_cost`` and ``<name>_violation`` for each of several costs. Goals are counted
where ``goal_met`` is written, and paths drawn where an environment has a ``layout``.
"""

from torchrl_safe.record.calibration import calibrate, discounted_sums, plot_calibration
from torchrl_safe.record.curves import (
    draw_curves,
    format_table,
    plot_learning_curves,
    read_metrics,
    terminal_curves,
)
from torchrl_safe.record.metrics import (
    batch_metrics,
    bootstrap_interval,
    count_violations,
    describe,
    evaluate,
    proportion_interval,
    score,
    summarize,
)
from torchrl_safe.record.trajectories import (
    Trajectory,
    plot_trajectories,
    record_trajectories,
)
from torchrl_safe.record.video import record_video

__all__ = [
    "Trajectory",
    "batch_metrics",
    "bootstrap_interval",
    "calibrate",
    "count_violations",
    "describe",
    "discounted_sums",
    "draw_curves",
    "evaluate",
    "format_table",
    "plot_calibration",
    "plot_learning_curves",
    "plot_trajectories",
    "proportion_interval",
    "read_metrics",
    "record_trajectories",
    "record_video",
    "score",
    "summarize",
    "terminal_curves",
]
