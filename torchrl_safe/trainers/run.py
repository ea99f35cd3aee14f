"""A folder is one run, and stays it: who has it, how it goes on, what it keeps."""

from __future__ import annotations

import json
import os
import platform
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

from tensordict import TensorDictBase
from torchrl.checkpoint import GlobalRNGState
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

from torchrl_safe._costs import costs_among
from torchrl_safe._files import (
    JSON_LIMIT,
    expand,
    read_bytes,
    read_json,
    write_atomically,
)
from torchrl_safe.record import (
    describe,
    evaluate,
    format_table,
    plot_learning_curves,
    record_video,
    summarize,
)
from torchrl_safe.trainers.checkpoints import (
    Rotation,
    SealedCheckpoint,
    latest,
    read_manifest,
    remove_leftovers,
)
from torchrl_safe.trainers.collectors import envs_per_batch
from torchrl_safe.trainers.locks import FolderLock
from torchrl_safe.trainers.logs import Log
from torchrl_safe.trainers.options import MethodOptions, settings_of, settle
from torchrl_safe.trainers.report import write_report
from torchrl_safe.trainers.saved import (
    CONFIG,
    HISTORY,
    RESULTS,
    RESULTS_LIMIT,
    Configuration,
    read_config,
    write_config,
)
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.surroundings import surroundings
from torchrl_safe.trainers.terminal import say

KINDS = {"eval/": ExplorationType.RANDOM, "eval/det/": ExplorationType.DETERMINISTIC}


