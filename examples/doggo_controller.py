"""The controller of Doggo's legs: PPO on top of a gait.

    python examples/doggo_controller.py              # find a gait, train, measure, export
    python examples/doggo_controller.py resume=true  # go on after Ctrl-C

The cross-entropy method finds a gait first: torques that swing with a clock. PPO then learns what a
small network adds to it from what the robot senses, on commands to walk anywhere at any speed, and
moves the gait itself too. ``legs.safetensors`` in the run's folder is what the robot ``doggo`` is
shipped with. Every option is in doggo_controller.yaml beside this file; the task is in walking.py.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig
from safetensors.torch import save_file
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from torchrl_safe.trainers.utils import Run, set_up
from walking import Walking

from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.envs.legs import INPUT_SIZE, OTHER_SIDE, SIGNS, STEP
from torchrl_safe.record import format_table
from torchrl_safe.trainers.collectors import ResumableCollector
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.terminal import GracefulStop, progress_bar, say

USED = ["observation", "action", "action_log_prob", "advantage", "value_target"]


class Legs(nn.Module):
    """Torques before tanh, of one side of the body and of what its mirror image does.

    The same function as :func:`torchrl_safe.envs.legs.torques`, with gradients.

    Args:
        gait (Tensor): [*B, 6, 6], three joints of the left legs, front and rear, from the features
            of a gait. With a batch [B] of gaits, as many observations belong to each of them.
        network (nn.Module): from what the controller sees, [N, 49], to what it adds, [N, 6].
        std (float): of the noise at first, before tanh.
    """

    def __init__(self, gait: torch.Tensor, network: nn.Module, std: float) -> None:
        super().__init__()
        self.gait, self.network = nn.Parameter(gait), network
        self.log_std = nn.Parameter(torch.tensor(std).log().expand(12).clone())
        self.register_buffer("signs", torch.from_numpy(SIGNS).float())

    def forward(self, observation: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[*N, 49] to mean and standard deviation, [*N, 12] both."""
        left = self.side(observation).unflatten(-1, (2, 3))
        right = self.side(observation[..., OTHER_SIDE] * self.signs).unflatten(-1, (2, 3))
        legs = (left[..., 0, :], left[..., 1, :], right[..., 1, :], right[..., 0, :])
        loc = torch.stack(legs, -1).flatten(-2)
        return loc, self.log_std.exp().expand_as(loc)

    def side(self, observation: torch.Tensor) -> torch.Tensor:
        """Torques of the left legs, [*N, 6]."""
        features = gait_features(observation).unflatten(0, (*self.gait.shape[:-2], -1))
        step = (features @ self.gait.mT).reshape(*observation.shape[:-1], 6)
        return step + self.network(observation)


def gait_features(observation: torch.Tensor) -> torch.Tensor:
    """How far to step ahead and to turn, each times (sine, cosine, 1) of the clock: [*N, 6]."""
    x, y = observation[..., 0], observation[..., 1]
    length, angle = torch.hypot(x, y), torch.atan2(y, x)
    ways = torch.stack((angle.cos().clamp_min(0.0).sqrt(), (angle / 2.0).clamp(-1.0, 1.0)), -1)
    clock = torch.cat((observation[..., -2:], torch.ones_like(observation[..., :1])), -1)
    return ((length[..., None] * ways)[..., None] * clock[..., None, :]).flatten(-2)


def make_legs(cfg: DictConfig, gait: torch.Tensor) -> Legs:
    """The gait alone at first: the network's last layer starts at zero."""
    network = MLP(INPUT_SIZE, 6, num_cells=list(cfg.policy.num_cells), activation_class=nn.Tanh)
    nn.init.zeros_(network[-1].weight)
    nn.init.zeros_(network[-1].bias)
    return Legs(gait, network, cfg.policy.init_std)


