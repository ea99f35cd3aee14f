"""Every way to misuse the public API or a configuration: a message that helps, and nothing changed.

Each case says what its message must name: the argument, the value it was given, and what is
allowed. Whatever has a state is compared before and after, and so is the random state of torch.
"""

from __future__ import annotations

import copy
import importlib.util
import math
from collections.abc import Callable
from functools import cache, partial, reduce
from typing import Any, NamedTuple

import doggo_controller
import gymnasium
import numpy as np
import pytest
import retrace_sac
import torch
from tensordict import TensorDict
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import nn
from torch.utils._pytree import tree_leaves
from torchrl.data import Bounded, Unbounded
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP, ValueOperator
from torchrl.objectives import SoftUpdate
from torchrl.objectives.utils import ValueEstimators

from torchrl_safe import (
    CVaRCostLoss,
    GMMTanhPolicy,
    RetraceEstimator,
    TanhGaussianMixture,
    TrustRegionSafeOptimizer,
    TsallisLoss,
    envs,
    record,
)
from torchrl_safe.modules import (
    DeterministicAction,
    DeterministicPolicy,
    GMMParamExtractor,
    divergences,
    export_policy,
    mixture_moments,
)
from torchrl_safe.objectives import (
    CVaRSurrogateLoss,
    LagrangeMultiplier,
    LimitController,
    PIDMultiplier,
    QuantileCostLoss,
    ReturnSurrogateLoss,
    exact_penalty,
    lagrangian,
    value,
)
from torchrl_safe.objectives import functional as F
from torchrl_safe.trainers import METHODS
from torchrl_safe.trainers.options import describe

NAN, INF = math.nan, math.inf
SPEC = Bounded(-1.0, 1.0, (2,))


class Misuse(NamedTuple):
    call: Callable[[], Any]
    error: type[Exception]
    says: tuple[str, ...]  # the argument, the value, what is allowed
    state: Callable[[], Any]


CASES: dict[str, Misuse] = {}


def bad(
    name: str,
    call: Callable[..., Any],
    error: type[Exception],
    *says: str,
    state: Callable[[], Any] = tuple,
) -> None:
    assert name not in CASES, name
    CASES[name] = Misuse(call, error, says, state)


def each(
    owner: str,
    call: Callable[..., Any],
    argument: str,
    values: tuple[Any, ...],
    allowed: str,
    error: type[Exception] = ValueError,
    **options: Any,
) -> None:
    """One case per value of an argument."""
    for wrong in values:
        shown = repr(wrong) if isinstance(wrong, str) else str(wrong)
        bad(
            f"{owner}: {argument}={wrong!r}",
            partial(call, **{argument: wrong}),
            error,
            argument,
            shown,
            allowed,
            **options,
        )


def zeros(*shape: int) -> torch.Tensor:
    return torch.zeros(shape)


# What objects are made of.


@cache
def policy() -> GMMTanhPolicy:
    torch.manual_seed(0)
    return GMMTanhPolicy(MLP(3, 10, num_cells=[4]), SPEC, num_components=2)


@cache  # a case draws no random numbers for it
def critic(key: str, *, inputs: int = 5, positive: bool = False) -> ValueOperator:
    last = [nn.Softplus()] if positive else []
    keys = ["observation", "action"] if inputs == 5 else ["observation"]
    return ValueOperator(MLP(inputs, 1, num_cells=[4]).extend(last), in_keys=keys, out_keys=[key])


@cache
def two_densities() -> ProbabilisticTensorDictSequential:
    """An actor whose action has two parts, each with a density of its own."""
    parts = dict.fromkeys(("speed", "turn"), torch.distributions.Normal)
    return ProbabilisticTensorDictSequential(
        TensorDictModule(nn.Identity(), ["observation"], ["params"]),
        ProbabilisticTensorDictModule(
            ["params"],
            list(parts),
            distribution_class=CompositeDistribution,
            distribution_kwargs={"distribution_map": parts},
            return_log_prob=True,
        ),
    )


def make_tsallis(**options: Any) -> TsallisLoss:
    return TsallisLoss(policy(), critic("state_action_value"), **options)


def make_cvar(**options: Any) -> CVaRCostLoss:
    networks = critic("cost_value"), critic("cost_std", positive=True)
    return CVaRCostLoss(policy(), *networks, **{"cost_limit": 1.0, **options})


def make_quantile(**options: Any) -> QuantileCostLoss:
    return QuantileCostLoss(policy(), critic("cost_quantiles"), **{"cost_limit": 1.0, **options})


def make_surrogate(**options: Any) -> CVaRSurrogateLoss:
    networks = critic("cost_value", inputs=3), critic("cost_variance", inputs=3, positive=True)
    return CVaRSurrogateLoss(*networks, **{"cost_limit": 1.0, **options})


tsallis, cvar, surrogate = cache(make_tsallis), cache(make_cvar), cache(make_surrogate)
quantile = cache(lambda: make_quantile().make_value_estimator())


@cache
def return_surrogate() -> ReturnSurrogateLoss:
    return ReturnSurrogateLoss(critic("state_value", inputs=3))


for make in (policy, tsallis, cvar, surrogate, return_surrogate):
    make()
SoftUpdate(tsallis(), tau=0.5)  # without, TorchRL warns
tsallis().make_value_estimator("td0", gamma=0.9)


def data(*without: str) -> TensorDict:
    """Trajectories [2, 4], without some entries."""
    flags = {name: torch.zeros(2, 4, 1, dtype=torch.bool) for name in ("done", "terminated")}
    rewards = {name: torch.ones(2, 4, 1) for name in ("reward", "cost")}
    following = {"observation": zeros(2, 4, 3), **rewards, **flags}
    td = TensorDict(
        observation=zeros(2, 4, 3),
        action=zeros(2, 4, 2),
        action_log_prob=zeros(2, 4),
        next=TensorDict(following, [2, 4]),
        batch_size=[2, 4],
    )
    return td.exclude(*without)


def weights(module: Callable[[], nn.Module]) -> Callable[[], Any]:
    return lambda: module().state_dict()


# The equations.

q_values = (0, -1.0, NAN, INF, "two", True, torch.ones(()))
each("q_logarithm", partial(F.q_logarithm, zeros(3)), "entropic_index", q_values, "positive finite")
each(
    "uniform_tsallis_entropy",
    partial(F.uniform_tsallis_entropy, 1.0),
    "entropic_index",
    (0.0, -2.0),
    "positive finite",
)
risk_levels = (0, -0.1, 1.5, NAN, "low")
each("cvar_factor", F.cvar_factor, "risk_level", risk_levels, "in (0, 1]")
each(
    "gaussian_cvar",
    partial(F.gaussian_cvar, zeros(3), zeros(3)),
    "risk_level",
    (0.0, 2.0),
    "(0, 1]",
)
bad(
    "gaussian_cvar: shapes",
    lambda: F.gaussian_cvar(zeros(3), zeros(4), 0.5),
    ValueError,
    "std",
    "(4,)",
    "(3,)",
)
gammas = (1.0, -0.1, NAN, 2)
each("discounted_cost_limit", partial(F.discounted_cost_limit, 0.1), "gamma", gammas, "in [0, 1)")
each(
    "discounted_cost_limit",
    partial(F.discounted_cost_limit, gamma=0.9),
    "cost_rate",
    (-0.1, NAN),
    "at least 0",
)
each(
    "surrogate_change",
    partial(F.surrogate_change, zeros(3), zeros(3), zeros(3), zeros(3)),
    "gamma",
    gammas,
    "in [0, 1)",
)
bad(
    "surrogate_change: shapes",
    lambda: F.surrogate_change(zeros(3), zeros(3), zeros(3, 1), zeros(3), 0.9),
    ValueError,
    "log_mu",
    "(3, 1)",
    "that of log_prob",
)
each(
    "clipped_surrogate",
    partial(F.clipped_surrogate, zeros(3), zeros(3), zeros(3)),
    "clip_epsilon",
    (0.0, 1.0, NAN),
    "in (0, 1)",
)
for name in ("kl_weight", "max_kl"):
    each(
        "focops_loss",
        partial(F.focops_loss, *[zeros(3)] * 4, kl_weight=1.0, max_kl=0.1),
        name,
        (0.0, -1.0, NAN, INF),
        "positive finite number",
    )
