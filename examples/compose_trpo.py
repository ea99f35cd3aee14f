"""Plain TRPO on Pendulum-v1: ``TrustRegionSafeOptimizer`` without a constraint, in TorchRL's ``Trainer``.

    python examples/compose_trpo.py   # about 3 minutes; writes csv curves to runs/compose_trpo

The KL is any function of the parameters that is zero where the step starts; here it is that of the
Gaussians before tanh, which is that of the actions.
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torch.distributions import Normal, kl_divergence
from torchrl.collectors import Collector
from torchrl.envs import GymWrapper
from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import A2CLoss
from torchrl.record import CSVLogger
from torchrl.trainers import LogScalar, OptimizationStepper, Trainer

from torchrl_safe import TrustRegionSafeOptimizer


class TRPOStepper(OptimizationStepper):
    """Fit the critic to GAE's targets, then one trust-region step of the policy."""

    def __init__(self, actor: ProbabilisticActor, critic: nn.Module) -> None:
        self.actor = actor
        self.policy_optim = TrustRegionSafeOptimizer(actor.parameters(), max_kl=0.02)
        self.critic_optim = torch.optim.Adam(critic.parameters(), lr=3e-3)

    def step(self, trainer: Trainer, batch: TensorDictBase) -> TensorDictBase:
        """A step on the newest batch [N, T]."""
        with torch.no_grad():
            trainer.loss_module.value_estimator(batch)  # writes advantage and value_target
        data = batch.flatten()
        for index in torch.randperm(len(data)).repeat(10).split(512):
            trainer.loss_module(data[index])["loss_critic"].backward()
            self.critic_optim.step()
            self.critic_optim.zero_grad()
        advantage = data["advantage"].squeeze(-1)
        advantage = (advantage - advantage.mean()) / advantage.std()
        with torch.no_grad():
            old = self.actor.get_dist(data)

        def closure() -> TensorDict:
            new = self.actor.get_dist(data)
            ratio = (new.log_prob(data["action"]) - data["action_log_prob"]).exp()
            kl = kl_divergence(Normal(old.loc, old.scale), Normal(new.loc, new.scale))
            return TensorDict(objective=(ratio * advantage).mean(), kl=kl.sum(-1).mean())

        report = self.policy_optim.step(closure)
        return TensorDict({name: torch.tensor(v) for name, v in report.to_dict().items()})


def train(seed: int, total_frames: int, log_dir: str) -> float:
    """Train, log, and return the mean reward of the last batch."""
    torch.manual_seed(seed)
    disabled = {"autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED}  # TorchRL resets
    env = GymWrapper(gymnasium.make_vec("Pendulum-v1", 16, "sync", vector_kwargs=disabled))
    env.set_seed(seed)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(MLP(3, 2, num_cells=[64, 64]), NormalParamExtractor()),
            in_keys=["observation"],
            out_keys=["loc", "scale"],
        ),
        in_keys=["loc", "scale"],
        spec=env.action_spec_unbatched,
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -2.0, "high": 2.0, "tanh_loc": False},
        return_log_prob=True,
    )
    critic = ValueOperator(MLP(3, 1, num_cells=[64, 64]))
    loss_module = A2CLoss(actor, critic)
    loss_module.make_value_estimator(gamma=0.98, lmbda=0.95)
    collector = Collector(env, actor, frames_per_batch=3200, total_frames=total_frames)
    trainer = Trainer(
        collector=collector,
        total_frames=total_frames,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=loss_module,
        optimization_stepper=TRPOStepper(actor, critic),
        logger=CSVLogger("log", log_dir=log_dir),
        log_interval=1,
    )
    reward = LogScalar(logname="train/reward", log_pbar=True, include_std=False)
    reward.register(trainer)
    trainer.train()
    return trainer._log_dict["train/reward"][-1]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-frames", type=int, default=200_000)
    parser.add_argument("--log-dir", default="runs/compose_trpo")
    train(**vars(parser.parse_args()))
