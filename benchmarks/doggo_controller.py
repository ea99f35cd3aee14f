"""The controller of Doggo's legs: PPO on top of a gait.

    python benchmarks/doggo_controller.py              # find a gait, train, measure, export
    python benchmarks/doggo_controller.py resume=true  # go on after Ctrl-C

The cross-entropy method finds a gait first: torques that swing with a clock. PPO then learns what a
small network adds to it from what the robot senses, on commands to walk anywhere at any speed, and
moves the gait itself too. ``legs.safetensors`` in the run's folder is what the robot ``doggo`` is
shipped with. The task is in walking.py.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import torch
from pydantic import Field, field_validator, model_validator
from safetensors.torch import save_file
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from typing_extensions import Self
from walking import Walking

from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.envs.legs import INPUT_SIZE, OTHER_SIDE, SIGNS, STEP
from torchrl_safe.record import format_table
from torchrl_safe.trainers import cli
from torchrl_safe.trainers import options as shared
from torchrl_safe.trainers.collectors import ResumableCollector
from torchrl_safe.trainers.options import Group, again, check_widths, option
from torchrl_safe.trainers.run import Run
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.terminal import GracefulStop, Progress, say
from torchrl_safe.trainers.threads import most_threads, threads
from torchrl_safe.trainers.trainer import set_up

USED = ["observation", "action", "action_log_prob", "advantage", "value_target"]


class Env(Group):
    """Robots."""

    num_envs: int = option(128, "robots", ge=1)
    episode_length: int = option(1000, "steps of .1 s", ge=1)


class Task(Group):
    """See walking.py."""

    top_speed: float = option(0.6, "m/s that a command of length one asks for", gt=0)
    tilt_cost: float = option(4.0, "m/s that leaning by a right angle costs", ge=0)


class Stage(Group):
    """Of the cross-entropy method."""

    num_directions: int = option(1, "ways that a gait is tried in", ge=1)
    population: int = option(192, "gaits that are tried", ge=2)
    elites: int = option(12, "the best of them", ge=2)
    num_steps: int = option(30, "that each is tried for", ge=1)
    generations: int = option(8, "how often", ge=1)
    std: list[float] = option([0.6, 0.0], "spread at first of what steps ahead and what turns")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.elites > self.population or len(self.std) != 2 or min(self.std) < 0:
            raise ValueError("no stage")
        return self


STAGES = [
    Stage(),  # steps ahead
    Stage(  # and turns
        num_directions=4, population=64, elites=8, num_steps=40, generations=10, std=[0.1, 0.6]
    ),
    Stage(  # and lasts
        num_directions=8, population=48, elites=8, num_steps=100, generations=14, std=[0.15, 0.15]
    ),
]


class Policy(Group):
    """What is added to the gait."""

    num_cells: list[int] = again(shared.Policy, "num_cells", [64, 64])
    init_std: float = option(0.15, "of the torques' noise, before tanh", gt=0, fixed=True)

    @field_validator("num_cells")
    @classmethod
    def _check_widths(cls, value: list[int]) -> list[int]:
        return check_widths(value)


class Collector(Group):
    """Who acts, and for how long."""

    frames_per_batch: int = again(shared.Collector, "frames_per_batch", 8192)
    total_frames: int = option(
        409_600, "of the whole run after the gait, resumed parts included", ge=1
    )


class Loss(Group):
    """PPO's."""

    gamma: float = again(shared.Loss, "gamma", 0.97)
    lmbda: float = option(0.95, "of the advantages' traces", ge=0, le=1)
    clip_epsilon: float = option(0.2, "of the probability ratio", gt=0, lt=1)
    entropy_coeff: float = option(0.0, "of the bonus", ge=0)


class Optim(Group):
    """Its optimizer."""

    lr: float = option(5e-4, "at first; it falls linearly to a tenth", gt=0)
    num_epochs: int = option(5, "passes over each batch", ge=1)
    minibatch_size: int = option(1024, "frames", ge=1)
    max_grad_norm: float = option(1.0, "gradients are clipped to it", gt=0)


class Eval(Group):
    """Robots that walk one way each."""

    interval: int = option(81_920, "frames", ge=1)
    num_directions: int = option(16, "one robot each", ge=1)
    num_steps: int = option(400, "per direction", ge=1)


class Checkpoint(shared.Checkpoint):
    """Checkpoints."""

    interval: int = again(shared.Checkpoint, "interval", 81_920)