for name, wrong, allowed in (
    ("gamma", (-0.1, 1.0, NAN), "in [0, 1)"),
    ("lmbda", (-0.1, 1.1, NAN), "in [0, 1]"),
):
    each(
        "cup_loss",
        partial(F.cup_loss, *[zeros(3)] * 3, zeros(3, 2), zeros(2), gamma=0.9, lmbda=0.9),
        name,
        wrong,
        allowed,
    )
for name, call in (
    ("clipped_surrogate", lambda: F.clipped_surrogate(zeros(3), zeros(3), zeros(3, 1), 0.2)),
    (
        "focops_loss",
        lambda: F.focops_loss(*[zeros(3)] * 3, zeros(3, 1), kl_weight=1.0, max_kl=0.1),
    ),
    (
        "cup_loss",
        lambda: F.cup_loss(*[zeros(3)] * 3, zeros(3, 1), zeros(2), gamma=0.9, lmbda=0.9),
    ),
):
    bad(f"{name}: shapes", call, ValueError, "advantage", "(3, 1)", "log_prob")
EYE = torch.eye(2)
for name, moments in {
    "old_cov": (zeros(2), torch.eye(3), zeros(2), EYE),
    "new_mean": (zeros(2), EYE, zeros(3), EYE),
    "new_cov": (zeros(2), EYE, zeros(2), zeros(2)),
}.items():
    bad(
        f"moment_matched_kl: {name}",
        partial(divergences.moment_matched_kl, *moments),
        ValueError,
        name,
        str(tuple(moments[("old_mean", "old_cov", "new_mean", "new_cov").index(name)].shape)),
        "must have shape (2",
    )
bad(
    "categorical_kl: new_logits",
    lambda: divergences.categorical_kl(zeros(5, 3), zeros(5, 2)),
    ValueError,
    "new_logits",
    "(5, 2)",
    "must have shape (5, 3)",
)
MIXTURE = {
    f"{age}_{name}": torch.ones(shape)
    for age in ("old", "new")
    for name, shape in (("logits", (5, 3)), ("loc", (5, 3, 2)), ("scale", (5, 3, 2)))
}
for name in (name for name in MIXTURE if name != "old_loc"):
    bad(
        f"matched_bound_kl: {name}",
        partial(divergences.matched_bound_kl, **{**MIXTURE, name: zeros(5, 1)}),
        ValueError,
        name,
        "(5, 1)",
        "must have shape (5, 3",
    )
bad(
    "lagrangian: shapes",
    lambda: lagrangian(zeros(), zeros(2), zeros(3)),
    ValueError,
    "multiplier",
    "(3,)",
    "[m]",
)
bad(
    "exact_penalty: shapes",
    lambda: exact_penalty(zeros(2), zeros(3), 1.0),
    ValueError,
    "objective",
    "(2,)",
    "[m]",
)
each(
    "exact_penalty",
    partial(exact_penalty, zeros(), zeros(2)),
    "penalty",
    (0.0, -1.0, NAN, INF),
    "positive finite number",
)

# Multipliers.

priced = partial(lagrangian, zeros(), constraint=zeros(2), multiplier=zeros(2))
for name, wrong, allowed in (
    ("multiplier", [1.0, -2.0], "finite and at least 0"),
    ("multiplier", [1.0, INF], "finite and at least 0"),
    ("constraint", [NAN, 1.0], "finite"),
):
    call = partial(priced, **{name: torch.tensor(wrong)})
    bad(f"lagrangian: {name}={wrong}", call, ValueError, name, str(wrong), allowed)
counts = (0, -1, 1.5, True)
each("LagrangeMultiplier", LagrangeMultiplier, "num_constraints", counts, "integer, at least 1")
at_least_0 = "a finite number, at least 0"
each("LagrangeMultiplier", LagrangeMultiplier, "init", (-1.0, NAN, INF, "1"), at_least_0)
multiplier = cache(LagrangeMultiplier)
pid = cache(lambda: PIDMultiplier(2, kp=1.0, ki=0.1))
for name, owner, call in (
    ("LagrangeMultiplier.loss", multiplier, lambda c: multiplier().loss(c)),
    ("PIDMultiplier.update", pid, lambda c: pid().update(c)),
):
    m = len(owner()())
    bad(
        f"{name}: shape",
        partial(call, zeros(3)),
        ValueError,
        "constraint",
        "(3,)",
        f"must have shape ({m},)",
        state=weights(owner),
    )
    bad(
        f"{name}: NaN",
        partial(call, torch.full((m,), NAN)),
        ValueError,
        "constraint",
        "nan",
        "must be finite",
        state=weights(owner),
    )
for name, values, allowed in (
    ("kp", (-1.0, NAN, INF), "at least 0"),
    ("ki", (0.0, -1.0, NAN), "positive finite number"),
    ("tighten", (-0.1, 1.5, NAN), "at least 0, at most 1"),
    ("loosen", (-0.1, NAN, INF), "at least 0"),
):
    each("LimitController", LimitController, name, values, allowed)
controller = cache(LimitController)
for name, values, allowed in (
    ("level", (NAN, INF), "finite number"),
    ("cost_limit", (-1.0, NAN, INF), "finite number, at least 0"),
):
    each(
        "LimitController.update",
        lambda **option: controller().update(**{"level": 1.0, "cost_limit": 1.0, **option}),
        name,
        values,
        allowed,
        state=lambda: controller().integral.item(),
    )
make_pid = partial(PIDMultiplier, kp=1.0, ki=1.0)
each("PIDMultiplier", make_pid, "num_constraints", (0, 1.5), "at least 1")
for name in ("kp", "ki", "kd", "init"):
    each("PIDMultiplier", make_pid, name, (-1.0, NAN, INF, True), at_least_0)
bad(
    "PIDMultiplier: gains", lambda: PIDMultiplier(kp=0.0, ki=0.0), ValueError, "ki", "0", "positive"
)
bad(
    "PIDMultiplier: init without ki",
    lambda: PIDMultiplier(kp=1.0, ki=0.0, init=2.0),
    ValueError,
    "init=2.0",
    "ki=0.0",
    "positive ki",
)

# Losses.

each("TsallisLoss", make_tsallis, "entropic_index", q_values, "positive finite")
bad(
    "TsallisLoss.entropic_index: set",
    lambda: setattr(tsallis(), "entropic_index", -3.0),
    ValueError,
    "entropic_index",
    "-3.0",
    "positive finite",
    state=weights(tsallis),
)
each("TsallisLoss", make_tsallis, "num_qvalue_nets", counts, "integer, at least 1")
each("TsallisLoss", make_tsallis, "alpha_init", (0.0, -1.0, NAN, INF, True), "positive finite")
each("TsallisLoss", make_tsallis, "max_alpha", (0.0, NAN, "1"), "positive finite")
each("TsallisLoss", make_tsallis, "min_alpha", (-1.0, NAN, INF), at_least_0)
each("TsallisLoss", partial(make_tsallis, max_alpha=0.5), "min_alpha", (0.7,), "most max_alpha=0.5")
each("TsallisLoss", make_tsallis, "target_entropy", (NAN, "max", True), "'auto' or a finite number")
each("TsallisLoss", make_tsallis, "scalar_output_mode", ("mean",), "'exclude' or 'non_tensor'")
bad(
    "TsallisLoss: an actor of two densities",
    lambda: TsallisLoss(two_densities(), critic("state_action_value")),
    ValueError,
    "actor_network",
    "log_prob_keys=",
    "one log-density",
)
for value_type in ("gae", "td", 3, ValueEstimators.GAE, nn.Linear):
    bad(
        f"TsallisLoss.make_value_estimator: {value_type!r}",
        partial(tsallis().make_value_estimator, value_type),
        ValueError,
        "value_type",
        repr(value_type),
        "'td0', 'td1', 'tdlambda', 'retrace'",
        state=lambda: (tsallis().value_type, tsallis().state_dict()),
    )
