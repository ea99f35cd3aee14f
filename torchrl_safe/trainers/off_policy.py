"""What off-policy methods share: losses, replay of trajectories and the critics' learning."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
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
from torchrl.objectives import LossModule, SoftUpdate, ValueEstimators

from torchrl_safe import CVaRCostLoss, TsallisLoss
from torchrl_safe.envs import Reflection
from torchrl_safe.objectives import lagrangian
from torchrl_safe.objectives.value import PolicyEvaluation, evaluate_policy
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.options import Group, option
from torchrl_safe.trainers.policy_steps import make_multiplier
from torchrl_safe.trainers.trainer import ConstrainedTrainer, Trainer


class CriticSteps(Group):
    """The critics' gradient steps, on replayed slices."""

    critic_lr: float = option(1e-3, "of Adam", gt=0)
    max_grad_norm: float = option(1.0, "of the critics together", gt=0)
    max_skipped: int = option(
        100, "critic steps per update skipped as not finite, before the run stops", ge=0
    )
    critic_rounds: int = option(16, "times per update that targets are computed", ge=1)
    critic_frames: int = option(15_000, "replayed frames each time", ge=1)
    minibatch_size: int = option(1024, "transitions per gradient step of the critics", ge=1)
    mirror: bool = option(
        True, "show half of them in a mirror, where the environment has one (env.reflection)"
    )
    compile: bool = option(
        False,
        "on a CPU: a minute of compilation, which needs a C++ compiler, then a little faster; for "
        "long runs",
    )


class SoftUpdates(Group):
    """Gradient steps of policy and critics at once, with target networks that follow."""

    num_updates: int = option(120, "gradient steps per batch of new frames", ge=1)
    minibatch_size: int = option(1024, "transitions per gradient step", ge=1)
    lr: float = option(1e-3, "of Adam", gt=0)
    max_skipped: int = option(
        100, "gradient steps per update skipped as not finite, before the run stops", ge=0
    )
    tau: float = option(0.02, "of the target networks, per gradient step", gt=0, le=1)


