"""Metrics of safe agents, learning curves, tables and videos.

They work on any TorchRL environment that writes ``reward``, ``cost``, ``violation`` and
``goal_met`` under ``"next"``.
"""

from torchrl_safe.record.calibration import calibrate, discounted_sums, plot_calibration
from torchrl_safe.record.curves import format_table, plot_learning_curves, read_metrics
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
]
