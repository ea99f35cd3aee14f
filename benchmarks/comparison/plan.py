"""The comparison's numbers, its trainings, and what is kept of one.

``PLAN`` is what docs/protocol.md says. ``SMOKE`` is the same chain in seconds, for a test.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[1]))
import cell
from fill import ROOT, Table, add_arguments, facts
from spaces import ROWS, word

from torchrl_safe.record import read_metrics
from torchrl_safe.trainers.options import Options, flat

RESULTS = ROOT / "benchmarks" / "results" / "comparison"

POINTS = 20  # of a training's curve that are kept


class Plan(NamedTuple):
    """Who is trained how often and how long, on which seeds, and how it is judged.

    Attributes:
        trials: of the random search, for each method.
        trial_frames: of each.
        trial_seed: of the first; every trial has the next one, the same for all methods.
        best: trials that are trained again.
        best_seeds: with these.
        frames: of these trainings, of the search of the limit, and of the final ones.
        tuning_target: the realised mean discounted cost that tuning is for.
        tuning_episodes: of an evaluation in tuning and search.
        multiples: of the tuned limit, which the search of the limit begins with.
        factor: by which the search goes on beyond its ends, where a target is not between them.
        further: how often, at each end.
        search_seed: of the first multiple; every limit has the next one.
        targets: realised mean discounted costs that methods are compared at.
        final_seeds: of the final trainings.
        final_episodes: of a final evaluation.
        tiny: options of all trainings, where a method has them.
    """

    trials: int = 16
    trial_frames: int = 300_000
    trial_seed: int = 1_000
    best: int = 3
    best_seeds: tuple[int, ...] = (1_100, 1_101, 1_102)
    frames: int = 1_000_000
    tuning_target: float = 3.0
    tuning_episodes: int = 200
    multiples: tuple[float, ...] = (0.4, 0.65, 1.0, 1.6, 2.5)
    factor: float = 1.6
    further: int = 2
    search_seed: int = 1_200
    targets: tuple[float, ...] = (2.0, 3.0, 5.0)
    final_seeds: tuple[int, ...] = (2_000, 2_001, 2_002, 2_003, 2_004)
    final_episodes: int = 1_000
    tiny: tuple[tuple[str, Any], ...] = ()


PLAN = Plan()

SMOKE = Plan(
    trials=2,
    trial_frames=400,
    best=1,
    best_seeds=(1_100,),
    frames=600,
    tuning_episodes=8,
    multiples=(0.65, 1.6),
    further=0,
    targets=(3.0,),
    final_seeds=(2_000, 2_001),
    final_episodes=20,
    tiny=(
        ("env.num_envs", 4),
        ("env.episode_length", 50),
        ("collector.frames_per_batch", 200),
        ("collector.init_frames", 0),
        ("policy.num_cells", [8]),
        ("critic.num_cells", [8]),
        ("replay_buffer.size", 2_000),
        ("optim.num_updates", 2),
        ("safety_critic.num_updates", 2),
        ("optim.critic_rounds", 1),
        ("optim.num_epochs", 1),
        ("optim.minibatch_size", 100),
        ("optim.critic_frames", 200),
        ("optim.policy_frames", 200),
        ("eval.num_steps", 20),
    ),
)


class Training(NamedTuple):
    """A cell of the comparison.

    Attributes:
        robot: whose own task it is.
        stage: ``tuning``, ``search`` or ``final``: whose layouts it is judged on.
        row: a name in ``spaces.ROWS``.
        name: of the configuration.
        frames: of the training.
        seed: of the training.
        options: by dotted name.
        episodes: of the evaluation.
    """

    robot: str
    stage: str
    row: str
    name: str
    frames: int
    seed: int
    options: tuple[tuple[str, Any], ...]
    episodes: int

    @property
    def path(self) -> Path:
        """Of its result, without the suffix."""
        return Path(
            self.robot, self.stage, self.row, self.name, f"{self.frames}", f"seed_{self.seed}"
        )

    @property
    def words(self) -> list[str]:
        """What follows ``torchrl-safe train``: nothing is evaluated on the way, but at the end."""
        return [
            ROWS[self.row].method,
            word("env.robot", self.robot),
            *(word(*each) for each in self.options),
            f"eval.interval={self.frames}",
            "eval.num_episodes=2",
            "eval.final_episodes=2",
            "video.num_steps=0",
            f"seed={self.seed}",
        ]


def training(
    plan: Plan,
    robot: str,
    stage: str,
    row: str,
    name: str,
    frames: int,
    seed: int,
    drawn: Mapping[str, float],
) -> Training:
    """The training of drawn values."""
    method = ROWS[row].method
    values = ROWS[row].settled(dict(drawn), frames)
    tiny = {n: x for n, x in plan.tiny if n in dict(flat(Options.known[method]()))}
    options = tuple((n, tuple(x) if isinstance(x, list) else x) for n, x in (values | tiny).items())
    episodes = plan.final_episodes if stage == "final" else plan.tuning_episodes
    return Training(robot, stage, row, name, frames, seed, options, episodes)


def result(run: Training, run_dir: Path) -> dict[str, Any]:
    """What is kept of a training: all episodes of its evaluation, and a curve without any.

    Of one that diverged: that it did.

    Raises:
        ValueError: if the run has other options than the training's command.
    """
    about = {**dict(zip(run._fields[:6], run[:6], strict=True)), "options": dict(run.options)}
    played = json.loads((run_dir / cell.PLAYED).read_text())
    if "diverged" in played:
        return about | played
    metrics = read_metrics(run_dir / "log")
    frames, levels = metrics.get("update/cost_level", (np.zeros(0), np.zeros(0)))
    late = levels[frames > 0.9 * run.frames]
    at = metrics["train/cost_rate"][0]
    rows = np.unique(np.linspace(0, len(at) - 1, min(POINTS, len(at))).round().astype(int))
    known = facts(run, run_dir)
    seconds = round(known["evaluation_seconds"] + played["seconds"], 1)
    return {
        **about,
        **known,
        "evaluation_seconds": seconds,
        "level": round(float(late.mean()), 4) if len(late) else None,
        "curve": {
            "frames": at[rows].astype(int).tolist(),
            **{
                name: metrics[f"train/{name}"][1][rows].round(4).tolist()
                for name in ("reward_per_1000", "cost_rate", "cv_rate", "total_cvs")
            },
        },
        "episodes": played["episodes"],
    }


Result = Mapping[str, Any]
Array = NDArray[np.float64]


def column(kept: Result, name: str, kind: str = "sampled") -> Array:
    """A figure of all episodes of a result; ``score`` and ``outcomes`` are made of what is kept.

    ``outcomes`` are the discounted costs from each of the steps that ``cell.outcomes`` counts from,
    of all episodes together.
    """
    episodes = kept["episodes"][kind]
    if name == "score":
        return column(kept, "return", kind) / (1 + column(kept, "violations", kind))
    if name == "outcomes":
        values = [x for from_step in episodes["discounted"] for x in from_step if x is not None]
        return np.array(values, float)
    return np.array(episodes[name], float)


def realised(kept: Result) -> float:
    """The mean discounted cost that a training's evaluation had."""
    return float(column(kept, "outcomes").mean())


