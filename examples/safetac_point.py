"""SafeTAC on the Point robot: Algorithm 1 of the paper out of the five blocks.

    python examples/safetac_point.py                                # train, evaluate, film
    python examples/safetac_point.py collector.total_frames=100000  # a quick look
    python examples/safetac_point.py resume=true                    # go on after Ctrl-C

Every option is in safetac_point.yaml beside this file.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import hydra
import torch
from omegaconf import DictConfig
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl._utils import logger as torchrl_logger
from torchrl._utils import timeit
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType
from tqdm import tqdm
from utils import EVAL_SEED, GracefulStop, Run, make_critic, make_policy, use_threads

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, TrustRegionSafeOptimizer, TsallisLoss
from torchrl_safe.envs import SafeGoalEnv
from torchrl_safe.objectives.functional import moment_matched_kl
from torchrl_safe.record import batch_metrics, count_violations

REPLAYED = [
    "observation",
    "action",
    "action_log_prob",
    ("collector", "traj_ids"),
    *(
        ("next", key)
        for key in ("observation", "reward", "cost", "done", "terminated", "truncated")
    ),
]


def policy_closure(
    policy: GMMTanhPolicy,
    reward_loss: TsallisLoss,
    cost_loss: CVaRCostLoss,
    states: TensorDictBase,
    level: torch.Tensor,
) -> Callable[[], TensorDict]:
    """Objective, constraint and policy moments of (13) as a function of the policy's weights.

    ``level`` is the CVaR that the policy of now is known to have; the critics say how it changes.
    The noise of the actions is drawn here, once: the line search then compares policies, not draws.
    """
    with torch.no_grad():
        dist = policy.get_dist(states)
        noise = dist.draw_noise()
        reference = cost_loss.cvar(states, dist.rsample(noise=noise)).mean()

    def closure() -> TensorDict:
        dist = policy.get_dist(states)
        action, log_prob = dist.rsample_and_log_prob(noise=noise)
        mean, cov = dist.moments
        return TensorDict(
            {
                "objective": reward_loss.objective(states, action, log_prob).mean(),
                "constraint": cost_loss.constraint(
                    states, action, reference=reference, level=level
                )[None],
                "statistics": {"mean": mean, "cov": cov},
            }
        )

    return closure


def policy_kl(old: TensorDictBase, new: TensorDictBase) -> torch.Tensor:
    """The trust region's distance (15), averaged over states."""
    return moment_matched_kl(old["mean"], old["cov"], new["mean"], new["cov"]).mean()


def with_targets(
    trajectories: TensorDictBase, reward_loss: TsallisLoss, cost_loss: CVaRCostLoss
) -> TensorDictBase:
    """Transitions of trajectories [B, T] with the targets of (4) and (18), flat."""
    parts = []
    for part in trajectories.split(500):  # activations of this many stay in the cache
        target = reward_loss.compute_target(part)
        cost_target, std_target = cost_loss.compute_target(part)
        targets = {"value_target": target, "cost_target": cost_target, "std_target": std_target}
        parts.append(part.select("observation", "action").update(targets))
    return torch.cat(parts).flatten()


def minibatches(data: TensorDictBase, size: int) -> Iterator[TensorDictBase]:
    """All of ``data`` in random order, ``size`` at a time."""
    for index in torch.randperm(data.numel()).split(size):
        yield data[index]


