"""Every way to a constraint, on a CMDP whose best feasible return a linear program knows.

Learned policies are judged by the exact values of their mean actions, never by what they or their
critics measured. Feasible means within 2 % of the limit: the trained policy sees a noisy cost.
"""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from cmdp import GAMMA, LinearCMDP
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl.modules import ValueOperator

from torchrl_safe import (
    CVaRCostLoss,
    GMMTanhPolicy,
    TrustRegionSafeOptimizer,
    TsallisLoss,
)
from torchrl_safe.modules import moment_matched_kl
from torchrl_safe.objectives import (
    CVaRSurrogateLoss,
    LagrangeMultiplier,
    PIDMultiplier,
    ReturnSurrogateLoss,
    lagrangian,
)

N = LinearCMDP.num_states
ONE = {"cost": 1.5}
TWO = {"cost": 1.5, "second_cost": 1.2}

Closure = Callable[[], TensorDict]


class Bilinear(nn.Module):
    """Values of this CMDP are exactly linear in the action, state by state."""

    def __init__(self, *last: nn.Module) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(2 * N, 1), *last)

    def forward(self, observation: Tensor, action: Tensor) -> Tensor:
        return self.net(torch.cat([observation, observation * action], -1))


class OnPolicy:
    """CPO's surrogates, at ``risk_level=1``; TRC's below."""

    def __init__(self, policy: GMMTanhPolicy, limits: dict[str, float], risk_level: float) -> None:
        self.policy = policy
        self.reward_loss = ReturnSurrogateLoss(ValueOperator(nn.Linear(N, 1)))
        self.cost_losses = []
        for key, limit in limits.items():
            loss = CVaRSurrogateLoss(
                ValueOperator(nn.Linear(N, 1), out_keys=["cost_value"]),
                ValueOperator(
                    nn.Sequential(nn.Linear(N, 1), nn.Softplus()), out_keys=["cost_variance"]
                ),
                cost_limit=limit,
                risk_level=risk_level,
            )
            loss.set_keys(cost=key)
            self.cost_losses.append(loss)
        self.losses = [self.reward_loss, *self.cost_losses]
        for loss in self.losses:
            loss.make_value_estimator(gamma=GAMMA, lmbda=0.9)
        params = [p for loss in self.losses for p in loss.parameters()]
        self.critic_optim = torch.optim.Adam(params, lr=0.1)

    def closure(self, batch: TensorDictBase) -> Closure:
        for _ in range(3):
            data = [loss.compute_advantage(batch) for loss in self.losses]
            step(self.critic_optim, [loss(d) for loss, d in zip(self.losses, data, strict=True)])
        reward_data, *costs_data = (loss.compute_advantage(batch) for loss in self.losses)
        measured = [loss.measure(batch) for loss in self.cost_losses]

        def closure() -> TensorDict:
            dist = self.policy.get_dist(batch)
            log_prob = dist.log_prob(batch["action"])
            constraints = [
                loss.constraint(d, log_prob, m)
                for loss, d, m in zip(self.cost_losses, costs_data, measured, strict=True)
            ]
            objective = self.reward_loss.objective(reward_data, log_prob)
            return outcome(dist, objective, constraints)

        return closure


class OffPolicyBlocks:
    """SafeTAC's losses; data are those of the policy here, and q, K and Retrace are the paper's."""

    def __init__(self, policy: GMMTanhPolicy, limits: dict[str, float], risk_level: float) -> None:
        self.policy = policy
        self.reward_loss = TsallisLoss(
            policy,
            ValueOperator(Bilinear(), in_keys=["observation", "action"]),
            entropic_index=1.2,
            alpha_init=1e-3,
            fixed_alpha=True,
            delay_qvalue=False,
            deactivate_vmap=True,
        )
        self.reward_loss.make_value_estimator("retrace", gamma=GAMMA, lmbda=0.9)
        self.cost_losses = []
        for key, limit in limits.items():
            loss = CVaRCostLoss(
                policy,
                *(
                    ValueOperator(
                        Bilinear(*last), in_keys=["observation", "action"], out_keys=[name]
                    )
                    for name, last in (("cost_value", ()), ("cost_std", (nn.Softplus(),)))
                ),
                cost_limit=limit,
                risk_level=risk_level,
                deactivate_vmap=True,
            )
            loss.set_keys(cost=key)
            loss.make_value_estimator(gamma=GAMMA, lmbda=0.9)
            self.cost_losses.append(loss)
        params = [
            *self.reward_loss.qvalue_network_params.parameters(),
            *(
                p
                for loss in self.cost_losses
                for critic in (loss.cost_network_params, loss.std_network_params)
                for p in critic.parameters()
            ),
        ]
        self.critic_optim = torch.optim.Adam(params, lr=0.1)

    def closure(self, batch: TensorDictBase) -> Closure:
        for _ in range(3):
            loss_qvalue, _ = self.reward_loss.qvalue_v2_loss(batch)
            losses = [loss(batch) for loss in self.cost_losses]
            step(self.critic_optim, [TensorDict(loss_qvalue=loss_qvalue), *losses])
        states = batch.select("observation")
        noise = self.policy.get_dist(states).draw_noise()
        with torch.no_grad():
            action = self.policy.get_dist(states).rsample(noise=noise)
        measured = [loss.measure(batch, action) for loss in self.cost_losses]

        def closure() -> TensorDict:
            dist = self.policy.get_dist(states)
            action, log_prob = dist.rsample_and_log_prob(noise=noise)
            constraints = [
                loss.constraint(states, action, m)
                for loss, m in zip(self.cost_losses, measured, strict=True)
            ]
            # In the unit of the constraint, which matters to a multiplier.
            value = self.reward_loss.objective(states, action, log_prob).mean()
            return outcome(dist, value / (1 - GAMMA), constraints)

        return closure


