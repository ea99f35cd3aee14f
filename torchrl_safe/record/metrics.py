"""What a safe agent is judged by: return, cost, constraint violations (CV) and the score.

Every definition lives here once, as a pure function or a sum over an episode, and is that of
"SafeTAC: Safe Tsallis Actor-Critic Reinforcement Learning for Safer Exploration" (section V), which
takes it from "TRC: Trust Region Conditional Value at Risk" (Kim and Oh, RA-L 2022): the score of an
episode is ``R / (1 + CV)``, where CV counts its violating steps.

An environment says whether a step violates in ``("next", "violation")``, or for how many violating
steps it counts in ``("next", "violations")``, which is read where there is one: a collision that
ends an episode counts for the steps that remained. Rates are per step of the episodes as they would
have been, so a step that counts for n violating ones is n steps long.
"""

from __future__ import annotations

import contextlib
import math
from collections import defaultdict
from collections.abc import Callable, Iterator

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from torchrl_safe._costs import costs_among, prefix_of, violation_key

__all__ = [
    "batch_metrics",
    "bootstrap_interval",
    "count_violations",
    "describe",
    "evaluate",
    "proportion_interval",
    "score",
    "summarize",
]

_NUM_RESAMPLES = 2_000


def score(episode_return: Tensor, violations: Tensor) -> Tensor:
    r"""Score of an episode, :math:`\sum_t R_t / (1 + \sum_t CV_t)`.

    A violation divides the return, so a negative return is pulled towards zero by violations:
    compare scores only together with the CV rate.

    Args:
        episode_return (Tensor): undiscounted return of each episode, any shape.
        violations (Tensor): number of violating steps of each episode, same shape.

    Returns:
        Tensor: one score per episode. Average these; the score of the averages is another number.

    Raises:
        ValueError: if the shapes differ.

    Examples:
        >>> import torch
        >>> score(torch.tensor([8.0, 9.0]), torch.tensor([0, 2]))
        tensor([8., 3.])
    """
    if episode_return.shape != violations.shape:
        raise ValueError(
            "episode_return and violations must have the same shape, got "
            f"{tuple(episode_return.shape)} and {tuple(violations.shape)}."
        )
    return episode_return / (1 + violations)


def bootstrap_interval(values: Tensor) -> tuple[float, float]:
    """95 % percentile-bootstrap interval of the mean of independent values.

    The score is skewed (one violation halves it), which the bootstrap follows and a normal
    interval does not. Resampling uses a generator of its own with a fixed seed: equal values give
    equal intervals, and the global random state is untouched.

    Args:
        values (Tensor): shape [N].

    Returns:
        tuple of float: lower and upper bound; both NaN for fewer than two values, which say
        nothing about their spread.

    Raises:
        ValueError: if ``values`` is not one-dimensional.

    Examples:
        >>> import torch
        >>> bootstrap_interval(torch.full((10,), 3.0))
        (3.0, 3.0)
    """
    if values.ndim != 1:
        raise ValueError(f"values must have shape [N], got {tuple(values.shape)}.")
    if len(values) < 2:
        return float("nan"), float("nan")
    generator = torch.Generator().manual_seed(0)
    rows = torch.randint(len(values), (_NUM_RESAMPLES, len(values)), generator=generator)
    means = values.detach().cpu().double()[rows].mean(-1)
    low, high = means.quantile(torch.tensor([0.025, 0.975], dtype=means.dtype)).tolist()
    return low, high


def proportion_interval(successes: int, trials: int) -> tuple[float, float]:
    """95 % Wilson score interval of the share of successes.

    Unlike the normal interval it says something at zero successes or failures: of 100 episodes
    without a violation, up to 3.7 % could have had one. Wilson, JASA 1927,
    https://doi.org/10.1080/01621459.1927.10502953.

    Args:
        successes (int): how many.
        trials (int): of how many.

    Returns:
        tuple of float: lower and upper bound, in [0, 1].

    Raises:
        ValueError: if there is no trial, or ``successes`` is not between 0 and ``trials``.

    Examples:
        >>> low, high = proportion_interval(0, 100)
        >>> round(low, 3), round(high, 3)
        (0.0, 0.037)
    """
    if trials < 1:
        raise ValueError(f"trials must be at least 1, got {trials}.")
    if not 0 <= successes <= trials:
        raise ValueError(f"successes must be in [0, {trials}], got {successes}.")
    z = 1.959963984540054  # the 97.5 % quantile of the normal distribution
    share = successes / trials
    scale = 1 + z**2 / trials
    centre = (share + z**2 / (2 * trials)) / scale
    half = z / scale * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    return max(0.0, centre - half), min(1.0, centre + half)


