"""One page about a run, or about several side by side, that opens anywhere.

It is one HTML file: pictures, film and style are in it, nothing is loaded and no script runs. All
that is on it is in the runs' folders, and a folder that somebody else made can be shown, too.
"""

from __future__ import annotations

import base64
import contextlib
import json
import math
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from torchrl_safe._costs import costs_among
from torchrl_safe._files import (
    JSON_LIMIT,
    FileRefusedError,
    expand,
    printable,
    read_bytes,
    read_json,
    write_atomically,
)
from torchrl_safe.record import bootstrap_interval, draw_curves, proportion_interval, read_metrics
from torchrl_safe.trainers.options import Options, describe, flat, per_episode
from torchrl_safe.trainers.saved import CONFIG, HISTORY, RESULTS, RESULTS_LIMIT, read_config

MEDIA_LIMIT = 2**22  # bytes of a picture or film that is put into the page
MOST_RUNS = 200
DEPTH = 4  # folders below one that is searched for runs
# What may differ between runs of one setting: who counts them as seeds of it.
OF_ONE_RUN = ("seed", "run_dir", "resume", "num_threads", "device")
NAN = float("nan")


class Number(NamedTuple):
    """A mean with its 95 % interval; NaN where there is none."""

    value: float
    low: float = NAN
    high: float = NAN


@dataclass(frozen=True)
class Look:
    """What a run's folder says.

    Attributes:
        path: the folder.
        settings: options by their dotted names.
        defaults: those of the method; empty for a method that is not known here.
        meanings: of the options, a line each.
        curves: what was logged.
        results: of the final evaluation; empty before it.
        evaluation: of ``torchrl-safe evaluate``; empty without.
        history: an entry per start.
    """

    path: Path
    settings: Mapping[str, Any]
    defaults: Mapping[str, Any]
    meanings: Mapping[str, str]
    curves: Mapping[str, tuple[np.ndarray, np.ndarray]]
    results: Mapping[str, Any]
    evaluation: Mapping[str, Any]
    history: Sequence[Mapping[str, Any]]

    @property
    def method(self) -> str:
        """The method's name as its class has it."""
        from torchrl_safe.trainers.methods import METHODS

        name = str(self.settings.get("method", "a run"))
        return METHODS[name].__name__ if name in METHODS else name

    @property
    def environment(self) -> str:
        """What was trained in."""
        name, robot, task, id_ = (
            self.settings.get(f"env.{each}") for each in ("name", "robot", "task", "id")
        )
        if name == "robot":
            return f"{robot}, {task}" if task else str(robot)
        return str(id_ or name)

    @property
    def frames(self) -> int:
        """Frames so far."""
        steps = [int(steps[-1]) for steps, _ in self.curves.values()]
        return int(_number(self.results.get("frames"), max(steps, default=0)))

    @property
    def limits(self) -> dict[str, float]:
        """The limit on each cost, as the sum of an evaluated episode."""
        limit = self.settings.get("loss.cost_limit")
        limits = limit if isinstance(limit, Mapping) else {"cost": limit}
        unit, gamma, steps = (
            self.settings.get(name)
            for name in ("loss.limit_unit", "loss.cost_gamma", "eval.num_steps")
        )
        found = {}
        for cost, value in limits.items():
            with contextlib.suppress(TypeError):
                found[str(cost)] = per_episode(value, str(unit), gamma, steps)  # type: ignore[arg-type]
        return found


def write_report(folders: Sequence[str | os.PathLike[str]], path: str | os.PathLike[str]) -> Path:
    """Writes the page about runs.

    Args:
        folders (sequence of path): runs, or folders below which there are runs, such as those of a
            sweep. Runs that differ in nothing but their seed are shown as one, with mean and
            interval over the seeds.
        path (path): the page; its folder is made if need be.

    Returns:
        Path: the page.

    Raises:
        FileNotFoundError: if there is no run.
        CheckpointError: if a configuration is not what was written.
        FileRefusedError: a ``ValueError``, if there are links in a log, or too many runs.
    """
    looks = [look(folder) for folder in runs_in(folders)]
    path = expand(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, page(looks))
    return path


