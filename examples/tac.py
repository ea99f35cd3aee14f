"""Tsallis actor-critic (Lee et al. 2020), without a constraint: SAC's script with another loss.

    python examples/tac.py                          # train, evaluate, film
    python examples/tac.py loss.entropic_index=1    # SAC

Every option is in tac.yaml and base.yaml beside this file.
"""

from __future__ import annotations

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from torchrl._utils import timeit
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from torchrl_safe import TsallisLoss
from torchrl_safe.trainers.critics import REPLAYED
from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.utils import Run, make_critic, make_eval_env, make_policy, set_up, train


def run_tac(run: Run) -> None:
    """Train, evaluate and film an agent."""
    cfg = run.cfg
    set_up(cfg)
    eval_env = make_eval_env(cfg)
    policy = make_policy(cfg, eval_env)
    loss = TsallisLoss(
        policy,
        make_critic(cfg, eval_env, "state_action_value"),
        entropic_index=cfg.loss.entropic_index,
        alpha_init=cfg.loss.alpha,
        deactivate_vmap=True,
    )
    loss.make_value_estimator(gamma=cfg.loss.gamma)
    target = SoftUpdate(loss, tau=cfg.optim.tau)
    optim = torch.optim.Adam(loss.parameters(), lr=cfg.optim.lr, fused=True)
    descent = Descent(cfg, optim)
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.replay_buffer.size, device=cfg.device),
        batch_size=cfg.optim.minibatch_size,
    )
    run.register(loss=loss, optim=optim, buffer=buffer)

    def update(batch: TensorDictBase) -> dict[str, float]:
        """Gradient steps on replayed transitions."""
        buffer.extend(batch.select(*REPLAYED).flatten())
        if run.frames < cfg.collector.init_frames:
            return {}
        with timeit("time/update"):
            for _ in range(cfg.optim.num_updates):
                losses = loss(buffer.sample())
                descent.step(losses)
                target.step()
        metrics = {f"update/{name}": value.item() for name, value in losses.items()}
        return metrics | {"update/skipped_steps": descent.count()}

    train(run, policy, update, eval_env)


@hydra.main(config_path="pkg://torchrl_safe.trainers", config_name="tac", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Tsallis actor-critic as configured in tac.yaml."""
    with Run(cfg) as run:
        run_tac(run)


if __name__ == "__main__":
    main()
