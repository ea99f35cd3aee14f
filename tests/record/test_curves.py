from __future__ import annotations

import math
import re
from xml.etree import ElementTree

import imageio.v3 as imageio
import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torchrl.record import CSVLogger

from torchrl_safe.record import (
    draw_curves,
    format_table,
    plot_learning_curves,
    read_metrics,
    terminal_curves,
)


@pytest.fixture
def run(tmp_path):
    logger = CSVLogger("run", log_dir=str(tmp_path))
    yield logger
    for file in logger.experiment.files.values():
        file.close()


def log_full_run(logger, num_points=40):
    rng = np.random.default_rng(0)
    for i in range(num_points):
        step = 25_000 * (i + 1)
        rise = 1 - math.exp(-i / 12)
        values = {
            "eval/return": 9 + 3 * rise + 0.4 * rng.normal(),
            "eval/det/return": 9 + 4 * rise + 0.4 * rng.normal(),
            "eval/score": 9 * rise + 0.4 * rng.normal(),
            "eval/det/score": 10.5 * rise + 0.4 * rng.normal(),
            "eval/cv_rate": 0.03 * (1 - rise) + 0.004 * rng.uniform(),
            "eval/det/cv_rate": 0.025 * (1 - rise) + 0.003 * rng.uniform(),
            "train/cv_rate": 0.05 * (1 - rise) + 0.01 * rng.uniform(),
            "update/cost_level": 2.5 + 2 * (1 - rise) + 0.2 * rng.normal(),
            "update/cost_limit": 2.5,
        }
        for name in ("eval/", "eval/det/"):
            values[f"{name}score_low"] = values[f"{name}score"] - 0.8
            values[f"{name}score_high"] = values[f"{name}score"] + 0.6
        for name, value in values.items():
            logger.log_scalar(name, value, step=step)


def run_dir(logger):
    return f"{logger.log_dir}/{logger.exp_name}"


def test_round_trip_through_the_real_logger(run):
    run.log_scalar("eval/score", 1.5, step=1000)
    run.log_scalar("eval/score", -2.25e-9, step=2000)
    run.log_scalar("eval/det/score", 3.0, step=2000)
    run.log_scalar("update/kl", math.nan, step=10)
    run.log_scalar("plain.name", 4.0, step=0)
    metrics = read_metrics(run_dir(run))
    assert set(metrics) == {"eval/score", "eval/det/score", "update/kl", "plain.name"}
    steps, values = metrics["eval/score"]
    assert (steps.dtype, values.dtype) == (np.int64, np.float64)
    assert steps.tolist() == [1000, 2000]
    assert values.tolist() == [1.5, -2.25e-9]
    assert np.isnan(metrics["update/kl"][1]).tolist() == [True]


@pytest.mark.parametrize(
    ("written", "steps", "values"),
    [
        # A whole-looking last line without its newline may be half a number.
        ("100,1.0\n200,2.0\n300,3.1", [100, 200], [1.0, 2.0]),
        ("100,1.0\n200,2.0\n300,", [100, 200], [1.0, 2.0]),
        # Resumed from step 200: what the killed run logged later is of a branch that is gone.
        ("100,1.0\n200,2.0\n300,3.0\n200,20.0\n300,30.0\n", [100, 200, 300], [1.0, 20.0, 30.0]),
        ("100,1.0\n200,2.0\n300,3.0\n250,25.0\n", [100, 200, 250], [1.0, 2.0, 25.0]),
        # The resumed run appends to the torn line: an impossible line, or an impossible step.
        ("100,1.0\n200,2.200,2.0\n300,3.0\n", [100, 300], [1.0, 3.0]),
        ("100,1.0\n20200,2.0\n300,3.0\n", [100, 300], [1.0, 3.0]),
        ("100,1.0\n\n,\nstep,value\n200,2.0\n", [100, 200], [1.0, 2.0]),
        ("100,1.0\n200,nan\n", [100, 200], [1.0, math.nan]),
    ],
)
def test_torn_and_resumed_files(tmp_path, written, steps, values):
    (tmp_path / "scalars/eval").mkdir(parents=True)
    (tmp_path / "scalars/eval/score.csv").write_text(written)
    got = read_metrics(tmp_path)["eval/score"]
    assert got[0].tolist() == steps
    np.testing.assert_array_equal(got[1], values)


def test_resume_through_the_real_logger(tmp_path):
    for start, offset in ((0, 0.0), (2, 100.0)):
        logger = CSVLogger("run", log_dir=str(tmp_path))
        for i in range(start, 4):
            logger.log_scalar("eval/score", i + offset, step=10 * i)
        logger.experiment.files.popitem()[1].close()
    steps, values = read_metrics(tmp_path / "run")["eval/score"]
    assert steps.tolist() == [0, 10, 20, 30]
    assert values.tolist() == [0.0, 1.0, 102.0, 103.0]