def runs_in(folders: Sequence[str | os.PathLike[str]]) -> list[Path]:
    """The runs among and below folders, each once.

    Raises:
        FileNotFoundError: if a folder has none.
        FileRefusedError: if there are more than 200.
    """
    runs: dict[Path, None] = {}
    for folder in map(expand, folders):
        found = sorted(_below(folder, DEPTH))
        if not found:
            raise FileNotFoundError(
                f"run_dir={printable(folder)} holds no run: there is no {CONFIG} in it or below."
            )
        runs |= dict.fromkeys(found)
    if len(runs) > MOST_RUNS:
        raise FileRefusedError(f"A page shows at most {MOST_RUNS} runs, and here are {len(runs)}.")
    return list(runs)


def _below(folder: Path, depth: int) -> Iterator[Path]:
    """The folder if it is a run, or the runs below it; links are not followed."""
    if os.path.lexists(folder / CONFIG):
        yield folder
    elif depth and folder.is_dir():
        for entry in os.scandir(folder):
            if entry.is_dir(follow_symlinks=False):
                yield from _below(Path(entry.path), depth - 1)


def look(folder: Path) -> Look:
    """What a run's folder says; what is missing in it is empty.

    Raises:
        CheckpointError: if the configuration is not what was written.
        FileRefusedError: if there are links in the log.
    """
    import torchrl_safe.trainers.methods  # noqa: F401, makes them known

    settings = read_config(folder / CONFIG)
    known = Options.known.get(str(settings.get("method")))
    return Look(
        path=folder,
        settings=dict(_leaves(settings, {} if known is None else dict(flat(known())))),
        defaults={} if known is None else dict(flat(known())),
        meanings={} if known is None else {row.name: row.meaning for row in describe(known)},
        curves=read_metrics(folder / "log") if (folder / "log").is_dir() else {},
        results=_read_results(folder / RESULTS),
        evaluation=_read_results(_evaluation(folder) / RESULTS),
        history=_read_history(folder / HISTORY),
    )


def _evaluation(folder: Path) -> Path:
    """Where an evaluation is; nowhere, if a link stands in its place."""
    path = folder / "evaluation"
    return Path(os.devnull) if path.is_symlink() else path


def _leaves(
    settings: Mapping[str, Any], defaults: Mapping[str, Any], prefix: str = ""
) -> Iterator[tuple[str, Any]]:
    """Settings by their dotted names; an option's own mapping stays whole."""
    for name, value in settings.items():
        full = f"{prefix}{name}"
        if isinstance(value, Mapping) and full not in defaults:
            yield from _leaves(value, defaults, f"{full}.")
        else:
            yield full, value


def _read_results(path: Path) -> Mapping[str, Any]:
    """Results, or none of a file that is missing or no such file."""
    try:
        results = read_json(path, RESULTS_LIMIT)
    except (OSError, FileRefusedError):
        return {}
    return results if isinstance(results, dict) else {}


def _read_history(path: Path) -> list[Mapping[str, Any]]:
    try:
        lines = read_bytes(path, JSON_LIMIT).decode(errors="replace").splitlines()
        entries = [json.loads(line) for line in lines]
    except (OSError, ValueError, RecursionError):
        return []
    return [entry for entry in entries if isinstance(entry, dict)]


# What is on the page in numbers


