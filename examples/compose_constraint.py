"""A cost constraint added to a policy-gradient script, on Pendulum-v1: swing up, but slowly.

    python examples/compose_constraint.py                    # at most 2 % of the steps above 4 rad/s
    python examples/compose_constraint.py --cost-limit inf   # the script it was before: TRPO

The lines that the constraint added are marked with ``+``.
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from tensordict import TensorDict
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import Bounded
from torchrl.envs import GymWrapper, Transform, TransformedEnv
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives.value import GAE

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, TrustRegionSafeOptimizer
from torchrl_safe.objectives.functional import discounted_cost_limit, moment_matched_kl

GAMMA = 0.98


class SpeedCost(Transform):  # +
    """A cost of 1 in every step that ends above 4 rad/s."""

    def _step(self, tensordict, next_tensordict):
        speed = next_tensordict["observation"][..., 2:].abs()
        return next_tensordict.set("cost", (speed > 4).float())

    def transform_reward_spec(self, reward_spec):
        reward_spec["cost"] = Bounded(0.0, 1.0, (*reward_spec.shape, 1))
        return reward_spec


def train(cost_limit: float, seed: int, total_frames: int) -> list[tuple[int, float, float]]:
    """Train, and return (frames, reward per step, cost per step) of every update."""
    torch.manual_seed(seed)
    disabled = {"autoreset_mode": gymnasium.vector.AutoresetMode.DISABLED}  # TorchRL resets
    env = GymWrapper(gymnasium.make_vec("Pendulum-v1", 16, "sync", vector_kwargs=disabled))
    env = TransformedEnv(env, SpeedCost())
    env.set_seed(seed)
    policy = GMMTanhPolicy(MLP(3, 3, num_cells=[64, 64]), env.action_spec, num_components=1)
    critic = ValueOperator(MLP(3, 1, num_cells=[64, 64]))
    advantage = GAE(gamma=GAMMA, lmbda=0.95, value_network=critic, average_gae=True)

    def cost_critic(key, *last):  # +
        network = MLP(4, 1, num_cells=[64, 64]).extend(last)
        return ValueOperator(network, in_keys=["observation", "action"], out_keys=[key])

    cost_loss = CVaRCostLoss(  # +
        policy,
        cost_critic("cost_value"),
        cost_critic("cost_std", nn.Softplus()),
        cost_limit=discounted_cost_limit(min(cost_limit, 1.0), GAMMA),
        risk_level=1.0,
    )
    cost_loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)  # +
    critic_optim = torch.optim.Adam(
        [
            *critic.parameters(),
            *cost_loss.cost_network_params.parameters(),
            *cost_loss.std_network_params.parameters(),
        ],
        lr=3e-3,
    )
    policy_optim = TrustRegionSafeOptimizer(
        policy.parameters(),
        max_kl=0.02,
        recovery_ratio=0.7,
        statistics_kl=lambda old, new: moment_matched_kl(*old.values(), *new.values()).mean(),
    )
    curve, frames = [], 0
    for batch in Collector(
        env,
        policy,
        frames_per_batch=3200,
        total_frames=total_frames,
        auto_register_policy_transforms=False,
    ):
        frames += batch.numel()
        with torch.no_grad():
            advantage(batch)
        batch["cost_target"], batch["std_target"] = cost_loss.compute_target(batch)  # +
        data = batch.flatten()
        for index in torch.randperm(len(data)).repeat(10).split(512):
            minibatch = data[index]
            value = critic(minibatch.select("observation"))["state_value"]
            loss = (value - minibatch["value_target"]).square().mean()
            losses = cost_loss(minibatch)
            (loss + losses["loss_cost_value"] + losses["loss_cost_std"]).backward()
            critic_optim.step()
            critic_optim.zero_grad()
        noise = policy.get_dist(data).draw_noise()
        reference = cost_loss.cvar(data, policy.get_dist(data).rsample(noise=noise)).mean().detach()
        level = cost_loss.on_policy_cvar(batch)

        def closure():
            dist = policy.get_dist(data)
            ratio = (dist.log_prob(data["action"]) - data["action_log_prob"]).exp()
            mean, cov = dist.moments
            out = TensorDict(
                objective=(ratio * data["advantage"].squeeze(-1)).mean(),
                statistics={"mean": mean, "cov": cov},
            )
            if cost_limit < 1:
                out["constraint"] = cost_loss.constraint(
                    data, dist.rsample(noise=noise), reference=reference, level=level
                )[None]
            return out

        report = policy_optim.step(closure)
        curve.append(
            (frames, batch["next", "reward"].mean().item(), batch["next", "cost"].mean().item())
        )
        print(*curve[-1], report.case, round(report.kl, 4), losses["cost_value"].item(), flush=True)
    return curve


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cost-limit", type=float, default=0.02)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--total-frames", type=int, default=100_000)
    train(**vars(parser.parse_args()))