def merit(kept: Result, target: float) -> float:
    """What trials are ranked by: the score, and less where the realised cost is above the target.

    Twice the target's cost halves a score that is above zero, and doubles one below. Costs below
    the target neither help nor hurt. What diverged is worst.

    Args:
        kept (mapping): a result.
        target (float): realised mean discounted cost.
    """
    if "diverged" in kept:
        return -math.inf
    score = float(column(kept, "score").mean())
    excess = max(1.0, realised(kept) / target)
    return score / excess if score > 0 else score * excess


class Comparison:
    """Where the comparison is kept, and what of it is there.

    Args:
        args (argparse.Namespace): of :func:`arguments`.
    """

    def __init__(self, args: argparse.Namespace) -> None:
        self.plan = SMOKE if args.smoke else PLAN
        self.args = args
        script = [sys.executable, str(Path(cell.__file__))]
        self.table: Table[Training] = Table(
            results=args.results,
            runs=args.runs,
            command=lambda run: [
                *script,
                *(run.stage, str(run.episodes), *run.words, f"num_threads={args.threads}"),
            ],
            result=result,
            product=cell.PLAYED,
            here=(lambda line: cell.main(line[2:])) if args.smoke else None,
        )
        self.file = args.results / "frozen.json"

    def fill(self, cells: Sequence[Training]) -> int:
        """Run those that are missing; the number of those that failed."""
        return self.table.fill(cells, self.args.jobs, self.args.threads, self.args.dry_run)

    def kept(self, cells: Iterable[Training]) -> list[Result] | None:
        """Results of cells, if all are there."""
        cells = list(cells)
        if self.table.missing(cells):
            return None
        return [json.loads(self.table.file(cell).read_text()) for cell in cells]

    def estimate(self, trainings: Sequence[tuple[str, int]], what: str) -> None:
        """Say what will follow."""
        if trainings:
            hours = self.table.core_hours(trainings)
            print(f"then {len(trainings)} {what}, about {hours:.3g} core-hours")

    @property
    def frozen(self) -> dict[str, Any]:
        """What was found, by row: the tuned values, and limits by robot and frames."""
        return json.loads(self.file.read_text()) if self.file.exists() else {}

    def freeze(self, row: str, **found: Any) -> None:
        """Write down what was found of a row; what is written once stays.

        Raises:
            ValueError: if something else is there already.
        """
        frozen = self.frozen
        entry = frozen.setdefault(row, {})
        for name, value in found.items():
            if entry.setdefault(name, value) != value:
                raise ValueError(
                    f"{name} of {row} is frozen as {entry[name]}, and would be {value}: take it "
                    f"out of {self.file} if the comparison is to begin again."
                )
        self.file.parent.mkdir(parents=True, exist_ok=True)
        self.file.write_text(json.dumps(frozen, indent=1) + "\n")


def arguments(about: str | None, argv: Sequence[str] | None, *more: Any) -> argparse.Namespace:
    """The command line of the comparison's programs.

    Args:
        about (str, optional): the program's docstring.
        argv (sequence of str, optional): defaults to the process's.
        *more: pairs of a name and the keywords of further arguments.
    """
    parser = argparse.ArgumentParser(description=(about or "").splitlines()[0])
    parser.add_argument("--methods", nargs="+", choices=ROWS, default=list(ROWS))
    for name, how in more:
        parser.add_argument(name, **how)
    parser.add_argument("--smoke", action="store_true", help="tiny trainings, in this process")
    add_arguments(parser, RESULTS, ROOT / "runs" / "comparison")
    args = parser.parse_args(argv)
    if args.smoke and RESULTS in (args.results, *args.results.parents):
        parser.error("--smoke needs --results elsewhere: its figures are none")
    return args