class Options(shared.Options):
    """All of the controller's options."""

    method = "doggo_controller"

    env: Env = Field(default_factory=Env)
    task: Task = Field(default_factory=Task)
    gait: list[dict[str, Any]] = option(
        [stage.model_dump() for stage in STAGES],
        "the cross-entropy method, in stages",
        allowed="a list of stages with num_directions, population, elites, num_steps, generations "
        "(integers of at least 1; 2 to population elites) and std (two numbers of at least 0)",
        fixed=True,
    )
    policy: Policy = Field(default_factory=Policy)
    critic: shared.Critic = Field(default_factory=shared.Critic)
    collector: Collector = Field(default_factory=Collector)
    loss: Loss = Field(default_factory=Loss)
    optim: Optim = Field(default_factory=Optim)
    eval: Eval = Field(default_factory=Eval)
    logger: shared.Logger = Field(default_factory=shared.Logger)
    checkpoint: Checkpoint = Field(default_factory=Checkpoint)

    @field_validator("gait")
    @classmethod
    def _check_gait(cls, value: list[dict[str, Any]]) -> list[dict[str, Any]]:
        try:
            return [Stage(**stage).model_dump() for stage in value]
        except ValueError:
            raise ValueError("no gait") from None

    @property
    def folder(self) -> str:
        """Where the run is."""
        return self.run_dir or f"runs/doggo_controller/seed_{self.seed}"


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


