"""What the off-policy examples share: the losses, the replay buffer and the critics' learning."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule
from torch import Tensor, nn
from torchrl._utils import timeit
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    SliceSampler,
    Storage,
    TensorDictReplayBuffer,
)
from torchrl.envs import EnvBase

from torchrl_safe import CVaRCostLoss, GMMTanhPolicy, TsallisLoss
from torchrl_safe.objectives.value import PolicyEvaluation, evaluate_policy
from torchrl_safe.trainers.descent import Descent
from torchrl_safe.trainers.utils import make_critic

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


def make_losses(
    cfg: DictConfig, env: EnvBase, policy: GMMTanhPolicy
) -> tuple[TsallisLoss, CVaRCostLoss]:
    """The losses of reward and cost, with critics of their own and Retrace targets."""
    reward_loss = TsallisLoss(
        policy,
        make_critic(cfg, env, "state_action_value"),
        entropic_index=cfg.loss.entropic_index,
        alpha_init=cfg.loss.alpha,
        fixed_alpha=True,
        delay_qvalue=False,
        deactivate_vmap=True,  # on a CPU, two small products are faster than a batched one
    )
    reward_loss.make_value_estimator("retrace", gamma=cfg.loss.gamma, lmbda=cfg.loss.lmbda)
    cost_loss = CVaRCostLoss(
        policy,
        make_critic(cfg, env, "cost_value"),
        make_critic(cfg, env, "cost_std", nn.Softplus()),
        risk_level=cfg.loss.risk_level,
        cost_limit=cfg.loss.cost_limit,
        variance_reward=cfg.loss.variance_reward,
        deactivate_vmap=True,
    )
    cost_loss.make_value_estimator(gamma=cfg.loss.cost_gamma, lmbda=cfg.loss.lmbda)
    return reward_loss, cost_loss


def make_critic_optim(
    cfg: DictConfig, reward_loss: TsallisLoss, cost_loss: CVaRCostLoss
) -> torch.optim.Optimizer:
    """Adam on the critics: the losses' own, not those of the networks they were made from."""
    critics = (
        reward_loss.qvalue_network_params,
        cost_loss.cost_network_params,
        cost_loss.std_network_params,
    )
    params = [param for critic in critics for param in critic.parameters()]
    on_gpu = torch.device(cfg.device).type == "cuda"
    return torch.optim.Adam(params, lr=cfg.optim.critic_lr, fused=True, capturable=on_gpu)


def make_buffer(cfg: DictConfig) -> TensorDictReplayBuffer:
    """Replays slices of trajectories, from memory or from files in the run's folder."""
    size, kind = cfg.replay_buffer.size, cfg.replay_buffer.storage
    if kind == "memmap":
        folder = Path(cfg.run_dir) / "replay"
        storage: Storage = LazyMemmapStorage(size, scratch_dir=folder, existsok=True, ndim=2)
    elif kind == "memory":
        storage = LazyTensorStorage(size, ndim=2, device=cfg.device)
    else:
        raise ValueError(f"replay_buffer.storage must be memory or memmap, got {kind!r}.")
    return TensorDictReplayBuffer(
        storage=storage,
        sampler=SliceSampler(
            slice_len=cfg.replay_buffer.slice_len,
            traj_key=("collector", "traj_ids"),
            strict_length=True,
            cache_values=True,  # of one update, until the next batch comes
        ),
    )