each(
    "TsallisLoss.make_value_estimator",
    tsallis().make_value_estimator,
    "gamma",
    (-0.1, 1.5, NAN, "one"),
    "at least 0, at most 1",
)
for key, says in (
    (("next", "reward"), "the reward"),
    (("next", "done"), "the end of trajectories"),
    ("action", "an input of qvalue_network"),
):
    bad(
        f"TsallisLoss: no {key}",
        lambda key=key: tsallis()(data(key)),
        KeyError,
        repr(key[-1] if isinstance(key, tuple) else key),
        says,
        "is not in the tensordict",
        state=weights(tsallis),
    )
flat_reward = data()
flat_reward["next", "reward"] = zeros(2, 4)
bad(
    "TsallisLoss: a reward without feature",
    lambda: tsallis()(flat_reward),
    ValueError,
    "'reward'",
    "got (2, 4)",
    "a last dimension of 1",
    state=weights(tsallis),
)
bad(
    "TsallisLoss: a target without feature",
    lambda: tsallis()(data().set("qvalue_target", zeros(2, 4))),
    ValueError,
    "'qvalue_target'",
    "got (2, 4)",
    "(2, 4, 1)",
    state=weights(tsallis),
)
each("CVaRCostLoss", make_cvar, "cost_limit", (-1.0, NAN, INF), "finite number, at least 0")
each("CVaRCostLoss", make_cvar, "risk_level", risk_levels, "in (0, 1]")
each("CVaRCostLoss", make_cvar, "num_cost_nets", (0, 1.5, True), "at least 1")
each(
    "CVaRCostLoss", make_cvar, "variance_reward", ("none",), "one of ['second_moment', 'td_error']"
)
for name, values, allowed in (
    ("cost_limit", (-1.0, NAN, INF), "finite number, at least 0"),
    ("risk_level", risk_levels, "in (0, 1]"),
    ("num_cost_nets", (0, 1.5, True), "at least 1"),
    ("num_samples", (0, 1.5, True), "at least 1"),
    ("kappa", (-1.0, NAN, INF), "finite number, at least 0"),
    ("pessimism", (-1.0, NAN, INF), "finite number, at least 0"),
    ("pessimism", (1.0,), "num_cost_nets of at least 2"),
    ("level", ("median",), "one of 'mean', 'realised'"),
    ("reduction", ("median",), "one of 'none', 'mean', 'sum'"),
):
    each("QuantileCostLoss", make_quantile, name, values, allowed)
each(
    "CVaRSurrogateLoss", make_surrogate, "cost_limit", (-1.0, NAN, INF), "finite number, at least 0"
)
each("CVaRSurrogateLoss", make_surrogate, "risk_level", risk_levels, "in (0, 1]")
for owner, make in {
    "TsallisLoss": make_tsallis,
    "CVaRCostLoss": make_cvar,
    "CVaRSurrogateLoss": make_surrogate,
    "ReturnSurrogateLoss": partial(ReturnSurrogateLoss, critic("state_value", inputs=3)),
}.items():
    each(owner, make, "loss_function", ("l3",), "one of 'l1', 'l2', 'smooth_l1'")
    each(owner, make, "reduction", ("median",), "one of 'none', 'mean', 'sum'")
for owner, loss in {
    "CVaRCostLoss": cvar,
    "QuantileCostLoss": quantile,
    "CVaRSurrogateLoss": surrogate,
    "ReturnSurrogateLoss": return_surrogate,
}.items():
    name = f"{owner}.make_value_estimator"
    make = loss().make_value_estimator
    each(name, make, "gamma", gammas, "in [0, 1)", state=weights(loss))
    allowed = "in [0, 1]"
    if loss is quantile:  # its default, sums of real costs, has no lambda
        make, allowed = partial(make, "tdlambda"), "at least 0, at most 1"
    each(name, make, "lmbda", (-0.1, 1.5), allowed, state=weights(loss))
bad(
    "CVaRCostLoss.make_value_estimator: value_type",
    lambda: cvar().make_value_estimator(ValueEstimators.GAE),
    ValueError,
    "value_type",
    "GAE",
    "one of 'td0', 'td1', 'tdlambda', 'retrace'",
    state=weights(cvar),
)
bad(
    "ReturnSurrogateLoss.make_value_estimator: value_type",
    lambda: return_surrogate().make_value_estimator(ValueEstimators.GAE),
    ValueError,
    "value_type",
    "GAE",
    "RetraceEstimator or None",
)
bad(
    "TsallisLoss.objective: log_prob",
    lambda: tsallis().objective(data(), zeros(2, 4, 2), zeros(2, 4, 1)),
    ValueError,
    "log_prob",
    "(2, 4, 1)",
    "same shape",
    state=weights(tsallis),
)
bad(
    "CVaRCostLoss.constraint: measured",
    lambda: cvar().constraint(data(), zeros(2, 4, 2), torch.tensor(3.0)),
    TypeError,
    "measured",
    "Tensor",
    "what measure(...) returned",
    state=weights(cvar),
)
bad(
    "CVaRSurrogateLoss.constraint: measured",
    lambda: surrogate().constraint(data(), zeros(2, 4), torch.tensor(3.0)),
    TypeError,
    "measured",
    "Tensor",
    "what measure(...) returned",
    state=weights(surrogate),
)
bad(
    "CVaRSurrogateLoss.level: measured",
    lambda: surrogate().level(torch.tensor(3.0)),
    TypeError,
    "measured",
    "Tensor",
    "what measure(...) returned",
    state=weights(surrogate),
)
bad(
    "ReturnSurrogateLoss.objective: no advantage",
    lambda: return_surrogate().objective(data(), zeros(2, 4)),
    KeyError,
    "'advantage'",
    "is missing",
    "compute_advantage",
)
bad(
    "CVaRSurrogateLoss.constraint: no advantage",
    lambda: surrogate().constraint(data(), zeros(2, 4), surrogate().measure(data())),
    KeyError,
    "'cost_advantage'",
    "is missing",
    "compute_advantage",
)
bad(
    "TsallisLoss: no next observation",
    lambda: tsallis()(data(("next", "observation"))),
    KeyError,
    '"observation"',
    "not found",
    "in TensorDict with keys",
    state=weights(tsallis),
)
for owner, loss, key in (
    ("CVaRCostLoss", cvar, ("next", "observation")),
    ("QuantileCostLoss", quantile, ("next", "observation")),
    ("CVaRSurrogateLoss", surrogate, "observation"),
):
    bad(
        f"{owner}: no {key}",
        lambda loss=loss, key=key: loss()(data(key)),
        KeyError,
        "observation",
        "is not in the tensordict",
        "which has",
        state=weights(loss),
    )
for owner, loss in {
    "CVaRCostLoss": cvar,
    "QuantileCostLoss": quantile,
    "CVaRSurrogateLoss": surrogate,
}.items():
    for name, values, allowed in (
        ("cost_limit", (-1.0, NAN, INF, "1"), "finite number, at least 0"),
        ("risk_level", risk_levels, "in (0, 1]"),
    ):
        each(
            f"{owner}, when it is set",
            lambda loss=loss, **option: [setattr(loss(), *pair) for pair in option.items()],
            name,
            values,
            allowed,
            state=weights(loss),
        )

# Retrace.

make_retrace = partial(RetraceEstimator, gamma=0.9, lmbda=0.9)
for name in ("gamma", "lmbda"):
    each("RetraceEstimator", make_retrace, name, (-0.1, 1.5, NAN), "one number in [0, 1]")