def make_legs(options: Options, gait: torch.Tensor) -> Legs:
    """The gait alone at first: the network's last layer starts at zero."""
    network = MLP(INPUT_SIZE, 6, num_cells=list(options.policy.num_cells), activation_class=nn.Tanh)
    nn.init.zeros_(network[-1].weight)
    nn.init.zeros_(network[-1].bias)
    return Legs(gait, network, options.policy.init_std)


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
    options: Options, num_envs: int, seed: int, num_directions: int | None = None, **kwargs: Any
) -> SafeGoalEnv:
    """Doggo by its motors, walking where commands say."""
    return SafeGoalEnv(
        "doggo_torques",
        num_envs=num_envs,
        num_threads=most_threads(options),
        seed=seed,
        task=Walking(options.task.top_speed, options.task.tilt_cost, num_directions),
        **kwargs,
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


def find_gait(options: Options) -> torch.Tensor:
    """A gait to start from, [6, 6]: the cross-entropy method on the reward, from nothing.

    Straight ahead first, then in several directions, which takes turning, under the noise that PPO
    starts with: a gait that stands it has some margin. A candidate is worth its mean reward and
    that of its worst direction; a fall costs a metre per second.
    """
    mean = torch.zeros(6, 6)
    for stage in (Stage(**each) for each in options.gait):
        population, ways = stage.population, stage.num_directions
        seed = stream_seed("gait", options.seed)
        env = make_env(options, population * ways, seed, num_directions=ways)
        std = torch.tensor(stage.std).repeat_interleave(3).expand(6, 6)  # of ahead, of turn
        progress = Progress(stage.generations, unit=f"generations of a gait, {ways} directions")
        for _ in range(stage.generations):
            candidates = mean + std * torch.randn(population, 6, 6)
            candidates[0] = mean
            actor = make_actor(make_legs(options, candidates))
            with set_exploration_type(ExplorationType.RANDOM):
                reward, speed, fallen = walk(env, actor, stage.num_steps)
            worth = (reward - fallen.float()).view(population, ways)
            best = (worth.mean(1) + worth.min(1).values).topk(stage.elites).indices
            mean, std = candidates[best].mean(0), candidates[best].std(0)
            speed = speed.view(population, ways)[best].mean().item()
            fallen_share = f"{fallen.float().mean().item():.3f}"
            progress.update(1, speed=f"{speed:.3f}", fallen=fallen_share)
        progress.close()
    return mean


def export(legs: Legs, path: Path) -> None:
    """Writes gait and network, and the command that made them."""
    tensors = {"gait": legs.gait.detach().clone()}
    for i, layer in enumerate(m for m in legs.network if isinstance(m, nn.Linear)):
        tensors |= {f"weight{i}": layer.weight.detach(), f"bias{i}": layer.bias.detach()}
    words = [word for word in sys.argv[1:] if not word.startswith(("run_dir", "resume"))]
    command = " ".join(["python benchmarks/doggo_controller.py", *words])
    save_file(tensors, path, metadata={"command": command})


def run_doggo(run: Run) -> None:
    """Find a gait, train, measure and export a controller."""
    options = run.options
    set_up(options)
    # A checkpoint brings its own gait.
    legs = make_legs(options, find_gait(options) if run.begins else torch.zeros(6, 6))
    actor = make_actor(legs)
    critic = ValueOperator(
        MLP(INPUT_SIZE, 1, num_cells=list(options.critic.num_cells), activation_class=nn.Tanh),
        in_keys=["observation"],
    )
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=options.loss.clip_epsilon,
        entropy_coeff=options.loss.entropy_coeff,
        loss_critic_type="l2",
        normalize_advantage=True,
    )
    advantage = GAE(gamma=options.loss.gamma, lmbda=options.loss.lmbda, value_network=critic)
    optim = torch.optim.Adam(loss.parameters(), lr=options.optim.lr)
    collector = ResumableCollector(
        make_env(
            options,
            options.env.num_envs,
            stream_seed("training", options.seed, 0),
            episode_length=options.env.episode_length,
            stagger=True,
        ),
        actor,
        frames_per_batch=options.collector.frames_per_batch,
        total_frames=-1,  # or it closes its environment, which is to be saved
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )
    begins = run.begins
    run.restore(loss=loss, optim=optim, collector=collector)
    if begins:
        export(legs, run.path / "gait.safetensors")  # to compare with

    total = options.collector.total_frames
    progress = Progress(total, run.frames)
    intervals = (options.eval.interval, options.checkpoint.interval)
    next_eval, next_save = (run.frames // each * each + each for each in intervals)
    eval_env = make_env(
        options,
        options.eval.num_directions,
        stream_seed("evaluation"),
        num_directions=options.eval.num_directions,
    )
    started = time.perf_counter()
    with GracefulStop() as stop:
        for batch in collector if run.frames_left else ():
            # Steps get smaller towards the end.
            for group in optim.param_groups:
                group["lr"] = options.optim.lr * max(1.0 - run.frames / total, 0.1)
            run.counters["frames"] += batch.numel()
            run.counters["instabilities"] += int(batch["next", "diverged"].sum())
            metrics = update(options, batch, loss, advantage, optim)
            metrics["train/instabilities"] = run.counters["instabilities"]
            if run.frames >= next_eval:
                next_eval += options.eval.interval
                metrics |= evaluate(options, actor, eval_env)
            seconds = time.perf_counter() - started
            started += seconds
            run.counters["seconds"] += seconds
            metrics["time/frames_per_second"] = batch.numel() / seconds
            run.log(metrics)
            progress.update(
                batch.numel(),
                reward=f"{metrics['train/reward']:.3f}",
                tipped=f"{metrics['train/tipped']:.4f}",
            )
            if run.frames >= next_save or stop.requested:
                next_save += options.checkpoint.interval
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
    say(format_table(evaluate(options, actor, eval_env)))
    say(f"controller: {run.path / 'legs.safetensors'}")


def update(
    options: Options,
    batch: TensorDictBase,
    loss: ClipPPOLoss,
    advantage: GAE,
    optim: torch.optim.Optimizer,
) -> dict[str, float]:
    """PPO on a new batch [N, T]: several passes over it in minibatches."""
    with torch.no_grad():
        data = advantage(batch).select(*USED).flatten()
    for _ in range(options.optim.num_epochs):
        for index in torch.randperm(len(data)).split(options.optim.minibatch_size):
            losses = loss(data[index])
            sum(losses[f"loss_{part}"] for part in ("objective", "critic", "entropy")).backward()
            nn.utils.clip_grad_norm_(loss.parameters(), options.optim.max_grad_norm)
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


def evaluate(options: Options, actor: ProbabilisticActor, env: SafeGoalEnv) -> dict[str, float]:
    """Speed along fixed directions and share of fallen robots, without noise."""
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        _, speed, fallen = walk(env, actor, options.eval.num_steps)
    return {
        "eval/speed": speed.mean().item(),
        "eval/slowest": speed.min().item(),
        "eval/fallen": fallen.float().mean().item(),
    }


def main(given: Options) -> None:
    """Find, train, measure and export, or go on with it."""
    with Run(given) as run, threads(run.options):
        run_doggo(run)


if __name__ == "__main__":
    cli.run("doggo_controller", main)
