"""SafeTAC on the Point robot: Algorithm 1 of the paper out of the five blocks.

    python examples/safetac_point.py                                # train, evaluate, film
    python examples/safetac_point.py collector.total_frames=100000  # a quick look
    python examples/safetac_point.py resume=true                    # go on after Ctrl-C

Every option is in safetac_point.yaml, constrained.yaml and base.yaml beside this file.
"""

from __future__ import annotations

from collections.abc import Callable

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torchrl._utils import timeit

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, TsallisLoss
from torchrl_safe.trainers.critics import (
    REPLAYED,
    CriticFit,
    make_buffer,
    make_critic_optim,
    make_losses,
    minibatches,
)
from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.policy_steps import (
    MOMENT_MATCHED,
    Distance,
    Multiplier,
    ascend,
    choose_distance,
    cost_limit_at,
    make_trust_region,
)
from torchrl_safe.trainers.utils import Run, make_eval_env, make_policy, set_up, train


def policy_closure(
    policy: GMMTanhPolicy,
    reward_loss: TsallisLoss,
    cost_loss: CVaRCostLoss,
    states: TensorDictBase,
    batch: TensorDictBase | None = None,
    curvature_frames: int | None = None,
    distance: Distance = MOMENT_MATCHED,
) -> Callable[[], TensorDict]:
    """Objective, constraint and statistics of (13) as a function of the policy's weights.

    How high the cost of the policy of now stands is measured on ``batch``; the critics say how a
    change that is kept will move it. Without, the constraint is (8) as written, of one action, as
    the objective is. The noise of the actions is drawn here, once: the line search then compares
    policies, not draws. Curvature is that of the first ``curvature_frames`` states, all of them by
    default.
    """
    with torch.no_grad():
        dist = policy.get_dist(states)
        noise = dist.draw_noise()
        measured = None
        if batch is not None:
            measured = cost_loss.measure(batch, dist.rsample(noise=noise), states=states)

    def closure() -> TensorDict:
        dist = policy.get_dist(states)
        action, log_prob = dist.rsample_and_log_prob(noise=noise)
        if measured is None:
            constraint = cost_loss.cvar(states, action).mean() - cost_loss.cost_limit
        else:
            constraint = cost_loss.constraint(states, action, measured)
        out = {
            "objective": reward_loss.objective(states, action, log_prob).mean(),
            "constraint": constraint[None],
            "statistics": distance.statistics(dist),
        }
        if curvature_frames is not None:
            some = policy.get_dist(states[:curvature_frames])
            out["curvature_statistics"] = distance.statistics(some)
        return TensorDict(out)

    return closure


def run_safetac(run: Run) -> None:
    """Train, evaluate and film an agent."""
    cfg = run.cfg
    set_up(cfg)
    eval_env = make_eval_env(cfg)

    # The blocks: a policy, critics of reward and cost, and the trust region.
    policy = make_policy(cfg, eval_env)
    reward_loss, cost_loss = make_losses(cfg, eval_env, policy)
    critic_optim = make_critic_optim(cfg, reward_loss, cost_loss)
    buffer = make_buffer(cfg)
    fit_critics = CriticFit(cfg, buffer, reward_loss, cost_loss, critic_optim)
    components = {}
    if cfg["update"] == "trust_region":  # as an attribute, update is a method of the configuration
        distance = choose_distance(cfg)
        policy_optim = make_trust_region(cfg, policy, distance)
    else:  # (9), the ablation
        policy_optim = torch.optim.Adam(
            policy.parameters(), lr=cfg.lagrangian.policy_lr, fused=True
        )
        descent = Descent(cfg, policy_optim)
        components["multiplier"] = multiplier = Multiplier(cfg, cfg["update"])
    run.register(
        reward_loss=reward_loss,
        cost_loss=cost_loss,
        critic_optim=critic_optim,
        policy_optim=policy_optim,
        buffer=buffer,
        **components,
    )

    def update(batch: TensorDictBase) -> dict[str, float]:
        """Algorithm 1: critics on replayed slices, then the policy on the new states."""
        buffer.extend(batch.select(*REPLAYED))
        if run.frames < cfg.collector.init_frames:
            return {}
        limit = cost_limit_at(cfg, run.frames)
        cost_loss.cost_limit = limit
        metrics = fit_critics()
        with timeit("time/policy"):
            visited = batch.select("observation").flatten()
            if cfg["update"] == "trust_region":
                order = torch.randperm(len(visited), device=visited.device)
                states = visited[order[: cfg.optim.policy_frames]]
                closure = policy_closure(
                    policy,
                    reward_loss,
                    cost_loss,
                    states,
                    batch,
                    cfg.optim.curvature_frames,
                    distance,
                )
                metrics |= policy_optim.step(closure).to_dict()
                metrics["update/constraint"] += limit
            else:
                level = cost_loss.on_policy_cvar(batch)
                multiplier.update((level - limit)[None])
                for states in minibatches(visited, cfg.lagrangian.minibatch_size):
                    closure = policy_closure(policy, reward_loss, cost_loss, states)
                    metrics |= ascend(descent, closure, multiplier())
                metrics["update/skipped_steps"] += descent.count()
                metrics["update/constraint"] = level.item()
        return {**metrics, "update/cost_limit": limit}

    train(run, policy, update, eval_env)


@hydra.main(
    config_path="pkg://torchrl_safe.trainers", config_name="safetac_point", version_base="1.3"
)
def main(cfg: DictConfig) -> None:
    """SafeTAC as configured in safetac_point.yaml."""
    with Run(cfg) as run:
        run_safetac(run)


if __name__ == "__main__":
    main()