def judged(results: Mapping[str, Any], prefix: str) -> dict[str, Number]:
    """What an evaluation's episodes say of one way to act, by name.

    Args:
        results (mapping): of ``results.json``.
        prefix (str): of the way, ``"eval/det/"`` and the like.

    Returns:
        dict of Number: means per episode, the quantiles ``violations_p95`` and ``violations_p99``,
        and the shares ``violating`` and, where there are goals, ``no_goal_rate``.
    """
    everything = results.get("episodes")
    episodes = everything.get(prefix) if isinstance(everything, Mapping) else None
    rows = [row for row in episodes if isinstance(row, Mapping)] if episodes else []
    columns = {
        name: np.array([_number(row.get(name)) for row in rows])
        for name in (rows[0] if rows else ())
        if not isinstance(rows[0][name], str)
    }
    found = {
        name.removeprefix(prefix): Number(_number(value))
        for name, value in results.items()
        if name.startswith(prefix) and "/" not in name.removeprefix(prefix)
    }
    for name, column in columns.items():
        low, high = bootstrap_interval(torch.from_numpy(column))
        found[name] = Number(float(column.mean()), low, high)
    violations = columns.get("violations")
    if violations is not None:
        for name, share in (("violations_p95", 0.95), ("violations_p99", 0.99)):
            found.setdefault(name, Number(float(np.quantile(violations, share))))
        found["violating"] = _share(violations > 0)
    if "goals" in columns:
        found["no_goal_rate"] = _share(columns["goals"] == 0)
    return found


def over_seeds(numbers: Sequence[Mapping[str, Number]]) -> Mapping[str, Number]:
    """Numbers of several runs: the mean over runs, and its interval; those of one stay."""
    if len(numbers) == 1:
        return numbers[0]
    shared = [name for name in numbers[0] if all(name in each for each in numbers)]
    values = {name: torch.tensor([each[name].value for each in numbers]) for name in shared}
    return {
        name: Number(float(each.double().mean()), *bootstrap_interval(each))
        for name, each in values.items()
    }


def _share(met: np.ndarray) -> Number:
    return Number(float(met.mean()), *proportion_interval(int(met.sum()), len(met)))


def _number(value: Any, otherwise: float = NAN) -> float:
    return float(value) if isinstance(value, int | float) else otherwise


def grouped(looks: Sequence[Look]) -> dict[str, list[Look]]:
    """Runs of one setting together, under a name that says what is theirs alone."""
    groups: dict[str, list[Look]] = {}
    for each in looks:
        rest = {n: v for n, v in each.settings.items() if n not in OF_ONE_RUN}
        groups.setdefault(json.dumps(rest, sort_keys=True, default=str), []).append(each)
    firsts = [group[0] for group in groups.values()]
    names = [[first.method for first in firsts]]
    names.append([f"{first.method}, {first.environment}" for first in firsts])
    names.append([f"{first.method}, {', '.join(_own_words(first, firsts))}" for first in firsts])
    names.append([f"{first.method}, {printable(first.path)}" for first in firsts])
    chosen = [
        next((form[i] for form in names if form.count(form[i]) == 1), names[-1][i])
        for i in range(len(firsts))
    ]
    return dict(zip(chosen, groups.values(), strict=True))


def _own_words(run: Look, others: Sequence[Look]) -> list[str]:
    """The options in which a run differs from others of its method, three at most."""
    rivals = [other for other in others if other.method == run.method]
    words = [
        f"{name.rpartition('.')[2]}={_plain(value)}"
        for name, value in run.settings.items()
        if name not in OF_ONE_RUN and any(each.settings.get(name) != value for each in rivals)
    ]
    return words if len(words) <= 3 else [printable(run.path.name)]


# The page


def page(looks: Sequence[Look]) -> str:
    """The page about runs, as HTML."""
    groups = grouped(looks)
    first = looks[0]
    if len(looks) == 1:
        title = f"{first.method}, {first.environment}, seed {first.settings.get('seed')}"
        opening = f"<p class='lead'>{verdict(first)}</p>{tiles(first)}"
    else:
        places = sorted({each.environment for each in looks})
        title = f"{len(looks)} runs, {' and '.join(places)}"
        opening = f"<p class='lead'>{len(groups)} settings side by side.</p>"
    parts = [
        section("What ran", what_ran(groups)),
        section("Learning curves", curves(groups)),
        section("Score, cost and violations", numbers(groups)),
        *(section(name, media(group[0])) for name, group in _titled_media(groups)),
        section("Configuration", configuration(groups)),
    ]
    written = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime())
    return (
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        "<meta http-equiv='Content-Security-Policy' content=\"default-src 'none'; "
        "style-src 'unsafe-inline'; img-src data:; media-src data:\">"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n<body><main>"
        f"<h1>{escape(title)}</h1>{opening}{''.join(parts)}"
        f"<footer>torchrl-safe report, {written}</footer></main></body></html>\n"
    )