class Counters(dict):
    """Plain numbers of a run that a checkpoint keeps."""

    def state_dict(self) -> dict[str, Any]:
        """The numbers."""
        return dict(self)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put numbers back."""
        self.update(state)


class Run:
    """A run's folder: resolved config, log, checkpoints, learning curves, results and video.

    A run has its folder from :meth:`start` to :meth:`close`, before anything is built and alone::

        with Run(options) as run:  # run.options, from here on
            ...  # build
            run.restore(policy=policy)
            ...  # train, run.log(metrics), run.save()

    Args:
        options (MethodOptions): those of this call. A resumed run keeps its own for those that are
            not given again.
    """

    def __init__(self, options: MethodOptions) -> None:
        self.options: Any = options.model_copy(deep=True)
        self.path = expand(options.folder)
        self.counters = Counters(frames=0, total_cvs=0, instabilities=0, seconds=0.0)
        self.changed: dict[str, tuple[Any, Any]] = {}
        self.checkpoint = SealedCheckpoint()
        self._components: dict[str, Any] = {}
        self._saved: int | None = None  # frames of the newest checkpoint
        self._saved_options: Mapping[str, Any] | None = None
        self._lock: FolderLock | None = None
        self._log: Any = None  # open from restore to close
        self._without_curves = False

    def __enter__(self) -> Run:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def start(self) -> None:
        """Take the folder, and settle the options.

        Raises:
            ValueError: if an option is wrong, or one that a run cannot change is given another
                value.
            FileExistsError: if the folder is another process's, holds a run and ``resume`` is not
                set, or holds checkpoints without the options that belong to them.
            FileNotFoundError: if there is nothing to resume.
        """
        self.options.check_installed()
        if not self.options.resume:
            self.path.mkdir(parents=True, exist_ok=True)
        elif not self.path.is_dir():
            raise FileNotFoundError(f"run_dir={self.options.folder} holds no run to resume from.")
        self._lock = FolderLock(self.path)
        try:
            self._settle()
        except BaseException:
            self.close()
            raise

    def _settle(self) -> None:
        run_dir, resume = self.options.folder, self.options.resume
        exists = os.path.lexists(self.path / CONFIG)
        if not exists and latest(self.path) is not None:
            raise FileExistsError(
                f"run_dir={run_dir} holds checkpoints but no config.yaml, without which nobody "
                "knows what they are of: put it back, or choose another run_dir."
            )
        if resume and not exists:
            raise FileNotFoundError(f"run_dir={run_dir} holds no run to resume from.")
        if exists and not resume:
            raise FileExistsError(
                f"run_dir={run_dir} holds a run already: add resume=true to go on with it, or "
                "choose another run_dir."
            )
        if resume:
            remove_leftovers(self.path)
            self._saved_options = read_config(self.path / CONFIG)
            self.options, self.changed = settle(self._saved_options, self.options)
            self.options.check_installed()
        self.options.run_dir = str(self.path)
        self.rotation = Rotation(self.path, self.options.checkpoint.keep_last)
        self.register(
            config=Configuration(self.options), counters=self.counters, random=GlobalRNGState()
        )

    def register(self, **components: Any) -> None:
        """Name what a checkpoint keeps, besides counters and random state."""
        self._components |= components
        for name, component in components.items():
            self.checkpoint.register(name, component)

    @property
    def begins(self) -> bool:
        """Whether there is no checkpoint to go on from: the run is new, or was killed early."""
        return latest(self.path) is None

    def restore(self, **components: Any) -> None:
        """Go on from the newest checkpoint if there is one, and open the log.

        Call it when everything is made: making things draws random numbers, and a resumed run goes
        on with those that the checkpoint holds. A run that was killed before its first checkpoint
        begins again. A run that is :attr:`finished` stays as it is.

        Args:
            **components: the last things that a checkpoint keeps.

        Raises:
            CheckpointError: if the checkpoint is not what was written, or could run code.
            ValueError: if batches of another number of environments do not fit what it holds.
        """
        self.register(**components)
        checkpoint = latest(self.path)
        if checkpoint is not None:
            self._check_width()
            self._check_collector(checkpoint)
            put_back = [settings_of(component) for component in self._components.values()]
            self.checkpoint.load(checkpoint)
            for settings in put_back:
                settings()
            self._saved = self.frames
        if self.finished:
            return
        self._log = Log(self.options.logger, self.path, self.frames, finishing=not self.frames_left)
        for name, (old, new) in self.changed.items():
            say(f"from frame {self.frames} on, {name} is {new!r}; it was {old!r}")
        self._remember()
        # Last: where the log cannot be opened, there is no run.
        write_config(self.path / CONFIG, self.options)

    def close(self) -> None:
        """Close the log, and let go of the folder."""
        if self._log is not None:
            self._log.close()
            self._log = None
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    @property
    def frames(self) -> int:
        """Frames collected so far."""
        return self.counters["frames"]

    @property
    def frames_left(self) -> int:
        """Frames that the configuration still asks for."""
        return max(0, self.options.collector.total_frames - self.frames)

    @property
    def finished(self) -> bool:
        """Whether it has its frames, and their results under the ``eval`` options of now."""
        if self.frames_left or any(n.startswith(("eval.", "video.")) for n in self.changed):
            return False
        try:
            return read_json(self.path / RESULTS, RESULTS_LIMIT)["frames"] == self.frames
        except (OSError, ValueError, TypeError, KeyError):
            return False  # none, or not a whole one: they are written again

    def _check_width(self) -> None:
        """Replay and running episodes have a column for every environment of a batch."""
        if not {"buffer", "collector"} & self._components.keys() or self._saved_options is None:
            return
        saved, new = (
            envs_per_batch(each) for each in (self._saved_options, self.options.settings())
        )
        if saved != new:
            raise ValueError(
                f"run_dir={self.options.run_dir} has batches of {saved} environments and cannot go "
                f"on with batches of {new}: leave env.num_envs as it was, with "
                "collector.backend=multi_async env.num_envs / collector.num_workers."
            )

    def _check_collector(self, checkpoint: Path) -> None:
        """Episodes of several processes are in no checkpoint."""
        if "collector" in self._components.keys() - read_manifest(checkpoint)["components"]:
            raise ValueError(
                f"collector.backend={self.options.collector.backend} goes on inside of episodes, "
                f"and the checkpoints in run_dir={self.options.run_dir} hold none: leave "
                "collector.backend as it was."
            )

    def _remember(self) -> None:
        """A line of the folder's history: who goes on from where, with which other options."""
        entry = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "frames": self.frames,
            "process": os.getpid(),
            "machine": platform.node(),
            "changed": {n: {"from": old, "to": new} for n, (old, new) in self.changed.items()},
            "surroundings": surroundings(),
        }
        path = self.path / HISTORY
        history = read_bytes(path, JSON_LIMIT).decode() if os.path.lexists(path) else ""
        write_atomically(path, f"{history}{json.dumps(entry)}\n")

    def log(self, metrics: Mapping[str, float]) -> None:
        """Write metrics at the current frame.

        Raises:
            OSError: if the disk is full.
        """
        self._log.write(metrics, self.frames)

    def save(self) -> None:
        """Write a checkpoint; a crash while writing leaves the last one whole.

        Raises:
            OSError: if the disk is full.
        """
        if self._saved != self.frames:  # to replace one by its like could lose both to a kill
            self.rotation.save(self.checkpoint, step=self.frames)
            self._saved = self.frames

    def evaluate(
        self, env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]
    ) -> dict[str, float]:
        """One episode in every environment, with sampled and with deterministic actions."""
        played = self._play(env, policy, "evaluation")
        return {k: v for prefix, each in played.items() for k, v in summarize(each, prefix).items()}

    def _play(
        self,
        env: EnvBase,
        policy: Callable[[TensorDictBase], TensorDictBase],
        stream: str,
    ) -> dict[str, TensorDictBase]:
        return {
            prefix: evaluate(
                env,
                policy,
                num_steps=self.options.eval.num_steps,
                exploration_type=kind,
                seed=stream_seed(stream),
                cost_gamma=cost_gamma(self.options),
            )
            for prefix, kind in KINDS.items()
        }

    def plot(self) -> None:
        """Draw the learning curves, if it can be done; they need the csv log."""
        if self.options.logger.backend != "csv":
            return
        try:
            plot_learning_curves(self.path / "log", self.path / "curves.png")
        except Exception as error:  # whatever it is, it is not the training's
            if not self._without_curves:
                say(f"no curves: {type(error).__name__}: {error}")
            self._without_curves = True

    def finish(self, env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]) -> None:
        """Final evaluation, table and curves."""
        played = self._play(env, policy, "final evaluation")
        metrics = {
            k: v for prefix, each in played.items() for k, v in summarize(each, prefix).items()
        }
        self.log({f"final/{key.removeprefix('eval/')}": value for key, value in metrics.items()})
        frames, seconds = self.counters["frames"], self.counters["seconds"]
        results = {
            **metrics,
            "total_cvs": self.counters["total_cvs"],
            "frames": frames,
            "seconds": seconds,
            "frames_per_second": frames / seconds if seconds else 0.0,
            "episodes": {prefix: describe(each) for prefix, each in played.items()},
        }
        write_results(self.path / RESULTS, results)
        self.plot()
        rows = {
            f"score, deterministic ({env.batch_size.numel()} episodes)": metrics["eval/det/score"],
            "score, sampled": metrics["eval/score"],
            "return, deterministic": metrics["eval/det/return"],
            **{
                f"{cost} per episode, {kind}": metrics[prefix + cost]
                for cost in costs_among(played["eval/"].keys())
                if not cost.endswith("discounted_cost")
                for kind, prefix in (("deterministic", "eval/det/"), ("sampled", "eval/"))
            },
            "CV per step, deterministic": metrics["eval/det/cv_rate"],
            "CV per step, sampled": metrics["eval/cv_rate"],
            "total CVs in training": str(self.counters["total_cvs"]),
            "frames": str(frames),
            "frames/s": results["frames_per_second"],
        }
        say(format_table(rows))
        say(f"results: {self.path}")

    def film(
        self, make_env: Callable[[], EnvBase], policy: Callable[[TensorDictBase], TensorDictBase]
    ) -> None:
        """The film at the end, of an environment of its own."""
        try:
            env = make_env()
            path = record_video(
                env, policy, self.path / "video.mp4", num_steps=self.options.video.num_steps
            )
            env.close()
            say(f"video: {path}")
        except Exception as error:  # whatever it is, the results are written
            say(f"no video: {error}")

    def report(self) -> None:
        """The page about the run, see :func:`~torchrl_safe.trainers.report.write_report`."""
        try:
            say(f"report: {write_report([self.path], self.path / 'report.html')}")
        except Exception as error:  # whatever it is, the results are written
            say(f"no report: {type(error).__name__}: {error}")


def cost_gamma(options: Any) -> float:
    """The discount of a method's cost; that of the reward, where the method has no limit."""
    return getattr(options.loss, "cost_gamma", options.loss.gamma)


def write_results(path: Path, results: Mapping[str, Any]) -> None:
    """Results as JSON, which has no number for what is not finite: ``null`` stands for it."""
    write_atomically(path, json.dumps(plain(results), indent=2, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """A JSON value: NaN and infinities are ``None``.

    Examples:
        >>> plain({"score": 1.5, "interval": [float("nan"), 2.0]})
        {'score': 1.5, 'interval': [None, 2.0]}
    """
    if isinstance(value, Mapping):
        return {name: plain(each) for name, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return None if isinstance(value, float) and not abs(value) < float("inf") else value
