"""SafeTAC: Algorithm 1 of the paper out of the five blocks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Literal

import torch
from pydantic import Field
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn
from torchrl._utils import timeit
from torchrl.envs import EnvBase

from torchrl_safe.modules import DISTANCES, Distance
from torchrl_safe.objectives import CVaRCostLoss, LimitController, QuantileCostLoss
from torchrl_safe.optim import FiniteSteps
from torchrl_safe.trainers.cost_sums import CostSums, SafetyCritic, make_quantile_losses
from torchrl_safe.trainers.off_policy import (
    CriticFit,
    CriticSteps,
    as_components,
    make_cost_losses,
    make_critic_optim,
    make_reward_loss,
    make_slice_buffer,
    minibatches,
    reflection_of,
    replayed,
)
from torchrl_safe.trainers.options import (
    ConstrainedLoss,
    Lagrangian,
    MethodOptions,
    Policy,
    SliceBuffer,
    TrustRegion,
    again,
    option,
)
from torchrl_safe.trainers.policy_steps import PID, Multiplier, ascend, make_trust_region
from torchrl_safe.trainers.tasks import robot_of
from torchrl_safe.trainers.trainer import ConstrainedTrainer


class SafeTACPolicy(Policy):
    """The policy, a mixture of Gaussians."""

    num_components: int = again(Policy, "num_components", 5)


class SafeTACLoss(ConstrainedLoss):
    """Reward, entropy and the limit."""

    # An agent held safer from the start learns to drive later.
    initial_ratio: ClassVar[float] = 1.5

    initial_cost_limit: float | dict[str, float] | None = again(
        ConstrainedLoss,
        "initial_cost_limit",
        None,
        meaning="moves linearly to cost_limit; null is 1.5 times cost_limit: an agent held safer "
        "from the start learns to drive later",
    )
    limit_gain: float = option(
        0.03,
        "per update: the limit in use is tightened by this share of what the measured level stands "
        "above cost_limit, until it no longer does; 0 for none",
        ge=0,
        le=1,
    )
    entropic_index: float = option(1.2, "q; 1 is Shannon entropy", gt=0)
    alpha: float = option(0.001, "entropy weight, beta in the paper", gt=0)
    lmbda: float = option(0.97, "trace decay of Retrace", ge=0, le=1)
    variance_reward: Literal["td_error", "second_moment"] = option(
        "td_error", "or second_moment, (18) as written"
    )


class SafeTACOptim(TrustRegion, CriticSteps):
    """Critics and the trust-region step."""

    policy_frames: int = option(
        4000, "states of the trust-region step, from the newest batch", ge=1
    )
    curvature_frames: int | None = option(
        None,
        "of them, for curvature products: fewer are faster and less exact",
        ge=1,
        le=2**31 - 1,
    )
    kl: Literal["auto", "moment_matched", "matched_bound"] = option(
        "auto",
        "its distance of policies: moment_matched (15) on Point, elsewhere matched_bound, which "
        "holds every component",
    )


class SafeTACLagrangian(Lagrangian):
    """The multiplier of update=lagrangian and update=pid, which has gains in place of lr."""

    policy_lr: float = option(1e-3, "of Adam", gt=0)
    minibatch_size: int = option(
        512, "states per gradient step, in one pass over the newest batch", ge=1
    )


class SafeTACOptions(MethodOptions):
    """The options of SafeTAC."""

    method: ClassVar[str] = "safetac"

    update: Literal["trust_region", "lagrangian", "pid"] = option(
        "trust_region", "of the policy; or lagrangian, pid: the ablations", fixed=True
    )
    replay_buffer: SliceBuffer = Field(default_factory=SliceBuffer)
    policy: SafeTACPolicy = Field(default_factory=SafeTACPolicy)
    loss: SafeTACLoss = Field(default_factory=SafeTACLoss)
    safety_critic: SafetyCritic = Field(default_factory=SafetyCritic)
    optim: SafeTACOptim = Field(default_factory=SafeTACOptim)
    lagrangian: SafeTACLagrangian = Field(default_factory=SafeTACLagrangian)
    pid: PID = Field(default_factory=PID)


class SafeTAC(ConstrainedTrainer):
    """Safe Tsallis actor-critic.

    A mixture policy gains reward and Tsallis entropy within a trust region, under a limit on the
    CVaR of each cost, by critics that learn from replayed trajectories with Retrace.

    Examples:
        >>> from torchrl_safe.trainers import SafeTAC
        >>> trainer = SafeTAC("point", cost_limit=2.5)
        >>> policy = trainer.train(total_frames=1_000_000)  # doctest: +SKIP
    """

    Options = SafeTACOptions

    cost_losses: Mapping[str, CVaRCostLoss | QuantileCostLoss]
    cost_sums: CostSums | None = None

    def build(self, env: EnvBase) -> dict[str, Any]:
        """A policy, critics of reward and costs, and the trust region."""
        options = self.options
        self.policy = self.make_policy(env)
        self.reward_loss = make_reward_loss(self, env, fixed_alpha=True, delay_qvalue=False)
        self.reward_loss.make_value_estimator(
            "retrace", gamma=options.loss.gamma, lmbda=options.loss.lmbda
        )
        reflection = reflection_of(self, env)
        components: dict[str, Any] = {}
        replay_losses: dict[str, CVaRCostLoss] = {}  # of the costs, those that learn from replay
        if options.safety_critic.kind == "quantiles":
            self.cost_losses = make_quantile_losses(self, env)
            self.cost_sums = components["cost_sums"] = CostSums(self, self.cost_losses, reflection)
        else:
            variance_reward = options.loss.variance_reward
            replay_losses = make_cost_losses(self, env, variance_reward=variance_reward)
            for loss in replay_losses.values():
                loss.make_value_estimator(gamma=options.loss.cost_gamma, lmbda=options.loss.lmbda)
            self.cost_losses = replay_losses
        critic_optim = make_critic_optim(self, self.reward_loss, replay_losses)
        self.buffer = make_slice_buffer(self)
        self.fit_critics = CriticFit(
            self, self.buffer, self.reward_loss, replay_losses, critic_optim, reflection
        )
        components |= {
            "reward_loss": self.reward_loss,
            **as_components(self, "cost_loss", self.cost_losses),
            "critic_optim": critic_optim,
            "buffer": self.buffer,
        }
        if options.update == "trust_region":
            self.distance = choose_distance(options)
            self.trust_region = make_trust_region(
                options.optim, self.policy, self.distance, options.device
            )
            gain = options.loss.limit_gain
            self.controllers = [LimitController(ki=gain) for _ in self.costs if gain]
            return {
                **components,
                "policy_optim": self.trust_region,
                "limit_controllers": nn.ModuleList(self.controllers),
            }
        # (9), the ablation
        adam = torch.optim.Adam(
            self.policy.parameters(), lr=options.lagrangian.policy_lr, fused=True
        )
        self.policy_steps = FiniteSteps(
            adam,
            max_grad_norm=options.optim.max_grad_norm,
            max_skipped=options.optim.max_skipped,
        )
        pid = options.pid if options.update == "pid" else None
        self.multiplier = Multiplier(len(self.costs), options.lagrangian, pid, options.device)
        return {**components, "policy_optim": adam, "multiplier": self.multiplier}

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Algorithm 1: critics on replayed slices, then the policy on the new states."""
        self.buffer.extend(batch.select(*replayed(self)))
        if self.cost_sums is not None:
            self.cost_sums.extend(batch)
        if self.frames < self.options.collector.init_frames:
            return {}
        metrics = self.fit_critics()
        if self.cost_sums is not None:
            metrics |= self.cost_sums.fit()
        with timeit("time/policy"):
            step = self._step if self.options.update == "trust_region" else self._ascend
            return step(batch, metrics)

    def hand_over(self) -> dict[str, float]:
        """Predictions rescaled by new episodes of the last policy."""
        metrics = {} if self.cost_sums is None else self.cost_sums.calibrate()
        return {f"final/{name}": value for name, value in metrics.items()}

    def _step(self, batch: TensorDictBase, metrics: dict[str, float]) -> dict[str, float]:
        """The trust region's step, (13), to limits that make up for where it ends above them."""
        optim, limits = self.options.optim, self.limits()
        levels = {name: loss.on_policy_cvar(batch) for name, loss in self.cost_losses.items()}
        for controller, name in zip(self.controllers, limits, strict=False):
            if levels[name].isfinite():  # if not, the trust region refuses its step
                limits[name] = controller.update(levels[name], limits[name])
        visited = batch.select(*self.in_keys).flatten()
        order = torch.randperm(len(visited), device=visited.device)
        states = visited[order[: optim.policy_frames]]
        closure = self.policy_closure(states, limits, batch, optim.curvature_frames, self.distance)
        return {**metrics, **self.report(self.trust_region.step(closure), limits)}

    def _ascend(self, batch: TensorDictBase, metrics: dict[str, float]) -> dict[str, float]:
        """The multipliers' step, then gradient steps up the Lagrangian."""
        limits = self.limits()
        levels = {name: loss.on_policy_cvar(batch) for name, loss in self.cost_losses.items()}
        priced = self.multiplier.react(self, levels)
        visited = batch.select(*self.in_keys).flatten()
        for states in minibatches(visited, self.options.lagrangian.minibatch_size):
            closure = self.policy_closure(states, limits)
            metrics |= ascend(self.policy_steps, closure, self.multiplier())
        metrics["update/skipped_steps"] += self.policy_steps.count()
        return {**metrics, **priced}

    def policy_closure(
        self,
        states: TensorDictBase,
        limits: Mapping[str, float],
        batch: TensorDictBase | None = None,
        curvature_frames: int | None = None,
        distance: Distance = DISTANCES["moment_matched"],
    ) -> Callable[[], TensorDict]:
        """Objective, constraints and statistics of (13) as a function of the policy's weights.

        How high the costs of the policy of now stand is measured on ``batch``; the critics say how
        a change that is kept will move them. Without, the constraints are (8) as written, of one
        action, as the objective is. The noise of the actions is drawn here, once: the line search
        then compares policies, not draws. Curvature is that of the first ``curvature_frames``
        states, all of them by default.
        """
        policy, losses = self.policy, self.cost_losses
        with torch.no_grad():
            dist = policy.get_dist(states)
            noise = dist.draw_noise()
            measured: dict[str, Any] = {}
            if batch is not None:
                action = dist.rsample(noise=noise)
                for name, loss in losses.items():
                    measured[name] = loss.measure(batch, action, states=states)

        def constraint(name: str, loss: CVaRCostLoss | QuantileCostLoss, action: Tensor) -> Tensor:
            if batch is None:
                return loss.cvar(states, action).mean() - limits[name]
            return loss.constraint(states, action, measured[name], cost_limit=limits[name])

        def closure() -> TensorDict:
            dist = policy.get_dist(states)
            action, log_prob = dist.rsample_and_log_prob(noise=noise)
            constraints = [constraint(name, loss, action) for name, loss in losses.items()]
            out = {
                "objective": self.reward_loss.objective(states, action, log_prob).mean(),
                "constraint": torch.stack(constraints),
                "statistics": distance.statistics(dist),
            }
            if curvature_frames is not None:
                some = policy.get_dist(states[:curvature_frames])
                out["curvature_statistics"] = distance.statistics(some)
            return TensorDict(out)

        return closure


def choose_distance(options: SafeTACOptions) -> Distance:
    """The distance of ``optim.kl``.

    ``auto`` is the paper's for the robot that learns more with it, and for the others the one that
    keeps components from collapsing (docs/experiments.md, "The distance of mixtures").
    """
    if options.optim.kl != "auto":
        return DISTANCES[options.optim.kl]
    env = options.env
    on_point = env.name == "robot" and "point" in (env.robot, robot_of(env.task))
    return DISTANCES["moment_matched" if on_point else "matched_bound"]
