"""TRC: trust region conditional value at risk (Kim and Oh, RA-L 2022), on-policy.

    python examples/trc.py                          # train, evaluate, film
    python examples/trc.py loss.risk_level=0.5      # the worst half of outcomes, not an eighth

Every option is in trc.yaml, constrained.yaml and base.yaml beside this file.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl._utils import timeit

from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.policy_steps import cost_limit_at, make_trust_region
from torchrl_safe.trainers.surrogates import (
    fit_critics,
    make_surrogates,
    policy_step,
    with_advantages,
)
from torchrl_safe.trainers.utils import Run, make_eval_env, make_policy, set_up, train


def run_trc(run: Run) -> None:
    """Train, evaluate and film an agent; at ``risk_level=1`` the algorithm is CPO."""
    cfg = run.cfg
    set_up(cfg)
    eval_env = make_eval_env(cfg)
    policy = make_policy(cfg, eval_env)
    reward_loss, cost_loss, critic_optim = make_surrogates(cfg, eval_env)
    descent = Descent(cfg, critic_optim)
    policy_optim = make_trust_region(cfg, policy)
    run.register(
        reward_loss=reward_loss,
        cost_loss=cost_loss,
        critic_optim=critic_optim,
        policy_optim=policy_optim,
    )

    def update(batch: TensorDictBase) -> dict[str, float]:
        """Critics on the new batch, then a trust-region step on it; then it is thrown away."""
        cost_loss.cost_limit = cost_limit_at(cfg, run.frames)
        with timeit("time/critics"):
            for _ in range(cfg.optim.critic_rounds):
                data = with_advantages(batch, reward_loss, cost_loss)
                losses = fit_critics(cfg, data, reward_loss, cost_loss, descent)
        with timeit("time/policy"):
            data = with_advantages(batch, reward_loss, cost_loss)
            step = policy_step(policy, policy_optim, reward_loss, cost_loss, data, batch)
        return {**losses, **step}

    train(run, policy, update, eval_env)


@hydra.main(config_path="pkg://torchrl_safe.trainers", config_name="trc", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """TRC as configured in trc.yaml."""
    with Run(cfg) as run:
        run_trc(run)


if __name__ == "__main__":
    main()