each("RetraceEstimator", make_retrace, "num_next_actions", (0,), "at least 1")
each("RetraceEstimator", make_retrace, "action_space", ("binary",), "one-hot")
bad(
    "RetraceEstimator: no time",
    lambda: make_retrace()(data()[0, 0]),
    RuntimeError,
    "tensordict",
    "batch_size=()",
    "trajectories",
)
entries = {"policy_log_prob": zeros(2, 4), "state_action_value": zeros(2, 4, 1)}
following = {("next", "state_value"): zeros(2, 4, 1)}
whole = data().update({**entries, **following})
for key in (
    "action_log_prob",
    "policy_log_prob",
    "state_action_value",
    ("next", "state_value"),
    ("next", "reward"),
    ("next", "done"),
):
    lacking = whole.exclude(key)
    bad(
        f"RetraceEstimator: no {key}",
        lambda td=lacking: make_retrace()(td),
        KeyError,
        str(key[-1] if isinstance(key, tuple) else key),
        "the ",
        "tensordict",
        state=lambda td=lacking: td.to_dict(),
    )
bad(
    "RetraceEstimator.for_loss: no critic",
    lambda: RetraceEstimator.for_loss(surrogate(), gamma=0.9, lmbda=0.9),
    ValueError,
    "actor",
    "CVaRSurrogateLoss",
    "critic of states and actions",
)
bad(
    "RetraceEstimator.for_loss: shifted",
    lambda: RetraceEstimator.for_loss(tsallis(), gamma=0.9, lmbda=0.9, shifted=True),
    ValueError,
    "shifted",
    "True",
    "the loss computes",
    state=weights(tsallis),
)
bad(
    "RetraceEstimator: an actor of two densities",
    lambda: make_retrace(actor_network=two_densities()),
    ValueError,
    "actor_network",
    "['speed_log_prob', 'turn_log_prob']",
    "one log-density for the whole action",
)
column = zeros(4, 1)
traces = {
    "retrace": (column, column),
    "importance_sampling": (column, column),
    "tree_backup": (column, None),
    "q_lambda": (None, None),
}
for trace, densities in traces.items():
    name, no = f"trace_lambda_return_estimate, {trace}", column.bool()

    def estimate(
        gamma=0.9,
        lmbda=0.9,
        action_value=column,
        next_state_value=column,
        done=no,
        time_dim=-2,
        trace=trace,
        densities=densities,
    ):
        return value.trace_lambda_return_estimate(
            *(gamma, lmbda, *densities, action_value, next_state_value, column, done),
            trace=trace,
            time_dim=time_dim,
        )

    each(name, estimate, "gamma", (-0.1, 1.1, NAN), "in [0, 1]")
    each(name, estimate, "lmbda", (2.0,), "in [0, 1]")
    each(name, estimate, "time_dim", (-1, 5), "dimension of reward other than its last")
    for argument in ("action_value", "next_state_value"):
        bad(
            f"{name}: {argument} of another shape",
            partial(estimate, **{argument: zeros(5, 1)}),
            ValueError,
            argument,
            "(5, 1)",
            "must have shape (4, 1)",
        )
    bad(
        f"{name}: done of floats",
        partial(estimate, done=column),
        TypeError,
        "done",
        "torch.float32",
        "must be boolean",
    )
    for i, missing in enumerate(("log_pi", "log_mu")):
        if densities[i] is not None:
            bad(
                f"{name}: without {missing}",
                partial(estimate, densities=[column] * i + [None] * (2 - i)),
                ValueError,
                missing,
                "got None",
                f"a tensor for trace={trace!r}",
            )
each(
    "trace_lambda_return_estimate",
    lambda trace: estimate(trace=trace, densities=(column, column)),
    "trace",
    ("v_trace",),
    "'importance_sampling'",
)
for function in (value.retrace_variance_reward, value.squared_td_error):
    name = function.__name__
    each(
        name,
        lambda gamma, function=function: function(gamma, column, column, column, column.bool()),
        "gamma",
        (-0.1, 1.1),
        "in [0, 1]",
    )
    bad(
        f"{name}: shape",
        partial(function, 0.9, column, zeros(3, 1), column, column.bool()),
        ValueError,
        "action_value",
        "(3, 1)",
        "must have shape (4, 1)",
    )
    bad(
        f"{name}: terminated",
        partial(function, 0.9, column, column, column, column),
        TypeError,
        "terminated",
        "torch.float32",
        "must be boolean",
    )
for key in ("observation", "action"):
    bad(
        f"evaluate_policy: no {key}",
        lambda key=key: value.evaluate_policy(data(key), policy()),
        KeyError,
        key,
        "batch size (2, 4)",
        "not in the tensordict",
        state=weights(policy),
    )
bad(
    "evaluate_policy: time_dim",
    lambda: value.evaluate_policy(data(), policy(), shifted=True, time_dim=2),
    ValueError,
    "time_dim",
    "got 2",
    "batch size (2, 4)",
    state=weights(policy),
)

# The policy.

NETWORK = nn.Linear(3, 10)


def make_policy(spec: Any = SPEC, **options: Any) -> GMMTanhPolicy:
    return GMMTanhPolicy(NETWORK, spec, **{"num_components": 2, **options})


each("GMMTanhPolicy", make_policy, "num_components", (0, -1, 1.5), "at least 1")
each("GMMTanhPolicy", make_policy, "relaxation", ("soft",), "one of ('gumbel_softmax'")
each("GMMTanhPolicy", make_policy, "temperature", (0.0, -1.0, NAN, INF), "positive and finite")
each("GMMTanhPolicy", make_policy, "log_std_bounds", ((2.0, -4.0), (0.0, INF)), "increasing")
bad(
    "GMMTanhPolicy: unbounded",
    lambda: make_policy(Unbounded((2,))),
    TypeError,
    "action_spec",
    "Unbounded",
    "Bounded spec of floating type",
)
bad(
    "GMMTanhPolicy: infinite bounds",
    lambda: make_policy(Bounded(-INF, 1.0, (2,))),
    ValueError,
    "action_spec",
    "inf",
    "finite bounds",
)
bad(
    "GMMTanhPolicy: network",
    lambda: make_policy(num_components=3)(data()),
    ValueError,
    "num_components",
    "(2, 4, 10)",
    "15",
)
make_deterministic = partial(DeterministicPolicy, nn.Linear(3, 2), SPEC)
each("DeterministicPolicy", make_deterministic, "noise", (0.0, -1.0, NAN, INF), "positive finite")
bad(
    "DeterministicPolicy: infinite bounds",
    lambda: DeterministicPolicy(NETWORK, Bounded(-INF, 1.0, (2,))),
    ValueError,
    "action_spec",
    "inf",
    "finite bounds",
)
make_extractor = partial(GMMParamExtractor, num_components=2, action_dim=2)
each("GMMParamExtractor", make_extractor, "num_components", (0, 2.0), "at least 1")
each("GMMParamExtractor", make_extractor, "action_dim", (0, 2.0), "at least 1")
each("GMMParamExtractor", make_extractor, "log_std_bounds", ((1.0, 1.0),), "increasing")
PARAMETERS = {"logits": zeros(5, 3), "loc": zeros(5, 3, 2), "scale": torch.ones(5, 3, 2)}
for name, wrong in (("logits", zeros(5, 2)), ("loc", zeros(5, 3, 1)), ("scale", zeros(5, 3))):
    for function in (TanhGaussianMixture, mixture_moments):
        bad(
            f"{function.__name__}: {name}",
            partial(function, **{**PARAMETERS, name: wrong}),
            ValueError,
            name,
            str(tuple(wrong.shape)),
            "[*B, K, D]",
        )
