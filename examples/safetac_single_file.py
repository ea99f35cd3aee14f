"""SafeTAC in one file: plain TorchRL and the five blocks, no trainer, no run's folder.

    python examples/safetac_single_file.py
    python examples/safetac_single_file.py --robot car --total-frames 200000

What torchrl_safe.trainers.SafeTAC has besides: resuming, logs, evaluation, video, checks, other
environments, several costs, GPU graphs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import nn
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, SliceSampler, TensorDictReplayBuffer
from torchrl.modules import MLP, ValueOperator

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, TrustRegionSafeOptimizer, TsallisLoss
from torchrl_safe.envs import SafeRobotEnv
from torchrl_safe.modules import MOMENT_MATCHED
from torchrl_safe.objectives.value import evaluate_policy
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.record import batch_metrics


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """The numbers of a run, by default those of the paper's Point."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--robot", default="point")
    add("--seed", type=int, default=0)
    add("--num-envs", type=int, default=400)
    add("--episode-length", type=int, default=125, help="steps")
    add("--frames-per-batch", type=int, default=8000, help="frames between two updates")
    add("--total-frames", type=int, default=1_000_000)
    add("--init-frames", type=int, default=20_000, help="before the first update")
    add("--num-cells", type=int, nargs="*", default=[128, 128], help="of every network")
    add("--num-components", type=int, default=5, help="Gaussians in the mixture, K")
    add("--gamma", type=float, default=0.99, help="of reward and cost")
    add("--lmbda", type=float, default=0.97, help="of Retrace")
    add("--entropic-index", type=float, default=1.2, help="q")
    add("--alpha", type=float, default=0.001, help="entropy weight")
    add("--risk-level", type=float, default=0.125, help="share of worst outcomes in the CVaR")
    add("--cost-limit", type=float, default=5.0, help="on the discounted cost sum")
    add("--initial-cost-limit", type=float, default=15.0, help="it falls to cost-limit")
    add("--anneal-frames", type=int, default=500_000, help="over these")
    add("--buffer-size", type=int, default=1_000_000, help="frames")
    add("--slice-len", type=int, default=20, help="steps of a replayed slice")
    add("--critic-lr", type=float, default=1e-3)
    add("--critic-rounds", type=int, default=16, help="times per update that targets are computed")
    add("--critic-frames", type=int, default=15_000, help="replayed each time")
    add("--minibatch-size", type=int, default=1024)
    add("--policy-frames", type=int, default=4000, help="states of the trust region's step")
    add("--max-kl", type=float, default=0.02, help="nats")
    return parser.parse_args(words)


