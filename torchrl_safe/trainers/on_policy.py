"""What CPO, TRC and off-policy TRC share: surrogates, their critics and the closure of a step."""

from __future__ import annotations

from collections.abc import Callable

import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase

from torchrl_safe import GMMTanhPolicy, TrustRegionSafeOptimizer
from torchrl_safe.objectives import CostMoments, CVaRSurrogateLoss, ReturnSurrogateLoss
from torchrl_safe.trainers.critics import minibatches
from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.policy_steps import moments
from torchrl_safe.trainers.utils import make_critic


def make_surrogates(
    cfg: DictConfig, env: EnvBase
) -> tuple[ReturnSurrogateLoss, CVaRSurrogateLoss, torch.optim.Optimizer]:
    """The surrogates of return and cost, and Adam on their critics."""
    reward_loss = ReturnSurrogateLoss(make_critic(cfg, env, "state_value", of_actions=False))
    cost_loss = CVaRSurrogateLoss(
        make_critic(cfg, env, "cost_value", of_actions=False),
        make_critic(cfg, env, "cost_variance", nn.Softplus(), of_actions=False),
        risk_level=cfg.loss.risk_level,
        cost_limit=cfg.loss.cost_limit,
    )
    reward_loss.make_value_estimator(gamma=cfg.loss.gamma, lmbda=cfg.loss.lmbda)
    cost_loss.make_value_estimator(gamma=cfg.loss.cost_gamma, lmbda=cfg.loss.lmbda)
    params = [*reward_loss.parameters(), *cost_loss.parameters()]
    return reward_loss, cost_loss, torch.optim.Adam(params, lr=cfg.optim.critic_lr, fused=True)


def with_advantages(
    trajectories: TensorDictBase,
    reward_loss: ReturnSurrogateLoss,
    cost_loss: CVaRSurrogateLoss,
    policy: GMMTanhPolicy | None = None,
) -> TensorDictBase:
    """Steps of trajectories [B, T] with advantages and critics' targets, flat.

    Advantages are those of ``policy``, by default of the one that acted.
    """
    log_prob = None
    if policy is not None:
        with torch.no_grad():
            log_prob = policy.get_dist(trajectories).log_prob(trajectories["action"])
    for loss in (reward_loss, cost_loss):
        trajectories = loss.compute_advantage(trajectories, policy_log_prob=log_prob)
    return trajectories.flatten()


def fit_critics(
    cfg: DictConfig,
    data: TensorDictBase,
    reward_loss: ReturnSurrogateLoss,
    cost_loss: CVaRSurrogateLoss,
    descent: Descent,
) -> dict[str, float]:
    """One pass of gradient steps over steps with their targets."""
    for minibatch in minibatches(data, cfg.optim.minibatch_size):
        losses = cost_loss(minibatch).update(reward_loss(minibatch))
        descent.step(losses)
    metrics = {f"update/{name}": value.item() for name, value in losses.items()}
    return metrics | {"update/skipped_steps": descent.count()}


def surrogate_closure(
    policy: GMMTanhPolicy,
    reward_loss: ReturnSurrogateLoss,
    cost_loss: CVaRSurrogateLoss,
    data: TensorDictBase,
    measured: CostMoments,
) -> Callable[[], TensorDict]:
    """Objective, constraint and policy moments as a function of the policy's weights."""

    def closure() -> TensorDict:
        dist = policy.get_dist(data)
        log_prob = dist.log_prob(data["action"])
        return TensorDict(
            {
                "objective": reward_loss.objective(data, log_prob),
                "constraint": cost_loss.constraint(data, log_prob, measured)[None],
                "statistics": moments(dist),
            }
        )

    return closure


def policy_step(
    policy: GMMTanhPolicy,
    policy_optim: TrustRegionSafeOptimizer,
    reward_loss: ReturnSurrogateLoss,
    cost_loss: CVaRSurrogateLoss,
    data: TensorDictBase,
    batch: TensorDictBase,
) -> dict[str, float]:
    """A trust-region step on ``data``; how high the cost stands is measured on ``batch``."""
    measured = cost_loss.measure(batch)
    closure = surrogate_closure(policy, reward_loss, cost_loss, data, measured)
    report = policy_optim.step(closure)
    metrics = report.to_dict()
    limit = cost_loss.cost_limit.item()
    metrics["update/constraint"] += limit
    return {
        **metrics,
        "update/cost_limit": limit,
        "update/measured_cost_std": measured.variance.sqrt().item(),
    }