def section(title: str, content: str) -> str:
    """A section, or nothing where there is no content."""
    return f"\n<section><h2>{escape(title)}</h2>{content}</section>" if content else ""


def verdict(run: Look) -> str:
    """The run in two sentences: how far it is, and its cost beside the limit."""
    total = run.settings.get("collector.total_frames")
    so_far = f"{run.frames:,} of {total:,} frames" if isinstance(total, int) else ""
    source = evaluated([run])
    if source is None:
        return escape(f"Not finished: {so_far}. Numbers follow the final evaluation.")
    values = judged(source.results(run), source.prefixes["deterministic action"])
    words = [f"Finished, {so_far}."]
    for cost, limit in run.limits.items():
        if cost not in values:
            continue
        name = cost.removesuffix("_cost").removesuffix("cost")
        paid = values[cost]
        if paid.high <= limit:
            stand = "below its limit of"
        elif paid.low > limit:
            stand = "above its limit of"
        else:
            stand = "not to be told from its limit of"
        of = f" of {name}" if name else ""
        words.append(f"The mean cost{of} of an episode is {shown(paid.value)}, {stand} {limit:g}.")
        suffix = "" if cost == "cost" or len(run.limits) == 1 else f"/{cost}"
        now = [run.curves.get(f"update/cost_{each}{suffix}") for each in ("level", "limit")]
        if now[0] is not None and now[1] is not None:
            level, line = float(now[0][1][-1]), float(now[1][1][-1])
            words.append(
                f"The method's last estimate of what it limits is {shown(level)}, where "
                f"{shown(line)} is allowed."
            )
    return escape(" ".join(words))


def tiles(run: Look) -> str:
    """The numbers that matter, large."""
    source = evaluated([run])
    if source is None:
        return ""
    values = judged(source.results(run), source.prefixes["deterministic action"])
    boxes = []
    for label, name in ROWS:
        if name in TILES and name in values:
            boxes.append((label, cell(values[name], name)))
    for cost, limit in run.limits.items():
        if cost in values:
            boxes.insert(1, (_of_cost(cost), f"{cell(values[cost], cost)}<i>limit {limit:g}</i>"))
    return (
        "<div class='tiles'>"
        + "".join(f"<div><b>{escape(label)}</b><span>{text}</span></div>" for label, text in boxes)
        + "</div><p class='note'>Deterministic action, with 95 % intervals.</p>"
    )


def what_ran(groups: Mapping[str, Sequence[Look]]) -> str:
    """Method, environment, time, versions and machine; a column per group."""
    columns = [facts(group) for group in groups.values()]
    names = list(dict.fromkeys(name for column in columns for name in column))
    rows = [[escape(name), *(escape(c.get(name, "-")) for c in columns)] for name in names]
    return table(list(groups) if len(groups) > 1 else [], rows)