def make_actor(legs: Legs) -> ProbabilisticActor:
    """A Gaussian before tanh."""
    return ProbabilisticActor(
        TensorDictModule(legs, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
    )


def make_env(
    cfg: DictConfig, num_envs: int, seed: int, num_directions: int | None = None, **options: Any
) -> SafeGoalEnv:
    """Doggo by its motors, walking where commands say."""
    return SafeGoalEnv(
        "doggo_torques",
        num_envs=num_envs,
        num_threads=cfg.num_threads,
        seed=seed,
        task=Walking(cfg.task.top_speed, cfg.task.tilt_cost, num_directions),
        **options,
    )


@torch.no_grad()
def walk(
    env: SafeGoalEnv, actor: ProbabilisticActor, num_steps: int
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What robots do that keep walking in one direction each.

    Returns:
        tuple of Tensors, [N] each: mean reward, none after a fall; speed along the command in
        metres per second, of the whole way; whether the robot ever fell.
    """
    td = env.reset()
    reward = torch.zeros(len(td))
    fallen = torch.zeros(len(td), dtype=torch.bool)
    for _ in range(num_steps):
        td = env.step(actor(td))["next"]
        fallen |= td["terminated"].squeeze(-1)
        reward += td["reward"].squeeze(-1) * ~fallen
    layouts = [env.layout(i) for i in range(len(td))]
    along = [float(layout["robot"] @ layout["command"]) for layout in layouts]
    return reward / num_steps, torch.tensor(along) / (num_steps * STEP), fallen


def find_gait(cfg: DictConfig) -> torch.Tensor:
    """A gait to start from, [6, 6]: the cross-entropy method on the reward, from nothing.

    Straight ahead first, then in several directions, which takes turning, under the noise that PPO
    starts with: a gait that stands it has some margin. A candidate is worth its mean reward and
    that of its worst direction; a fall costs a metre per second.
    """
    mean = torch.zeros(6, 6)
    for stage in cfg.gait:
        population, ways = stage.population, stage.num_directions
        seed = stream_seed("gait", cfg.seed)
        env = make_env(cfg, population * ways, seed, num_directions=ways)
        std = torch.tensor(stage.std).repeat_interleave(3).expand(6, 6)  # of ahead, of turn
        progress = progress_bar(
            total=stage.generations, desc=f"gait, {ways} directions", unit="generation"
        )
        for _ in range(stage.generations):
            candidates = mean + std * torch.randn(population, 6, 6)
            candidates[0] = mean
            actor = make_actor(make_legs(cfg, candidates))
            with set_exploration_type(ExplorationType.RANDOM):
                reward, speed, fallen = walk(env, actor, stage.num_steps)
            worth = (reward - fallen.float()).view(population, ways)
            best = (worth.mean(1) + worth.min(1).values).topk(stage.elites).indices
            mean, std = candidates[best].mean(0), candidates[best].std(0)
            speed = speed.view(population, ways)[best].mean().item()
            progress.update()
            progress.set_postfix(speed=f"{speed:.3f}", fallen=f"{fallen.float().mean().item():.3f}")
        progress.close()
    return mean


def export(legs: Legs, path: Path) -> None:
    """Writes gait and network, and the command that made them."""
    tensors = {"gait": legs.gait.detach().clone()}
    for i, layer in enumerate(m for m in legs.network if isinstance(m, nn.Linear)):
        tensors |= {f"weight{i}": layer.weight.detach(), f"bias{i}": layer.bias.detach()}
    options = [word for word in sys.argv[1:] if not word.startswith(("run_dir", "resume"))]
    command = " ".join(["python examples/doggo_controller.py", *options])
    save_file(tensors, path, metadata={"command": command})


def run_doggo(run: Run) -> None:
    """Find a gait, train, measure and export a controller."""
    cfg = run.cfg
    set_up(cfg)
    # A checkpoint brings its own gait.
    legs = make_legs(cfg, find_gait(cfg) if run.begins else torch.zeros(6, 6))
    actor = make_actor(legs)
    critic = ValueOperator(
        MLP(INPUT_SIZE, 1, num_cells=list(cfg.critic.num_cells), activation_class=nn.Tanh),
        in_keys=["observation"],
    )
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=cfg.loss.clip_epsilon,
        entropy_coeff=cfg.loss.entropy_coeff,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    advantage = GAE(gamma=cfg.loss.gamma, lmbda=cfg.loss.lmbda, value_network=critic)
    optim = torch.optim.Adam(loss.parameters(), lr=cfg.optim.lr)
    collector = ResumableCollector(
        make_env(
            cfg,
            cfg.env.num_envs,
            stream_seed("training", cfg.seed, 0),
            episode_length=cfg.env.episode_length,
            stagger=True,
        ),
        actor,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=-1,  # or it closes its environment, which is to be saved
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )
    begins = run.begins
    run.restore(loss=loss, optim=optim, collector=collector)
    if begins:
        export(legs, run.path / "gait.safetensors")  # to compare with

    total = cfg.collector.total_frames
    progress = progress_bar(total=total, initial=run.frames, unit="frame")
    intervals = (cfg.eval.interval, cfg.checkpoint.interval)
    next_eval, next_save = (run.frames // each * each + each for each in intervals)
    eval_env = make_env(
        cfg,
        cfg.eval.num_directions,
        stream_seed("evaluation"),
        num_directions=cfg.eval.num_directions,
    )
    started = time.perf_counter()
    with GracefulStop() as stop:
        for batch in collector if run.frames_left else ():
            # Steps get smaller towards the end.
            for group in optim.param_groups:
                group["lr"] = cfg.optim.lr * max(1.0 - run.frames / total, 0.1)
            run.counters["frames"] += batch.numel()
            run.counters["instabilities"] += int(batch["next", "diverged"].sum())
            metrics = update(cfg, batch, loss, advantage, optim)
            metrics["train/instabilities"] = run.counters["instabilities"]
            if run.frames >= next_eval:
                next_eval += cfg.eval.interval
                metrics |= evaluate(cfg, actor, eval_env)
            seconds = time.perf_counter() - started
            started += seconds
            run.counters["seconds"] += seconds
            metrics["time/frames_per_second"] = batch.numel() / seconds
            run.log(metrics)
            progress.update(batch.numel())
            progress.set_postfix(
                reward=f"{metrics['train/reward']:.3f}", tipped=f"{metrics['train/tipped']:.4f}"
            )
            if run.frames >= next_save or stop.requested:
                next_save += cfg.checkpoint.interval
                run.save()
            if stop.requested or not run.frames_left:
                break
    progress.close()
    if not stop.requested:
        run.save()
    collector.shutdown()
    if stop.requested:
        say(f"stopped at {run.frames} frames; go on with the same command and resume=true")
        return
    export(legs, run.path / "legs.safetensors")
    say(format_table(evaluate(cfg, actor, eval_env)))
    say(f"controller: {run.path / 'legs.safetensors'}")


def update(
    cfg: DictConfig,
    batch: TensorDictBase,
    loss: ClipPPOLoss,
    advantage: GAE,
    optim: torch.optim.Optimizer,
) -> dict[str, float]:
    """PPO on a new batch [N, T]: several passes over it in minibatches."""
    with torch.no_grad():
        data = advantage(batch).select(*USED).flatten()
    for _ in range(cfg.optim.num_epochs):
        for index in torch.randperm(len(data)).split(cfg.optim.minibatch_size):
            losses = loss(data[index])
            sum(losses[f"loss_{part}"] for part in ("objective", "critic", "entropy")).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), cfg.optim.max_grad_norm)
            optim.step()
            optim.zero_grad()
    following = batch["next"]
    return {
        "train/reward": following["reward"].mean().item(),
        "train/tipped": following["terminated"].float().mean().item(),
        "update/kl": losses["kl_approx"].item(),
        "update/clip_fraction": losses["clip_fraction"].item(),
        "update/loss_critic": losses["loss_critic"].item(),
    }


def evaluate(cfg: DictConfig, actor: ProbabilisticActor, env: SafeGoalEnv) -> dict[str, float]:
    """Speed along fixed directions and share of fallen robots, without noise."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        _, speed, fallen = walk(env, actor, cfg.eval.num_steps)
    return {
        "eval/speed": speed.mean().item(),
        "eval/slowest": speed.min().item(),
        "eval/fallen": fallen.float().mean().item(),
    }


@hydra.main(
    config_path="pkg://torchrl_safe.trainers", config_name="doggo_controller", version_base="1.3"
)
def main(cfg: DictConfig) -> None:
    """Doggo's controller as configured in doggo_controller.yaml."""
    with Run(cfg) as run:
        run_doggo(run)


if __name__ == "__main__":
    main()