class TrustRegion:
    max_kl = 0.06

    def __init__(self, policy: GMMTanhPolicy, num_constraints: int) -> None:
        self.optim = TrustRegionSafeOptimizer(
            policy.parameters(),
            max_kl=self.max_kl,
            cg_iters=5,
            statistics_kl=lambda old, new: moment_matched_kl(*old.values(), *new.values()).mean(),
        )

    def __call__(self, closure: Closure) -> None:
        self.optim.step(closure)


class SmallTrustRegion(TrustRegion):
    """Where two boundaries meet, steps of .06 overshoot noise by more than what is allowed."""

    max_kl = 0.02


class Lagrangian:
    def __init__(self, policy: GMMTanhPolicy, num_constraints: int) -> None:
        # Adam's step does not shrink near the saddle point: it would circle at full speed.
        self.optim = torch.optim.SGD(policy.parameters(), lr=2.0)
        self.multiplier = LagrangeMultiplier(num_constraints)
        self.multiplier_optim = torch.optim.SGD(self.multiplier.parameters(), lr=1.0)

    def __call__(self, closure: Closure) -> None:
        constraint = ascend(self.optim, closure, self.multiplier())
        self.multiplier_optim.zero_grad()
        self.multiplier.loss(constraint).backward()
        self.multiplier_optim.step()


class PID:
    def __init__(self, policy: GMMTanhPolicy, num_constraints: int) -> None:
        self.optim = torch.optim.SGD(policy.parameters(), lr=2.0)
        self.multiplier = PIDMultiplier(num_constraints, kp=1.0, ki=0.2, kd=1.0, init=1.0)

    def __call__(self, closure: Closure) -> None:
        self.multiplier.update(ascend(self.optim, closure, self.multiplier()))


def step(optim: torch.optim.Optimizer, losses: list[TensorDictBase]) -> None:
    optim.zero_grad()
    sum(v for out in losses for key, v in out.items() if key.startswith("loss")).backward()
    optim.step()


def outcome(dist, objective: Tensor, constraints: list[Tensor]) -> TensorDict:
    mean, cov = dist.moments
    out = {"objective": objective, "statistics": {"mean": mean, "cov": cov}}
    if constraints:
        out["constraint"] = torch.stack(constraints)
    return TensorDict(out)


def ascend(optim: torch.optim.Optimizer, closure: Closure, multiplier: Tensor) -> Tensor:
    """One gradient step on the Lagrangian; the constraint before it."""
    out = closure()
    optim.zero_grad()
    (-lagrangian(out["objective"], out["constraint"], multiplier)).backward()
    optim.step()
    return out["constraint"].detach()


def train(
    blocks, update, limits: dict[str, float], num_updates: int, risk_level: float = 1.0
) -> tuple[GMMTanhPolicy, dict[str, float]]:
    """Train a policy; it and its exact values, averaged over the last third of the updates.

    Gradient steps on policy and multiplier circle around the saddle point; it is the average that
    converges, and a mixture of policies is worth the average of their values.
    """
    torch.manual_seed(0)
    env = LinearCMDP(num_envs=400)
    components = 3 if blocks is OffPolicyBlocks else 1
    network = nn.Linear(N, 3 * components, bias=False)
    policy = GMMTanhPolicy(network, env.action_spec, num_components=components)
    blocks = blocks(policy, limits, risk_level)
    update = update(policy, len(limits))
    state = env.reset()
    values = []
    for i in range(num_updates):
        with torch.no_grad():
            batch = env.rollout(
                5, policy, auto_reset=False, tensordict=state, break_when_any_done=False
            )
        state = env.maybe_reset(
            batch[:, -1]["next"].select("observation", "done", "terminated", "truncated")
        )
        update(blocks.closure(batch))
        if 3 * i >= 2 * num_updates:
            values.append(env.values(mean_action(policy)))
    return policy, {key: sum(v[key] for v in values) / len(values) for key in values[0]}


@torch.no_grad()
def mean_action(policy: GMMTanhPolicy) -> Tensor:
    states = TensorDict({"observation": torch.eye(N)}, [N])
    return policy.get_dist(states).sample((5_000,)).mean(0).squeeze(-1)


METHODS = {
    "cpo": (OnPolicy, TrustRegion, 30),
    "safetac": (OffPolicyBlocks, TrustRegion, 150),
    "on_policy_lagrangian": (OnPolicy, Lagrangian, 150),
    "on_policy_pid": (OnPolicy, PID, 150),
    "safetac_lagrangian": (OffPolicyBlocks, Lagrangian, 150),
    "safetac_pid": (OffPolicyBlocks, PID, 150),
}


@pytest.mark.parametrize("method", METHODS)
def test_one_constraint(method):
    check(*METHODS[method], ONE)


@pytest.mark.parametrize(
    "method", [METHODS["cpo"], (OffPolicyBlocks, SmallTrustRegion, 200)], ids=["cpo", "safetac"]
)
def test_two_constraints(method):
    check(*method, TWO)


def check(blocks, update, num_updates: int, limits: dict[str, float]) -> None:
    _, values = train(blocks, update, limits, num_updates)
    for key, limit in limits.items():
        assert values[key] <= 1.02 * limit
    assert values["reward"] >= 0.95 * LinearCMDP(1).optimum(limits)