make_mixture = partial(TanhGaussianMixture, **PARAMETERS)
each("TanhGaussianMixture", make_mixture, "low", (2.0, -INF, NAN), "low must be")
each("TanhGaussianMixture", make_mixture, "high", (INF, NAN), "must be finite")
each("TanhGaussianMixture", make_mixture, "temperature", (0.0, NAN), "positive and finite")
each("TanhGaussianMixture", make_mixture, "relaxation", ("none",), "one of ('gumbel_softmax'")
bad(
    "TanhGaussianMixture: low of another shape",
    lambda: make_mixture(low=zeros(3)),
    ValueError,
    "low",
    "(3,)",
    "must broadcast to [*B, D] = (5, 2)",
)
bad(
    "TanhGaussianMixture.log_prob: shape",
    lambda: make_mixture().log_prob(zeros(5, 3)),
    ValueError,
    "value",
    "(5, 3)",
    "[..., 2]",
)
bad(
    "TanhGaussianMixture.rsample: noise",
    lambda: make_mixture().rsample(noise=zeros(5, 3)),
    ValueError,
    "noise",
    "(5, 3)",
    "must have shape [*S, 5, 2]",
)
bad(
    "export_policy: path",
    lambda: export_policy(policy(), "policy.pkl", data()[0]),
    ValueError,
    "path",
    "'policy.pkl'",
    ".pt2 or .onnx",
)
bad(
    "export_policy: batch",
    lambda: export_policy(policy(), "policy.pt2", data()),
    ValueError,
    "example",
    "(2, 4)",
    "batch size [B]",
)
bad(
    "export_policy: keys",
    lambda: export_policy(policy(), "policy.pt2", data("observation")[0]),
    KeyError,
    "example",
    "'observation'",
    "the policy's in_keys",
)
bad(
    "DeterministicAction: inputs",
    lambda: DeterministicAction(policy())(zeros(4, 3), zeros(4, 3)),
    ValueError,
    "inputs",
    "2",
    "['observation']",
)

# The trust region.


@cache
def parameter() -> nn.Parameter:
    return nn.Parameter(torch.tensor([0.5, -0.5]))


@cache
def optimizer() -> TrustRegionSafeOptimizer:
    return TrustRegionSafeOptimizer([parameter()], max_kl=0.1)


OLD = torch.tensor([0.5, -0.5])


def step(optim: Callable[[], TrustRegionSafeOptimizer] = optimizer, **entries: Any) -> Any:
    """A step whose closure has entries changed, or left out if they are None."""

    def closure() -> TensorDict:
        x = parameter()
        right = {
            "objective": x.sum(),
            "constraint": (x[0] - 1)[None],
            "kl": 0.5 * (x - OLD).square().sum(),
        }
        changed = {**right, **entries}
        return TensorDict({name: v for name, v in changed.items() if v is not None})

    return optim().step(closure)


def optimizer_state() -> Any:
    return parameter().detach().clone(), copy.deepcopy(optimizer().state_dict())


make_optimizer = partial(TrustRegionSafeOptimizer, [nn.Parameter(OLD.clone())])
positive = (0.0, -1.0, NAN, INF, "small")
each("TrustRegionSafeOptimizer", make_optimizer, "max_kl", positive, "positive finite number")
each("TrustRegionSafeOptimizer", make_optimizer, "damping", (-1.0, NAN, INF), "at least 0")
each("TrustRegionSafeOptimizer", make_optimizer, "cg_iters", (0, 1.5), "an integer, at least 1")
each("TrustRegionSafeOptimizer", make_optimizer, "backtrack_ratio", (0.0, 1.0, NAN), "in (0, 1)")
each("TrustRegionSafeOptimizer", make_optimizer, "max_backtracks", (-1, 0.5), "at least 0")
each("TrustRegionSafeOptimizer", make_optimizer, "recovery_ratio", (0.0, 1.1, NAN), "in (0, 1]")
each("TrustRegionSafeOptimizer", make_optimizer, "statistics_kl", (3,), "callable", TypeError)
each("TrustRegionSafeOptimizer", make_optimizer, "projection", (1,), "True or False", TypeError)
each("TrustRegionSafeOptimizer", make_optimizer, "cuda_graph", (1,), "True or False", TypeError)
each("TrustRegionSafeOptimizer", make_optimizer, "cuda_graph", (True,), "on a CUDA device, got cpu")
bad(
    "TrustRegionSafeOptimizer: types of params",
    lambda: TrustRegionSafeOptimizer([nn.Parameter(zeros(1)), nn.Parameter(zeros(1).double())]),
    ValueError,
    "params",
    "torch.float64",
    "one floating-point dtype",
)
bad(
    "TrustRegionSafeOptimizer: groups",
    lambda: optimizer().add_param_group({"params": [nn.Parameter(zeros(1))]}),
    ValueError,
    "params",
    "several",
    "one group",
    state=optimizer_state,
)
for name, call, error, *says in (
    ("no closure", lambda: optimizer().step(None), TypeError, "closure", "None", "TensorDict"),
    (
        "a number",
        lambda: optimizer().step(lambda: 1.0),
        TypeError,
        "closure",
        "float",
        "must return a TensorDict",
    ),
    ("no objective", partial(step, objective=None), KeyError, "'objective'", "lacks", "'kl'"),
    ("no kl", partial(step, kl=None), KeyError, "'kl'", "lacks", "'objective'"),
    (
        "objective of a batch",
        partial(step, objective=zeros(3)),
        ValueError,
        "'objective'",
        "(3,)",
        "a scalar",
    ),
    ("kl of a batch", partial(step, kl=zeros(1)), ValueError, "'kl'", "(1,)", "a scalar"),
    (
        "a scalar constraint",
        partial(step, constraint=zeros()),
        ValueError,
        "'constraint'",
        "shape ()",
        "shape [m]",
    ),
    (
        "too many constraints",
        partial(step, constraint=zeros(11)),
        ValueError,
        "'constraint'",
        "(11,)",
        "at most 10",
    ),
    (
        "a constant objective",
        partial(step, objective=zeros()),
        ValueError,
        "'objective'",
        "does not",
        "must depend on the optimizer's parameters",
    ),
    (
        "a kl that is not zero",
        partial(step, kl=torch.tensor(1.0)),
        ValueError,
        "'kl'",
        "1.0",
        "must be zero",
    ),
    (
        "curvature statistics without statistics_kl",
        partial(step, curvature_statistics=zeros(1)),
        ValueError,
        "'curvature_statistics'",
        "None",
        "statistics_kl",
    ),
):
    bad(f"TrustRegionSafeOptimizer.step: {name}", call, error, *says, state=optimizer_state)

# Environments.

make_env = partial(envs.SafeGoalEnv, num_envs=3, num_threads=1)
ROBOT = "one of 'car', 'doggo', 'doggo_torques', 'jackal', 'point'"


@cache
def env() -> envs.SafeGoalEnv:
    env = make_env()
    env.reset()
    return env


def snapshot() -> dict[str, torch.Tensor]:
    return dict(env().state_dict())


each("SafeGoalEnv", make_env, "robot", ("unicycle", 3), ROBOT)
for name in ("num_envs", "num_threads", "episode_length"):
    each("SafeGoalEnv", make_env, name, (0, -1, 2.5, True), "an integer >= 1")
each("SafeGoalEnv", make_env, "seed", (-1, 1.5, "one"), "None or an integer >= 0")
each("SafeGoalEnv", make_env, "task", (envs.GoalTask, 3), "a task", TypeError)
each("SafeGoalEnv", make_env, "task", ("walk",), "one of goal, navigation")
each("SafeGoalEnv", make_env, "randomization", ({"mass": (1, 2)},), "Randomization", TypeError)
bad(
    "SafeGoalEnv: a task for robots with a footprint",
    lambda: make_env(task=envs.NavigationTask()),
    ValueError,
    "robot",
    "'point'",
    "footprint",
)
for name, action, *says in (
    ("shape", zeros(3, 3), "action", "(3, 3)", "(3, 2)"),
    ("NaN", torch.full((3, 2), NAN), "action", "environments [0, 1, 2]", "must be finite"),
    ("infinity", torch.tensor([[0, 0], [INF, 0], [0, 0]]), "action", "[1]", "must be finite"),
):
    bad(
        f"SafeGoalEnv.step: {name}",
        lambda action=action: env()._step(TensorDict({"action": action})),
        ValueError,
        *says,
        state=snapshot,
    )