def test_empty_and_missing_runs(tmp_path):
    assert read_metrics(tmp_path) == {}
    (tmp_path / "scalars").mkdir()
    (tmp_path / "scalars/loss.csv").write_text("10,0.")
    assert read_metrics(tmp_path) == {}
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read_metrics(tmp_path / "nowhere")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        plot_learning_curves(tmp_path / "nowhere", tmp_path / "curves.png")


@pytest.fixture
def draw(monkeypatch, tmp_path):
    """Draws the curves; returns the picture's path and per panel its lines and its texts."""
    figures = []
    savefig = Figure.savefig

    def keep(figure, *args, **kwargs):
        figures.append(figure)
        savefig(figure, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", keep)

    def draw(directory):
        path = plot_learning_curves(directory, tmp_path / "pictures/curves.png")
        axes = figures[-1].axes
        lines = [{line.get_label(): line for line in panel.lines} for panel in axes]
        return path, lines, [[text.get_text() for text in panel.texts] for panel in axes]

    return draw


def test_full_run(run, tmp_path, draw):
    log_full_run(run)
    path, lines, texts = draw(run_dir(run))
    assert path == tmp_path / "pictures/curves.png"
    assert texts == [[], [], [], []]
    metrics = read_metrics(run_dir(run))
    expected = [
        {"sampled action": "eval/return", "deterministic action": "eval/det/return"},
        {"sampled action": "eval/score", "deterministic action": "eval/det/score"},
        {
            "training": "train/cv_rate",
            "sampled action": "eval/cv_rate",
            "deterministic action": "eval/det/cv_rate",
        },
        {"estimate": "update/cost_level", "limit": "update/cost_limit"},
    ]
    for panel, names in zip(lines, expected, strict=True):
        assert set(panel) == set(names)
        for label, name in names.items():
            np.testing.assert_array_equal(panel[label].get_xdata(), metrics[name][0])
            np.testing.assert_array_equal(panel[label].get_ydata(), metrics[name][1])
        # Told apart without colour, too.
        styles = {(line.get_linestyle(), line.get_linewidth()) for line in panel.values()}
        assert len(styles) == len(panel)
    assert lines[3]["limit"].get_linestyle() == "--"

    picture = imageio.imread(path)[..., :3].astype(int)
    assert picture.shape == (570, 2550, 3)
    for colour in ((0, 114, 178), (213, 94, 0), (153, 153, 153), (0, 0, 0)):
        assert (np.abs(picture - colour).max(-1) < 20).sum() > 300, colour


def test_the_interval_is_shaded(run, tmp_path, draw, monkeypatch):
    bands = []
    fill_between = Axes.fill_between
    monkeypatch.setattr(
        Axes, "fill_between", lambda self, *a, **k: bands.append(a) or fill_between(self, *a, **k)
    )
    for step in (10, 20):
        run.log_scalar("eval/score", 1.0, step=step)
        run.log_scalar("eval/score_low", 0.5, step=step)
    # Killed between two writes: one bound is missing its last step.
    run.log_scalar("eval/score_high", 2.0, step=10)
    run.log_scalar("eval/det/score_low", 2.0, step=10)
    draw(run_dir(run))
    assert [[list(part) for part in band] for band in bands] == [[[10], [0.5], [2.0]]]


def test_values_that_are_not_numbers_leave_gaps(run, draw):
    for name in ("eval/score", "eval/score_low", "eval/score_high", "update/cost_level"):
        for step, value in ((10, math.nan), (20, math.inf if "update" in name else math.nan)):
            run.log_scalar(name, value, step=step)
    _, lines, _ = draw(run_dir(run))
    assert np.isnan(lines[1]["sampled action"].get_ydata()).all()


@pytest.mark.parametrize(
    ("logged", "panel"),
    [
        (None, None),
        ("eval/return", 0),
        ("eval/det/score", 1),
        ("train/cv_rate", 2),
        ("update/cost_level", 3),
        # A limit with no estimate to compare it with is nothing to look at.
        ("update/cost_limit", None),
        ("update/kl", None),
    ],
)
def test_young_runs(run, draw, logged, panel):
    if logged:
        run.log_scalar(logged, 2.0, step=100)
    path, lines, texts = draw(run_dir(run))
    for i in range(4):
        assert bool(lines[i]) == (i == panel)
        assert texts[i] == ([] if i == panel else ["no data yet"])
        # A single point is a line without length.
        assert all(line.get_marker() == "o" for line in lines[i].values())
    assert imageio.imread(path).std() > 5


def test_matplotlib_global_state_is_untouched(run, tmp_path):
    import matplotlib
    import matplotlib.pyplot as plt

    before = dict(matplotlib.rcParams)
    log_full_run(run, num_points=2)
    plot_learning_curves(run_dir(run), tmp_path / "curves.svg")
    assert dict(matplotlib.rcParams) == before
    assert plt.get_fignums() == []


def test_format_table():
    rows = {
        "task": "point, goal",
        "score": 10.42512,
        "score_low": math.nan,
        "cv_rate": 0.00712345,
        "total_cvs": 116_000,
        "frames": 1.25e6,
        "kl": -1.25e-5,
        "zero": 0.0,
    }
    assert format_table(rows).splitlines() == [
        "task       point, goal",
        "score            10.43",
        "score_low          nan",
        "cv_rate       0.007123",
        "total_cvs      116,000",
        "frames       1,250,000",
        "kl           -1.25e-05",
        "zero                 0",
    ]
    assert format_table({}) == ""


def line(values, steps=None):
    return np.arange(len(values)) if steps is None else np.array(steps), np.array(values, float)


class TestDrawCurves:
    def drawn(self, monkeypatch, runs, title):
        """Lines and bands of a panel, by label."""
        lines, bands, plot, fill = {}, [], Axes.plot, Axes.fill_between

        def spy(axes, x, y, **style):
            lines.setdefault(style["label"], []).append((axes, np.array(x), np.array(y)))
            return plot(axes, x, y, **style)

        def spy_fill(axes, x, low, high, **style):
            bands.append((axes, np.array(low), np.array(high)))
            return fill(axes, x, low, high, **style)

        monkeypatch.setattr(Axes, "plot", spy)
        monkeypatch.setattr(Axes, "fill_between", spy_fill)
        svg = draw_curves(runs)[title]
        ElementTree.fromstring(svg.replace("xlink:", ""))
        of = {label: found[0][1:] for label, found in lines.items()}
        return of, [band[1:] for band in bands]

    def test_seeds_are_averaged_where_all_have_been(self, monkeypatch):
        """Seeds that logged at other steps: by hand, on the steps that both reach."""
        runs = [
            {"eval/det/return": line([0.0, 4.0, 8.0], [0, 200, 400])},
            {"eval/det/return": line([3.0, 5.0], [100, 300])},
        ]
        lines, ((low, high),) = self.drawn(monkeypatch, {"a": runs}, "Return")
        steps, mean = lines["a"]
        assert steps.tolist() == [100, 200, 300]
        assert mean.tolist() == [2.5, 4.0, 5.5]
        # Of two seeds, a resample is one, the other or their mean: the ends are the seeds.
        assert low.tolist() == [2.0, 4.0, 5.0]
        assert high.tolist() == [3.0, 4.0, 6.0]

    def test_costs_keep_their_names(self, monkeypatch):
        runs = {
            "one": [{"update/cost_level": line([1.0, 2.0])}],
            "two": [{"update/cost_level/speed_cost": line([3.0, 4.0])}],
        }
        lines, bands = self.drawn(monkeypatch, runs, "Constraint")
        assert lines["one"][1].tolist() == [1.0, 2.0]
        assert lines["two of speed_cost"][1].tolist() == [3.0, 4.0]
        assert not bands

    def test_colours_are_the_pages(self):
        (svg, *_) = draw_curves({"a": [{"eval/return": line([1.0, 2.0])}]}).values()
        assert not re.search("#[0-9a-f]{6}", svg.replace("xlink", ""), re.IGNORECASE)
        assert "<text" in svg

    def test_none(self):
        with pytest.raises(ValueError, match="runs must hold at least one, got"):
            draw_curves({"a": []})


class TestTerminalCurves:
    def test_a_rising_line_rises(self):
        """Each character's dots, seen as a picture: one path from below left to above right."""
        _, *rows = terminal_curves({"eval/return": line([0.0, 1.0])}, width=29, height=5).split(
            "\n"
        )
        dots = np.zeros((20, 40), bool)
        places = [(0, 0), (1, 0), (2, 0), (0, 1), (1, 1), (2, 1), (3, 0), (3, 1)]  # Unicode's
        for i, row in enumerate(rows):
            for j, character in enumerate(row[9:]):
                for bit, (down, right) in enumerate(places):
                    dots[4 * i + down, 2 * j + right] = (ord(character) - 0x2800) >> bit & 1
        heights = 19 - np.array([column.nonzero()[0].mean() for column in dots.T])
        np.testing.assert_allclose(heights, np.linspace(0, 19, 40), atol=0.8)

    def test_limit_has_the_same_scale(self):
        level, limit = line([1.0, 1.0]), line([3.0, 3.0])
        text = terminal_curves({"update/cost_level": level, "update/cost_limit": limit}, width=30)
        title, top, *_, bottom = text.split("\n")
        assert title == "Constraint"
        assert top.startswith("       3 \u2809")
        assert bottom.startswith("       1 \u28c0")

    @pytest.mark.parametrize("width", [1, 9, 69, 70, 200])
    def test_fits(self, run, width):
        log_full_run(run)
        text = terminal_curves(read_metrics(run_dir(run)), width)
        assert max(map(len, text.split("\n"))) <= max(width, 10)

    @pytest.mark.parametrize("values", [[math.nan], [math.inf, 1.0], [2.0], []])
    def test_numbers_that_are_none(self, values):
        assert isinstance(terminal_curves({"eval/return": line(values)} if values else {}), str)