def facts(group: Sequence[Look]) -> dict[str, str]:
    """What is known of runs of one setting."""
    first = group[0]
    found = {"Method": first.method, "Environment": first.environment}
    seeds = [each.settings.get("seed") for each in group]
    found["Seed" if len(seeds) == 1 else "Seeds"] = ", ".join(map(str, seeds))
    frames = sum(each.frames for each in group) / len(group)
    found["Frames"] = f"{frames:,.0f}"
    seconds = [_number(each.results.get("seconds")) for each in group]
    mean = sum(seconds) / len(seconds)
    if math.isfinite(mean):
        found["Time"] = duration(mean) + (", on average" if len(group) > 1 else "")
        found["Frames per second"] = f"{frames / mean:,.0f}" if mean else "-"
    violations = [_number(each.results.get("total_cvs")) for each in group]
    if math.isfinite(sum(violations)):
        found["Violations in training"] = f"{sum(violations) / len(group):,.0f}"
    started = [str(each.history[0].get("time", "")) for each in group if each.history]
    if started:
        found["Started"] = min(started).replace("T", " ").replace("Z", " UTC")
    found["Folder"] = printable(first.path if len(group) == 1 else first.path.parent)
    starts = sum(len(each.history) for each in group)
    if starts > len(group):
        found["Resumed"] = f"{starts - len(group)} times"
    last = first.history[-1].get("surroundings") if first.history else None
    if not isinstance(last, Mapping):
        return found | {"Software and machine": "not recorded"}
    packages = last.get("packages")
    commit, _, state = str(last.get("commit") or "not known: no checkout").partition(",")
    found["Commit"] = (commit[:12] if len(commit) == 40 else commit) + (state and f",{state}")
    found["Software"] = ", ".join(
        [f"Python {last.get('python')}"] + [f"{n} {v}" for n, v in packages.items() if v]
        if isinstance(packages, Mapping)
        else []
    )
    graphics = f", {last['gpu']}" if last.get("gpu") else ""
    found["Machine"] = f"{last.get('processor')}, {last.get('cores')} cores{graphics}"
    found["System"] = str(last.get("system"))
    return found


def curves(groups: Mapping[str, Sequence[Look]]) -> str:
    """The learning curves, a picture per panel."""
    logged = {name: [run.curves for run in g if run.curves] for name, g in groups.items()}
    logged = {name: runs for name, runs in logged.items() if runs}
    if not logged:
        return "<p>Nothing is logged as csv.</p>"
    figures = "".join(
        f"<figure><figcaption>{escape(title)}</figcaption>{svg}</figure>"
        for title, svg in draw_curves(logged).items()
    )
    if sum(map(len, logged.values())) == 1:
        note = "Shaded: 95 % intervals over episodes. The dashed line is the limit in use."
    else:
        note = (
            "Evaluations of the deterministic action; shaded: 95 % bootstrap intervals of the mean "
            "over seeds. Thin dashed lines are limits. With few seeds an interval is narrower than "
            "what other seeds would give."
        )
    return f"<div class='curves'>{figures}</div><p class='note'>{note}</p>"


class Source(NamedTuple):
    """Where the episodes are from that runs are judged by."""

    attribute: str
    prefixes: Mapping[str, str]
    words: str

    def results(self, run: Look) -> Mapping[str, Any]:
        """The results of a run."""
        return getattr(run, self.attribute)


SOURCES = (
    Source(
        "evaluation",
        {"deterministic action": "det/", "sampled action": "sampled/"},
        "torchrl-safe evaluate, on layouts that neither training nor its evaluations saw",
    ),
    Source(
        "results",
        {"deterministic action": "eval/det/", "sampled action": "eval/"},
        "the evaluation at the end of training",
    ),
)

TILES = ("score", "return", "violations", "violations_p99", "no_goal_rate")
ROWS = [
    ("Score", "score"),
    ("Return", "return"),
    ("Violations", "violations"),
    ("Violations, 95th percentile", "violations_p95"),
    ("Violations, 99th percentile", "violations_p99"),
    ("Longest violation, steps", "longest_violation"),
    ("Episodes with a violation", "violating"),
    ("Goals", "goals"),
    ("Episodes without a goal", "no_goal_rate"),
    ("Steps", "length"),
]
SHARES = ("violating", "no_goal_rate")


def evaluated(runs: Sequence[Look]) -> Source | None:
    """The first source that all runs have."""
    for source in SOURCES:
        if all(source.results(run) for run in runs):
            return source
    return None


