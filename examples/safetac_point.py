"""SafeTAC on the Point robot: Algorithm 1 of the paper out of the five blocks.

    python examples/safetac_point.py                              # train, evaluate, film
    python examples/safetac_point.py collector.total_frames=20000 # a quick look
    python examples/safetac_point.py resume=true                  # go on after Ctrl-C

Every option is in safetac_point.yaml beside this file.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

os.environ.setdefault("WANDB_MODE", "offline")

import hydra
import torch
from omegaconf import DictConfig, OmegaConf
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl._utils import timeit
from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP, ValueOperator
from torchrl.record.loggers import get_logger
from tqdm import tqdm

from torchrl_safe import (
    CVaRCostLoss,
    GMMTanhPolicy,
    TrustRegionSafeOptimizer,
    TsallisLoss,
)
from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.objectives.functional import moment_matched_kl
from torchrl_safe.record import (
    batch_metrics,
    count_violations,
    evaluate,
    format_table,
    plot_learning_curves,
    record_video,
    summarize,
)


def make_policy(cfg: DictConfig, env: EnvBase) -> GMMTanhPolicy:
    """The mixture policy (11)."""
    num_components, action_dim = cfg.policy.num_components, env.action_spec.shape[-1]
    network = MLP(
        env.observation_spec["observation"].shape[-1],
        num_components * (1 + 2 * action_dim),
        num_cells=list(cfg.policy.num_cells),
        activation_class=nn.ReLU,
    )
    return GMMTanhPolicy(
        network,
        env.action_spec_unbatched,
        num_components=num_components,
        relaxation=cfg.policy.relaxation,
        temperature=cfg.policy.temperature,
    )


def make_critic(cfg: DictConfig, env: EnvBase, out_key: str, *last: nn.Module) -> ValueOperator:
    """A critic of observation and action."""
    network = MLP(
        env.observation_spec["observation"].shape[-1] + env.action_spec.shape[-1],
        1,
        num_cells=list(cfg.critic.num_cells),
        activation_class=nn.ReLU,
    )
    network.extend(last)
    return ValueOperator(network, in_keys=["observation", "action"], out_keys=[out_key])


def minibatches(data: TensorDictBase, size: int) -> Iterator[TensorDictBase]:
    """Transitions of ``data`` in random order, ``size`` at a time."""
    for index in torch.randperm(data.numel()).split(size):
        yield data[index]


def policy_closure(
    policy: GMMTanhPolicy,
    reward_loss: TsallisLoss,
    cost_loss: CVaRCostLoss,
    states: TensorDictBase,
) -> Callable[[], TensorDict]:
    """Objective, constraint and policy moments of (13) as a function of the policy's weights.

    The noise of the actions is drawn here, once: the line search then compares policies, not draws.
    """
    with torch.no_grad():
        dist = policy.get_dist(states)
        noise = dist.draw_noise()
        action, _ = dist.rsample_and_log_prob(noise=noise)
        reference = cost_loss.cvar(states, action).mean()

    def closure() -> TensorDict:
        dist = policy.get_dist(states)
        action, log_prob = dist.rsample_and_log_prob(noise=noise)
        mean, cov = dist.moments
        return TensorDict(
            {
                "objective": reward_loss.objective(states, action, log_prob).mean(),
                "constraint": cost_loss.constraint(states, action, reference=reference)[None],
                "statistics": {"mean": mean, "cov": cov},
            }
        )

    return closure


def policy_kl(old: TensorDictBase, new: TensorDictBase) -> torch.Tensor:
    """The trust region's distance (15), averaged over states."""
    return moment_matched_kl(old["mean"], old["cov"], new["mean"], new["cov"]).mean()


