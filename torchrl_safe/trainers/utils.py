"""What the example scripts share: networks, and the training loop around an update.

A trained policy, in two lines::

    from torchrl_safe.trainers.utils import load_policy
    policy = load_policy("runs/safetac_point/seed_0")
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import nn
from torchrl._utils import logger as torchrl_logger
from torchrl._utils import timeit
from torchrl.checkpoint import CheckpointError
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.modules import MLP, ValueOperator

from torchrl_safe import GMMTanhPolicy
from torchrl_safe._files import printable
from torchrl_safe.envs import RANDOMIZATIONS, SafeGoalEnv
from torchrl_safe.record import batch_metrics, count_violations
from torchrl_safe.trainers.checkpoints import load_components
from torchrl_safe.trainers.collectors import WorkerDied, make_collector
from torchrl_safe.trainers.run import Run
from torchrl_safe.trainers.saved import from_newest
from torchrl_safe.trainers.saved import load_run as load_run
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.terminal import GracefulStop, progress_bar, say


def set_up(cfg: DictConfig) -> None:
    """Threads, seed, a quiet logger: what a script does first."""
    torchrl_logger.setLevel("WARNING")  # its notes would break the progress bar
    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(cfg.num_threads)
    torch.manual_seed(stream_seed("networks", cfg.seed))


def make_eval_env(cfg: DictConfig) -> SafeGoalEnv:
    """The environments of evaluations during training."""
    return make_env(cfg, cfg.eval.num_episodes, stream_seed("evaluation"))


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
        run.restore(policy=policy)  # workers keep no state: a resumed run sees new layouts
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
        seed=stream_seed("training", cfg.seed, run.frames),
    )
    with GracefulStop() as stop, closing_down(collector):
        if in_process:
            run.restore(policy=policy, collector=collector)
        if run.finished:
            say(
                f"collector.total_frames={cfg.collector.total_frames} leaves nothing to do: the "
                f"run in run_dir={cfg.run_dir} has {run.frames} frames and its results."
            )
            return
        try:
            # None is left of a run that was killed in its final evaluation.
            if run.frames_left:
                _train(run, policy, collector, update, eval_env, stop)
        except WorkerDied:
            # A signal to the whole group of processes ends the workers, too. Everything learned is
            # in this process: nothing of it is lost.
            run.save()
            if not stop.requested:
                raise
        else:
            run.save()
    if stop.requested:
        say(f"stopped at {run.frames} frames; go on with the same command and resume=true")
        return
    final_env = make_env(cfg, cfg.eval.final_episodes, stream_seed("final evaluation"))
    run.finish(final_env, policy)
    final_env.close()


def _train(
    run: Run,
    policy: GMMTanhPolicy,
    collector: BaseCollector,
    update: Callable[[TensorDictBase], dict[str, float]],
    eval_env: EnvBase,
    stop: GracefulStop,
) -> None:
    cfg = run.cfg
    collector.update_policy_weights_()  # workers start with what a checkpoint brought
    progress = progress_bar(total=cfg.collector.total_frames, initial=run.frames, unit="frame")
    next_eval, next_save = (
        run.frames // interval * interval + interval
        for interval in (cfg.eval.interval, cfg.checkpoint.interval)
    )
    timeit.erase()  # what was timed before is not the run's
    started = time.perf_counter()
    for batch in collector:
        run.counters["frames"] += batch.numel()
        run.counters["total_cvs"] += count_violations(batch)
        run.counters["instabilities"] += int(batch["next", "diverged"].sum())
        metrics = batch_metrics(batch)
        metrics["train/total_cvs"] = run.counters["total_cvs"]
        metrics["train/instabilities"] = run.counters["instabilities"]
        metrics["train/entropy"] = -batch["action_log_prob"].mean().item()
        metrics |= update(batch)

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
        if stop.requested or not run.frames_left:
            break
        # After the log: where a worker has died meanwhile, the update is saved and logged.
        collector.update_policy_weights_()
    progress.close()


@contextmanager
def closing_down(collector: BaseCollector) -> Iterator[None]:
    """However it ends: a process waits for those that it has started before it exits."""
    try:
        yield
    finally:
        collector.shutdown()


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
