"""Plain TRPO on Pendulum-v1: the optimizer without a constraint, in TorchRL's ``Trainer``.

python examples/compose_trpo.py   # half a minute; csv curves in runs/compose_trpo
"""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, GymWrapper
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import A2CLoss
from torchrl.record import CSVLogger
from torchrl.trainers import LogScalar, OptimizationStepper, Trainer

from torchrl_safe import GMMTanhPolicy, TrustRegionSafeOptimizer
from torchrl_safe.modules import moment_matched_kl


def make_env(seed: int) -> EnvBase:
    """Sixteen pendulums at once; TorchRL resets them, so Gymnasium must not."""
    disabled = {"autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED}
    env = GymWrapper(gymnasium.make_vec("Pendulum-v1", 16, "sync", vector_kwargs=disabled))
    env.set_seed(seed)
    return env


class TRPOStepper(OptimizationStepper):
    """Fit the critic to GAE's targets, then take one trust-region step of the policy."""

    def __init__(self, policy: GMMTanhPolicy) -> None:
        self.policy = policy
        critic = ValueOperator(MLP(3, 1, num_cells=[64, 64]))
        self.loss_module = A2CLoss(policy, critic)
        self.loss_module.make_value_estimator(gamma=0.98, lmbda=0.95, average_gae=True)
        self.critic_optim = torch.optim.Adam(critic.parameters(), lr=3e-3)
        self.policy_optim = TrustRegionSafeOptimizer(
            policy.parameters(),
            max_kl=0.02,
            recovery_ratio=0.7,  # of the region's radius, should there be a constraint
            statistics_kl=lambda old, new: moment_matched_kl(*old.values(), *new.values()).mean(),
        )

    def step(self, trainer: Trainer, batch: TensorDictBase) -> TensorDictBase:
        """Learn from the newest batch [N, T]; the report goes to the log."""
        self.fit_critics(batch)
        report = self.policy_optim.step(self.make_closure(batch))
        return TensorDict({name: torch.tensor(x) for name, x in report.to_dict().items()})

    def fit_critics(self, batch: TensorDictBase) -> None:
        """Ten passes over the batch."""
        with torch.no_grad():
            self.loss_module.value_estimator(batch)  # writes advantage and value_target
        for index in torch.randperm(batch.numel()).repeat(10).split(512):
            self.loss_module(batch.flatten()[index])["loss_critic"].backward()
            self.critic_optim.step()
            self.critic_optim.zero_grad()

    def make_closure(self, batch: TensorDictBase) -> Callable[[], TensorDict]:
        """The surrogate objective and the policy's moments, as functions of its weights."""

        def closure() -> TensorDict:
            dist = self.policy.get_dist(batch)
            ratio = (dist.log_prob(batch["action"]) - batch["action_log_prob"]).exp()
            mean, cov = dist.moments
            objective = (ratio * batch["advantage"].squeeze(-1)).mean()
            return TensorDict(objective=objective, statistics={"mean": mean, "cov": cov})

        return closure


def make_trainer(env: EnvBase, stepper: TRPOStepper, total_frames: int, log_dir: str) -> Trainer:
    """TorchRL's trainer around the stepper."""
    budget = {"frames_per_batch": 3200, "total_frames": total_frames}
    collector = Collector(env, stepper.policy, **budget, auto_register_policy_transforms=False)
    trainer = Trainer(
        collector=collector,
        total_frames=total_frames,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=stepper.loss_module,
        optimization_stepper=stepper,
        logger=CSVLogger("log", log_dir=log_dir),
        log_interval=1,
    )
    LogScalar(logname="train/reward", log_pbar=True, include_std=False).register(trainer)
    return trainer


if __name__ == "__main__":
    torch.manual_seed(0)
    env = make_env(seed=0)
    policy = GMMTanhPolicy(MLP(3, 3, num_cells=[64, 64]), env.action_spec, num_components=1)
    make_trainer(env, TRPOStepper(policy), 96_000, "runs/compose_trpo").train()
