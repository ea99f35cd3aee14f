"""Metrics of safe agents, learning curves, tables and videos.

They work on any TorchRL environment that writes ``reward``, ``cost``, ``violation`` and
``goal_met`` under ``"next"``.
"""

from torchrl_safe.record.curves import format_table, plot_learning_curves, read_metrics
from torchrl_safe.record.metrics import (
    batch_metrics,
    bootstrap_interval,
    count_violations,
    evaluate,
    score,
    summarize,
)
from torchrl_safe.record.video import record_video

__all__ = [
    "batch_metrics",
    "bootstrap_interval",
    "count_violations",
    "evaluate",
    "format_table",
    "plot_learning_curves",
    "read_metrics",
    "record_video",
    "score",
    "summarize",
]
