"""What the example scripts share: networks, the training loop around an update, a run folder.

A trained policy, in two lines::

    from utils import load_policy
    policy = load_policy("runs/safetac_point/seed_0")
"""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any

import torch
from checkpoints import Rotation, SealedCheckpoint, latest, load_components, remove_leftovers
from collectors import WorkerDied, envs_per_batch, make_collector
from config import check_config
from omegaconf import DictConfig
from saved import CONFIG, Configuration, from_newest, read_config, write_config
from saved import load_run as load_run
from tensordict import TensorDictBase
from torch import nn
from torchrl._utils import logger as torchrl_logger
from torchrl._utils import timeit
from torchrl.checkpoint import CheckpointError, GlobalRNGState
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP, ValueOperator
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from torchrl_safe import GMMTanhPolicy
from torchrl_safe._files import printable, regular_files, write_atomically
from torchrl_safe.envs import RANDOMIZATIONS, SafeGoalEnv
from torchrl_safe.record import (
    batch_metrics,
    count_violations,
    evaluate,
    format_table,
    plot_learning_curves,
    record_video,
    summarize,
)

# Evaluation layouts are the same for every run, and never those of training (seeded by cfg.seed).
EVAL_SEED = 1_000_003


def set_up(cfg: DictConfig) -> None:
    """Checks the configuration; threads, seed, a quiet logger: what a script does first."""
    check_config(cfg)
    torchrl_logger.setLevel("WARNING")  # its notes would break the progress bar
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(cfg.num_threads)
    torch.manual_seed(cfg.seed)


def make_env(cfg: DictConfig, num_envs: int, seed: int, **kwargs: Any) -> SafeGoalEnv:
    """A batch of environments with the robot of the configuration."""
    return SafeGoalEnv(
        cfg.env.robot,
        num_envs=num_envs,
        num_threads=cfg.num_threads,
        seed=seed,
        device=cfg.device,
        **kwargs,
    )


def make_policy(cfg: DictConfig, env: EnvBase) -> GMMTanhPolicy:
    """The mixture policy (11)."""
    action_dim = env.action_spec.shape[-1]
    network = MLP(
        env.observation_spec["observation"].shape[-1],
        cfg.policy.num_components * (1 + 2 * action_dim),
        num_cells=list(cfg.policy.num_cells),
        activation_class=nn.ReLU,
        device=cfg.device,
    )
    return GMMTanhPolicy(
        network,
        env.action_spec,
        num_components=cfg.policy.num_components,
        relaxation=cfg.policy.relaxation,
        temperature=cfg.policy.temperature,
        log_std_bounds=tuple(cfg.policy.log_std_bounds),
    )


def make_critic(
    cfg: DictConfig, env: EnvBase, out_key: str, *last: nn.Module, of_actions: bool = True
) -> ValueOperator:
    """A critic of observation and, by default, action; ``last`` goes behind its linear output."""
    specs = {"observation": env.observation_spec["observation"], "action": env.action_spec}
    in_keys = ["observation", "action"] if of_actions else ["observation"]
    network = MLP(
        sum(specs[key].shape[-1] for key in in_keys),
        1,
        num_cells=list(cfg.critic.num_cells),
        activation_class=nn.ReLU,
        activation_kwargs={"inplace": True},  # half the memory to go through
        device=cfg.device,
    )
    network.extend(last)
    return ValueOperator(network, in_keys=in_keys, out_keys=[out_key])


