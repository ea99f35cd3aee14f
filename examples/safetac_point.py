"""SafeTAC on the Point robot: Algorithm 1 of the paper out of the five blocks.

    python examples/safetac_point.py                                # train, evaluate, film
    python examples/safetac_point.py collector.total_frames=100000  # a quick look
    python examples/safetac_point.py resume=true                    # go on after Ctrl-C

Every option is in safetac_point.yaml beside this file.
"""

from __future__ import annotations

from collections.abc import Callable

import hydra
import torch
from critics import REPLAYED, fit_critics, make_buffer, make_critic_optim, make_losses
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl._utils import timeit
from utils import EVAL_SEED, Run, make_env, make_policy, set_up, train

from torchrl_safe import (
    CVaRCostLoss,
    GMMTanhPolicy,
    TanhGaussianMixture,
    TrustRegionSafeOptimizer,
    TsallisLoss,
)
from torchrl_safe.objectives.functional import moment_matched_kl


def policy_closure(
    policy: GMMTanhPolicy,
    reward_loss: TsallisLoss,
    cost_loss: CVaRCostLoss,
    states: TensorDictBase,
    level: torch.Tensor,
    curvature_frames: int | None = None,
) -> Callable[[], TensorDict]:
    """Objective, constraint and policy moments of (13) as a function of the policy's weights.

    ``level`` is the CVaR that the policy of now is known to have; the critics say how it changes.
    The noise of the actions is drawn here, once: the line search then compares policies, not draws.
    Curvature is that of the first ``curvature_frames`` states, all of them by default.
    """

    def moments(dist: TanhGaussianMixture) -> dict[str, torch.Tensor]:
        mean, cov = dist.moments
        return {"mean": mean, "cov": cov}

    with torch.no_grad():
        dist = policy.get_dist(states)
        noise = dist.draw_noise()
        reference = cost_loss.cvar(states, dist.rsample(noise=noise)).mean()

    def closure() -> TensorDict:
        dist = policy.get_dist(states)
        action, log_prob = dist.rsample_and_log_prob(noise=noise)
        out = {
            "objective": reward_loss.objective(states, action, log_prob).mean(),
            "constraint": cost_loss.constraint(states, action, reference=reference, level=level)[
                None
            ],
            "statistics": moments(dist),
        }
        if curvature_frames is not None:
            out["curvature_statistics"] = moments(policy.get_dist(states[:curvature_frames]))
        return TensorDict(out)

    return closure


def policy_kl(old: TensorDictBase, new: TensorDictBase) -> torch.Tensor:
    """The trust region's distance (15), averaged over states."""
    return moment_matched_kl(old["mean"], old["cov"], new["mean"], new["cov"]).mean()


def cost_limit_at(cfg: DictConfig, frames: int) -> float:
    """The limit of now: it falls, so that the agent learns to drive before it has to avoid."""
    remaining = max(0.0, 1.0 - frames / max(1, cfg.loss.anneal_frames))
    return cfg.loss.cost_limit + remaining * (cfg.loss.initial_cost_limit - cfg.loss.cost_limit)


def make_trust_region(cfg: DictConfig, policy: GMMTanhPolicy) -> TrustRegionSafeOptimizer:
    """The optimizer of the policy, with the options of the configuration."""
    return TrustRegionSafeOptimizer(
        policy.parameters(),
        max_kl=cfg.optim.max_kl,
        damping=cfg.optim.damping,
        cg_iters=cfg.optim.cg_iters,
        backtrack_ratio=cfg.optim.backtrack_ratio,
        max_backtracks=cfg.optim.max_backtracks,
        recovery_ratio=cfg.optim.recovery_ratio,
        statistics_kl=policy_kl,
    )


@hydra.main(config_path=".", config_name="safetac_point", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Train, evaluate and film an agent."""
    set_up(cfg)
    eval_env = make_env(cfg, cfg.eval.num_episodes, EVAL_SEED)

    # The blocks: a policy, critics of reward and cost, and the trust region.
    policy = make_policy(cfg, eval_env)
    reward_loss, cost_loss = make_losses(cfg, eval_env, policy)
    critic_optim = make_critic_optim(cfg, reward_loss, cost_loss)
    policy_optim = make_trust_region(cfg, policy)
    buffer = make_buffer(cfg)
    run = Run(
        cfg,
        reward_loss=reward_loss,
        cost_loss=cost_loss,
        critic_optim=critic_optim,
        policy_optim=policy_optim,
        buffer=buffer,
    )

    def update(batch: TensorDictBase) -> dict[str, float]:
        """Algorithm 1: critics on replayed slices, then a trust-region step on the new states."""
        buffer.extend(batch.select(*REPLAYED))
        if run.frames < cfg.collector.init_frames:
            return {}
        limit = cost_limit_at(cfg, run.frames)
        cost_loss.cost_limit.fill_(limit)
        losses = fit_critics(cfg, buffer, reward_loss, cost_loss, critic_optim)
        with timeit("time/policy"):
            visited = batch.select("observation").flatten()
            states = visited[torch.randperm(len(visited))[: cfg.optim.policy_frames]]
            level = cost_loss.on_policy_cvar(batch)
            report = policy_optim.step(
                policy_closure(
                    policy, reward_loss, cost_loss, states, level, cfg.optim.curvature_frames
                )
            )
        metrics = {**report.to_dict(), **losses, "update/cost_limit": limit}
        metrics["update/constraint"] += limit
        return metrics

    train(run, policy, update, eval_env)


if __name__ == "__main__":
    main()
