"""What all methods are: networks and losses to build, an update, and the loop around it."""

from __future__ import annotations

import re
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl._utils import logger as torchrl_logger
from torchrl._utils import timeit
from torchrl.collectors import BaseCollector
from torchrl.envs import EnvBase
from torchrl.objectives import LossModule

from torchrl_safe.envs import ROBOTS
from torchrl_safe.optim.trust_region import TrustRegionReport
from torchrl_safe.record import batch_metrics, count_violations
from torchrl_safe.trainers.collectors import WorkerDied, make_collector
from torchrl_safe.trainers.environments import cost_names, has_state, make_env, source_of
from torchrl_safe.trainers.networks import (
    MakeNetwork,
    Scale,
    is_discrete,
    make_critic,
    make_policy,
    scale_of,
)
from torchrl_safe.trainers.options import ConstrainedLoss, MethodOptions, flat, per_episode
from torchrl_safe.trainers.run import Run
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.tasks import follows
from torchrl_safe.trainers.terminal import GracefulStop, Progress, say
from torchrl_safe.trainers.threads import threads

WIDTHS = ("env.num_envs", "eval.num_episodes", "eval.final_episodes")  # of batches


class Trainer(ABC):
    """A method. It says what it is made of in :meth:`build`, and what it does in :meth:`update`.

    Args:
        env (str, EnvBase or callable, optional): what to train in: the name of a robot of ours or
            of one of Safety-Gymnasium's tasks, a TorchRL environment with a cost in its reward
            spec, or a function that makes one, from the keywords ``num_envs`` and ``seed`` if it
            has them. By default what the options say.

    Keyword Args:
        in_keys (sequence of str): what the networks read. Defaults to ``"observation"``, which
            several vectors are concatenated to where an environment has no such entry.
        network (callable, optional): makes the networks of policy and critics from the specs of
            their inputs and the number of outputs, as images need. Defaults to an MLP.
        options (MethodOptions, optional): of :attr:`Options`.
        **named: options by name: dotted, or the last part where only one option has it.

    Raises:
        ValueError: if an option is unknown or its value impossible, or the method cannot have the
            environment's actions.
        TypeError: if ``env`` is something else.
    """

    Options: ClassVar[type[MethodOptions]]
    discrete: ClassVar[bool] = False  # whether it can have discrete actions

    policy: ProbabilisticTensorDictSequential

    def __init__(
        self,
        env: str | EnvBase | Callable[..., EnvBase] | None = None,
        *,
        in_keys: Sequence[str] = ("observation",),
        network: MakeNetwork | None = None,
        options: MethodOptions | None = None,
        **named: Any,
    ) -> None:
        self.source: Callable[..., EnvBase] | None = None
        width = None
        if isinstance(env, str):
            if env not in ROBOTS and not follows(env):
                raise ValueError(
                    f"env must be a TorchRL environment, a function that makes one, a task of "
                    f"Safety-Gymnasium's or one of {', '.join(map(repr, ROBOTS))}, got {env!r}."
                )
            named["env.robot" if env in ROBOTS else "env.task"] = env
        elif env is not None:
            self.source, width = source_of(env)
            named.setdefault("env.name", "python")
            if width is not None:
                named = dict.fromkeys(WIDTHS, width) | named
        options = self.Options() if options is None else options
        self.options: Any = options.changed(**named)
        self.width = width
        self.in_keys = list(in_keys)
        self.network = network
        self.scales: dict[str, Scale] | None = None
        self.run: Run | None = None

    @abstractmethod
    def build(self, env: EnvBase) -> dict[str, Any]:
        """Make the networks, losses and optimizers of an environment, :attr:`policy` among them.

        Returns:
            dict: what a checkpoint keeps besides the policy, by name.
        """

    @abstractmethod
    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """The method's step on a new batch ``[N, T]``.

        Returns:
            dict: metrics to log.
        """

    def hand_over(self) -> dict[str, float]:
        """What is left to do when the policy learns no more, before it is saved.

        Returns:
            dict: metrics to log.
        """
        return {}

    @property
    def frames(self) -> int:
        """Frames collected so far."""
        return 0 if self.run is None else self.run.frames

    def make_env(self, num_envs: int, seed: int, **how: Any) -> EnvBase:
        """A batch of the environments, see :func:`~torchrl_safe.trainers.environments.make_env`."""
        return make_env(self.options, num_envs, seed, source=self.source, **how)

    def make_policy(self, env: EnvBase) -> Any:
        """A policy of the environment's actions.

        Raises:
            ValueError: if the actions are discrete and the method needs others.
        """
        if is_discrete(env) and not self.discrete:
            raise ValueError(
                f"{type(self).__name__} needs continuous actions, because it differentiates "
                f"through them; the environment's are {type(env.action_spec).__name__}."
            )
        return make_policy(
            self.options, env, in_keys=self.in_keys, network=self.network, scales=self.scales
        )

    def make_critic(self, env: EnvBase, out_key: str, *last: nn.Module, **how: Any) -> Any:
        """A critic, see :func:`~torchrl_safe.trainers.networks.make_critic`."""
        return make_critic(
            self.options,
            env,
            out_key,
            *last,
            **how,
            in_keys=self.in_keys,
            network=self.network,
            scales=self.scales,
        )

    def measure_scales(self) -> dict[str, Scale]:
        """Where observations lie, by key, from ``env.standardize_frames`` random steps."""
        options, seed = self.options.env, stream_seed("standardization", self.options.seed)
        frames = options.standardize_frames
        whole = -(-frames // options.episode_length)  # episodes
        num_envs = self.width or min(options.num_envs, whole)
        env = self.make_env(num_envs, seed, training=True)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            data = env.rollout(-(-frames // num_envs), break_when_any_done=False)
        env.close(raise_if_closed=False)
        return {key: scale_of(data[key]) for key in self.in_keys}

    def train(self, **named: Any) -> Any:
        """Train, evaluate and film, in a run's folder.

        Args:
            **named: options, as of the constructor.

        Returns:
            The policy.

        Raises:
            ValueError: if an option is unknown or its value impossible.
            FileExistsError: if the folder is another process's, or holds a run and ``resume`` is
                not set.
            FileNotFoundError: if there is nothing to resume.
        """
        options: Any = self.options.changed(**named)
        values = dict(flat(options))
        for name in WIDTHS if self.width is not None else ():
            if values[name] != self.width:
                raise ValueError(
                    f"{name} must be {self.width}, the batch of env, got {values[name]}; a "
                    "function that makes environments of num_envs and seed can have any."
                )
        with Run(options) as run, threads(run.options):
            self.run, self.options = run, run.options
            set_up(self.options)
            if self.options.env.standardize_frames:
                self.scales = self.measure_scales()
            eval_env = self.make_env(self.options.eval.num_episodes, stream_seed("evaluation"))
            run.register(**self.build(eval_env))
            self._train(run, eval_env)
            eval_env.close(raise_if_closed=False)  # one that nobody stepped is not open
        return self.policy

    def _train(self, run: Run, eval_env: EnvBase) -> None:
        """Collect, update, log, evaluate and save until the frames are spent; then finish."""
        options = self.options
        resumes_inside = options.collector.backend == "single" and has_state(eval_env)
        if not resumes_inside:
            run.restore(policy=self.policy)  # nobody keeps a state: a resumed run starts episodes
        collector = make_collector(
            options,
            partial(make_env, options, training=True, source=self.source),
            self.policy,
            seed=stream_seed("training", options.seed, run.frames),
        )
        with GracefulStop() as stop, closing_down(collector):
            if resumes_inside:
                run.restore(policy=self.policy, collector=collector)
            if run.finished:
                say(
                    f"collector.total_frames={options.collector.total_frames} leaves nothing to "
                    f"do: the run in run_dir={options.run_dir} has {run.frames} frames and its "
                    "results."
                )
                return
            try:
                # None is left of a run that was killed in its final evaluation.
                if run.frames_left:
                    self._loop(run, collector, eval_env, stop)
                    if not run.frames_left:
                        run.log(self.hand_over())
            except WorkerDied:
                # A signal to the whole group of processes ends the workers, too. Everything learned
                # is in this process: nothing of it is lost.
                run.save()
                if not stop.requested:
                    raise
            else:
                run.save()
        if stop.requested:
            say(f"stopped at {run.frames} frames; go on with the same command and resume=true")
            return
        seed = stream_seed("final evaluation")
        final_env = self.make_env(options.eval.final_episodes, seed)
        run.finish(final_env, self.policy)
        final_env.close(raise_if_closed=False)
        if options.video.num_steps:  # of one, as those of others draw all of a batch
            run.film(partial(self.make_env, self.width or 1, seed), self.policy)
        run.report()

    def _loop(
        self, run: Run, collector: BaseCollector, eval_env: EnvBase, stop: GracefulStop
    ) -> None:
        options = self.options
        collector.update_policy_weights_()  # workers start with what a checkpoint brought
        progress = Progress(options.collector.total_frames, run.frames)
        next_eval, next_save = (
            run.frames // interval * interval + interval
            for interval in (options.eval.interval, options.checkpoint.interval)
        )
        timeit.erase()  # what was timed before is not the run's
        started = time.perf_counter()
        for batch in collector:
            metrics = self._count(run, batch)
            metrics |= self.update(batch)

            if run.frames >= next_eval:
                next_eval += options.eval.interval
                with timeit("time/eval"):
                    metrics |= run.evaluate(eval_env, self.policy)
                run.plot()
            seconds = time.perf_counter() - started
            started += seconds
            run.counters["seconds"] += seconds
            metrics |= timeit.todict(percall=False)
            metrics["time/frames_per_second"] = batch.numel() / seconds
            metrics["time/seconds"] = run.counters["seconds"]
            timeit.erase()
            run.log(metrics)
            progress.update(batch.numel(), **self.standing(metrics))
            if run.frames >= next_save:
                next_save += options.checkpoint.interval
                run.save()
            if stop.requested or not run.frames_left:
                break
            # After the log: where a worker has died meanwhile, the update is saved and logged.
            collector.update_policy_weights_()
        progress.close()

    def standing(self, metrics: Mapping[str, float]) -> dict[str, str]:
        """Return, costs beside their limits and violations, for the progress line.

        All are of the newest batch, per episode of ``eval.num_steps`` steps.
        """
        steps, limits = self.options.eval.num_steps, self.episode_limits()
        words = {"return": f"{metrics['train/reward_per_1000'] * steps / 1_000:.1f}"}
        for name, rate in metrics.items():
            if is_cost_rate(name):
                cost = name.removeprefix("train/").removesuffix("_rate")
                limit = f"/{limits[cost]:.3g}" if cost in limits else ""
                words[cost] = f"{rate * steps:.1f}{limit}"
        return words | {"violations": f"{metrics['train/cv_rate'] * steps:.1f}"}

    def episode_limits(self) -> dict[str, float]:
        """The limits of now on the costs of an episode of ``eval.num_steps``; none by default."""
        return {}

    def _count(self, run: Run, batch: TensorDictBase) -> dict[str, float]:
        """What a batch adds to the counters, and is by itself."""
        run.counters["frames"] += batch.numel()
        run.counters["total_cvs"] += count_violations(batch)
        diverged = batch.get(("next", "diverged"), None)
        run.counters["instabilities"] += 0 if diverged is None else int(diverged.sum())
        return {
            **batch_metrics(batch),
            "train/total_cvs": run.counters["total_cvs"],
            "train/instabilities": run.counters["instabilities"],
            "train/entropy": -batch["action_log_prob"].mean().item(),
        }


class ConstrainedTrainer(Trainer):
    """A method under limits on one or several costs.

    Limits are in ``loss.limit_unit`` for whoever reads the log, and on the discounted sum of the
    cost for the losses: a mean of ``c`` per step is a discounted sum of ``c / (1 - cost_gamma)``.
    """

    @property
    def costs(self) -> list[str]:
        """Names of the costs that are limited."""
        return cost_names(self.options)

    def limits(self) -> dict[str, float]:
        """The limits of now on the discounted sums, by cost."""
        loss, scale = self.options.loss, discounted_unit(self.options)
        return {name: scale * limit_at(loss, name, self.frames) for name in self.costs}

    def episode_limits(self) -> dict[str, float]:
        """The limits of now as sums of an episode of ``eval.num_steps``, by cost."""
        gamma, steps = self.options.loss.cost_gamma, self.options.eval.num_steps
        return {
            name: per_episode(limit, "discounted", gamma, steps)
            for name, limit in self.limits().items()
        }

    def levels(self, levels: Mapping[str, float | Tensor]) -> dict[str, float]:
        """Metrics of how high costs stand, and of the limits of now, in ``loss.limit_unit``.

        Args:
            levels (mapping): discounted sums, by cost.
        """
        scale = discounted_unit(self.options)
        return {
            **self.named("update/cost_level", {n: value / scale for n, value in levels.items()}),
            **self.named("update/cost_limit", {n: x / scale for n, x in self.limits().items()}),
        }

    def report(self, report: TrustRegionReport, limits: Mapping[str, float]) -> dict[str, float]:
        """Metrics of a trust region's step: its constraints as levels of the costs."""
        numbers = report.to_dict()
        levels = {
            name: over + limit
            for over, (name, limit) in zip(report.constraint, limits.items(), strict=True)
        }
        excess = re.compile(r"update/constraint(_\d+)?")
        plain = {n: x for n, x in numbers.items() if not excess.fullmatch(n)}
        return {**plain, **self.levels(levels)}

    def named(self, metric: str, values: Mapping[str, float | Tensor]) -> dict[str, float]:
        """A metric of every cost: under its plain name if there is one cost."""
        return {self.name_of(metric, cost): float(value) for cost, value in values.items()}

    def joined(self, losses: Mapping[str, LossModule], minibatch: TensorDictBase) -> TensorDict:
        """What the losses of the costs return, told apart where there are several."""
        joined = TensorDict()
        for cost, loss in losses.items():
            own = loss(minibatch)
            if len(losses) > 1:
                for name in list(own.keys()):
                    own.rename_key_(name, self.name_of(name, cost))
            joined.update(own)
        return joined

    def name_of(self, name: str, cost: str) -> str:
        """The name of something that each cost has, told apart where there are several."""
        return name if len(self.costs) == 1 else f"{name}/{cost}"


def is_cost_rate(metric: str) -> bool:
    """Whether a metric is a cost per step of training."""
    return metric.startswith("train/") and metric.endswith("cost_rate")


def limit_at(loss: ConstrainedLoss, cost: str, frames: int) -> float:
    """The limit after ``frames``: it moves, so that an agent learns to drive before it must avoid.

    Args:
        loss (ConstrainedLoss): ``cost_limit``, where it starts and when it is there.
        cost (str): the name of the cost.
        frames (int): so far.

    Returns:
        float: in ``loss.limit_unit``.
    """
    final, initial = (
        value.get(cost) if isinstance(value, dict) else value
        for value in (loss.cost_limit, loss.initial_cost_limit)
    )
    if final is None:
        raise ValueError(f"loss.cost_limit must have a limit on {cost!r}, got {loss.cost_limit}.")
    initial = loss.initial_ratio * final if initial is None else initial
    remaining = max(0.0, 1.0 - frames / max(1, loss.anneal_frames))
    return final + remaining * (initial - final)


def discounted_unit(options: Any) -> float:
    """The discounted sum of a cost that is 1 in ``loss.limit_unit``."""
    loss = options.loss
    if loss.limit_unit == "discounted":
        return 1.0
    steps = options.eval.num_steps if loss.limit_unit == "episode" else 1
    return 1.0 / (steps * (1.0 - loss.cost_gamma))


def set_up(options: MethodOptions) -> None:
    """Seed and a quiet logger: what comes first."""
    torchrl_logger.setLevel("WARNING")  # its notes would break the progress bar
    torch.manual_seed(stream_seed("networks", options.seed))


@contextmanager
def closing_down(collector: BaseCollector) -> Iterator[None]:
    """However it ends: a process waits for those that it has started before it exits."""
    try:
        yield
    finally:
        collector.shutdown()