def numbers(groups: Mapping[str, Sequence[Look]]) -> str:
    """Everything per episode: of one setting both ways to act, of several a table for each way."""
    groups = {
        name: runs
        for name, group in groups.items()
        if (runs := [run for run in group if evaluated([run])])
    }
    everyone = [run for group in groups.values() for run in group]
    source = evaluated(everyone) if everyone else None
    if source is None:
        return "<p>No run has been evaluated at its end yet.</p>"
    values = {
        (name, kind): over_seeds([judged(source.results(run), prefix) for run in group])
        for name, group in groups.items()
        for kind, prefix in source.prefixes.items()
    }
    firsts = [group[0] for group in groups.values()]
    if len(groups) == 1:
        content = numbers_table({kind: each for (_, kind), each in values.items()}, firsts)
    else:
        content = "".join(
            f"<h3>{escape(kind.capitalize())}</h3>"
            + numbers_table({name: values[name, kind] for name in groups}, firsts)
            for kind in source.prefixes
        )
    over = "episodes" if len(everyone) == len(groups) else "the means of seeds"
    return content + (
        f"<p class='note'>Per episode, from {source.words}. Means with 95 % intervals over {over}. "
        f"{limit_words(firsts[0])}</p>"
    )


def numbers_table(columns: Mapping[str, Mapping[str, Number]], runs: Sequence[Look]) -> str:
    """A row per number, a column per setting or way to act; ``runs`` are one of each setting."""
    rows = []
    for label, name in ROWS:
        if any(name in values for values in columns.values()):
            rows.append([escape(label), *(cell(v.get(name), name) for v in columns.values())])
        if name == "return":
            costs = dict.fromkeys(cost for v in columns.values() for cost in costs_among(v))
            for cost in costs:
                rows.append(
                    [escape(_of_cost(cost)), *(cell(v.get(cost), cost) for v in columns.values())]
                )
                limits = [run.limits.get(cost, NAN) for run in runs]
                if len(set(limits)) == 1:
                    limits = limits[:1] * len(columns)
                if any(map(math.isfinite, limits)):
                    rows.append(["Limit on it", *(f"{x:g}" if x == x else "-" for x in limits)])
    return table(list(columns), rows)


def limit_words(run: Look) -> str:
    """What the limit of a run means."""
    if not run.limits:
        return ""
    risk = _number(run.settings.get("loss.risk_level"), 1.0)
    worst = f" of the worst {risk:.3g} of outcomes" if risk < 1 else ""
    unit = escape(str(run.settings.get("loss.limit_unit")))
    return (
        f"A limit is shown as what it allows an episode at an even cost; it was set in the unit "
        f"<code>{unit}</code>, on the mean{worst}."
    )


def _titled_media(
    groups: Mapping[str, Sequence[Look]],
) -> Iterator[tuple[str, Sequence[Look]]]:
    for name, group in groups.items():
        if len(groups) == len(group) == 1:
            yield "Film, trajectories and calibration", group
        else:
            yield f"{name}, seed {group[0].settings.get('seed')}", group


def media(run: Look) -> str:
    """Film, paths and the safety critic's calibration, as far as there are any."""
    folder, figures = run.path, []
    film = data_uri(folder / "video.mp4", "video/mp4") or data_uri(
        _evaluation(folder) / "video.mp4", "video/mp4"
    )
    if film:
        figures.append(
            f"<figure class='film'><video controls preload='metadata' src='{film}'></video>"
            "<figcaption>The deterministic action, filmed.</figcaption></figure>"
        )
    pictures = {
        "trajectories.png": "Paths over the map; violating steps are red, goals are numbered.",
        "calibration.png": "What the safety critic predicted, beside what followed: on the "
        "diagonal it was right, above it too low.",
    }
    costs = [name for name in run.limits if name != "cost"]
    pictures |= {
        f"calibration_{cost}.png": f"Calibration of the safety critic of {cost}." for cost in costs
    }
    for name, caption in pictures.items():
        source = data_uri(_evaluation(folder) / name, "image/png")
        if source:
            figures.append(
                f"<figure><img alt='{escape(caption)}' src='{source}'>"
                f"<figcaption>{escape(caption)}</figcaption></figure>"
            )
    if not run.evaluation:
        figures.append(
            "<p class='note'>Trajectories and calibration are drawn by <code>torchrl-safe evaluate"
            "</code>; then write this page again.</p>"
        )
    return f"<div class='media'>{''.join(figures)}</div>"


