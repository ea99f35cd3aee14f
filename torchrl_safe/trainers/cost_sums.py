"""Safety critics of a cost's whole distribution, learned from sums of real costs.

A critic that bootstraps early hides the errors that it keeps along a trajectory, and its tail is
too light. Sums of the costs that the newest policies really met hide nothing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl._utils import timeit
from torchrl.envs import EnvBase

from torchrl_safe.envs import Reflection
from torchrl_safe.objectives import QuantileCostLoss
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.options import Group, option, settings_of
from torchrl_safe.trainers.trainer import ConstrainedTrainer

NUM_FOLDS = 4  # of episodes
RECALIBRATION_RATE = 0.3  # a window's episodes are few: their noise is averaged over updates


class SafetyCritic(Group):
    """What predicts the risk of a cost."""

    kind: Literal["gaussian", "quantiles"] = option(
        "quantiles",
        "quantiles of sums of real costs; or gaussian: mean and deviation by Retrace, as in the "
        "paper",
        fixed=True,
    )
    num_quantiles: int = option(32, "of kind=quantiles, as all that follow", ge=2, fixed=True)
    num_nets: int = option(
        2,
        "networks; each leaves out a fourth of the episodes, and is judged by these",
        ge=1,
        le=NUM_FOLDS,
        fixed=True,
    )
    window: int = option(260, "newest steps of every environment whose costs are summed", ge=2)
    num_updates: int = option(120, "gradient steps per batch of new frames", ge=1)


def make_quantile_losses(trainer: ConstrainedTrainer, env: EnvBase) -> dict[str, QuantileCostLoss]:
    """The loss of each cost, with a critic of quantiles, by the name of the cost."""
    options = trainer.options
    losses = {}
    for cost, limit in trainer.limits().items():
        losses[cost] = loss = QuantileCostLoss(
            trainer.policy,
            trainer.make_critic(
                env, "cost_quantiles", num_outputs=options.safety_critic.num_quantiles
            ),
            risk_level=options.loss.risk_level,
            cost_limit=limit,
            num_cost_nets=options.safety_critic.num_nets,
            deactivate_vmap=True,
        )
        loss.set_keys(
            cost=cost,
            cost_target=trainer.name_of("cost_target", cost),
            target_weight=trainer.name_of("target_weight", cost),
        )
        loss.make_value_estimator("td1", gamma=options.loss.cost_gamma)
    return losses


class CostSums:
    """The newest steps of every environment, and the critics' learning from their costs.

    Every network leaves out a fourth of the episodes. How wrong it is about them is how wrong it is
    about layouts that it has not seen, and predictions are rescaled by it.

    It is a component of a checkpoint: the steps, and the optimizer's state.

    Args:
        trainer (ConstrainedTrainer): whose critics they are.
        losses (mapping of str to QuantileCostLoss): critics of the costs.
        reflection (Reflection, optional): half of what they learn from is seen in this mirror.
    """

    def __init__(
        self,
        trainer: ConstrainedTrainer,
        losses: Mapping[str, QuantileCostLoss],
        reflection: Reflection | None = None,
    ) -> None:
        self.trainer, self.losses, self.reflection = trainer, losses, reflection
        self.steps: TensorDictBase | None = None
        params = [p for loss in losses.values() for p in loss.cost_network_params.parameters()]
        self.optim = torch.optim.Adam(params, lr=trainer.options.optim.critic_lr, fused=True)
        self._descent = FiniteSteps(
            self.optim,
            max_grad_norm=trainer.options.optim.max_grad_norm,
            max_skipped=trainer.options.optim.max_skipped,
        )

    def extend(self, batch: TensorDictBase) -> None:
        """Take up new steps ``[N, T]``, and forget the oldest.

        Raises:
            ValueError: if they are of another number of environments.
        """
        keys = self.trainer.in_keys
        steps = batch.select(
            *keys,
            "action",
            ("collector", "traj_ids"),
            *(("next", key) for key in (*keys, *self.losses, "done", "terminated")),
        )
        if self.steps is not None:
            if len(steps) != len(self.steps):
                raise ValueError(
                    "safety_critic.kind=quantiles needs all environments in every batch, got "
                    f"{len(steps)} after {len(self.steps)}: collector.backend=multi_async has "
                    "those of one worker."
                )
            steps = torch.cat([self.steps, steps], 1)
        self.steps = steps[:, -self.trainer.options.safety_critic.window :].clone()

    def fit(self) -> dict[str, float]:
        """Gradient steps on sums of the costs; metrics of the critics.

        Raises:
            FloatingPointError: if more than ``optim.max_skipped`` of them were skipped.
        """
        options = self.trainer.options
        with timeit("time/targets"):
            steps = self.rows()
            data = steps.select(*self.trainer.in_keys, "action")
            for loss in self.losses.values():
                keys = loss.tensor_keys
                data[keys.cost_target], data[keys.target_weight] = loss.compute_target(steps)
            data["learned_by"] = learned_by(
                steps["collector", "traj_ids"], options.safety_critic.num_nets
            )
            known = known_share(steps["next"], options.loss.cost_gamma)
            data = data.flatten()
        with timeit("time/critics"):
            for _ in range(options.safety_critic.num_updates):
                size = (options.optim.minibatch_size,)
                minibatch = data[torch.randint(len(data), size, device=data.device)]
                if self.reflection is not None:
                    minibatch = self.reflection.of_half(minibatch)
                losses = self.trainer.joined(self.losses, minibatch)
                self._descent.step(losses)
        metrics = {f"update/{name}": value.item() for name, value in losses.items()}
        # Early, no sum is known to its end: then the half that is known best.
        enough = known > min(1 - 1 / math.e, 0.5 * known.max().item())
        for cost, loss in self.losses.items():
            report = loss.recalibrate(data[enough.flatten()], rate=RECALIBRATION_RATE)
            for name, value in report.items():
                metrics[self.trainer.name_of(f"calibration/{name}", cost)] = value.item()
        return metrics | {"update/skipped_cost_steps": float(self._descent.count())}

    def rows(self) -> TensorDictBase:
        """The steps, cut where a row goes on with another episode than it had."""
        if self.steps is None:
            raise RuntimeError("extend must be called before the sums of costs are asked for.")
        steps = self.steps.copy()
        episode = steps["collector", "traj_ids"]
        cut = torch.zeros_like(steps["next", "done"])
        cut[:, :-1, 0] = episode[:, 1:] != episode[:, :-1]
        steps["next"] = steps["next"].copy().set("done", steps["next", "done"] | cut)
        return steps

    def state_dict(self) -> dict[str, Any]:
        """The steps and the optimizer's state."""
        steps = {} if self.steps is None else self.steps.to_dict()
        return {"steps": steps, "optim": self.optim.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put both back."""
        steps = TensorDict(state["steps"])
        self.steps = None if steps.is_empty() else steps.auto_batch_size_(2).clone()
        put_back = settings_of(self.optim)
        self.optim.load_state_dict(state["optim"])
        put_back()


def learned_by(episode: Tensor, num_nets: int) -> Tensor:
    """Which networks learn from a step: each but one, or all where there are too few episodes.

    Args:
        episode (Tensor): the number of the step's episode, ``[*B]``.
        num_nets (int): networks, E; at most ``NUM_FOLDS``.

    Returns:
        Tensor: bool, ``[*B, E]``.
    """
    network = torch.arange(num_nets, device=episode.device)
    learned = (episode % NUM_FOLDS).unsqueeze(-1) != network
    few = episode.unique().numel() < 2 * NUM_FOLDS
    return torch.ones_like(learned) if few else learned


def known_share(following: TensorDictBase, gamma: float) -> Tensor:
    """How much of the discounted weight of what follows a step lies within its row.

    Args:
        following (TensorDictBase): ``done`` and ``terminated`` after the steps, ``[N, T, 1]``; a
            row ends with its last step.
        gamma (float): the discount, in [0, 1).

    Returns:
        Tensor: in (0, 1], ``[N, T]``; 1 where the episode terminates.
    """
    done, terminated = following["done"].squeeze(-1), following["terminated"].squeeze(-1)
    beyond = torch.ones(len(done), device=done.device)  # the share beyond what is known
    shares = torch.empty(done.shape, device=done.device)
    for t in reversed(range(done.shape[1])):
        beyond = gamma * beyond.masked_fill(done[:, t], 1.0).masked_fill(terminated[:, t], 0.0)
        shares[:, t] = 1.0 - beyond
    return shares