def evaluate(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    num_steps: int = 1_000,
    exploration_type: ExplorationType,
    seed: int | None = None,
    cost_gamma: float = 0.99,
) -> TensorDict:
    r"""Plays one episode in every environment of a batch and measures each of them.

    All environments step together and only running sums are kept, never the rollout. An
    environment stops counting at its first ``done``, terminated or truncated; it goes on stepping
    (reset) until the last one is done or ``num_steps`` is reached.

    Pass an environment made for evaluation, never the collector's: the reset here would cut the
    episodes the collector is in the middle of without it noticing; training episodes may be
    shorter or start staggered; and training transforms (reward scaling, running normalisation)
    would enter the score. Global random state is left as found, so training does not depend on
    when one evaluates.

    Args:
        env (EnvBase): batch size [\*N], with leaves of shape [\*N, 1] ``("next", "reward")``,
            ``("next", "cost")``, ``("next", "violation")`` or ``("next", "violations")``, and
            ``("next", "goal_met")`` if there are goals. Of several costs, ``"<name>_cost"`` and
            ``"<name>_violation"`` each.
        policy (callable): from tensordict to tensordict with the action. Put a policy with
            dropout or the like in ``eval()`` mode first.

    Keyword Args:
        num_steps (int): most steps per episode. Defaults to 1,000, the paper's episode.
        exploration_type (ExplorationType): ``RANDOM`` samples the action, ``DETERMINISTIC`` does
            not. The two differ for a stochastic policy: report both.
        seed (int, optional): seed of the environments and of the sampled actions. Equal seeds
            give equal layouts, which makes policies comparable.
        cost_gamma (float): discount per step of ``discounted_cost``, in [0, 1]. Defaults to 0.99.

    Returns:
        TensorDict: batch size [\*N], per episode. In float64: ``episode_return``, ``violations``
        (steps), ``entries`` (violating steps after one that was none, or at the start),
        ``longest_violation`` (most violating steps in a row), ``cv_rate``
        and ``cost_rate`` (per step), ``cost`` and ``discounted_cost`` (sums), ``score``,
        ``length`` (steps taken); where there are goals, ``goals`` (steps that met one). Of several
        costs, ``<name>_cost``, ``<name>_discounted_cost``, ``<name>_cost_rate``,
        ``<name>_violations`` and ``<name>_cv_rate`` each, and ``violations`` counts steps that
        violate any. In bool, how it ended: ``terminated``, ``truncated``, or neither if
        ``num_steps`` were over first.

    Raises:
        ValueError: if ``num_steps`` is not positive, ``cost_gamma`` is not in [0, 1], or a leaf has
            another shape.
        KeyError: if the environment does not write one of the leaves.

    Examples:
        >>> from torchrl.envs.utils import ExplorationType
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=2, num_threads=1)
        >>> episodes = evaluate(
        ...     env, env.rand_action, num_steps=5, exploration_type=ExplorationType.RANDOM, seed=0
        ... )
        >>> episodes["length"].tolist()
        [5.0, 5.0]
        >>> summarize(episodes)["eval/length"]
        5.0
    """
    if num_steps < 1:
        raise ValueError(f"num_steps must be at least 1, got {num_steps}.")
    if not 0.0 <= cost_gamma <= 1.0:
        raise ValueError(f"cost_gamma must be in [0, 1], got {cost_gamma}.")
    costs = costs_among(env.full_reward_spec.keys(True, True))
    zero = torch.zeros(env.batch_size, dtype=torch.float64, device=env.device)
    total: dict[str, Tensor] = defaultdict(zero.clone)
    running = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    violated = torch.zeros_like(running)
    in_a_row = zero.clone()
    ends = {name: torch.zeros_like(running) for name in ("terminated", "truncated")}
    with acting(exploration_type):
        if seed is not None:
            env.set_seed(seed)
            # An environment may seed more than itself, or less: the policy's noise starts here.
            torch.manual_seed(seed)
        td = env.reset()
        for step in range(num_steps):
            stepped, td = env.step_and_maybe_reset(policy(td))
            violations = _violations(stepped)
            total["reward"] += _signal(stepped, ("next", "reward")).double().where(running, 0.0)
            if "goal_met" in stepped["next"].keys():
                total["goals"] += _signal(stepped, ("next", "goal_met")) & running
            for key in costs or ("cost",):
                prefix = prefix_of(key)
                cost = _signal(stepped, ("next", key)).double().where(running, 0.0)
                total[key] += cost
                total[f"{prefix}discounted_cost"] += cost_gamma**step * cost
                if prefix:
                    own = _violations(stepped, prefix)
                    total[f"{prefix}violations"] += own.where(running, 0.0)
            total["violations"] += violations.where(running, 0.0)
            total["entries"] += running & (violations > 0) & ~violated
            violated = violations > 0
            in_a_row = (in_a_row + 1).where(violated & running, 0.0)
            total["longest_violation"] = total["longest_violation"].maximum(in_a_row)
            total["length"] += running
            total["duration"] += violations.clamp(min=1.0).where(running, 0.0)
            for name, ended in ends.items():
                ended |= running & _signal(stepped, ("next", name))
            running = running & ~_signal(stepped, ("next", "done"))
            if not running.any():
                break
    duration, episode_return = total.pop("duration"), total.pop("reward")
    rates = {f"{key}_rate": total[key] / duration for key in costs}
    rates |= {
        f"{name.removesuffix('violations')}cv_rate": total[name] / duration
        for name in total
        if name.endswith("violations")
    }
    return TensorDict(
        {
            "episode_return": episode_return,
            "score": score(episode_return, total["violations"]),
            **total,
            **rates,
            **ends,
        },
        batch_size=env.batch_size,
    )


