"""A cost constraint added to compose_trpo.py: swing up, but with few steps above 4 rad/s.

    python examples/compose_constraint.py               # at most 10 % of the steps; a minute
    python examples/compose_constraint.py --limit 0.05  # csv curves in runs/compose_constraint

What it took: a cost, its critics, and one more entry in the optimizer's closure.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from compose_trpo import TRPOStepper, make_env, make_trainer
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.data import Bounded, Composite
from torchrl.envs import Transform, TransformedEnv
from torchrl.modules import MLP, ValueOperator
from torchrl.trainers import LogScalar, Trainer

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy
from torchrl_safe.objectives.functional import discounted_cost_limit


class SpeedCost(Transform):
    """A cost of 1 for every step that ends above 4 rad/s, as a leaf of the reward spec."""

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        speed = next_tensordict["observation"][..., 2:].abs()
        return next_tensordict.set("cost", (speed > 4).float())

    def transform_reward_spec(self, reward_spec: Composite) -> Composite:
        """Declare the cost."""
        reward_spec["cost"] = Bounded(0.0, 1.0, (*reward_spec.shape, 1))
        return reward_spec


class ConstrainedStepper(TRPOStepper):
    """TRPO with a limit on the expected cost per step."""

    def __init__(self, policy: GMMTanhPolicy, limit: float) -> None:
        super().__init__(policy)
        mean = MLP(4, 1, num_cells=[64, 64])
        std = MLP(4, 1, num_cells=[64, 64]).extend([nn.Softplus()])
        self.cost_loss = CVaRCostLoss(
            policy,
            ValueOperator(mean, in_keys=["observation", "action"], out_keys=["cost_value"]),
            ValueOperator(std, in_keys=["observation", "action"], out_keys=["cost_std"]),
            cost_limit=discounted_cost_limit(limit, gamma=0.99),
            risk_level=1.0,  # the mean; 0.1 would be the worst tenth of outcomes
        )
        self.cost_loss.make_value_estimator(gamma=0.99, lmbda=0.95)
        nets = self.cost_loss.cost_network_params, self.cost_loss.std_network_params
        self.cost_optim = torch.optim.Adam([p for n in nets for p in n.parameters()], lr=3e-3)

    def step(self, trainer: Trainer, batch: TensorDictBase) -> TensorDictBase:
        """Steps that shrink: along a boundary, large ones leap from side to side."""
        self.policy_optim.param_groups[0]["max_kl"] *= 0.96
        return super().step(trainer, batch)

    def fit_critics(self, batch: TensorDictBase) -> None:
        """Those of the cost, too."""
        super().fit_critics(batch)
        batch["cost_target"], batch["std_target"] = self.cost_loss.compute_target(batch)
        for index in torch.randperm(batch.numel()).repeat(10).split(512):
            losses = self.cost_loss(batch.flatten()[index])
            (losses["loss_cost_value"] + losses["loss_cost_std"]).backward()
            self.cost_optim.step()
            self.cost_optim.zero_grad()

    def make_closure(self, batch: TensorDictBase) -> Callable[[], TensorDict]:
        """One more entry: the constraint, feasible at or below zero."""
        surrogate = super().make_closure(batch)
        with torch.no_grad():
            dist = self.policy.get_dist(batch)
            noise = dist.draw_noise()  # once: candidates are compared on equal draws
            measured = self.cost_loss.measure(batch, dist.rsample(noise=noise))

        def closure() -> TensorDict:
            action = self.policy.get_dist(batch).rsample(noise=noise)
            value = self.cost_loss.constraint(batch, action, measured)
            return surrogate().set("constraint", value[None])

        return closure


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--limit", type=float, default=0.1, help="cost per step")
    torch.manual_seed(0)
    env = TransformedEnv(make_env(seed=0), SpeedCost())
    policy = GMMTanhPolicy(MLP(3, 3, num_cells=[64, 64]), env.action_spec, num_components=1)
    stepper = ConstrainedStepper(policy, parser.parse_args().limit)
    trainer = make_trainer(env, stepper, 112_000, "runs/compose_constraint")
    cost = LogScalar(("next", "cost"), "train/cost", log_pbar=True, include_std=False)
    cost.register(trainer, "log_cost")
    trainer.train()