def train(
    run: Run,
    policy: GMMTanhPolicy,
    update: Callable[[TensorDictBase], dict[str, float]],
    eval_env: EnvBase,
) -> None:
    """Collect, update, log, evaluate and save until the frames are spent; then finish the run.

    Args:
        run (Run): the run's folder, resumed or new.
        policy (GMMTanhPolicy): acts, and is what ``update`` improves.
        update (callable): an algorithm's step on a new batch ``[N, T]``; its metrics are logged.
        eval_env (EnvBase): environments of the evaluations during training.
    """
    cfg = run.cfg
    in_process = cfg.collector.backend == "single"
    if not in_process:
        run.start(policy=policy)  # workers keep no state: a resumed run sees new layouts
    make_training_env = partial(
        make_env,
        cfg,
        episode_length=cfg.env.episode_length,
        stagger=True,
        randomization=RANDOMIZATIONS.get(cfg.env.randomization),
    )
    collector = make_collector(
        cfg,
        make_training_env,
        policy,
        seed=cfg.seed + run.frames,
        total_frames=run.frames_left or cfg.collector.frames_per_batch,
    )
    if in_process:
        run.start(policy=policy, collector=collector)
    collector.update_policy_weights_()  # workers start with what a checkpoint brought
    progress = tqdm(total=cfg.collector.total_frames, initial=run.frames, unit="frame")
    next_eval, next_save = (
        run.frames // interval * interval + interval
        for interval in (cfg.eval.interval, cfg.checkpoint.interval)
    )
    timeit.erase()  # what was timed before is not the run's
    started = time.perf_counter()
    with GracefulStop() as stop, closing_down(collector), run.saved_if_a_worker_dies():
        # None is left of a run that was killed in its final evaluation.
        for batch in collector if run.frames_left else ():
            run.counters["frames"] += batch.numel()
            run.counters["total_cvs"] += count_violations(batch)
            run.counters["instabilities"] += int(batch["next", "diverged"].sum())
            metrics = batch_metrics(batch)
            metrics["train/total_cvs"] = run.counters["total_cvs"]
            metrics["train/instabilities"] = run.counters["instabilities"]
            metrics["train/entropy"] = -batch["action_log_prob"].mean().item()
            metrics |= update(batch)
            collector.update_policy_weights_()

            if run.frames >= next_eval:
                next_eval += cfg.eval.interval
                with timeit("time/eval"):
                    metrics |= run.evaluate(eval_env, policy)
                run.plot()
            seconds = time.perf_counter() - started
            started += seconds
            run.counters["seconds"] += seconds
            metrics |= timeit.todict(percall=False)
            metrics["time/frames_per_second"] = batch.numel() / seconds
            timeit.erase()
            run.log(metrics)
            progress.update(batch.numel())
            progress.set_postfix(
                reward=f"{metrics['train/reward_per_1000']:.1f}",
                cost=f"{metrics['train/cost_rate']:.3f}",
                cv=f"{metrics['train/cv_rate']:.4f}",
                kl=f"{metrics.get('update/kl', 0.0):.4f}",
            )
            if run.frames >= next_save:
                next_save += cfg.checkpoint.interval
                run.save()
            if stop.requested:
                break
        run.save()
    progress.close()
    if stop.requested:
        print(f"stopped at {run.frames} frames; go on with the same command and resume=true")
        return
    final_env = make_env(cfg, cfg.eval.final_episodes, EVAL_SEED)
    run.finish(final_env, policy)
    final_env.close()


@contextmanager
def closing_down(collector: BaseCollector) -> Iterator[None]:
    """However it ends: a process waits for those that it has started before it exits."""
    try:
        yield
    finally:
        collector.shutdown()