def data_uri(path: Path, kind: str) -> str:
    """A small file as part of the page; nothing for one that is missing, large or no file."""
    try:
        content = read_bytes(path, MEDIA_LIMIT)
    except (OSError, FileRefusedError):
        return ""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def configuration(groups: Mapping[str, Sequence[Look]]) -> str:
    """Options that differ from the default, or between settings; then all of them."""
    firsts = [group[0] for group in groups.values()]
    names = list(dict.fromkeys(n for run in firsts for n in run.settings if n not in OF_ONE_RUN))

    def value(run: Look, name: str) -> str:
        if name not in run.settings:
            return "-"
        text = escape(_plain(run.settings[name]))
        return f"<mark>{text}</mark>" if differs(run, name) else text

    def row(name: str) -> list[str]:
        defaults = {_plain(run.defaults[name]) for run in firsts if name in run.defaults}
        meaning = next((run.meanings[name] for run in firsts if name in run.meanings), "")
        return [
            f"<code>{escape(name)}</code>",
            *(value(run, name) for run in firsts),
            escape(" or ".join(sorted(defaults))),
            escape(meaning),
        ]

    changed = [name for name in names if any(differs(run, name) for run in firsts)]
    head = ["Option", *(groups if len(groups) > 1 else ["Value"]), "Default", "Meaning"]
    first = (
        table(head, [row(name) for name in changed], corner=False)
        if changed
        else "<p>Every option has its default.</p>"
    )
    everything = table(head, [row(name) for name in names], corner=False)
    return f"{first}<details><summary>All {len(names)} options</summary>{everything}</details>"


def differs(run: Look, name: str) -> bool:
    """Whether an option is not at its default."""
    return name in run.defaults and run.settings.get(name) != run.defaults[name]


def table(head: Sequence[str], rows: Sequence[Sequence[str]], *, corner: bool = True) -> str:
    """A table that scrolls by itself where it is too wide; cells are HTML already."""
    names = ["", *head] if corner else list(head)
    top = "".join(f"<th scope='col'>{escape(name)}</th>" for name in names) if head else ""
    body = "".join(
        f"<tr><th scope='row'>{first}</th>" + "".join(f"<td>{each}</td>" for each in rest) + "</tr>"
        for first, *rest in rows
    )
    opening = f"<thead><tr>{top}</tr></thead>" if top else ""
    return f"<div class='wide' tabindex='0'><table>{opening}<tbody>{body}</tbody></table></div>"


def cell(number: Number | None, name: str) -> str:
    """A number with its interval."""
    if number is None or not math.isfinite(number.value):
        return "-"
    percent = name in SHARES
    text = shown(number.value, percent)
    if math.isfinite(number.low) and number.low < number.high:
        text += f" <small>{shown(number.low, percent)} to {shown(number.high, percent)}</small>"
    return text


def shown(value: float, percent: bool = False) -> str:
    """A number with three significant digits, or a share in per cent.

    Examples:
        >>> shown(12.345), shown(12345.6), shown(0.0833, percent=True)
        ('12.3', '12,346', '8.3 %')
    """
    if percent:
        return f"{100 * value:.1f} %"
    return f"{value:,.0f}" if abs(value) >= 1_000 else f"{value:.3g}"