class PricedActorCritic(ConstrainedTrainer):
    """Critics of actions, target networks, and a policy that follows the Lagrangian.

    Each gradient step is one of all networks, on replayed transitions.
    """

    policy_delay: int = 1

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, losses of reward and costs with target networks, and a multiplier."""
        options = self.options
        self.policy = self.make_policy(env)
        self.reward_loss = self.make_reward_loss(env)
        self.cost_losses = make_cost_losses(self, env, delay_cost=True)
        self.reward_loss.make_value_estimator(ValueEstimators.TD0, gamma=options.loss.gamma)
        for loss in self.cost_losses.values():
            loss.make_value_estimator(ValueEstimators.TD0, gamma=options.loss.cost_gamma)
        losses = [self.reward_loss, *self.cost_losses.values()]
        self.targets = [SoftUpdate(loss, tau=options.optim.tau) for loss in losses]
        optim = joint_optim(losses, options.optim.lr)
        self.steps = FiniteSteps(optim, max_skipped=options.optim.max_skipped)
        self.multiplier = make_multiplier(self)
        self.buffer = make_buffer(self)
        return {
            "reward_loss": self.reward_loss,
            **as_components(self, "cost_loss", self.cost_losses),
            "optim": optim,
            "multiplier": self.multiplier,
            "buffer": self.buffer,
        }

    def make_reward_loss(self, env: EnvBase) -> Any:
        """The loss of the reward, with critics of its own."""
        raise NotImplementedError

    def critic_losses(self, minibatch: TensorDictBase) -> TensorDictBase:
        """Losses of all critics."""
        raise NotImplementedError

    def policy_losses(
        self, minibatch: TensorDictBase, limits: Mapping[str, float]
    ) -> dict[str, Tensor]:
        """Losses of the policy, and of what is learned with it."""
        raise NotImplementedError

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """The multiplier on the new batch's cost, then gradient steps on replayed transitions.

        Of every ``policy_delay`` steps, the last moves policy and target networks.
        """
        self.buffer.extend(batch.select(*replayed(self)).flatten())
        if self.frames < self.options.collector.init_frames:
            return {}
        limits = self.limits()
        levels = {cost: loss.on_policy_cvar(batch) for cost, loss in self.cost_losses.items()}
        priced = self.multiplier.react(self, levels)
        with timeit("time/update"):
            for step in range(1, self.options.optim.num_updates + 1):
                minibatch = self.buffer.sample()
                losses = self.critic_losses(minibatch)
                moves = step % self.policy_delay == 0
                if moves:
                    losses.update(self.policy_losses(minibatch, limits))
                self.steps.step(losses)
                for target in self.targets if moves else ():
                    target.step()
        return {
            **{f"update/{name}": value.item() for name, value in losses.items()},
            **priced,
            "update/skipped_steps": float(self.steps.count()),
        }

    def priced(
        self,
        objective: Tensor,
        minibatch: TensorDictBase,
        action: Tensor,
        limits: Mapping[str, float],
    ) -> Tensor:
        """The Lagrangian of an objective and of the costs of one action, as the objective is.

        Args:
            objective (Tensor): a scalar.
            minibatch (TensorDictBase): states, ``[B]``.
            action (Tensor): the policy's in them, ``[B, D]``.
            limits (mapping): on discounted sums, by cost.
        """
        constraints = [
            self.cost_losses[cost].cvar(minibatch, action).mean() - limit
            for cost, limit in limits.items()
        ]
        return lagrangian(objective, torch.stack(constraints), self.multiplier())


def replayed(trainer: Trainer) -> list[Any]:
    """What of a batch is kept for replay."""
    costs = trainer.costs if isinstance(trainer, ConstrainedTrainer) else []
    signals = ("reward", *costs, "done", "terminated", "truncated")
    return [
        *trainer.in_keys,
        *("action", "action_log_prob"),
        ("collector", "traj_ids"),
        *(("next", key) for key in (*trainer.in_keys, *signals)),
    ]


def make_reward_loss(trainer: Trainer, env: EnvBase, **how: Any) -> TsallisLoss:
    """The loss of the reward, with a critic of its own."""
    loss = trainer.options.loss
    return TsallisLoss(
        trainer.policy,
        trainer.make_critic(env, "state_action_value"),
        entropic_index=loss.entropic_index,
        alpha_init=loss.alpha,
        deactivate_vmap=True,  # on a CPU, two small products are faster than a batched one
        **how,
    )


def make_cost_losses(
    trainer: ConstrainedTrainer, env: EnvBase, **how: Any
) -> dict[str, CVaRCostLoss]:
    """The loss of each cost, with critics of its own, by the name of the cost."""
    losses = {}
    for cost, limit in trainer.limits().items():
        losses[cost] = CVaRCostLoss(
            trainer.policy,
            trainer.make_critic(env, "cost_value"),
            trainer.make_critic(env, "cost_std", nn.Softplus()),
            risk_level=trainer.options.loss.risk_level,
            cost_limit=limit,
            deactivate_vmap=True,
            **how,
        )
        losses[cost].set_keys(
            cost=cost,
            cost_target=trainer.name_of("cost_target", cost),
            std_target=trainer.name_of("std_target", cost),
        )
    return losses


def critic_losses(
    trainer: ConstrainedTrainer,
    minibatch: TensorDictBase,
    reward_loss: TsallisLoss,
    cost_losses: Mapping[str, CVaRCostLoss],
) -> TensorDictBase:
    """Losses of all critics, and their mean predictions of costs."""
    losses = trainer.joined(cost_losses, minibatch)
    losses["loss_qvalue"], _ = reward_loss.qvalue_v2_loss(minibatch)
    return losses


def as_components(trainer: ConstrainedTrainer, name: str, losses: Mapping[str, Any]) -> dict:
    """The losses of the costs as components of a checkpoint."""
    return {trainer.name_of(name, cost).replace("/", "_"): x for cost, x in losses.items()}


def reflection_of(trainer: Trainer, env: EnvBase) -> Reflection | None:
    """The environment's mirror, if critics are to learn in it and read what it knows."""
    if not trainer.options.optim.mirror or trainer.in_keys != ["observation"]:
        return None
    return getattr(env, "reflection", None)


def make_critic_optim(
    trainer: ConstrainedTrainer,
    reward_loss: TsallisLoss,
    cost_losses: Mapping[str, CVaRCostLoss],
) -> torch.optim.Optimizer:
    """Adam on the critics: the losses' own, not those of the networks they were made from."""
    critics = [reward_loss.qvalue_network_params]
    for loss in cost_losses.values():
        critics += [loss.cost_network_params, loss.std_network_params]
    params = [param for critic in critics for param in critic.parameters()]
    on_gpu = torch.device(trainer.options.device).type == "cuda"
    lr = trainer.options.optim.critic_lr
    return torch.optim.Adam(params, lr=lr, fused=True, capturable=on_gpu)


def joint_optim(losses: Sequence[LossModule], lr: float) -> torch.optim.Optimizer:
    """Adam on all that losses learn; the policy's parameters, which several have, once."""
    params = dict.fromkeys(param for loss in losses for param in loss.parameters())
    return torch.optim.Adam(list(params), lr=lr, fused=True)


def make_buffer(trainer: Trainer) -> TensorDictReplayBuffer:
    """Replays single transitions."""
    options = trainer.options
    return TensorDictReplayBuffer(
        storage=LazyTensorStorage(options.replay_buffer.size, device=options.device),
        batch_size=options.optim.minibatch_size,
    )