class Critics(nn.Module):
    """Losses of reward and cost, each with critics of its own.

    Args:
        args (Namespace): the numbers of the run.
        env (SafeRobotEnv): whose observations and actions they are.
        policy (GMMTanhPolicy): whose value they learn.
    """

    def __init__(self, args: argparse.Namespace, env: SafeRobotEnv, policy: GMMTanhPolicy) -> None:
        super().__init__()
        in_keys = ["observation", "action"]
        num_inputs = env.observation_spec["observation"].shape[-1] + env.action_spec.shape[-1]

        def critic(out_key: str, *last: nn.Module) -> ValueOperator:
            network = MLP(num_inputs, 1, num_cells=args.num_cells, activation_class=nn.ReLU)
            return ValueOperator(network.extend(last), in_keys=in_keys, out_keys=[out_key])

        self.reward = TsallisLoss(
            policy,
            critic("state_action_value"),
            entropic_index=args.entropic_index,
            alpha_init=args.alpha,
            fixed_alpha=True,
            delay_qvalue=False,
            deactivate_vmap=True,
        )
        self.cost = CVaRCostLoss(
            policy,
            critic("cost_value"),
            critic("cost_std", nn.Softplus()),
            risk_level=args.risk_level,
            cost_limit=args.cost_limit,
            deactivate_vmap=True,
        )
        self.reward.make_value_estimator("retrace", gamma=args.gamma, lmbda=args.lmbda)
        self.cost.make_value_estimator(gamma=args.gamma, lmbda=args.lmbda)

    def critic_parameters(self) -> list[nn.Parameter]:
        """Those of the critics, without the policy's."""
        reward, cost = self.reward, self.cost
        networks = (
            reward.qvalue_network_params,
            cost.cost_network_params,
            cost.std_network_params,
        )
        return [param for network in networks for param in network.parameters()]

    def with_targets(self, slices: TensorDictBase) -> TensorDictBase:
        """Steps of slices [B, T] with the Retrace targets of (4) and (18), flat."""
        policy = evaluate_policy(slices, self.reward.actor_network, shifted=True)
        cost_target, std_target = self.cost.compute_target(slices, policy=policy)
        targets = {
            "qvalue_target": self.reward.compute_target(slices, policy=policy),
            "cost_target": cost_target,
            "std_target": std_target,
        }
        return slices.select("observation", "action").update(targets).flatten()

    def losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Of all critics, on steps with their targets."""
        losses = self.cost(minibatch)
        losses["loss_qvalue"], _ = self.reward.qvalue_v2_loss(minibatch)
        return losses


def policy_closure(
    policy: GMMTanhPolicy,
    critics: Critics,
    batch: TensorDictBase,
    states: TensorDictBase,
    cost_limit: float,
) -> Callable[[], TensorDict]:
    """Objective, constraint and statistics of (13) as a function of the policy's weights.

    How high the cost stands is measured on the batch; the critics say how a change of the policy
    will move it. The noise is drawn once: the line search then compares policies, not draws.
    """
    with torch.no_grad():
        dist = policy.get_dist(states)
        noise = dist.draw_noise()
        measured = critics.cost.measure(batch, dist.rsample(noise=noise), states=states)

    def closure() -> TensorDict:
        dist = policy.get_dist(states)
        action, log_prob = dist.rsample_and_log_prob(noise=noise)
        constraint = critics.cost.constraint(states, action, measured, cost_limit=cost_limit)
        return TensorDict(
            {
                "objective": critics.reward.objective(states, action, log_prob).mean(),
                "constraint": constraint[None],
                "statistics": MOMENT_MATCHED.statistics(dist),
            }
        )

    return closure


def train(args: argparse.Namespace) -> GMMTanhPolicy:
    """Algorithm 1."""
    torch.manual_seed(args.seed)
    env = SafeRobotEnv(
        args.robot,
        num_envs=args.num_envs,
        seed=args.seed,
        episode_length=args.episode_length,
        stagger=True,
    )
    num_features = args.num_components * (1 + 2 * env.action_spec.shape[-1])
    network = MLP(
        env.observation_spec["observation"].shape[-1],
        num_features,
        num_cells=args.num_cells,
        activation_class=nn.ReLU,
    )
    policy = GMMTanhPolicy(network, env.action_spec, num_components=args.num_components)
    critics = Critics(args, env, policy)
    adam = torch.optim.Adam(critics.critic_parameters(), lr=args.critic_lr, fused=True)
    critic_steps = FiniteSteps(adam, max_grad_norm=1.0, max_skipped=100)
    trust_region = TrustRegionSafeOptimizer(
        policy.parameters(), max_kl=args.max_kl, statistics_kl=MOMENT_MATCHED.kl
    )
    trajectory = ("collector", "traj_ids")
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(args.buffer_size, ndim=2),
        sampler=SliceSampler(slice_len=args.slice_len, traj_key=trajectory, strict_length=True),
    )
    kept = ["observation", "action", "action_log_prob", trajectory]
    following = ("observation", "reward", "cost", "done", "terminated", "truncated")
    kept += [("next", key) for key in following]
    collector = Collector(
        env,
        policy,
        frames_per_batch=args.frames_per_batch,
        total_frames=args.total_frames,
        auto_register_policy_transforms=False,
    )
    frames = 0
    for batch in collector:
        frames += batch.numel()
        buffer.extend(batch.select(*kept))
        if frames < args.init_frames:
            continue
        left = max(0.0, 1 - frames / max(1, args.anneal_frames))
        cost_limit = args.cost_limit + left * (args.initial_cost_limit - args.cost_limit)

        for _ in range(args.critic_rounds):  # each with new targets
            slices = buffer.sample(args.critic_frames).select(*kept)
            data = critics.with_targets(slices.reshape(-1, args.slice_len))
            for minibatch in data[torch.randperm(len(data))].split(args.minibatch_size):
                critic_steps.step(critics.losses(minibatch))
        critic_steps.count()  # fails if many were not finite

        visited = batch.select("observation").flatten()
        states = visited[torch.randperm(len(visited))[: args.policy_frames]]
        report = trust_region.step(policy_closure(policy, critics, batch, states, cost_limit))
        collector.update_policy_weights_()

        metrics = batch_metrics(batch)
        print(
            f"{frames:9,} frames  "
            f"reward per 1000 {metrics['train/reward_per_1000']:7.2f}  "
            f"violations per step {metrics['train/cv_rate']:.4f}  "
            f"cost {report.constraint[0] + cost_limit:6.2f} of {cost_limit:.2f}  "
            f"kl {report.kl:.4f}  {report.case}"
        )
    collector.shutdown()
    return policy


if __name__ == "__main__":
    train(arguments())