def summarize(episodes: TensorDictBase, prefix: str = "eval/") -> dict[str, float]:
    """Means over episodes, flat and ready for ``logger.log_metrics``.

    Args:
        episodes (TensorDictBase): what :func:`evaluate` returned, any batch size.
        prefix (str): put before every name. Defaults to ``"eval/"``.

    Returns:
        dict of float: ``return``, the means of all other entries (of ``terminated`` and
        ``truncated``, the shares), the 95 % interval ``score_low``, ``score_high`` of the score,
        and of the violations, if there are any to count, what 95 and 99 % of the episodes do not
        exceed, ``violations_p95`` and ``violations_p99``: means hide the episodes that matter.

    Raises:
        ValueError: if there is no episode.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> episodes = TensorDict({"score": torch.tensor([2.0, 2.0])}, batch_size=[2])
        >>> summarize(episodes, "eval/det/")
        {'eval/det/score': 2.0, 'eval/det/score_low': 2.0, 'eval/det/score_high': 2.0}
    """
    if not episodes.batch_size.numel():
        raise ValueError(f"episodes must hold at least one, got batch {episodes.batch_size}.")
    metrics = {
        prefix + name.removeprefix("episode_"): value.double().mean().item()
        for name, value in episodes.items()
    }
    low, high = bootstrap_interval(episodes["score"].flatten())
    if "violations" in episodes.keys():
        violations = episodes["violations"].double().flatten()
        for share in (95, 99):
            metrics[f"{prefix}violations_p{share}"] = violations.quantile(share / 100).item()
    return {**metrics, f"{prefix}score_low": low, f"{prefix}score_high": high}