class CriticFit:
    """The critics' part of an update: some rounds of new targets, each with one pass over them.

    On a GPU the targets of a round are one CUDA graph and its gradient steps another: they are
    thousands of small kernels, which would wait for Python to launch them one by one. The first
    two rounds, which run as on a CPU, settle what is settled once. On a CPU both can be compiled.

    Args:
        cfg (DictConfig): the run's configuration.
        buffer (TensorDictReplayBuffer): replays trajectories.
        reward_loss (TsallisLoss): critics of the reward.
        cost_loss (CVaRCostLoss): critics of the cost.
        optim (torch.optim.Optimizer): of both, fused.
    """

    def __init__(
        self,
        cfg: DictConfig,
        buffer: TensorDictReplayBuffer,
        reward_loss: TsallisLoss,
        cost_loss: CVaRCostLoss,
        optim: torch.optim.Optimizer,
    ) -> None:
        self.cfg = cfg
        self.buffer = buffer
        self.descent = Descent(cfg, optim)

        def targets_of(
            part: TensorDictBase, policy: PolicyEvaluation
        ) -> tuple[Tensor, Tensor, Tensor]:
            return (
                reward_loss.compute_target(part, policy=policy),
                *cost_loss.compute_target(part, policy=policy),
            )

        def losses_of(minibatch: TensorDictBase) -> TensorDictBase:
            losses = cost_loss(minibatch)
            losses["loss_qvalue"], _ = reward_loss.qvalue_v2_loss(minibatch)
            return losses

        on_gpu = torch.device(cfg.device).type == "cuda"
        if cfg.optim.compile and not on_gpu:
            warnings.filterwarnings("ignore", ".*inline_inbuilt_nn_modules", FutureWarning)
            # Sizes that come up are few: the last minibatch is smaller than the others. Nothing
            # sets an attribute of the losses from here on; to look at all of them, every time,
            # costs a tenth of a gradient step.
            unguarded = {"guard_filter_fn": torch.compiler.skip_guard_on_all_nn_modules_unsafe}
            targets_of, losses_of = (
                torch.compile(function, dynamic=False, options=unguarded)
                for function in (targets_of, losses_of)
            )

        def add_targets(trajectories: TensorDictBase) -> TensorDictBase:
            return with_targets(trajectories, reward_loss.actor_network, targets_of)

        def descend(data: TensorDictBase) -> TensorDictBase:
            for minibatch in minibatches(data, cfg.optim.minibatch_size):
                losses = losses_of(minibatch)
                self.descent.step(losses)
            return losses.detach()

        self._add_targets, self._descend = add_targets, descend
        if on_gpu and cfg.optim.cuda_graphs:
            # A graph is recorded on a stream of its own, and CudaGraphModule takes tensordicts out
            # of PyTree, where nothing here needs them.
            warnings.filterwarnings("ignore", "The AccumulateGrad node's stream")
            warnings.filterwarnings("ignore", "Tensordict is registered in PyTree")
            self._add_targets, self._descend = (
                CudaGraphModule(function, in_keys=[]) for function in (add_targets, descend)
            )

    def __call__(self) -> dict[str, float]:
        """Fit the critics to what is in the buffer.

        Raises:
            FloatingPointError: if more than ``optim.max_skipped`` gradient steps were skipped.
        """
        cfg = self.cfg
        for _ in range(cfg.optim.critic_rounds):
            # Targets are renewed each round: one round is one step of value iteration.
            with timeit("time/targets"):
                data = self.buffer.sample(cfg.optim.critic_frames).select(*REPLAYED)
                data = self._add_targets(data.reshape(-1, cfg.replay_buffer.slice_len))
            with timeit("time/critics"):
                losses = self._descend(data)
        metrics = {f"update/{name}": value.item() for name, value in losses.items()}
        return metrics | {"update/skipped_steps": self.descent.count()}


def with_targets(
    trajectories: TensorDictBase,
    actor: GMMTanhPolicy,
    targets_of: Callable[[TensorDictBase, PolicyEvaluation], tuple[Tensor, Tensor, Tensor]],
) -> TensorDictBase:
    """Transitions of trajectories [B, T] with the targets of (4) and (18), flat."""
    policy = evaluate_policy(trajectories, actor, shifted=True)
    names = ("qvalue_target", "cost_target", "std_target")
    targets = dict(zip(names, targets_of(trajectories, policy), strict=True))
    return trajectories.select("observation", "action").update(targets).flatten()


def minibatches(data: TensorDictBase, size: int) -> Iterator[TensorDictBase]:
    """All of ``data`` in random order, ``size`` at a time."""
    yield from data[torch.randperm(len(data), device=data.device)].split(size)
