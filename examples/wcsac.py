"""WCSAC: worst-case soft actor-critic (Yang et al. 2021), SAC with a multiplier on the CVaR.

    python examples/wcsac.py                        # train, evaluate, film
    python examples/wcsac.py loss.risk_level=0.5    # the worst half of outcomes, not an eighth

Every option is in wcsac.yaml, constrained.yaml and base.yaml beside this file.
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torch import nn
from torchrl._utils import timeit
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate, ValueEstimators

from torchrl_safe import CVaRCostLoss, TsallisLoss
from torchrl_safe.objectives import lagrangian
from torchrl_safe.objectives.functional import q_logarithm
from torchrl_safe.trainers.critics import REPLAYED
from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.policy_steps import Multiplier, cost_limit_at
from torchrl_safe.trainers.utils import Run, make_critic, make_eval_env, make_policy, set_up, train


def run_wcsac(run: Run) -> None:
    """Train, evaluate and film an agent; at ``risk_level=1`` the algorithm is SAC-Lagrangian."""
    cfg = run.cfg
    set_up(cfg)
    eval_env = make_eval_env(cfg)
    policy = make_policy(cfg, eval_env)
    reward_loss = TsallisLoss(
        policy,
        make_critic(cfg, eval_env, "state_action_value"),
        entropic_index=cfg.loss.entropic_index,
        alpha_init=cfg.loss.alpha,
        deactivate_vmap=True,
    )
    cost_loss = CVaRCostLoss(
        policy,
        make_critic(cfg, eval_env, "cost_value"),
        make_critic(cfg, eval_env, "cost_std", nn.Softplus()),
        risk_level=cfg.loss.risk_level,
        cost_limit=cfg.loss.cost_limit,
        delay_cost=True,
        deactivate_vmap=True,
    )
    reward_loss.make_value_estimator(ValueEstimators.TD0, gamma=cfg.loss.gamma)
    cost_loss.make_value_estimator(ValueEstimators.TD0, gamma=cfg.loss.cost_gamma)
    targets = [SoftUpdate(loss, tau=cfg.optim.tau) for loss in (reward_loss, cost_loss)]
    # The policy's parameters are in both losses.
    params = dict.fromkeys([*reward_loss.parameters(), *cost_loss.parameters()])
    optim = torch.optim.Adam(list(params), lr=cfg.optim.lr, fused=True)
    descent = Descent(cfg, optim)
    multiplier = Multiplier(cfg, "lagrangian")
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.replay_buffer.size, device=cfg.device),
        batch_size=cfg.optim.minibatch_size,
    )
    run.register(
        reward_loss=reward_loss,
        cost_loss=cost_loss,
        optim=optim,
        multiplier=multiplier,
        buffer=buffer,
    )

    def update(batch: TensorDictBase) -> dict[str, float]:
        """The multiplier on the new batch's cost, then gradient steps on replayed transitions."""
        buffer.extend(batch.select(*REPLAYED).flatten())
        if run.frames < cfg.collector.init_frames:
            return {}
        limit = cost_limit_at(cfg, run.frames)
        cost_loss.cost_limit = limit
        level = cost_loss.on_policy_cvar(batch)
        multiplier.update((level - limit)[None])
        with timeit("time/update"):
            for _ in range(cfg.optim.num_updates):
                minibatch = buffer.sample()
                losses = cost_loss(minibatch)
                losses["loss_qvalue"], _ = reward_loss.qvalue_v2_loss(minibatch)
                action, log_prob = policy.get_dist(minibatch).rsample_and_log_prob()
                losses["loss_actor"] = -lagrangian(
                    reward_loss.objective(minibatch, action, log_prob).mean(),
                    cost_loss.cvar(minibatch, action).mean()[None] - limit,  # of one action, too
                    multiplier(),
                )
                entropy = -q_logarithm(log_prob.detach(), cfg.loss.entropic_index)
                losses["loss_alpha"] = reward_loss.alpha_loss(-entropy).mean()
                descent.step(losses)
                for target in targets:
                    target.step()
        metrics = {f"update/{name}": value.item() for name, value in losses.items()}
        return {
            **metrics,
            "update/skipped_steps": descent.count(),
            "update/constraint": level.item(),
            "update/cost_limit": limit,
            "update/multiplier": multiplier().item(),
            "update/alpha": reward_loss.log_alpha.exp().item(),
        }

    train(run, policy, update, eval_env)


@hydra.main(config_path="pkg://torchrl_safe.trainers", config_name="wcsac", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """WCSAC as configured in wcsac.yaml."""
    with Run(cfg) as run:
        run_wcsac(run)


if __name__ == "__main__":
    main()