def make_slice_buffer(trainer: Trainer) -> TensorDictReplayBuffer:
    """Replays slices of trajectories, from memory or from files in the run's folder."""
    options = trainer.options
    size = options.replay_buffer.size
    if options.replay_buffer.storage == "memmap":
        folder = Path(options.folder) / "replay"
        storage: Storage = LazyMemmapStorage(size, scratch_dir=folder, existsok=True, ndim=2)
    else:
        storage = LazyTensorStorage(size, ndim=2, device=options.device)
    return TensorDictReplayBuffer(
        storage=storage,
        sampler=SliceSampler(
            slice_len=options.replay_buffer.slice_len,
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
        trainer (ConstrainedTrainer): whose critics they are.
        buffer (TensorDictReplayBuffer): replays trajectories.
        reward_loss (TsallisLoss): critics of the reward.
        cost_losses (mapping of str to CVaRCostLoss): critics of the costs.
        optim (torch.optim.Optimizer): of all of them, fused.
        reflection (Reflection, optional): half of each minibatch is seen in this mirror.
    """

    def __init__(
        self,
        trainer: ConstrainedTrainer,
        buffer: TensorDictReplayBuffer,
        reward_loss: TsallisLoss,
        cost_losses: Mapping[str, CVaRCostLoss],
        optim: torch.optim.Optimizer,
        reflection: Reflection | None = None,
    ) -> None:
        self.options = options = trainer.options
        self.keys = replayed(trainer)
        self.buffer = buffer
        self.steps = FiniteSteps(
            optim,
            max_grad_norm=options.optim.max_grad_norm,
            max_skipped=options.optim.max_skipped,
        )
        names = ["qvalue_target"]
        for loss in cost_losses.values():
            names += [loss.tensor_keys.cost_target, loss.tensor_keys.std_target]
        inputs = [*trainer.in_keys, "action"]

        def targets_of(part: TensorDictBase, policy: PolicyEvaluation) -> tuple[Tensor, ...]:
            targets = [reward_loss.compute_target(part, policy=policy)]
            for loss in cost_losses.values():
                targets += loss.compute_target(part, policy=policy)
            return tuple(targets)

        def losses_of(minibatch: TensorDictBase) -> TensorDictBase:
            return critic_losses(trainer, minibatch, reward_loss, cost_losses)

        on_gpu = torch.device(options.device).type == "cuda"
        if options.optim.compile and not on_gpu:
            warnings.filterwarnings("ignore", ".*inline_inbuilt_nn_modules", FutureWarning)
            # Sizes that come up are few: the last minibatch is smaller than the others. Nothing
            # sets an attribute of the losses from here on; to look at all of them, every time,
            # costs a tenth of a gradient step.
            unguarded: dict[str, Any] = {
                "guard_filter_fn": torch.compiler.skip_guard_on_all_nn_modules_unsafe
            }
            targets_of, losses_of = (
                torch.compile(function, dynamic=False, options=unguarded)
                for function in (targets_of, losses_of)
            )

        def add_targets(trajectories: TensorDictBase) -> TensorDictBase:
            """Transitions of trajectories [B, T] with the targets of (4) and (18), flat."""
            policy = evaluate_policy(trajectories, reward_loss.actor_network, shifted=True)
            targets = dict(zip(names, targets_of(trajectories, policy), strict=True))
            return trajectories.select(*inputs).update(targets).flatten()

        def descend(data: TensorDictBase) -> TensorDictBase:
            for minibatch in minibatches(data, options.optim.minibatch_size):
                if reflection is not None:
                    minibatch = reflection.of_half(minibatch)
                losses = losses_of(minibatch)
                self.steps.step(losses)
            return losses.detach()

        self._add_targets: Callable[[TensorDictBase], TensorDictBase] = add_targets
        self._descend: Callable[[TensorDictBase], TensorDictBase] = descend
        if on_gpu and options.optim.cuda_graphs:
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
        options = self.options
        for _ in range(options.optim.critic_rounds):
            # Targets are renewed each round: one round is one step of value iteration.
            with timeit("time/targets"):
                data = self.buffer.sample(options.optim.critic_frames).select(*self.keys)
                data = self._add_targets(data.reshape(-1, options.replay_buffer.slice_len))
            with timeit("time/critics"):
                losses = self._descend(data)
        metrics = {f"update/{name}": value.item() for name, value in losses.items()}
        return metrics | {"update/skipped_steps": float(self.steps.count())}


def minibatches(data: TensorDictBase, size: int) -> Iterator[TensorDictBase]:
    """All of ``data`` in random order, ``size`` at a time."""
    yield from data[torch.randperm(len(data), device=data.device)].split(size)
