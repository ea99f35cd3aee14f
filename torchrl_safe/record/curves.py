"""Learning curves from the files TorchRL's ``CSVLogger`` writes, and a table for the end of a run.

The drawing uses matplotlib's objects, never ``pyplot``: no window, no global state, no display.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from torchrl_safe._extras import need
from torchrl_safe._files import expand, printable, read_bytes, regular_files, replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["format_table", "plot_learning_curves", "read_metrics"]

Curves = Mapping[str, tuple[np.ndarray, np.ndarray]]

_LOG_LIMIT = 2**25  # bytes of one metric

# Okabe and Ito's colours, told apart by every kind of colour vision; line styles say it again.
_LEVEL = "update/cost_level"
_BLUE, _VERMILLION, _GREY, _BLACK = "#0072B2", "#D55E00", "#999999", "#000000"


def read_metrics(run_dir: str | os.PathLike[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Reads every scalar of a run that was logged by :class:`torchrl.record.CSVLogger`.

    A run that was killed and resumed reads as one: lines that are no step and number are skipped,
    be they torn by the kill or by a bad disk, and where
    the resumed run starts again at an earlier step, what the killed one had logged from there on
    is dropped. Steps therefore always rise.

    Args:
        run_dir (path): the logger's own directory, ``<log_dir>/<exp_name>``.

    Returns:
        dict: from metric name, e.g. ``"eval/score"``, to its steps (int64, [M]) and values
        (float64, [M]). Empty if nothing has been logged yet; metrics without one whole line are
        left out.

    Raises:
        FileNotFoundError: if ``run_dir`` is not a directory.
        FileRefusedError: a ``ValueError``, if below it there is a link, a pipe or the like, a
            folder that cannot be listed, or a log of more than 32 MiB.

    Examples:
        >>> import tempfile
        >>> from torchrl.record import CSVLogger
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     logger = CSVLogger("run", log_dir=folder)
        ...     logger.log_scalar("eval/score", 2.5, step=4000)
        ...     logger.experiment.files.popitem()[1].close()
        ...     steps, values = read_metrics(f"{folder}/run")["eval/score"]
        >>> steps.tolist(), values.tolist()
        ([4000], [2.5])
    """
    folder = expand(run_dir)
    if not folder.is_dir():
        raise FileNotFoundError(f"run_dir {os.fspath(run_dir)!r} is not a directory.")
    scalars = folder / "scalars"
    files = regular_files(scalars) if os.path.lexists(scalars) else {}
    metrics = {}
    for name, file in files.items():
        points = _read_points(file) if file.suffix == ".csv" else []
        if points:
            steps, values = zip(*points, strict=True)
            metrics[name.removesuffix(".csv")] = (
                np.array(steps, np.int64),
                np.array(values, np.float64),
            )
    return metrics