bad(
    "SafeGoalEnv.step: before a reset",
    lambda: make_env()._step(TensorDict({"action": zeros(3, 2)})),
    RuntimeError,
    "reset",
    "before",
    "first step",
)
bad(
    "SafeGoalEnv.reset: mask",
    lambda: env()._reset(TensorDict({"_reset": torch.ones(4, dtype=torch.bool)})),
    ValueError,
    "_reset",
    "(4,)",
    "(3, 1)",
    state=snapshot,
)
bad(
    "SafeGoalEnv.set_seed: negative",
    lambda: env()._set_seed(-1),
    ValueError,
    "seed",
    "-1",
    ">= 0",
    state=snapshot,
)
for name in ("layout", "render"):
    each(
        f"SafeGoalEnv.{name}",
        lambda index, name=name: getattr(env(), name)(index),
        "index",
        (-1, 3),
        "in [0, 3)",
        state=snapshot,
    )
bad(
    "SafeGoalEnv.load_state_dict: entries",
    lambda: env().load_state_dict({"physics": zeros(3)}),
    ValueError,
    "snapshot",
    "['physics']",
    "must have the entries",
    state=snapshot,
)
bad(
    "SafeGoalEnv.load_state_dict: shape",
    lambda: env().load_state_dict({**env().state_dict(), "elapsed": zeros(4)}),
    ValueError,
    "'elapsed'",
    "(4,)",
    "(3,)",
    state=snapshot,
)
bad("get_robot", lambda: envs.get_robot("tank"), ValueError, "robot", "'tank'", ROBOT)
make_robot = lambda **options: type(envs.get_robot("point"))(  # noqa: E731
    **{**vars(envs.get_robot("point")), **options}
)
for name in ("timestep", "keepout"):
    each("Robot", make_robot, name, (0.0, -1.0, NAN), "positive and finite")
for name in ("substeps", "action_dim"):
    each("Robot", make_robot, name, (0, 1.5), "an integer >= 1")

for task, counts in ((envs.GoalTask, "num_hazards"), (envs.NavigationTask, "num_boxes")):
    owner = task.__name__
    each(owner, task, counts, (-1,), "at least 0")
    each(owner, task, counts, (1.5, True), "an int", TypeError)
    each(owner, task, "binary_cost", (1,), "a bool", TypeError)
    for name in ("goal_radius", "lidar_range", "cost_slope"):
        each(owner, task, name, (0.0, -1.0, NAN, INF), "positive and finite")
    each(owner, task, "lidar_bins", (0,), "at least")
each("GoalTask", envs.GoalTask, "goal_keepout", (9.0,), "smaller than extent=1.5")
each("GoalTask", envs.GoalTask, "hazard_keepout", (9.0,), "smaller than extent=1.5")
each("NavigationTask", envs.NavigationTask, "discount", (1.0,), "in (0, 1)")
each("NavigationTask", envs.NavigationTask, "wall_distance", (1.0,), "larger than grid_extent")
bad(
    "GoalTask: too many hazards",
    lambda: make_env(task=envs.GoalTask(num_hazards=60)),
    ValueError,
    "num_hazards",
    "60",
    "fewer hazards",
)
for name in ("mass", "friction", "actuator_gain"):
    each("Randomization", envs.Randomization, name, ((0.0, 1.0),), "must be positive")
    each("Randomization", envs.Randomization, name, ((2.0, 1.0), 1.0, (1.0, INF)), "(low, high)")
each("Randomization", envs.Randomization, "actuator_delay", ((0, 1.5),), "integers")
each("Randomization", envs.Randomization, "actuator_delay", ((-1, 1),), ">= 0")
each("Randomization", envs.Randomization, "sensor_noise", ((-0.1, 0.1),), ">= 0")
each("Randomization", envs.Randomization, "lidar_dropout", ((0.5, 1.5),), "in [0, 1]")

# Costs, checks, and the other interfaces.

for name in ("num_steps", "time_limit"):
    each(
        "check_safe_env",
        lambda **options: envs.check_safe_env(env(), **options),
        name,
        (0, -1),
        "must be positive",
        state=snapshot,
    )
bad(
    "CostToReward: no such observation",
    lambda: TransformedEnv(make_env(), envs.CostToReward("price")).full_reward_spec,
    KeyError,
    "observation",
    "'price'",
    "'violation'",
)
bad(
    "CostToReward: shape",
    lambda: TransformedEnv(make_env(), envs.CostToReward("observation")).full_reward_spec,
    ValueError,
    "'observation'",
    "(3, 24)",
    "(3, 1)",
)
bad(
    "CostToReward: violation_key",
    lambda: TransformedEnv(make_env(), envs.CostToReward("goal_met")).full_reward_spec,
    ValueError,
    "violation_key",
    "'violation'",
    "another",
)
bad(
    "cost_from_info: another environment",
    lambda: envs.cost_from_info(make_env()),
    TypeError,
    "env",
    "SafeRobotEnv",
    "GymWrapper or GymEnv",
)
for name in ("SafetyBudget", "Saute", "EarlyTermination"):
    make = partial(getattr(envs, name), budget=1.0)
    each(name, make, "budget", (0.0, -1.0, NAN, INF, "much"), "a positive finite number")
    each(name, make, "gamma", (0.0, 1.1, NAN), "at most 1")
each("Saute", partial(envs.Saute, 1.0), "unsafe_reward", (NAN, INF), "a finite number")
make = partial(envs.EarlyTermination, 1.0)
each("EarlyTermination", make, "termination_reward", (NAN, INF), "a finite number")
bad(
    "cost_from_info: frame_skip",
    lambda: envs.cost_from_info(GymEnv("torchrl_safe/PointGoal-v0", frame_skip=2)),
    ValueError,
    "frame_skip",
    "2",
    "SafeFrameSkip",
)


def priced() -> Any:
    env = envs.cost_from_info(GymEnv("torchrl_safe/PointGoal-v0"), cost="price")
    return env.step(env.reset().set("action", zeros(2)))


bad("cost_from_info: key", priced, KeyError, "info", "'price'", "'cost'")
bad(
    "cost_from_info: no costs",
    lambda: envs.cost_from_info(GymEnv("torchrl_safe/PointGoal-v0"), {}),
    ValueError,
    "cost",
    "[]",
    "at least one",
)
bad(
    "cost_from_info: kind",
    lambda: envs.cost_from_info(GymEnv("torchrl_safe/PointGoal-v0"), 3),
    TypeError,
    "cost",
    "3",
    "a key in info or a function",
)
bad(
    "cost_from_info: names",
    lambda: envs.cost_from_info(
        GymEnv("torchrl_safe/PointGoal-v0"), {"hazard": "cost"}, violation_above={"danger": 1.0}
    ),
    ValueError,
    "violation_above",
    "['danger']",
    "['hazard']",
)
bad(
    "CostToReward: violation_above",
    lambda: envs.CostToReward(violation_above=NAN),
    ValueError,
    "violation_above",
    "nan",
    "a number",
)

gym = cache(envs.GymRobotEnv)
vector = cache(lambda: envs.GymRobotVectorEnv(num_envs=3, num_threads=1, autoreset_mode="Disabled"))
many = partial(envs.GymRobotVectorEnv, num_envs=3, num_threads=1)
for make, interface, shape in ((gym, envs.GymRobotEnv, (2,)), (vector, many, (3, 2))):
    owner = "GymRobotEnv" if make is gym else "GymRobotVectorEnv"
    make().reset(seed=0)
    state = lambda make=make: make()._core.snapshot()  # noqa: E731
    each(owner, interface, "robot", ("unicycle",), ROBOT)
    each(owner, interface, "episode_length", (0,), "an integer >= 1")
    each(owner, interface, "render_mode", ("ascii",), "None or one of ['rgb_array'")
    for name, action, *says in (
        ("shape", np.zeros(5), "(5,)", f"shape {shape}"),
        ("kind", np.full(shape, "x"), "<U1", "must be numbers"),
        ("NaN", np.full(shape, NAN), "environments [0", "must be finite"),
    ):
        bad(
            f"{owner}.step: {name}",
            lambda action=action, make=make: make().step(action),
            ValueError,
            "action",
            *says,
            state=state,
        )
    bad(
        f"{owner}.reset: options",
        lambda make=make: make().reset(options={"speed": 1}),
        ValueError,
        "options",
        "'speed'",
        "unknown",
        state=state,
    )
    bad(
        f"{owner}.reset: seed",
        lambda make=make: make().reset(seed=-1),
        ValueError,
        "seed",
        "-1",
        ">= 0",
        state=state,
    )
