"""TorchRL's SAC with Retrace targets: the estimator with nothing else of this library.

    python examples/retrace_sac.py                     # Retrace
    python examples/retrace_sac.py estimator.name=td0  # one-step targets, equal replayed slices

Three things differ from SAC with TD(0): the actor writes the density of its actions, the replay
buffer gives back slices of trajectories, and the loss is given another value estimator. Every
option is in retrace_sac.yaml beside this file.
"""

from __future__ import annotations

import csv
import time
from contextlib import closing
from functools import partial
from pathlib import Path

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torchrl._utils import logger as torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, EnvBase, GymEnv, RewardSum, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import SACLoss, SoftUpdate
from torchrl_safe.trainers.config import check_config
from torchrl_safe.trainers.descent import Descent

from torchrl_safe import RetraceEstimator
from torchrl_safe._files import write_atomically
from torchrl_safe.trainers.locks import FolderLock
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.terminal import progress_bar

COLUMNS = ("frames", "seconds", "eval_return", "train_return", "alpha", "loss_qvalue", "trace")


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


@hydra.main(
    config_path="pkg://torchrl_safe.trainers", config_name="retrace_sac", version_base="1.3"
)
def main(cfg: DictConfig) -> None:
    """Train an agent and write its learning curve."""
    check_config(cfg)
    run_dir = Path(cfg.run_dir).expanduser()
    run_dir.mkdir(parents=True, exist_ok=True)
    with closing(FolderLock(run_dir)):
        if (run_dir / "config.yaml").exists():
            raise FileExistsError(f"run_dir={run_dir} holds a run already: choose another one.")
        run_retrace_sac(cfg, run_dir)


def run_retrace_sac(cfg: DictConfig, run_dir: Path) -> None:
    """The run itself, in a folder that is its own."""
    torchrl_logger.setLevel("WARNING")  # its notes would break the progress bar
    torch.set_num_threads(1)
    torch.manual_seed(stream_seed("networks", cfg.seed))
    env = make_env(cfg.env.name, stream_seed("training", cfg.seed, 0))
    eval_env = make_env(cfg.env.name, stream_seed("evaluation"))
    actor, critic = make_networks(env, cfg.network.num_cells)

    loss = SACLoss(actor, critic, alpha_init=cfg.loss.alpha_init, action_spec=env.action_spec)
    gamma, lmbda = cfg.estimator.gamma, cfg.estimator.lmbda
    if cfg.estimator.name == "retrace":
        loss.make_value_estimator(RetraceEstimator.for_loss(loss, gamma=gamma, lmbda=lmbda))
    else:
        loss.make_value_estimator(cfg.estimator.name, gamma=gamma)
    target_updater = SoftUpdate(loss, tau=cfg.loss.target_update_tau)
    optim = torch.optim.Adam(loss.parameters(), lr=cfg.optim.lr, fused=True)
    descent = Descent(cfg, optim)

    # Slices come flat, [B * T], with done at the end of each: that is where the traces stop.
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.replay_buffer.size),
        sampler=SliceSampler(
            slice_len=cfg.replay_buffer.slice_len,
            traj_key=("collector", "traj_ids"),
            strict_length=False,
        ),
        batch_size=cfg.replay_buffer.batch_size,
    )
    collector = Collector(
        env,
        actor,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )

    write_atomically(run_dir / "config.yaml", OmegaConf.to_yaml(cfg, resolve=True))
    updates = round(cfg.optim.updates_per_frame * cfg.collector.frames_per_batch)
    frames, started = 0, time.perf_counter()
    progress = progress_bar(total=cfg.collector.total_frames, unit="frame")
    with open(run_dir / "curves.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        for batch in collector:
            frames += batch.numel()
            progress.update(batch.numel())
            buffer.extend(batch)
            row = {"frames": frames, "seconds": time.perf_counter() - started}
            ended = batch["next", "done"].squeeze(-1)
            if ended.any():
                row["train_return"] = batch["next", "episode_reward"][ended].mean().item()
            if frames >= cfg.collector.init_frames:
                for _ in range(updates):
                    sample = buffer.sample()
                    losses = loss(sample)
                    descent.step(losses)
                    target_updater.step()
                descent.count()
                row |= {name: losses[name].item() for name in ("alpha", "loss_qvalue")}
                row["trace"] = mean_trace(actor, sample).item()
            if frames % cfg.eval.interval == 0:
                row["eval_return"] = evaluate(eval_env, actor, cfg.eval.num_episodes)
                progress.set_postfix(eval_return=f"{row['eval_return']:.1f}")
            writer.writerow({name: f"{value:.6g}" for name, value in row.items()})
            file.flush()
    progress.close()
    collector.shutdown()


if __name__ == "__main__":
    main()