@hydra.main(config_path=".", config_name="safetac_point", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Train, evaluate and film an agent."""
    torch.manual_seed(cfg.seed)
    run_dir = Path(cfg.run_dir)
    run_dir.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(cfg, run_dir / "config.yaml", resolve=True)

    env = SafeGoalEnv(
        cfg.env.robot,
        num_envs=cfg.env.num_envs,
        num_threads=cfg.env.num_threads,
        episode_length=cfg.env.episode_length,
        stagger=True,
        seed=cfg.seed,
    )
    eval_env = SafeGoalEnv(
        cfg.env.robot, num_envs=cfg.eval.num_episodes, num_threads=cfg.env.num_threads
    )

    # The blocks: policy, critics, losses, trust region.
    policy = make_policy(cfg, env)
    reward_loss = TsallisLoss(
        policy,
        make_critic(cfg, env, "state_action_value"),
        entropic_index=cfg.loss.entropic_index,
        alpha_init=cfg.loss.alpha_init,
        fixed_alpha=cfg.loss.fixed_alpha,
        delay_qvalue=False,
        deactivate_vmap=True,
    )
    cost_loss = CVaRCostLoss(
        policy,
        make_critic(cfg, env, "cost_value"),
        make_critic(cfg, env, "cost_std", nn.Softplus()),
        cost_limit=cfg.loss.cost_limit,
        risk_level=cfg.loss.risk_level,
        num_cost_nets=cfg.loss.num_cost_nets,
        deactivate_vmap=True,
    )
    reward_loss.make_value_estimator("retrace", gamma=cfg.loss.gamma, lmbda=cfg.loss.lmbda)
    cost_loss.make_value_estimator(gamma=cfg.loss.gamma, lmbda=cfg.loss.lmbda)
    critic_params = [
        *reward_loss.qvalue_network_params.parameters(),
        *cost_loss.cost_network_params.parameters(),
        *cost_loss.std_network_params.parameters(),
    ]
    critic_optim = torch.optim.Adam(critic_params, lr=cfg.optim.critic_lr, fused=True)
    policy_optim = TrustRegionSafeOptimizer(
        policy.parameters(),
        max_kl=cfg.optim.max_kl,
        damping=cfg.optim.damping,
        cg_iters=cfg.optim.cg_iters,
        backtrack_ratio=cfg.optim.backtrack_ratio,
        max_backtracks=cfg.optim.max_backtracks,
        recovery_ratio=cfg.optim.recovery_ratio,
        statistics_kl=policy_kl,
    )

    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.replay_buffer.size, ndim=2),
        sampler=SliceSampler(
            slice_len=cfg.replay_buffer.slice_len,
            end_key=("next", "done"),
            strict_length=True,
            cache_values=True,
        ),
    )
    collector = Collector(
        env,
        policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames,
        exploration_type=ExplorationType.RANDOM,
    )
    logger = get_logger(cfg.logger.backend, logger_name=str(run_dir), experiment_name="log")

    keys = ["observation", "action", "action_log_prob"]
    next_keys = [
        ("next", k) for k in ("observation", "reward", "cost", "done", "terminated", "truncated")
    ]
    frames = total_cvs = 0
    next_eval = 0
    progress = tqdm(total=cfg.collector.total_frames)
    for batch in collector:
        frames += batch.numel()
        total_cvs += count_violations(batch)
        metrics = batch_metrics(batch) | {"train/total_cvs": total_cvs}
        buffer.extend(batch.select(*keys, *next_keys))
        if frames >= cfg.collector.init_frames:
            with timeit("critics"):
                for _ in range(cfg.optim.critic_rounds):
                    data = buffer.sample(cfg.optim.critic_frames).reshape(
                        -1, cfg.replay_buffer.slice_len
                    )
                    with timeit("targets"):
                        chunks = data.split(500)
                        for chunk in chunks:
                            chunk["value_target"] = reward_loss.compute_target(chunk)
                            chunk["cost_target"], chunk["std_target"] = cost_loss.compute_target(
                                chunk
                            )
                        data = torch.cat(chunks)
                    flat = data.select(
                        "observation", "action", "value_target", "cost_target", "std_target"
                    ).flatten()
                    for minibatch in minibatches(flat, cfg.optim.minibatch_size):
                        losses = cost_loss(minibatch)
                        loss_q = reward_loss.qvalue_v2_loss(minibatch)[0]
                        loss = loss_q + losses["loss_cost_value"] + losses["loss_cost_std"]
                        critic_optim.zero_grad()
                        loss.backward()
                        nn.utils.clip_grad_norm_(critic_params, cfg.optim.max_grad_norm)
                        critic_optim.step()
            with timeit("policy"):
                for _ in range(cfg.optim.policy_updates):
                    pick = torch.randint(flat.numel(), (cfg.optim.policy_frames,))
                    states = torch.cat(
                        [batch.select("observation").flatten(), flat[pick].select("observation")]
                    )
                    report = policy_optim.step(
                        policy_closure(policy, reward_loss, cost_loss, states)
                    )
            metrics |= report.to_dict()
            metrics["update/loss_q"] = loss_q.item()
            metrics["update/loss_c"] = losses["loss_cost_value"].item()
            metrics["update/cost_value"] = losses["cost_value"].item()
            metrics["update/cost_std"] = losses["cost_std"].item()
        if frames >= next_eval:
            next_eval += cfg.eval.interval
            with timeit("eval"):
                for name, kind in (
                    ("eval/det/", ExplorationType.DETERMINISTIC),
                    ("eval/", ExplorationType.RANDOM),
                ):
                    metrics |= summarize(
                        evaluate(
                            eval_env,
                            policy,
                            num_steps=cfg.eval.num_steps,
                            exploration_type=kind,
                            seed=1,
                        ),
                        name,
                    )
            print(frames, {k: round(float(v), 4) for k, v in metrics.items()}, flush=True)
            print(
                {k: round(v, 2) for k, v in timeit.todict(percall=False).items()},
                f"{progress.format_dict['elapsed']:.0f}s",
                flush=True,
            )
        for k, v in metrics.items():
            logger.log_scalar(k, v, step=frames)
        progress.update(batch.numel())


if __name__ == "__main__":
    main()
