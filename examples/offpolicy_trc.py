"""Off-policy TRC (Kim and Oh 2022): TRC's surrogates on replayed trajectories, by Retrace.

    python examples/offpolicy_trc.py                # train, evaluate, film

Every option is in offpolicy_trc.yaml, trc.yaml, constrained.yaml and base.yaml.
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl._utils import timeit

from torchrl_safe.trainers.critics import REPLAYED, make_buffer
from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.policy_steps import cost_limit_at, make_trust_region
from torchrl_safe.trainers.surrogates import (
    fit_critics,
    make_surrogates,
    policy_step,
    with_advantages,
)
from torchrl_safe.trainers.utils import Run, make_eval_env, make_policy, set_up, train


def run_offpolicy_trc(run: Run) -> None:
    """Train, evaluate and film an agent."""
    cfg = run.cfg
    set_up(cfg)
    eval_env = make_eval_env(cfg)
    policy = make_policy(cfg, eval_env)
    reward_loss, cost_loss, critic_optim = make_surrogates(cfg, eval_env)
    descent = Descent(cfg, critic_optim)
    policy_optim = make_trust_region(cfg, policy)
    buffer = make_buffer(cfg)
    run.register(
        reward_loss=reward_loss,
        cost_loss=cost_loss,
        critic_optim=critic_optim,
        policy_optim=policy_optim,
        buffer=buffer,
    )

    def replay(num_frames: int) -> TensorDictBase:
        """Steps of slices with the advantages of the policy of now."""
        slices = buffer.sample(num_frames).reshape(-1, cfg.replay_buffer.slice_len)
        return with_advantages(slices, reward_loss, cost_loss, policy)

    def update(batch: TensorDictBase) -> dict[str, float]:
        """Critics, then a trust-region step, on old and new data; the level is of the new."""
        buffer.extend(batch.select(*REPLAYED))
        if run.frames < cfg.collector.init_frames:
            return {}
        cost_loss.cost_limit = cost_limit_at(cfg, run.frames)
        with timeit("time/critics"):
            for _ in range(cfg.optim.critic_rounds):
                data = replay(cfg.optim.critic_frames)
                losses = fit_critics(cfg, data, reward_loss, cost_loss, descent)
        with timeit("time/policy"):
            data = replay(cfg.optim.policy_frames)
            step = policy_step(policy, policy_optim, reward_loss, cost_loss, data, batch)
        return {**losses, **step}

    train(run, policy, update, eval_env)


@hydra.main(
    config_path="pkg://torchrl_safe.trainers", config_name="offpolicy_trc", version_base="1.3"
)
def main(cfg: DictConfig) -> None:
    """Off-policy TRC as configured in offpolicy_trc.yaml."""
    with Run(cfg) as run:
        run_offpolicy_trc(run)


if __name__ == "__main__":
    main()