each("GymRobotVectorEnv", many, "autoreset_mode", ("Never",), "'NextStep'")
each("GymRobotVectorEnv", many, "num_envs", (0,), "an integer >= 1")
bad(
    "GymRobotVectorEnv.reset: seeds",
    lambda: vector().reset(seed=[1, 2]),
    ValueError,
    "seed",
    "2 of them",
    "one or 3",
    state=lambda: vector()._core.snapshot(),
)
bad(
    "GymRobotVectorEnv.reset: mask",
    lambda: vector().reset(options={"reset_mask": np.zeros(2)}),
    ValueError,
    "reset_mask",
    "float64 (2,)",
    "bool array of shape (3,)",
    state=lambda: vector()._core.snapshot(),
)
bad(
    "gymnasium.make",
    lambda: gymnasium.make("torchrl_safe/TankGoal-v0"),
    gymnasium.error.NameNotFound,
    "Environment",
    "Tank",
    "oesn't exist",
)
if importlib.util.find_spec("dm_control"):
    from torchrl_safe.envs.interfaces import suite

    control = cache(lambda: suite.load(random=0))
    control().reset()
    control_state = lambda: control().task._core.snapshot()  # noqa: E731
    each("suite.load", suite.load, "robot", ("unicycle",), ROBOT)
    each("suite.load", suite.load, "task", ("push",), "one of goal, navigation")
    each("suite.load", suite.load, "episode_length", (0,), "an integer >= 1")
    each("suite.load", suite.load, "random", (-1,), ">= 0")
    bad(
        "suite.Physics.set_control: shape",
        lambda: control().physics.set_control(np.zeros(3)),
        ValueError,
        "action",
        "(3,)",
        "(2,)",
        state=control_state,
    )
    bad(
        "suite.Physics.step: nstep",
        lambda: control().physics.step(3),
        ValueError,
        "nstep",
        "3",
        "must be 10",
        state=control_state,
    )
    bad(
        "suite.SafeTask: NaN",
        lambda: control().step(np.full(2, NAN)),
        ValueError,
        "action",
        "[0]",
        "must be finite",
        state=control_state,
    )

# Records.


def act(td: Any) -> Any:
    return env().rand_action(td)


evaluate = partial(record.evaluate, env(), act, exploration_type=ExplorationType.RANDOM)
each("evaluate", evaluate, "num_steps", (0, -1), "at least 1", state=snapshot)
bad(
    "summarize: no episode",
    lambda: record.summarize(TensorDict({"score": zeros(0)}, [0])),
    ValueError,
    "episodes",
    "[0]",
    "at least one",
)
bad(
    "score: shapes",
    lambda: record.score(zeros(3), zeros(4)),
    ValueError,
    "violations",
    "(4,)",
    "same shape",
)
bad(
    "bootstrap_interval: shape",
    lambda: record.bootstrap_interval(zeros(3, 2)),
    ValueError,
    "values",
    "(3, 2)",
    "[N]",
)
bad(
    "proportion_interval: trials",
    lambda: record.proportion_interval(0, 0),
    ValueError,
    "trials",
    "0",
    "at least 1",
)
bad(
    "proportion_interval: successes",
    lambda: record.proportion_interval(5, 4),
    ValueError,
    "successes",
    "5",
    "in [0, 4]",
)
for function, key in (
    (record.batch_metrics, "cost"),
    (record.batch_metrics, "violation"),
    (record.count_violations, "violation"),
):
    steps = data().set(("next", "violation"), torch.zeros(2, 4, 1, dtype=torch.bool))
    bad(
        f"{function.__name__}: no {key}",
        partial(function, steps.exclude(("next", key))),
        KeyError,
        key,
        "is missing",
        "reward",
    )
    bad(
        f"{function.__name__}: {key} of another shape",
        partial(function, steps.clone().set(("next", key), zeros(2, 4, 2))),
        ValueError,
        key,
        "(2, 4, 2)",
        "(2, 4, 1)",
    )
bad(
    "batch_metrics: empty",
    lambda: record.batch_metrics(data()[:0]),
    ValueError,
    "td",
    "(0, 4)",
    "at least one step",
)
each(
    "discounted_sums",
    partial(record.discounted_sums, zeros(3)),
    "gamma",
    (-0.1, 1.1, NAN),
    "in [0, 1]",
)
episode = torch.ones(4, 200)
calibrate = lambda **options: record.calibrate(  # noqa: E731
    episode, episode, episode, **{"gamma": 0.9, "risk_level": 0.5, **options}
)
each("calibrate", calibrate, "gamma", gammas, "in [0, 1)")
each("calibrate", calibrate, "risk_level", (0.0, 1.5, NAN), "in (0, 1]")
each("calibrate", calibrate, "num_bins", (0,), "at least 1")
each("calibrate", calibrate, "tail", (0.0, 1.0, NAN), "in (0, 1)")
bad(
    "calibrate: short episodes",
    lambda: calibrate(gamma=0.9999),
    ValueError,
    "gamma",
    "0.9999",
    "longer episodes",
)
bad(
    "calibrate: shapes",
    lambda: record.calibrate(episode, zeros(4, 3), episode, gamma=0.9, risk_level=0.5),
    ValueError,
    "cvar",
    "(4, 3)",
    "one shape [N, T]",
)
for function in (record.read_metrics, partial(record.plot_learning_curves, path="curves.png")):
    bad(
        getattr(function, "__name__", "plot_learning_curves"),
        partial(function, "nowhere"),
        FileNotFoundError,
        "run_dir",
        "'nowhere'",
        "a directory",
    )
bad("draw_curves: none", lambda: record.draw_curves({}), ValueError, "runs", "{}", "at least one")
record_paths = partial(record.record_trajectories, env(), act, num_episodes=2)
each("record_trajectories", record_paths, "num_steps", (0,), "at least 1", state=snapshot)
each("record_trajectories", record_paths, "num_episodes", (0, 4), "in [1, 3]", state=snapshot)
bad(
    "plot_trajectories: none",
    lambda: record.plot_trajectories([], "paths.png"),
    ValueError,
    "trajectories",
    "none",
    "at least one",
)
film = partial(record.record_video, env(), act, path="film.mp4")
each("record_video", film, "path", ("film.gif",), "must end in .mp4", state=snapshot)
for name in ("num_steps", "every", "fps"):
    each("record_video", film, name, (0, -1), "must be positive", state=snapshot)
for name in ("width", "height"):
    each("record_video", film, name, (0, 31), "even number", state=snapshot)
each("record_video", film, "index", (3, -1), "in [0, 3)", state=snapshot)


def same(one: Any, other: Any) -> bool:
    pairs = zip(tree_leaves(one), tree_leaves(other), strict=True)
    return all(np.array_equal(x, y, equal_nan=is_float(x)) for x, y in pairs)


def is_float(leaf: Any) -> bool:
    return np.asarray(leaf).dtype.kind == "f"


def kept(state: Any) -> Any:
    """A copy that what comes later cannot reach."""
    return copy.deepcopy(tree_leaves(state))


def test_there_are_enough():
    assert len(CASES) > 300


