"""TorchRL's SAC with Retrace targets: the estimator with nothing else of this library.

    python benchmarks/retrace_sac.py                     # Retrace
    python benchmarks/retrace_sac.py estimator.name=td0  # one-step targets, equal replayed slices

Three things differ from SAC with TD(0): the actor writes the density of its actions, the replay
buffer gives back slices of trajectories, and the loss is given another value estimator.
"""

from __future__ import annotations

import csv
import time
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Literal

import torch
from pydantic import Field
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl import collectors
from torchrl._utils import logger as torchrl_logger
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, EnvBase, GymEnv, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate

from torchrl_safe import RetraceEstimator
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers import cli
from torchrl_safe.trainers import options as shared
from torchrl_safe.trainers.locks import FolderLock
from torchrl_safe.trainers.options import Group, again, option
from torchrl_safe.trainers.saved import CONFIG, write_config
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.terminal import Progress

COLUMNS = ("frames", "seconds", "eval_return", "train_return", "alpha", "loss_qvalue", "trace")


class Env(Group):
    """The task."""

    name: str = option("Reacher-v5", "of Gymnasium", min_length=1, fixed=True)


class Collector(Group):
    """Who acts, and for how long."""

    total_frames: int = again(shared.Collector, "total_frames", 4000)
    frames_per_batch: int = option(100, "frames between two rounds of updates", ge=1)
    init_frames: int = option(
        500, "of the untrained policy; random actions would have no density", ge=0
    )


class ReplayBuffer(Group):
    """Slices of trajectories."""

    size: int = again(shared.ReplayBuffer, "size", 100_000)
    batch_size: int = option(256, "transitions, a multiple of slice_len", ge=1)
    slice_len: int = option(8, "steps of a replayed slice: the reach of Retrace", ge=1)


class Estimator(Group):
    """Of the critics' targets."""

    name: Literal["retrace", "td0"] = option("retrace", "td0 is on the same slices")
    gamma: float = option(0.99, "discount", ge=0, lt=1)
    lmbda: float = option(0.95, "of retrace", ge=0, le=1)


class Loss(Group):
    """SAC's."""

    alpha_init: float = option(0.1, "entropy weight at the start; it is learned", gt=0)
    target_update_tau: float = option(0.01, "of the target critics", gt=0, le=1)


class Optim(Group):
    """Adam."""

    lr: float = option(1e-3, "step size", gt=0)
    updates_per_frame: float = option(0.5, "gradient steps", gt=0)
    max_skipped: int = option(
        100, "of them, between two batches, skipped as not finite before the run stops", ge=0
    )


class Eval(Group):
    """Evaluations."""

    interval: int = option(1000, "frames", ge=1)
    num_episodes: int = option(10, "per evaluation", ge=1)


class Options(shared.Options):
    """All options of the script."""

    method = "retrace_sac"

    env: Env = Field(default_factory=Env)
    collector: Collector = Field(default_factory=Collector)
    replay_buffer: ReplayBuffer = Field(default_factory=ReplayBuffer)
    estimator: Estimator = Field(default_factory=Estimator)
    loss: Loss = Field(default_factory=Loss)
    network: shared.Critic = Field(default_factory=shared.Critic)
    optim: Optim = Field(default_factory=Optim)
    eval: Eval = Field(default_factory=Eval)

    @property
    def folder(self) -> str:
        """Where curves.csv goes."""
        name = f"runs/retrace_sac/{self.env.name}/{self.estimator.name}/seed_{self.seed}"
        return self.run_dir or name


def make_env(name: str, seed: int) -> EnvBase:
    """The task in float32, with the return of its episodes."""
    env = TransformedEnv(GymEnv(name), Compose(DoubleToFloat(), RewardSum()))
    env.set_seed(seed)
    return env


