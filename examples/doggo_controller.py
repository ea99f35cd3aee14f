"""The controller inside Doggo: PPO teaches twelve motors to follow a local goal.

    python examples/doggo_controller.py              # train, measure, export
    python examples/doggo_controller.py resume=true  # go on after Ctrl-C

The robot learns on the goal task without hazards: the direction to walk in is that of the goal, how
fast is drawn anew every few seconds. What the package ships is the exported
``controller.safetensors``. Every option is in doggo_controller.yaml beside this file.
"""

from __future__ import annotations

import time
from pathlib import Path

import hydra
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from safetensors.torch import save_file
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl._utils import logger as torchrl_logger
from torchrl.collectors import Collector
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform, TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE
from tqdm import tqdm
from utils import EVAL_SEED, GracefulStop, Run, use_threads

from torchrl_safe.envs import GoalTask, SafeGoalEnv, get_robot

STEP = 0.1  # seconds
# What the controller sees: direction (2) and length (1) of the local goal; the trunk's velocity
# (3), angular velocity (3) and vertical (3); velocity, sine and cosine of 12 joints.
INPUT = 48
# What the observation has divided these by.
SCALE = torch.tensor((0.7, 0.7, 1.0, *get_robot("doggo_torques").proprioception_scale))
UPRIGHT = 11  # the vertical component of the trunk's z axis


# Left and right of the robot: the same joints on the other side, and what changes its sign.
LEGS = [3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8]
OTHER_SIDE = [*range(12), *(first + joint for first in (12, 24, 36) for joint in LEGS)]
SIGNS = torch.tensor([1, -1, 1] + [1, -1, 1] + [-1, 1, -1] + [1, -1, 1] + [1] * 36)
OTHER_MOTORS = [3, 2, 1, 0, 7, 6, 5, 4, 11, 10, 9, 8]
USED = ["observation", "action", "action_log_prob", "advantage", "value_target"]


class FollowCommand(Transform):
    """Asks for a speed towards the goal, rewards it, and ends the episode of a robot on its back.

    The observation shows the wanted speed (as a share of the top speed) in place of the goal's
    distance. The reward is ``wanted - |progress - wanted|``, in metres per step.
    """

    def __init__(self, num_envs: int, top_speed: float, full_share: float, duration: float):
        super().__init__()
        self.top_speed, self.full_share, self.duration = top_speed, full_share, duration
        self.register_buffer("length", torch.ones(num_envs, 1))

    def _draw(self, renew: torch.Tensor) -> None:
        full = torch.rand_like(self.length) < self.full_share
        length = torch.where(full, 1.0, torch.rand_like(self.length))
        self.length = torch.where(renew, length, self.length)

    def _show(self, td: TensorDictBase) -> TensorDictBase:
        observation = td["observation"].clone()
        observation[:, 2:3] = self.length
        return td.set("observation", observation)

    def _reset(self, td: TensorDictBase, reset: TensorDictBase) -> TensorDictBase:
        everywhere = torch.ones_like(reset["done"])
        self._draw(everywhere if td is None else td.get("_reset", everywhere))
        reset["along"] = torch.zeros_like(self.length)
        return self._show(reset)

    def _step(self, td: TensorDictBase, following: TensorDictBase) -> TensorDictBase:
        observation = following["observation"]
        wanted = self.length * self.top_speed * STEP
        along = following["reward"] - following["goal_met"].float()
        following["along"] = along
        following["reward"] = wanted - (along - wanted).abs()
        tipped = observation[:, UPRIGHT, None] < 0.3
        following["terminated"] = following["terminated"] | tipped
        following["done"] = following["done"] | tipped
        self._draw(torch.rand_like(self.length) < 1.0 / self.duration)
        return self._show(following)

    def transform_observation_spec(self, spec: Composite) -> Composite:
        """Adds the progress of the step, metres."""
        spec["along"] = Unbounded((*spec.shape, 1))
        return spec


def mirrored(data: TensorDictBase, actor: ProbabilisticActor) -> TensorDictBase:
    """The same transitions, left and right exchanged: as good to learn from, for a robot alike."""
    other = data.clone()
    other["observation"] = data["observation"][:, OTHER_SIDE] * SIGNS
    other["action"] = data["action"][:, OTHER_MOTORS]
    other["action_log_prob"] = actor.get_dist(other.select("observation")).log_prob(other["action"])
    return other