def duration(seconds: float) -> str:
    """Seconds as a clock has them.

    Examples:
        >>> duration(59.6), duration(1782), duration(7325)
        ('60 s', '29 min 42 s', '2 h 2 min')
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60} min"


def _of_cost(cost: str) -> str:
    """How a cost is called on the page."""
    discounted = cost.endswith("discounted_cost")
    name = cost.removesuffix("cost").removesuffix("discounted_").rstrip("_")
    return ("Discounted cost" if discounted else "Cost") + (f" of {name}" if name else "")


def _plain(value: Any) -> str:
    """An option's value as the command line has it."""
    return value if isinstance(value, str) else json.dumps(value, default=str)


STYLE = """
:root { color-scheme: light dark; --paper: #fff; --ink: #1b1f24; --grey: #6b7280; --rule: #d5d9e0;
  --tint: #f4f6f9; --mark: #fff0c2; --line-0: #0072b2; --line-1: #c44f00; --line-2: #00805c;
  --line-3: #a8538a; --line-4: #a86f00; --line-5: #1f86bd; }
@media (prefers-color-scheme: dark) { :root { --paper: #15181d; --ink: #e4e7eb; --grey: #9aa3af;
  --rule: #363c46; --tint: #1e232a; --mark: #55430a; --line-0: #58b4f0; --line-1: #ff8a4a;
  --line-2: #3fcf9f; --line-3: #e39ccb; --line-4: #f0b840; --line-5: #8ccdf0; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 1rem/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; }
main { max-width: 70rem; margin: 0 auto; padding: 1rem 1.25rem 3rem; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 1rem 0 0.5rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 0.8rem; border-bottom: 1px solid var(--rule);
  padding-bottom: 0.3rem; }
h3 { font-size: 1rem; margin: 1.4rem 0 0.5rem; }
.lead { font-size: 1.1rem; margin: 0 0 1rem; max-width: 46rem; }
.note, figcaption, footer { color: var(--grey); font-size: 0.875rem; }
.note { max-width: 46rem; }
footer { margin-top: 3rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: 0.6rem; }
.tiles div { background: var(--tint); border-radius: 0.4rem; padding: 0.6rem 0.8rem; }
.tiles b { display: block; font-weight: 500; font-size: 0.8rem; color: var(--grey); }
.tiles span { font-size: 1.35rem; font-weight: 600; line-height: 1.3; }
.tiles small { font-size: 0.8rem; }
.tiles i { display: block; font-style: normal; font-weight: 400; font-size: 0.875rem; }
small { color: var(--grey); font-weight: 400; white-space: nowrap; }
.curves, .media { display: grid; gap: 1rem 1.5rem; align-items: start;
  grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); }
figure { margin: 0; break-inside: avoid; }
.curves figcaption { color: var(--ink); font-weight: 600; }
.curve { width: 100%; height: auto; display: block; }
.curve * { stroke-linejoin: round; stroke-linecap: butt; }
.curve text { fill: var(--ink); font-family: inherit !important; }
img, video { width: 100%; height: auto; display: block; border-radius: 0.3rem; background: #fff; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 0.925rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; vertical-align: top; padding: 0.3rem 1.2rem 0.3rem 0;
  border-bottom: 1px solid var(--rule); overflow-wrap: break-word; min-width: 5.5rem;
  max-width: 34rem; }
td { overflow-wrap: anywhere; }
tbody th { font-weight: 500; min-width: 6.5rem; }
thead th { color: var(--grey); font-weight: 500; }
mark { background: var(--mark); color: inherit; padding: 0 0.25rem; border-radius: 0.2rem; }
code { font-size: 0.9em; overflow-wrap: normal; }
details { margin-top: 1rem; }
summary { cursor: pointer; }
@media print { :root { color-scheme: light; --paper: #fff; --ink: #000; --grey: #444; --rule: #bbb;
  --tint: #f4f4f4; --mark: #eee; --line-0: #0072b2; --line-1: #c44f00; --line-2: #00805c;
  --line-3: #a8538a; --line-4: #a86f00; --line-5: #1f86bd; }
  body { font-size: 10pt; } .film { display: none; } .wide { overflow: visible; }
  h2 { break-after: avoid; } tr { break-inside: avoid; } main { padding: 0; max-width: none; } }
""".strip()