@pytest.mark.parametrize("name", CASES)
def test_api(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    case = CASES[name]
    before = kept(case.state())
    random = torch.get_rng_state()
    with pytest.raises(case.error) as info:
        case.call()
    message = str(info.value.args[0])
    for part in case.says:
        assert part in message, f"{part!r} is not in: {message}"
    assert same(before, case.state())
    assert torch.equal(torch.get_rng_state(), random)
    assert not list(tmp_path.iterdir())


# Options.

KINDS = {
    **{name: method.Options for name, method in METHODS.items()},
    "doggo_controller": doggo_controller.Options,
    "retrace_sac": retrace_sac.Options,
}

# One impossible value for each option of each method, and what its message says is allowed.
IMPOSSIBLE = {
    "seed": (-1, "at least 0"),
    "loss.limit_gain": (-0.1, "[0, 1]"),
    "optim.mirror": (2, "one of True, False"),
    "num_threads": (0, "at least 1"),
    "run_dir": ("", "null or a path"),
    "resume": (1, "one of True, False"),
    "published": ("nobody", "null"),
    "update": ("newton", "'trust_region', 'lagrangian', 'pid'"),
    "safety_critic.kind": ("deviation", "'gaussian', 'quantiles'"),
    "safety_critic.num_quantiles": (1, "at least 2"),
    "safety_critic.num_nets": (5, "at most 4"),
    "safety_critic.window": (1, "at least 2"),
    "safety_critic.num_updates": (0, "at least 1"),
    "safety_critic.calibration_frames": (-1, "at least 0"),
    "env.name": ("", "a name"),
    "env.task": ("chess", "or a task of Safety-Gymnasium's"),
    "env.id": ("", "null or a name"),
    "env.cost": ("", "null or a name"),
    "env.robot": ("unicycle", "'point'"),
    "env.num_envs": (0, "at least 1"),
    "env.episode_length": (0, "at least 1"),
    "env.standardize_frames": (-1, "at least 0"),
    "env.randomization": ("rain", "null or one of 'jackal_training'"),
    "task.top_speed": (0.0, "(0, inf)"),
    "task.tilt_cost": (-1.0, "[0, inf)"),
    "gait": ([{"population": 3}], "a list of stages"),
    "collector.backend": ("threads", "'single', 'multi_sync', 'multi_async', 'ray'"),
    "collector.num_workers": (0, "at least 1"),
    "collector.frames_per_batch": (0, "at least 1"),
    "collector.total_frames": (0, "at least 1"),
    "collector.init_frames": (-1, "at least 0"),
    "replay_buffer.storage": ("tape", "'memory', 'memmap'"),
    "replay_buffer.size": (0, "at least 1"),
    "replay_buffer.slice_len": (0, "at least 1"),
    "replay_buffer.batch_size": (0, "at least 1"),
    "estimator.name": ("td1", "'retrace', 'td0'"),
    "estimator.gamma": (1.0, "[0, 1)"),
    "estimator.lmbda": (1.5, "[0, 1]"),
    "network.num_cells": ([0], "integers of at least 1"),
    "policy.num_cells": ([64, -1], "integers of at least 1"),
    "policy.num_components": (0, "at least 1"),
    "policy.relaxation": ("soft", "'gumbel_softmax'"),
    "policy.temperature": (0.0, "(0, inf)"),
    "policy.log_std_bounds": ([2.0, -4.0], "the smaller one first"),
    "policy.init_std": (0.0, "(0, inf)"),
    "critic.num_cells": ([1.5], "integers of at least 1"),
    "loss.entropic_index": (0.0, "(0, inf)"),
    "loss.alpha": (0.0, "(0, inf)"),
    "loss.alpha_init": (-1.0, "(0, inf)"),
    "loss.target_update_tau": (0.0, "(0, 1]"),
    "loss.gamma": (1.0, "[0, 1)"),
    "loss.cost_gamma": (-0.1, "[0, 1)"),
    "loss.lmbda": (1.1, "[0, 1]"),
    "loss.risk_level": (0.0, "(0, 1]"),
    "loss.cost_limit": (-1.0, ", inf)"),
    "loss.limit_unit": ("week", "'discounted', 'step', 'episode'"),
    "loss.initial_cost_limit": (math.inf, "[0, inf)"),
    "loss.anneal_frames": (-1, "at least 0"),
    "loss.variance_reward": ("none", "'td_error', 'second_moment'"),
    "loss.clip_epsilon": (0.0, "(0, 1)"),
    "loss.kl_weight": (0.0, "(0, inf)"),
    "loss.penalty": (0.0, "(0, inf)"),
    "loss.tolerance": (-0.1, "[0, inf)"),
    "loss.entropy_coeff": (-1.0, "[0, inf)"),
    "lagrangian.policy_lr": (0.0, "(0, inf)"),
    "lagrangian.minibatch_size": (0, "at least 1"),
    "lagrangian.init": (0.0, "(0, inf)"),
    "lagrangian.lr": (-0.1, "(0, inf)"),
    "budget.budget_gamma": (0.0, "(0, 1]"),
    "budget.unsafe_reward": (0.5, ", 0]"),
    "budget.termination_reward": (0.5, ", 0]"),
    "pid.kp": (-1.0, "[0, inf)"),
    "pid.ki": (0.0, "(0, inf)"),
    "pid.kd": (-1.0, "[0, inf)"),
    "optim.policy_lr": (0.0, "(0, inf)"),
    "optim.num_epochs": (0, "at least 1"),
    "optim.policy_delay": (0, "at least 1"),
    "optim.target_noise": (-0.1, "[0, inf)"),
    "optim.noise_clip": (-0.1, "[0, inf)"),
    "policy.noise": (0.0, "(0, inf)"),
    "optim.num_updates": (0, "at least 1"),
    "optim.tau": (1.5, "(0, 1]"),
    "optim.lr": (0.0, "(0, inf)"),
    "optim.updates_per_frame": (0.0, "(0, inf)"),
    "optim.critic_lr": (0.0, "(0, inf)"),
    "optim.max_grad_norm": (0.0, "(0, inf)"),
    "optim.max_skipped": (-1, "at least 0"),
    "device": ("abacus", "cpu"),
    "optim.critic_rounds": (0, "at least 1"),
    "optim.critic_frames": (0, "at least 1"),
    "optim.minibatch_size": (0, "at least 1"),
    "optim.compile": (1, "one of True, False"),
    "optim.cuda_graphs": (1, "one of True, False"),
    "optim.policy_frames": (0, "at least 1"),
    "optim.curvature_frames": (0, "null or an integer of at least 1"),
    "optim.max_kl": (0.0, "(0, inf)"),
    "optim.kl": ("moments", "'auto', 'moment_matched', 'matched_bound'"),
    "optim.damping": (-0.1, "[0, inf)"),
    "optim.cg_iters": (0, "at least 1"),
    "optim.backtrack_ratio": (1.0, "(0, 1)"),
    "optim.max_backtracks": (-1, "at least 0"),
    "optim.recovery_ratio": (0.0, "(0, 1]"),
    "logger.backend": ("paper", "'csv', 'tensorboard', 'wandb'"),
    "logger.project_name": ("", "a name"),
    "eval.interval": (0, "at least 1"),
    "eval.num_episodes": (0, "at least 1"),
    "eval.final_episodes": (0, "at least 1"),
    "eval.num_directions": (0, "at least 1"),
    "eval.num_steps": (0, "at least 1"),
    "checkpoint.interval": (0, "at least 1"),
    "checkpoint.keep_last": (0, "at least 1"),
    "video.num_steps": (-1, "at least 0"),
}


def refused(name: str, option: str, wrong: Any) -> str:
    """The message for one wrong option."""
    settings = KINDS[name]().model_dump()
    *groups, last = option.split(".")
    reduce(dict.__getitem__, groups, settings)[last] = wrong
    with pytest.raises(ValueError) as info:
        KINDS[name](**settings)
    return str(info.value)


@pytest.mark.parametrize("name", KINDS)
def test_options(name):
    """Each option of a method: an impossible value, another type, and another name."""
    for option in (row.name for row in describe(KINDS[name])):
        wrong, allowed = IMPOSSIBLE[option]
        message = refused(name, option, wrong)
        assert message.startswith(f"{option} must be "), message
        assert allowed in message, message
        assert message.endswith(f"got {wrong!r}."), message
        kind = "?" if not isinstance(wrong, str) else 7
        message = refused(name, option, kind)
        assert message.startswith(f"{option} must be "), message
        assert message.endswith(f"got {kind!r}."), message
        if isinstance(wrong, float):
            assert "got nan" in refused(name, option, math.nan)
        unknown = f"{option}_"
        message = refused(name, unknown, 1)
        assert message.startswith(f"{unknown} is not an option"), message
        assert option in message, message