class Head(nn.Module):
    """The first entries of the observation: what the controller sees."""

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """[*B, D] to [*B, 48]."""
        return observation[..., :INPUT]


class Noise(nn.Module):
    """Puts a given standard deviation beside the mean."""

    def __init__(self, std: float):
        super().__init__()
        self.std = nn.Parameter(torch.tensor(std), requires_grad=False)

    def forward(self, loc: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """[*B, A] to [*B, A] twice."""
        return loc, self.std.expand_as(loc)


def make_actor(cfg: DictConfig, noise: Noise) -> ProbabilisticActor:
    """A Gaussian before tanh."""
    size = get_robot("doggo_torques").action_dim
    network = MLP(INPUT, size, num_cells=list(cfg.policy.num_cells), activation_class=nn.ReLU)
    with torch.no_grad():
        network[-1].weight.mul_(0.01)
    module = nn.Sequential(Head(), network, noise)
    return ProbabilisticActor(
        TensorDictModule(module, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -1.0, "high": 1.0},
        return_log_prob=True,
    )


def make_critic(cfg: DictConfig) -> ValueOperator:
    """The value of a state under its command."""
    network = MLP(INPUT, 1, num_cells=list(cfg.critic.num_cells), activation_class=nn.ReLU)
    return ValueOperator(nn.Sequential(Head(), network), in_keys=["observation"])


def export(actor: ProbabilisticActor, path: Path) -> None:
    """Writes the mean's network in half precision, and the command that made it.

    What the observation divides its entries by goes into the first weights: the exported network
    takes the readings as they are.
    """
    layers = [module for module in actor.modules() if isinstance(module, nn.Linear)]
    tensors = {}
    for i, layer in enumerate(layers):
        weight = layer.weight.detach() / SCALE if i == 0 else layer.weight.detach()
        tensors |= {f"weight{i}": weight.half(), f"bias{i}": layer.bias.detach().half()}
    overrides = HydraConfig.get().overrides.task
    options = [option for option in overrides if not option.startswith(("run_dir", "resume"))]
    command = " ".join(["python examples/doggo_controller.py", *options])
    save_file(tensors, path, metadata={"command": command})


def make_env(cfg: DictConfig, num_envs: int, seed: int, **kwargs: object) -> SafeGoalEnv:
    """Doggo on its own in the square."""
    return SafeGoalEnv(
        "doggo_torques",
        num_envs=num_envs,
        num_threads=cfg.num_threads,
        seed=seed,
        task=GoalTask(num_hazards=0, lidar_bins=3),
        **kwargs,
    )


@torch.no_grad()
def speed_by_direction(actor: ProbabilisticActor, cfg: DictConfig) -> torch.Tensor:
    """Metres per second along fixed directions of the world, by deterministic actions.

    Direction i is i / n of a full turn to the left of where the robot faced when it stood there;
    the local goal, of length one, is shown in the robot's frame of the moment.

    Returns:
        Tensor: [n], displacement along the direction over the time it took, start included.
    """
    env = make_env(cfg, cfg.eval.num_directions, EVAL_SEED)
    td = env.reset()

    def where() -> tuple[torch.Tensor, torch.Tensor]:
        layouts = [env.layout(i) for i in range(cfg.eval.num_directions)]
        position, heading = (
            torch.from_numpy(np.stack([layout[key] for layout in layouts]))
            for key in ("robot", "heading")
        )
        return position, torch.view_as_complex(heading)

    start, heading = where()
    turns = torch.arange(cfg.eval.num_directions) / cfg.eval.num_directions
    direction = heading * torch.exp(2j * torch.pi * turns)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        for _ in range(cfg.eval.num_steps):
            local = torch.view_as_real(direction * heading.conj()).float()
            td["observation"][:, :2], td["observation"][:, 2] = local / SCALE[:2], 1.0
            td = env.step(actor(td))["next"]
            position, heading = where()
    moved = torch.view_as_complex(position - start)
    return (moved * direction.conj()).real / (cfg.eval.num_steps * STEP)


@hydra.main(config_path=".", config_name="doggo_controller", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Train, measure and export a controller."""
    torchrl_logger.setLevel("WARNING")  # its notes would break the progress bar
    use_threads(cfg.num_threads)
    torch.manual_seed(cfg.seed)

    noise = Noise(cfg.policy.init_std)
    actor, critic = make_actor(cfg, noise), make_critic(cfg)
    advantage = GAE(
        gamma=cfg.loss.gamma,
        lmbda=cfg.loss.lmbda,
        value_network=critic,
        average_gae=True,
        deactivate_vmap=True,
    )
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=cfg.loss.clip_epsilon,
        entropy_bonus=False,
        loss_critic_type="l2",
    )
    optim = torch.optim.Adam(loss.parameters(), lr=cfg.optim.lr, fused=True)
    run = Run(cfg, loss=loss, optim=optim)
    env = TransformedEnv(
        make_env(
            cfg,
            cfg.env.num_envs,
            seed=cfg.seed + run.frames,  # a resumed run sees new layouts
            episode_length=cfg.env.episode_length,
            stagger=True,
        ),
        FollowCommand(cfg.env.num_envs, **cfg.command),
    )
    total_frames = cfg.collector.total_frames
    collector = Collector(
        env,
        actor,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=total_frames - run.frames,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )

    progress = tqdm(total=total_frames, initial=run.frames, unit="frame")
    next_eval, next_save = (
        run.frames // interval * interval + interval
        for interval in (cfg.eval.interval, cfg.checkpoint.interval)
    )
    started = time.perf_counter()
    with GracefulStop() as stop:
        for batch in collector:
            run.counters["frames"] += batch.numel()
            with torch.no_grad():
                advantage(batch)
                data = batch.select(*USED).flatten()
                data["observation"] = data["observation"][:, :INPUT]
                data = torch.cat((data, mirrored(data, actor)))
            kl = []
            for _ in range(cfg.optim.num_epochs):
                for index in torch.randperm(len(data)).split(cfg.optim.minibatch_size):
                    losses = loss(data[index])
                    (losses["loss_objective"] + losses["loss_critic"]).backward()
                    nn.utils.clip_grad_norm_(loss.parameters(), cfg.optim.max_grad_norm)
                    optim.step()
                    optim.zero_grad()
                    kl.append(losses["kl_approx"].item())
            # Steps are as long as the policy may move: less and less, as the noise falls.
            for group in optim.param_groups:
                group["lr"] *= 1.1 if sum(kl) / len(kl) < cfg.optim.kl else 1 / 1.1
            # Less and less noise, or the robot learns a walk that the noise has to start.
            share = min(1.0, run.frames / (cfg.policy.decay_share * total_frames))
            noise.std.fill_(cfg.policy.init_std ** (1 - share) * cfg.policy.final_std**share)

            seconds = time.perf_counter() - started
            started += seconds
            run.counters["seconds"] += seconds
            metrics = {
                "train/reward": batch["next", "reward"].mean().item() / STEP,
                "train/speed": batch["next", "along"].mean().item() / STEP,
                "train/tipped": batch["next", "terminated"].float().mean().item(),
                "train/std": noise.std.item(),
                "update/kl": sum(kl) / len(kl),
                "update/lr": optim.param_groups[0]["lr"],
                "update/clip_fraction": losses["clip_fraction"].item(),
                "update/loss_critic": losses["loss_critic"].item(),
                "time/frames_per_second": batch.numel() / seconds,
            }
            if run.frames >= next_eval:
                next_eval += cfg.eval.interval
                speed = speed_by_direction(actor, cfg)
                metrics |= {"eval/speed": speed.mean().item(), "eval/slowest": speed.min().item()}
            run.log(metrics)
            progress.update(batch.numel())
            progress.set_postfix({k: f"{metrics[f'train/{k}']:.3f}" for k in ("reward", "speed")})
            if run.frames >= next_save or stop.requested:
                next_save += cfg.checkpoint.interval
                run.save()
            if stop.requested:
                break
    progress.close()
    collector.shutdown()
    if stop.requested:
        print(f"stopped at {run.frames} frames; go on with the same command and resume=true")
        return
    run.save()
    path = run.path / "controller.safetensors"
    export(actor, path)
    speed = speed_by_direction(actor, cfg)
    for i, value in enumerate(speed.tolist()):
        print(f"{360 * i / len(speed):4.0f} degrees: {value:.3f} m/s")
    print(f"controller: {path}")


if __name__ == "__main__":
    main()
