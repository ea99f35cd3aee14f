"""Learning curves from the files TorchRL's ``CSVLogger`` writes, and a table for the end of a run.

The drawing uses matplotlib's objects, never ``pyplot``: no window, no global state, no display.
"""

from __future__ import annotations

import io
import itertools
import os
import re
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from torchrl_safe._extras import need
from torchrl_safe._files import expand, printable, read_bytes, regular_files, replacing
from torchrl_safe.record.metrics import bootstrap_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = [
    "draw_curves",
    "format_table",
    "plot_learning_curves",
    "read_metrics",
    "terminal_curves",
]

Curves = Mapping[str, tuple[np.ndarray, np.ndarray]]

_LOG_LIMIT = 2**25  # bytes of one metric
_LEVEL = "update/cost_level"

# Okabe and Ito's colours, told apart by every kind of colour vision; line styles say it again.
_BLUE, _VERMILLION, _GREY, _BLACK = "#0072B2", "#D55E00", "#999999", "#000000"
_COLOURS = (_BLUE, _VERMILLION, "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_DASHES = ("-", "--", "-.", ":")

# In a page, a colour is a variable of its style sheet, which has one for the dark, too.
_THEME = {
    _BLACK: "var(--ink)",
    _GREY: "var(--grey)",
    "#cccccc": "var(--rule)",
    **{colour: f"var(--line-{i})" for i, colour in enumerate(_COLOURS)},
}
_IDS = re.compile(
    r' id="(?:figure|axes|patch|line2d|text|xtick|ytick|legend|matplotlib|Fill)[^"]*"'
)


class _Line(NamedTuple):
    """A metric in a panel; ``band`` names those between which it is shaded."""

    metric: str
    label: str
    colour: str
    style: str = "-"
    width: float = 1.5
    band: tuple[str, str] | None = None


class _Panel(NamedTuple):
    """What is drawn in one pair of axes; ``main`` is what runs are compared by."""

    title: str
    unit: str
    lines: list[_Line]
    main: str


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

    metrics = read_metrics(run_dir)
    panels = _panels(metrics)
    figure = Figure(figsize=(17, 3.8), layout=ConstrainedLayoutEngine(w_pad=0.1))
    for axes, panel in zip(figure.subplots(1, len(panels)), panels, strict=True):
        _draw_panel(axes, panel, metrics)
        axes.set_title(panel.title)
    path = expand(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as draft:
        figure.savefig(draft, dpi=150)
    return path


def draw_curves(runs: Mapping[str, Sequence[Curves]]) -> dict[str, str]:
    """The panels of :func:`plot_learning_curves` for a page: one SVG each, in the page's colours.

    One run is drawn as there. Of several, each name is one line: the mean over its runs (seeds),
    with the 95 % bootstrap interval of the mean shaded; evaluations are those of the deterministic
    action. Where seeds logged at other steps, values between are interpolated.

    Args:
        runs (mapping): from a name to what :func:`read_metrics` returned of its runs.

    Returns:
        dict of str: from a panel's title to ``<svg>...</svg>``. Colours are the variables
        ``--ink``, ``--grey``, ``--rule`` and ``--line-0`` to ``--line-5`` of the page's style.

    Raises:
        ValueError: if there is no run.

    Examples:
        >>> import numpy as np
        >>> curve = {"eval/det/return": (np.array([0, 100]), np.array([1.0, 2.0]))}
        >>> pictures = draw_curves({"one": [curve], "other": [curve, curve]})
        >>> sorted(pictures), pictures["Return"][:4]
        (['Constraint', 'Return', 'Score', 'Violations'], '<svg')
    """
    if not any(runs.values()):
        raise ValueError(f"runs must hold at least one, got {dict(runs)}.")
    need("a plot", "train", "matplotlib")
    import matplotlib as mpl
    from matplotlib.figure import Figure

    everything = [run for group in runs.values() for run in group]
    pictures = {}
    for panel in _panels({name: curve for run in everything for name, curve in run.items()}):
        figure = Figure(figsize=(5.2, 3.3), layout="constrained")
        axes = figure.subplots()
        if len(everything) == 1:
            _draw_panel(axes, panel, everything[0])
        else:
            _draw_comparison(axes, panel, runs)
        file = io.StringIO()
        # Text stays text; equal pictures are equal files.
        with mpl.rc_context({"svg.fonttype": "none", "svg.hashsalt": "torchrl_safe"}):
            figure.savefig(file, format="svg", transparent=True, metadata={"Date": None})
        pictures[panel.title] = _themed(file.getvalue(), panel.title)
    return pictures


def terminal_curves(metrics: Curves, width: int = 80, height: int = 8) -> str:
    r"""The panels of :func:`plot_learning_curves` in characters: two beside one another.

    Each shows the metric that runs are compared by, and the limit where there is one, both to the
    same scale: dots of Unicode's Braille patterns, two by four to a character.

    Args:
        metrics (mapping): what :func:`read_metrics` returned.
        width (int): columns of the terminal. Defaults to 80.
        height (int): lines of a panel. Defaults to 8.

    Returns:
        str: lines without a final newline; empty if nothing has been logged that is drawn.

    Examples:
        >>> import numpy as np
        >>> steps, values = np.arange(5), np.array([0.0, 1.0, 2.0, 3.0, 4.0])
        >>> print(terminal_curves({"eval/return": (steps, values)}, 30, 3).partition("\n")[2])
               4 ⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⣀⣀⡤⠤⠖⠒⠋
                 ⠀⠀⠀⠀⠀⠀⢀⣀⣠⠤⠔⠒⠋⠉⠁⠀⠀⠀⠀⠀⠀
               0 ⣠⠤⠴⠒⠚⠉⠉⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀⠀
    """
    blocks = []
    columns = 2 if width >= 70 else 1
    each = (width - 2 * (columns - 1)) // columns
    for panel in _panels(metrics):
        names = [panel.main] if panel.main in metrics else [line.metric for line in panel.lines]
        names = [name for name in names[:1] if name in metrics]
        names += [line.metric for line in panel.lines if line.style == "--" and names]
        curves = [metrics[name] for name in names if name in metrics]
        if curves:
            blocks.append([panel.title[:each], *_braille(curves, each, height)])
    rows = [blocks[i : i + columns] for i in range(0, len(blocks), columns)]
    return "\n".join(
        "  ".join(f"{line:<{each}}" for line in lines).rstrip(" ")
        for row in rows
        for lines in zip(*row, strict=True)
    )


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


def _panels(metrics: Curves) -> list[_Panel]:
    """What is drawn of a run: four panels, whether or not it has logged what is in them."""

    def evaluated(name: str, band: bool = False) -> list[_Line]:
        kinds = (
            ("eval/", "sampled action", _BLUE, "-"),
            ("eval/det/", "deterministic action", _VERMILLION, "-."),
        )
        return [
            _Line(
                prefix + name,
                label,
                colour,
                style,
                band=(f"{prefix}{name}_low", f"{prefix}{name}_high") if band else None,
            )
            for prefix, label, colour, style in kinds
        ]

    costs = sorted(n.removeprefix(_LEVEL) for n in metrics if n.startswith(f"{_LEVEL}/")) or [""]
    levels = []
    for cost, colour in zip(costs, itertools.cycle((_BLUE, _VERMILLION, _GREY)), strict=False):
        name = f" of {cost[1:]}" if cost else ""
        levels += [
            _Line(f"{_LEVEL}{cost}", f"estimate{name}", colour),
            _Line(f"update/cost_limit{cost}", f"limit{name}", colour if name else _BLACK, "--"),
        ]
    training = _Line("train/cv_rate", "training", _GREY, width=0.8)
    return [
        _Panel("Return", "sum of rewards, per episode", evaluated("return"), "eval/det/return"),
        _Panel(
            "Score",
            "return / (1 + violations), per episode",
            evaluated("score", band=True),
            "eval/det/score",
        ),
        _Panel(
            "Violations",
            "violating steps, share of all",
            [training, *evaluated("cv_rate")],
            "eval/det/cv_rate",
        ),
        _Panel("Constraint", "cost, in the unit of the limit", levels, levels[0].metric),
    ]


def _draw_panel(axes: Axes, panel: _Panel, metrics: Curves) -> None:
    for line in panel.lines:
        if line.band is not None and all(name in metrics for name in line.band):
            low, high = (metrics[name] for name in line.band)
            steps, at_low, at_high = np.intersect1d(low[0], high[0], return_indices=True)
            _shade(axes, steps, low[1][at_low], high[1][at_high], line.colour)
        # The limit alone says nothing.
        if line.metric in metrics and (line.style != "--" or panel.main in metrics):
            _draw(axes, *metrics[line.metric], line)
    _finish(axes, panel)


def _draw_comparison(axes: Axes, panel: _Panel, runs: Mapping[str, Sequence[Curves]]) -> None:
    looks = itertools.cycle(itertools.product(_DASHES, _COLOURS))
    for (label, group), (style, colour) in zip(runs.items(), looks, strict=False):
        # Costs have names of their own in every environment.
        own = next(each for each in _panels(group[0]) if each.title == panel.title)
        curves = [run[own.main] for run in group if own.main in run]
        if not curves:
            continue
        steps, values = _aligned(curves)
        if len(curves) > 1:
            low, high = zip(*(bootstrap_interval(torch.tensor(v)) for v in values.T), strict=True)
            _shade(axes, steps, np.array(low), np.array(high), colour)
        name = own.lines[0].label.removeprefix("estimate") if own.main.startswith(_LEVEL) else ""
        _draw(axes, steps, values.mean(0), _Line(own.main, label + name, colour, style))
        limit = next((line.metric for line in own.lines if line.style == "--"), None)
        if limit is not None and limit in group[0]:
            _draw(axes, *group[0][limit], _Line(limit, "", colour, "--", 0.8))
    _finish(axes, panel)


def _aligned(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Steps [M] that all of N curves reach, and the values there, [N, M]."""
    first, last = max(steps[0] for steps, _ in curves), min(steps[-1] for steps, _ in curves)
    steps = np.unique(np.concatenate([steps for steps, _ in curves]))
    steps = steps[(steps >= first) & (steps <= last)]
    return steps, np.stack([np.interp(steps, *curve) for curve in curves])


def _finish(axes: Axes, panel: _Panel) -> None:
    from matplotlib.ticker import EngFormatter

    axes.set(xlabel="environment steps", ylabel=panel.unit)
    axes.spines[["top", "right"]].set_visible(False)
    if axes.lines:
        axes.set_xlim(left=0)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.grid(color="#cccccc", alpha=0.5)
        axes.legend(frameon=False)
    else:
        axes.set(xticks=[], yticks=[])
        axes.text(0.5, 0.5, "no data yet", transform=axes.transAxes, ha="center", color=_GREY)


def _draw(axes: Axes, steps: np.ndarray, values: np.ndarray, line: _Line) -> None:
    axes.plot(
        steps,
        _drawable(values),
        label=line.label or None,
        color=line.colour,
        ls=line.style,
        lw=line.width,
        marker="o" if len(steps) == 1 else "",  # one point has no line to show
    )


def _shade(axes: Axes, steps: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str) -> None:
    axes.fill_between(steps, _drawable(low), _drawable(high), color=colour, alpha=0.15, lw=0)


def _drawable(values: np.ndarray) -> np.ndarray:
    """Values with gaps where there is no number, or one of which no axis can be made."""
    return np.where(np.abs(values) < 1e100, values, np.nan)


def _themed(svg: str, title: str) -> str:
    """A picture as an element of a page: no size, no names of its own, colours of the page."""
    box = re.search(r'viewBox="[^"]*"', svg)
    assert box is not None
    for pattern in (r".*?<svg[^>]*>", r"<metadata>.*?</metadata>", r"<style.*?</style>"):
        svg = re.sub(pattern, "", svg, count=1, flags=re.DOTALL)
    for colour, variable in _THEME.items():
        svg = re.sub(colour, variable, svg, flags=re.IGNORECASE)
    svg = _IDS.sub("", svg)
    return f'<svg class="curve" role="img" aria-label="{escape(title)}" {box[0]}>{svg.strip()}'


def _braille(curves: Sequence[tuple[np.ndarray, np.ndarray]], width: int, height: int) -> list[str]:
    """Lines of characters: an axis of nine columns and the curves beside it."""
    columns, dots = max(1, width - 9), 4 * height
    values = np.concatenate([_drawable(values) for _, values in curves])
    values = values[np.isfinite(values)]
    low, high = (float(values.min()), float(values.max())) if values.size else (0.0, 0.0)
    last = max(1, max(int(steps[-1]) for steps, _ in curves))
    grid = np.zeros((height, columns), int)
    # Unicode's numbers of a pattern's dots, from above, to the left and to the right.
    bits = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
    at = np.linspace(0, last, 32 * columns)  # so often that a steep line has no gaps
    across = np.arange(32 * columns) // 16
    for steps, curve in curves:
        shown = np.interp(at, steps, _drawable(curve), left=np.nan, right=np.nan)
        is_there = np.isfinite(shown)
        up = (shown[is_there] - low) / ((high - low) or 1.0)
        row = np.rint((1 - up) * (dots - 1)).astype(int)
        column = across[is_there]
        np.bitwise_or.at(grid, (row // 4, column // 2), bits[row % 4, column % 2])
    ends = {0: f"{high:.4g}", height - 1: f"{low:.4g}"}
    return [
        f"{ends.get(i, ''):>8} {''.join(chr(0x2800 + int(dot)) for dot in line)}"
        for i, line in enumerate(grid)
    ]