@hydra.main(config_path=".", config_name="safetac_point", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Train, evaluate and film an agent."""
    torchrl_logger.setLevel("WARNING")  # its notes would break the progress bar
    use_threads(cfg.num_threads)
    torch.manual_seed(cfg.seed)

    def make_env(num_envs: int, seed: int, **kwargs: object) -> SafeGoalEnv:
        return SafeGoalEnv(
            cfg.env.robot, num_envs=num_envs, num_threads=cfg.num_threads, seed=seed, **kwargs
        )

    eval_env = make_env(cfg.eval.num_episodes, EVAL_SEED)

    # The blocks: a policy, critics of reward and cost, and the trust region.
    policy = make_policy(cfg, eval_env)
    reward_loss = TsallisLoss(
        policy,
        make_critic(cfg, eval_env, "state_action_value"),
        entropic_index=cfg.loss.entropic_index,
        alpha_init=cfg.loss.alpha,
        fixed_alpha=True,
        delay_qvalue=False,
        deactivate_vmap=True,  # on a CPU, two small products are faster than a batched one
    )
    reward_loss.make_value_estimator("retrace", gamma=cfg.loss.gamma, lmbda=cfg.loss.lmbda)
    cost_loss = CVaRCostLoss(
        policy,
        make_critic(cfg, eval_env, "cost_value"),
        make_critic(cfg, eval_env, "cost_std", nn.Softplus()),
        risk_level=cfg.loss.risk_level,
        cost_limit=cfg.loss.cost_limit,
        variance_reward=cfg.loss.variance_reward,
        deactivate_vmap=True,
    )
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

    # The data: staggered short episodes, replayed as slices of trajectories.
    slice_len = cfg.replay_buffer.slice_len
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(cfg.replay_buffer.size, ndim=2),
        sampler=SliceSampler(
            slice_len=slice_len, traj_key=("collector", "traj_ids"), strict_length=True
        ),
    )
    run = Run(
        cfg,
        reward_loss=reward_loss,
        cost_loss=cost_loss,
        critic_optim=critic_optim,
        policy_optim=policy_optim,
        buffer=buffer,
    )
    env = make_env(
        cfg.env.num_envs,
        seed=cfg.seed + run.frames,  # a resumed run sees new layouts
        episode_length=cfg.env.episode_length,
        stagger=True,
    )
    collector = Collector(
        env,
        policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames - run.frames,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )

    progress = tqdm(total=cfg.collector.total_frames, initial=run.frames, unit="frame")
    next_eval, next_save = (
        run.frames // interval * interval + interval
        for interval in (cfg.eval.interval, cfg.checkpoint.interval)
    )
    started = time.perf_counter()
    with GracefulStop() as stop:
        for batch in collector:
            run.counters["frames"] += batch.numel()
            run.counters["total_cvs"] += count_violations(batch)
            metrics = batch_metrics(batch)
            metrics["train/total_cvs"] = run.counters["total_cvs"]
            metrics["train/entropy"] = -batch["action_log_prob"].mean().item()
            buffer.extend(batch.select(*REPLAYED))

            if run.frames >= cfg.collector.init_frames:
                for _ in range(cfg.optim.critic_rounds):
                    # Targets are renewed each round: one round is one step of value iteration.
                    with timeit("time/targets"):
                        data = buffer.sample(cfg.optim.critic_frames).reshape(-1, slice_len)
                        data = with_targets(data, reward_loss, cost_loss)
                    with timeit("time/critics"):
                        for minibatch in minibatches(data, cfg.optim.minibatch_size):
                            loss_qvalue, _ = reward_loss.qvalue_v2_loss(minibatch)
                            losses = cost_loss(minibatch)
                            losses["loss_qvalue"] = loss_qvalue
                            sum(
                                loss for name, loss in losses.items() if name.startswith("loss_")
                            ).backward()
                            nn.utils.clip_grad_norm_(critic_params, cfg.optim.max_grad_norm)
                            critic_optim.step()
                            critic_optim.zero_grad()
                with timeit("time/policy"):
                    visited = batch.select("observation").flatten()
                    states = visited[torch.randperm(len(visited))[: cfg.optim.policy_frames]]
                    level = cost_loss.on_policy_cvar(batch)
                    report = policy_optim.step(
                        policy_closure(policy, reward_loss, cost_loss, states, level)
                    )
                metrics |= report.to_dict()
                metrics |= {f"update/{name}": value.item() for name, value in losses.items()}
                metrics["update/constraint"] += cfg.loss.cost_limit

            if run.frames >= next_eval:
                next_eval += cfg.eval.interval
                with timeit("time/eval"):
                    metrics |= run.evaluate(eval_env, policy)
                run.plot()
            seconds = time.perf_counter() - started
            started += seconds
            run.counters["seconds"] += seconds
            metrics |= timeit.todict(percall=False)
            metrics["time/frames_per_second"] = batch.numel() / seconds
            timeit.erase()
            run.log(metrics)
            progress.update(batch.numel())
            progress.set_postfix(
                reward=f"{metrics['train/reward_per_1000']:.1f}",
                cost=f"{metrics['train/cost_rate']:.3f}",
                cv=f"{metrics['train/cv_rate']:.4f}",
                kl=f"{metrics.get('update/kl', 0.0):.4f}",
            )
            if run.frames >= next_save or stop.requested:
                next_save += cfg.checkpoint.interval
                run.save()
            if stop.requested:
                break
    progress.close()
    collector.shutdown()
    if stop.requested:
        print(f"stopped at {run.frames} frames; go on with the same command and resume=true")
        return
    run.save()
    final_env = make_env(cfg.eval.final_episodes, EVAL_SEED)
    run.finish(final_env, policy)
    final_env.close()


if __name__ == "__main__":
    main()