def describe(episodes: TensorDictBase) -> list[dict[str, float | int | str]]:
    """Episodes one by one, as plain values that JSON takes.

    Args:
        episodes (TensorDictBase): what :func:`evaluate` returned, any batch size.

    Returns:
        list of dict, one per episode: ``return``, ``score``, ``cost``, ``discounted_cost`` (of
        several costs, each); the counts ``violations`` (of each, too), ``entries``, ``length`` and,
        where there are any, ``goals``; and ``end``, which is ``"terminated"``, ``"truncated"`` or,
        where steps were over first, ``"running"``.

    Examples:
        >>> from torchrl.envs.utils import ExplorationType
        >>> from torchrl_safe.envs import SafeRobotEnv
        >>> env = SafeRobotEnv("point", num_envs=2, num_threads=1)
        >>> episodes = evaluate(
        ...     env, env.rand_action, num_steps=5, exploration_type=ExplorationType.RANDOM, seed=0
        ... )
        >>> [(episode["length"], episode["end"]) for episode in describe(episodes)]
        [(5, 'running'), (5, 'running')]
    """
    episodes = episodes.flatten()
    columns = {
        "return": episodes["episode_return"].tolist(),
        "score": episodes["score"].tolist(),
        **{name: episodes[name].tolist() for name in costs_among(episodes.keys())},
        **{
            name: episodes[name].long().tolist()
            for name in episodes.keys()
            if name.endswith("violations") or name in ("entries", "goals", "length")
        },
        "end": [
            "terminated" if terminated else "truncated" if truncated else "running"
            for terminated, truncated in zip(
                episodes["terminated"].tolist(), episodes["truncated"].tolist(), strict=True
            )
        ],
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def count_violations(td: TensorDictBase) -> int:
    """Violating steps in a collector's batch, to be added to a running total of the training run.

    The total belongs to the caller, who saves it with the rest of a checkpoint.

    Args:
        td (TensorDictBase): a batch with ``("next", "violation")`` or ``("next", "violations")``,
            e.g. batch size [N, T].

    Returns:
        int: the number of violating steps.

    Raises:
        KeyError: if the leaf is missing.
        ValueError: if its shape is not the batch size and a trailing 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> violation = torch.tensor([[True], [False], [True]])
        >>> total_cvs = 40
        >>> batch = TensorDict({"next": {"violation": violation}}, batch_size=[3])
        >>> total_cvs += count_violations(batch)
        >>> total_cvs
        42
    """
    return int(_violations(td).sum())


def batch_metrics(td: TensorDictBase, prefix: str = "train/") -> dict[str, float]:
    """Means over the steps of a collector's batch, whatever episodes they belong to.

    Args:
        td (TensorDictBase): a batch with ``("next", "reward")``, ``("next", "cost")`` and
            ``("next", "violation")`` or ``("next", "violations")``, e.g. batch size [N, T].
        prefix (str): put before every name. Defaults to ``"train/"``.

    Returns:
        dict of float: ``reward_per_1000`` (reward per 1,000 steps, comparable with an episode's
        return), ``cost_rate`` and ``cv_rate`` (per step); of several costs, ``<name>_cost_rate``
        and ``<name>_cv_rate`` each, and ``cv_rate`` of steps that violate any.

    Raises:
        KeyError: if a leaf is missing.
        ValueError: if a leaf's shape is not the batch size and a trailing 1, or the batch is empty.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> step = {"reward": torch.tensor([[0.25], [0.75]]), "cost": torch.tensor([[0.0], [1.0]])}
        >>> step["violation"] = torch.tensor([[False], [True]])
        >>> batch_metrics(TensorDict({"next": step}, batch_size=[2]))
        {'train/reward_per_1000': 500.0, 'train/cost_rate': 0.5, 'train/cv_rate': 0.5}
    """
    if not td.batch_size.numel():
        raise ValueError(f"td must hold at least one step, got batch size {tuple(td.batch_size)}.")
    signals = {"reward_per_1000": 1_000 * _signal(td, ("next", "reward")).double()}
    for key in _costs_of(td) or ("cost",):
        signals[f"{key}_rate"] = _signal(td, ("next", key)).double()
        if own := prefix_of(key):
            signals[f"{own}cv_rate"] = _violations(td, own)
    violations = signals["cv_rate"] = _violations(td)
    sums = torch.stack([signal.sum() for signal in signals.values()])
    rates = (sums / violations.clamp(min=1.0).sum()).tolist()
    return {prefix + name: rate for name, rate in zip(signals, rates, strict=True)}


@contextlib.contextmanager
def acting(exploration_type: ExplorationType) -> Iterator[None]:
    """No gradients, the given exploration type, and the global random state put back at the end.

    Args:
        exploration_type (ExplorationType): how a stochastic policy picks its action.

    Examples:
        >>> import torch
        >>> from torchrl.envs.utils import ExplorationType
        >>> before = torch.get_rng_state()
        >>> with acting(ExplorationType.RANDOM):
        ...     noise = torch.randn(3)
        >>> torch.equal(before, torch.get_rng_state())
        True
    """
    devices = [torch.cuda.current_device()] if torch.cuda.is_initialized() else []
    with (
        torch.no_grad(),
        set_exploration_type(exploration_type),
        torch.random.fork_rng(devices=devices),
    ):
        yield


def _costs_of(td: TensorDictBase) -> tuple[str, ...]:
    """The costs of steps: what else is called so has no violation."""
    keys = td["next"].keys()
    return tuple(key for key in costs_among(keys) if key == "cost" or violation_key(key) in keys)


def _violations(td: TensorDictBase, prefix: str = "") -> Tensor:
    """How many violating steps each step counts for, of one cost or of any, [*B], float64."""
    keys = td["next"].keys()
    for name in (f"{prefix}violations", f"{prefix}violation"):
        if name in keys:
            return _signal(td, ("next", name)).double()
    several = [prefix_of(key) for key in _costs_of(td) if key != "cost"]
    if prefix or not several:
        return _signal(td, ("next", f"{prefix}violation")).double()  # which says what is missing
    return torch.stack([_violations(td, own) for own in several]).amax(0)


def _signal(td: TensorDictBase, key: NestedKey) -> Tensor:
    """The leaf ``key`` of shape [*B, 1] as [*B]."""
    value = td.get(key, None)
    if value is None:
        raise KeyError(f"{key} is missing; the tensordict has {sorted(map(str, td.keys(True)))}.")
    if value.shape != (*td.batch_size, 1):
        raise ValueError(
            f"{key} must have shape {(*td.batch_size, 1)} (batch size and a trailing 1), "
            f"got {tuple(value.shape)}."
        )
    return value.squeeze(-1)