@contextmanager
def nobody_to_ask() -> Iterator[None]:
    """No terminal to read from: wandb, asked to be online without an account, fails at once."""
    terminal, sys.stdin = sys.stdin, io.StringIO()
    try:
        yield
    finally:
        sys.stdin = terminal


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

    Nothing is written before :meth:`start`.

    Args:
        cfg (DictConfig): the run's configuration.
        **components: what a checkpoint keeps, besides counters and random state.

    Raises:
        FileExistsError: if the folder holds a run and ``cfg.resume`` is not set.
        FileNotFoundError: if there is nothing to resume.
    """

    def __init__(self, cfg: DictConfig, **components: Any) -> None:
        self.cfg = cfg
        self.path = Path(cfg.run_dir)
        self.counters = Counters(frames=0, total_cvs=0, instabilities=0, seconds=0.0)
        self._saved: int | None = None  # frames of the newest checkpoint
        self.checkpoint = SealedCheckpoint(
            config=Configuration(cfg),
            counters=self.counters,
            random=GlobalRNGState(),
            **components,
        )
        self.rotation = Rotation(self.path, cfg.checkpoint.keep_last)
        exists = (self.path / "config.yaml").exists()
        if cfg.resume and not exists:
            raise FileNotFoundError(f"run_dir={cfg.run_dir} holds no run to resume from.")
        if exists and not cfg.resume:
            raise FileExistsError(
                f"run_dir={cfg.run_dir} holds a run already: add resume=true to go on with it, or "
                "choose another run_dir."
            )

    def start(self, **components: Any) -> None:
        """Open the folder and the log, and go on from the newest checkpoint if asked to.

        Call it when everything is made: making things draws random numbers, and a resumed run goes
        on with those that the checkpoint holds. A run that was killed before its first checkpoint
        begins again.

        Args:
            **components: the last things that a checkpoint keeps.

        Raises:
            CheckpointError: if the checkpoint is not what was written, or could run code.
            ValueError: if the run to resume has all of its frames and its results, or has replayed
                batches of another number of environments.
        """
        cfg = self.cfg
        for name, component in components.items():
            self.checkpoint.register(name, component)
        if cfg.resume:
            remove_leftovers(self.path)
            if os.path.lexists(self.path / "log"):
                regular_files(self.path / "log")  # or a link would be written through
            checkpoint = latest(self.path)
            if checkpoint is not None:
                if "buffer" in self.checkpoint.components:
                    self._check_width()
                self.checkpoint.load(checkpoint)
                self._saved = self.frames
            if not self.frames_left and (self.path / "results.json").exists():
                raise ValueError(
                    f"collector.total_frames={cfg.collector.total_frames} leaves nothing to do: "
                    f"the run in run_dir={cfg.run_dir} has {self.frames} frames."
                )
        self.path.mkdir(parents=True, exist_ok=True)
        os.environ.setdefault("WANDB_MODE", "offline")
        with nobody_to_ask():
            self.logger = get_logger(
                cfg.logger.backend,
                logger_name=str(self.path),
                experiment_name="log",
                wandb_kwargs={"project": cfg.logger.project_name, "dir": str(self.path)},
            )
        # Last: where the log cannot be opened, there is no run.
        write_config(self.path / CONFIG, cfg)

    @property
    def frames(self) -> int:
        """Frames collected so far."""
        return self.counters["frames"]

    @property
    def frames_left(self) -> int:
        """Frames that the configuration still asks for."""
        return max(0, self.cfg.collector.total_frames - self.frames)

    def _check_width(self) -> None:
        """The replay buffer has a column for every environment of a batch."""
        saved, new = (envs_per_batch(cfg) for cfg in (read_config(self.path / CONFIG), self.cfg))
        if saved != new:
            raise ValueError(
                f"run_dir={self.cfg.run_dir} has replayed batches of {saved} environments and "
                f"cannot go on with batches of {new}: leave env.num_envs as it was, with "
                "collector.backend=multi_async env.num_envs / collector.num_workers."
            )

    def log(self, metrics: Mapping[str, float]) -> None:
        """Write metrics at the current frame."""
        if self.logger is not None:
            self.logger.log_metrics(dict(metrics), step=self.frames)
            if self.cfg.logger.backend == "csv":
                # TorchRL's keeps all it ever wrote: megabytes per hour that nobody reads.
                self.logger.experiment.scalars.clear()

    def save(self) -> None:
        """Write a checkpoint; a crash while writing leaves the last one whole.

        Raises:
            OSError: if the disk is full.
        """
        if self._saved != self.frames:  # to replace one by its like could lose both to a kill
            self.rotation.save(self.checkpoint, step=self.frames)
            self._saved = self.frames

    @contextmanager
    def saved_if_a_worker_dies(self) -> Iterator[None]:
        """Everything learned is in this process: nothing of it is lost."""
        try:
            yield
        except WorkerDied:
            self.save()
            raise

    def evaluate(
        self, env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]
    ) -> dict[str, float]:
        """One episode in every environment, with sampled and with deterministic actions."""
        metrics = {}
        for prefix, kind in (
            ("eval/", ExplorationType.RANDOM),
            ("eval/det/", ExplorationType.DETERMINISTIC),
        ):
            episodes = evaluate(
                env,
                policy,
                num_steps=self.cfg.eval.num_steps,
                exploration_type=kind,
                seed=EVAL_SEED,
            )
            metrics |= summarize(episodes, prefix)
        return metrics

    def plot(self) -> None:
        """Draw the learning curves; they need the csv log."""
        if self.cfg.logger.backend == "csv":
            plot_learning_curves(self.path / "log", self.path / "curves.png")

    def finish(self, env: EnvBase, policy: Callable[[TensorDictBase], TensorDictBase]) -> None:
        """Final evaluation, table, curves and video."""
        metrics = self.evaluate(env, policy)
        self.log({f"final/{key.removeprefix('eval/')}": value for key, value in metrics.items()})
        frames, seconds = self.counters["frames"], self.counters["seconds"]
        results = {
            **metrics,
            "total_cvs": self.counters["total_cvs"],
            "frames": frames,
            "seconds": seconds,
            "frames_per_second": frames / seconds if seconds else 0.0,
        }
        write_atomically(self.path / "results.json", json.dumps(results, indent=2) + "\n")
        self.plot()
        rows = {
            f"score, deterministic ({env.batch_size.numel()} episodes)": metrics["eval/det/score"],
            "score, sampled": metrics["eval/score"],
            "return, deterministic": metrics["eval/det/return"],
            "CV per step, deterministic": metrics["eval/det/cv_rate"],
            "CV per step, sampled": metrics["eval/cv_rate"],
            "total CVs in training": str(self.counters["total_cvs"]),
            "frames": str(frames),
            "frames/s": results["frames_per_second"],
        }
        print(format_table(rows))
        if self.cfg.video.num_steps:
            try:
                path = record_video(
                    env, policy, self.path / "video.mp4", num_steps=self.cfg.video.num_steps
                )
                print(f"video: {path}")
            except RuntimeError as error:
                print(f"no video: {error}")
        print(f"results: {self.path}")


def load_policy(run_dir: str | os.PathLike[str]) -> GMMTanhPolicy:
    """The policy of a run, as its newest checkpoint has it.

    Nothing is unpickled: weights are read as tensors, everything else as JSON.

    Args:
        run_dir (path): the run's folder.

    Raises:
        FileNotFoundError: if it holds no run, or one without a checkpoint.
        CheckpointError: if the checkpoint is not what was written, or could run code.
    """
    return from_newest(run_dir, saved_policy)


def saved_policy(cfg: DictConfig, checkpoint: Path) -> GMMTanhPolicy:
    """The policy of a checkpoint.

    Raises:
        CheckpointError: if it is not what was written, or not finite.
    """
    if "policy" not in cfg:
        raise CheckpointError(f"{printable(checkpoint)} has no mixture policy.")
    policy = make_policy(cfg, make_env(cfg, num_envs=1, seed=0))
    load_components(checkpoint, policy=policy)
    for name, weight in policy.named_parameters():
        if not weight.isfinite().all():
            raise CheckpointError(f"{name} of the policy in {printable(checkpoint)} is not finite.")
    return policy.eval().requires_grad_(False)


class GracefulStop:
    """Turns the first Ctrl-C (or SIGTERM) into a flag, so that a run stops between two updates.

    A second one interrupts at once.
    """

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> GracefulStop:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._previous[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
