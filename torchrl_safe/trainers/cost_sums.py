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
from torchrl.envs.utils import ExplorationType

from torchrl_safe.envs import Reflection
from torchrl_safe.objectives import QuantileCostLoss
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.record.metrics import acting
from torchrl_safe.trainers.options import FRAMES, Group, option, settings_of
from torchrl_safe.trainers.streams import stream_seed
from torchrl_safe.trainers.trainer import ConstrainedTrainer

NUM_FOLDS = 4  # of episodes
RECALIBRATION_RATE = 0.3  # a window's episodes are few: their noise is averaged over updates
JUDGED, BEYOND = 100, 0.02  # steps at the end; share of a sum's weight that may lie beyond them
CALIBRATION_FRAMES = 500_000  # at most, by default


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
    calibration_frames: int | None = option(
        None,
        "steps of the final policy, in new episodes that nothing learns from, by which predictions "
        "are rescaled at the end; null is half of collector.total_frames, at most 500,000",
        ge=0,
        le=FRAMES,
    )


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

    It is a component of a checkpoint: the steps, the optimizer's state, and scales to take back.

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
        self.scales: dict[str, Tensor] = {}  # in training, of critics that were handed over
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
        self.take_back()
        with timeit("time/targets"):
            steps = self.rows()
            data = self._sums(steps)
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
        metrics["update/skipped_cost_steps"] = float(self._descent.count())
        # Early, no sum is known to its end: then the half that is known best.
        enough = known > min(1 - 1 / math.e, 0.5 * known.max().item())
        return metrics | self._recalibrate(data[enough.flatten()], rate=RECALIBRATION_RATE)

    def calibrate(self) -> dict[str, float]:
        """Rescale predictions by new episodes of the policy that is handed over.

        The critics learned from what policies of a while ago met in some hundred layouts. Episodes
        of the last policy, which nothing was learned from, say how wrong predictions are about it.

        A training that goes on all the same takes back its own scales, and is the training that
        never stopped.

        Returns:
            dict: means and risks that were predicted before, and realised; empty where
            ``safety_critic.calibration_frames`` are too few for one episode.
        """
        trainer, options = self.trainer, self.trainer.options
        num_envs, num_steps, rounds = self.episodes()
        if not rounds:
            return {}
        # Of neighbours, one says as much as five.
        judged = range(0, max(1, min(JUDGED, num_steps - self.follow())), 5)
        data = []
        seed = stream_seed("calibration", options.seed)
        env = trainer.make_env(num_envs, seed)
        with acting(ExplorationType.RANDOM):
            torch.manual_seed(seed)
            for _ in range(rounds):
                steps = env.rollout(num_steps, trainer.policy, break_when_any_done=False)
                data.append(self._sums(steps)[:, judged].flatten())
        env.close(raise_if_closed=False)
        joined: TensorDictBase = torch.cat(data)
        shape = (len(joined), options.safety_critic.num_nets)
        joined["learned_by"] = torch.zeros(shape, dtype=torch.bool, device=joined.device)
        for cost, loss in self.losses.items():
            self.scales.setdefault(cost, loss.scales.clone())
        return self._recalibrate(joined, stretch=True)

    def _recalibrate(self, data: TensorDictBase, **how: Any) -> dict[str, float]:
        """What was predicted and realised of each cost, by which its predictions are rescaled."""
        return {
            self.trainer.name_of(f"calibration/{name}", cost): value.item()
            for cost, loss in self.losses.items()
            for name, value in loss.recalibrate(data, **how).items()
        }

    def take_back(self) -> None:
        """Scales as they were before :meth:`calibrate`."""
        for cost, scales in self.scales.items():
            self.losses[cost].scales.copy_(scales)
            self.losses[cost].stretch.copy_(torch.tensor([0.0, 1.0]))
        self.scales = {}

    def episodes(self) -> tuple[int, int, int]:
        """Those of :meth:`calibrate`: environments, steps of each, and how often."""
        options, width = self.trainer.options, self.trainer.width
        frames = options.safety_critic.calibration_frames
        if frames is None:
            frames = min(options.collector.total_frames // 2, CALIBRATION_FRAMES)
        num_steps = min(options.eval.num_steps, JUDGED + self.follow())
        num_envs = width or max(1, min(options.env.num_envs, frames // num_steps))
        return num_envs, num_steps, frames // (num_envs * num_steps)

    def follow(self) -> int:
        """Steps that hold all but a little of what follows one, discounted."""
        gamma = self.trainer.options.loss.cost_gamma
        return math.ceil(math.log(BEYOND) / math.log(gamma)) if gamma else 1

    def _sums(self, steps: TensorDictBase) -> TensorDict:
        """What critics learn from: states, actions, and the sums of costs that followed."""
        data = steps.select(*self.trainer.in_keys, "action")
        for loss in self.losses.values():
            keys = loss.tensor_keys
            data[keys.cost_target], data[keys.target_weight] = loss.compute_target(steps)
        return data

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
        """The steps, the optimizer's state, and scales to take back."""
        steps = {} if self.steps is None else self.steps.to_dict()
        return {"steps": steps, "optim": self.optim.state_dict(), "scales": dict(self.scales)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Put all back."""
        self.scales = dict(state["scales"])
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