def make_networks(env: EnvBase, num_cells: list[int]) -> tuple[ProbabilisticActor, ValueOperator]:
    """SAC's actor, which writes the density of its actions, and one critic."""
    observations, spec = env.observation_spec["observation"].shape[-1], env.action_spec
    actions = spec.shape[-1]
    mlp = partial(MLP, num_cells=num_cells, activation_class=nn.ReLU)
    net = nn.Sequential(mlp(observations, 2 * actions), NormalParamExtractor(scale_lb=0.01))
    actor = ProbabilisticActor(
        TensorDictModule(net, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        spec=spec,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
        return_log_prob=True,
    )
    critic = ValueOperator(mlp(observations + actions, 1), in_keys=["observation", "action"])
    return actor, critic


@torch.no_grad()
def evaluate(env: EnvBase, actor: ProbabilisticActor, num_episodes: int) -> float:
    """Mean return of episodes with the deterministic action."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        returns = [
            env.rollout(10_000, actor)["next", "reward"].sum().item() for _ in range(num_episodes)
        ]
    return sum(returns) / num_episodes


@torch.no_grad()
def mean_trace(actor: ProbabilisticActor, batch: TensorDictBase) -> Tensor:
    """Mean of min(1, pi / mu): how much of a trace one replayed step lets through."""
    log_pi = actor.get_dist(batch.select(*actor.in_keys)).log_prob(batch["action"])
    return (log_pi - batch["action_log_prob"]).clamp(max=0).exp().mean()


def main(options: Options) -> None:
    """Train an agent and write its learning curve."""
    run_dir = Path(options.folder).expanduser()
    run_dir.mkdir(parents=True, exist_ok=True)
    with closing(FolderLock(run_dir)):
        if (run_dir / CONFIG).exists():
            raise FileExistsError(f"run_dir={run_dir} holds a run already: choose another one.")
        run_retrace_sac(options, run_dir)


def run_retrace_sac(options: Options, run_dir: Path) -> None:
    """The run itself, in a folder that is its own."""
    torchrl_logger.setLevel("WARNING")  # its notes would break the progress bar
    torch.set_num_threads(1)
    torch.manual_seed(stream_seed("networks", options.seed))
    env = make_env(options.env.name, stream_seed("training", options.seed, 0))
    eval_env = make_env(options.env.name, stream_seed("evaluation"))
    actor, critic = make_networks(env, options.network.num_cells)

    loss = SACLoss(actor, critic, alpha_init=options.loss.alpha_init, action_spec=env.action_spec)
    gamma, lmbda = options.estimator.gamma, options.estimator.lmbda
    if options.estimator.name == "retrace":
        loss.make_value_estimator(RetraceEstimator.for_loss(loss, gamma=gamma, lmbda=lmbda))
    else:
        loss.make_value_estimator(options.estimator.name, gamma=gamma)
    target_updater = SoftUpdate(loss, tau=options.loss.target_update_tau)
    optim = torch.optim.Adam(loss.parameters(), lr=options.optim.lr, fused=True)
    steps = FiniteSteps(optim, max_skipped=options.optim.max_skipped)

    # Slices come flat, [B * T], with done at the end of each: that is where the traces stop.
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(options.replay_buffer.size),
        sampler=SliceSampler(
            slice_len=options.replay_buffer.slice_len,
            traj_key=("collector", "traj_ids"),
            strict_length=False,
        ),
        batch_size=options.replay_buffer.batch_size,
    )
    collector = collectors.Collector(
        env,
        actor,
        frames_per_batch=options.collector.frames_per_batch,
        total_frames=options.collector.total_frames,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )

    write_config(run_dir / CONFIG, options)
    updates = round(options.optim.updates_per_frame * options.collector.frames_per_batch)
    frames, started = 0, time.perf_counter()
    progress, shown = Progress(options.collector.total_frames), {}
    with open(run_dir / "curves.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for batch in collector:
            frames += batch.numel()
            buffer.extend(batch)
            row = {"frames": frames, "seconds": time.perf_counter() - started}
            ended = batch["next", "done"].squeeze(-1)
            if ended.any():
                row["train_return"] = batch["next", "episode_reward"][ended].mean().item()
            if frames >= options.collector.init_frames:
                for _ in range(updates):
                    sample = buffer.sample()
                    losses = loss(sample)
                    steps.step(losses)
                    target_updater.step()
                steps.count()
                row |= {name: losses[name].item() for name in ("alpha", "loss_qvalue")}
                row["trace"] = mean_trace(actor, sample).item()
            if frames % options.eval.interval == 0:
                row["eval_return"] = evaluate(eval_env, actor, options.eval.num_episodes)
                shown = {"return": f"{row['eval_return']:.1f}"}
            progress.update(batch.numel(), **shown)
            writer.writerow({name: f"{value:.6g}" for name, value in row.items()})
            file.flush()
    progress.close()
    collector.shutdown()


if __name__ == "__main__":
    cli.run("retrace_sac", main)