def plot_learning_curves(run_dir: str | os.PathLike[str], path: str | os.PathLike[str]) -> Path:
    """Draws return, score, violation rate and the constraint of a run over environment steps.

    The metrics drawn are ``return``, ``score`` and ``cv_rate`` under ``eval/`` (sampled actions)
    and ``eval/det/`` (deterministic), with the interval ``score_low``, ``score_high`` shaded;
    ``train/cv_rate``; ``update/cost_level`` and ``update/cost_limit``, of several costs each under
    its name. Those a run has not logged are left out, and a panel with none of its own says so.

    Args:
        run_dir (path): as in :func:`read_metrics`.
        path (path): the picture to write; the suffix (``.png``, ``.svg``, ``.pdf``) picks the
            format. Missing parent directories are made.

    Returns:
        Path: the picture.

    Raises:
        FileNotFoundError: if ``run_dir`` is not a directory.

    Examples:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     plot_learning_curves(folder, f"{folder}/curves.png").name
        'curves.png'
    """
    need("a plot", "train", "matplotlib")
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine
    from matplotlib.ticker import EngFormatter

    metrics = read_metrics(run_dir)
    figure = Figure(figsize=(17, 3.8), layout=ConstrainedLayoutEngine(w_pad=0.1))
    returns, score, violations, constraint = figure.subplots(1, 4)

    returns.set(title="Return", ylabel="sum of rewards, per episode")
    _draw(returns, metrics, "eval/return", "sampled action", color=_BLUE)
    _draw(returns, metrics, "eval/det/return", "deterministic action", color=_VERMILLION, ls="-.")

    score.set(title="Score", ylabel="return / (1 + violations), per episode")
    for prefix, colour in (("eval/", _BLUE), ("eval/det/", _VERMILLION)):
        _shade(score, metrics, f"{prefix}score_low", f"{prefix}score_high", colour)
    _draw(score, metrics, "eval/score", "sampled action", color=_BLUE)
    _draw(score, metrics, "eval/det/score", "deterministic action", color=_VERMILLION, ls="-.")

    violations.set(title="Constraint violations", ylabel="violations per step")
    _draw(violations, metrics, "train/cv_rate", "training", color=_GREY, lw=0.8)
    _draw(violations, metrics, "eval/cv_rate", "sampled action", color=_BLUE)
    _draw(
        violations, metrics, "eval/det/cv_rate", "deterministic action", color=_VERMILLION, ls="-."
    )

    constraint.set(title="Constraint estimate", ylabel="cost, in the unit of the limit")
    costs = sorted(n.removeprefix(_LEVEL) for n in metrics if n.startswith(f"{_LEVEL}/")) or [""]
    for cost, colour in zip(costs, itertools.cycle((_BLUE, _VERMILLION, _GREY)), strict=False):
        name = f" of {cost[1:]}" if cost else ""
        if f"{_LEVEL}{cost}" in metrics:
            _draw(constraint, metrics, _LEVEL + cost, f"estimate{name}", color=colour)
            black = colour if name else _BLACK
            limit = f"update/cost_limit{cost}"
            _draw(constraint, metrics, limit, f"limit{name}", color=black, ls="--")

    for axes in (returns, score, violations, constraint):
        axes.set_xlabel("environment steps")
        axes.spines[["top", "right"]].set_visible(False)
        if axes.lines:
            axes.set_xlim(left=0)
            axes.xaxis.set_major_formatter(EngFormatter(sep=""))
            axes.grid(alpha=0.25)
            axes.legend(frameon=False)
        else:
            axes.set(xticks=[], yticks=[])
            axes.text(0.5, 0.5, "no data yet", transform=axes.transAxes, ha="center", color=_GREY)

    path = expand(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        figure.savefig(draft, dpi=150)
    return path


def format_table(rows: Mapping[str, float | str]) -> str:
    """Two plain-text columns, names to the left and values to the right.

    Args:
        rows (mapping): name to value. Numbers are shown with four significant digits, from 1,000
            on as whole numbers with separators; strings as they are. What a terminal would obey
            instead of showing is escaped, in names, too.

    Returns:
        str: one line per row, without a final newline.

    Examples:
        >>> format_table({"score": 10.4251, "total CVs": 116000}).splitlines()
        ['score        10.43', 'total CVs  116,000']
    """
    cells = {printable(name): printable(_format_value(value)) for name, value in rows.items()}
    left = max(map(len, cells), default=0)
    right = max(map(len, cells.values()), default=0)
    return "\n".join(f"{name:<{left}}  {value:>{right}}" for name, value in cells.items())


def _format_value(value: float | str) -> str:
    if isinstance(value, str):
        return value
    return f"{value:,.0f}" if 1_000 <= abs(value) < 1e15 else f"{value:.4g}"


def _read_points(file: Path) -> list[tuple[int, float]]:
    """(step, value) pairs with rising steps."""
    points: list[tuple[int, float]] = []
    # A line still without its newline may be half a number, which would parse all the same.
    text = read_bytes(file, _LOG_LIMIT).decode(errors="replace")
    for line in text.rpartition("\n")[0].split("\n"):
        try:
            step_text, value_text = line.split(",")
            step, value = int(step_text), float(value_text)
        except ValueError:
            continue
        if not 0 <= step < 2**63:
            continue
        while points and points[-1][0] >= step:
            points.pop()
        points.append((step, value))
    return points


def _draw(axes: Axes, metrics: Curves, name: str, label: str, **style: object) -> None:
    if name in metrics:
        steps, values = metrics[name]
        # One point has no line to show.
        marker = "o" if len(steps) == 1 else ""
        axes.plot(steps, _drawable(values), label=label, marker=marker, **style)  # type: ignore[arg-type]


def _drawable(values: np.ndarray) -> np.ndarray:
    """Values with gaps where there is no number, or one of which no axis can be made."""
    return np.where(np.abs(values) < 1e100, values, np.nan)


def _shade(axes: Axes, metrics: Curves, low: str, high: str, colour: str) -> None:
    if low in metrics and high in metrics:
        steps, at_low, at_high = np.intersect1d(
            metrics[low][0], metrics[high][0], return_indices=True
        )
        axes.fill_between(
            steps,
            _drawable(metrics[low][1][at_low]),
            _drawable(metrics[high][1][at_high]),
            color=colour,
            alpha=0.15,
            lw=0,
        )
