"""What a safe environment promises, as an executable contract."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torchrl import torchrl_logger
from torchrl.data import Composite
from torchrl.envs import EnvBase, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_safe._costs import violation_key as flag_of
from torchrl_safe.envs.transforms import cost_keys

__all__ = ["check_safe_env"]

_DONE_KEYS = ("done", "terminated", "truncated")


def check_safe_env(
    env: EnvBase,
    *,
    twins: Iterable[EnvBase] = (),
    time_limit: int | None = None,
    num_steps: int = 20,
    seed: int = 0,
    cost_key: NestedKey | None = None,
    violation_key: NestedKey | None = "violation",
) -> None:
    """Runs an environment through everything that the blocks of this package rely on.

    In this order; the first broken promise raises:

    1. ``check_env_specs`` of TorchRL succeeds;
    2. the cost, and each of several, is a leaf of the reward spec beside a reward, ``[*B, 1]``,
       float32; it is finite, as reward and observation are, and never negative;
    3. its violation is an observation, ``[*B, 1]``, bool;
    4. ``done`` is ``terminated | truncated``, and a time limit truncates without terminating;
    5. the same seed and actions give the same rollout, whatever happened before;
    6. what a step returned is not written to by later steps;
    7. in a batch, a partial reset starts new episodes where it is asked to and leaves the others as
       they would have been;
    8. each twin gives the same rollout, bit for bit;
    9. ``load_state_dict(state_dict())`` of the innermost environment is a way back, if its state
       has entries at all. (That of an environment which saves nothing has none.)

    The environment is stepped and reset; it is left after a reset under ``seed``. PyTorch's global
    random state on the CPU is put back. The checks run under ``python -O``, too.

    Args:
        env (EnvBase): the environment, with or without transforms. Any batch size.

    Keyword Args:
        twins (iterable of EnvBase): the same environment built otherwise: with another number of
            threads, say.
        time_limit (int, optional): steps after which an episode is truncated, if there is such a
            limit. Make it small: the check steps this far.
        num_steps (int): steps of each rollout. Default: 20.
        seed (int): the first seed used. Default: 0.
        cost_key (NestedKey, optional): the only one that is looked at. Default: ``"cost"``; each
            ``"<name>_cost"`` where there are several, with its ``"<name>_violation"``.
        violation_key (NestedKey, optional): ``None`` for environments without. Default:
            ``"violation"``.

    Raises:
        AssertionError: if a promise is broken; the message says which and how.
        ValueError: if ``num_steps`` or ``time_limit`` is not positive.

    Examples:
        >>> from torchrl_safe.envs import SafeGoalEnv, check_safe_env
        >>> env, twin = (SafeGoalEnv(num_envs=3, num_threads=n, episode_length=9) for n in (1, 2))
        >>> check_safe_env(env, twins=[twin], time_limit=9)
    """
    for name, value in (("num_steps", num_steps), ("time_limit", time_limit)):
        if value is not None and value < 1:
            raise ValueError(f"{name} must be positive, got {value}.")
    with _quiet(), torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        check_env_specs(env, seed=seed)
        costs: list[NestedKey] = [*cost_keys(env)] if cost_key is None else [cost_key]
        violations: list[NestedKey] = []
        if cost_key is None and violation_key == "violation":
            violations += [flag_of(cost) for cost in cost_keys(env)]
        elif violation_key is not None:
            violations.append(violation_key)
        _check_promises(env, twins, time_limit, num_steps, seed, costs, violations)


def _check_promises(
    env: EnvBase,
    twins: Iterable[EnvBase],
    time_limit: int | None,
    num_steps: int,
    seed: int,
    costs: list[NestedKey],
    violations: list[NestedKey],
) -> None:
    shape = torch.Size((*env.batch_size, 1))
    leaves = list(env.full_reward_spec.keys(True, True))
    _promise(costs, f"'cost' must be among {leaves}.")
    for cost in costs:
        _check_leaf(env.full_reward_spec, cost, shape, torch.float32)
    _promise(
        len(env.reward_keys) > len(costs),
        f"there must be a reward beside {', '.join(map(repr, costs))}.",
    )
    for violation in violations:
        _check_leaf(env.full_observation_spec, violation, shape, torch.bool)

    actions = [env.full_action_spec.rand() for _ in range(max(num_steps, time_limit or 0))]
    kept: list[TensorDictBase] = []
    rollout = _rollout(env, actions, seed, kept)
    _check_values(env, rollout, costs)
    _check_done(rollout)
    if time_limit is not None:
        _check_time_limit(rollout, time_limit)
    for step, copy in zip(kept, rollout, strict=True):
        difference = _difference(step, copy)
        _promise(not difference, f"returned tensors are written to by later steps: {difference}.")

    difference = _difference(_rollout(env, actions, seed), rollout)
    _promise(not difference, f"the same seed and actions give another rollout: {difference}.")
    if env.batch_size.numel() > 1:
        _check_partial_reset(env, actions, seed, rollout)
    for number, twin in enumerate(twins):
        difference = _difference(_rollout(twin, actions, seed), rollout)
        _promise(not difference, f"twin {number} gives another rollout: {difference}.")
    _check_state(env, actions, seed)
    env.set_seed(seed)
    env.reset()


def _promise(kept: bool | torch.Tensor | list[NestedKey], message: str) -> None:
    """An assertion that ``python -O`` keeps."""
    if not kept:
        raise AssertionError(message)


def _check_leaf(spec: Composite, key: NestedKey, shape: torch.Size, dtype: torch.dtype) -> None:
    leaves = list(spec.keys(True, True))
    _promise(key in leaves, f"{key!r} must be among {leaves}.")
    found = spec[key].shape, spec[key].dtype
    _promise(
        found == (shape, dtype),
        f"{key!r} must be {dtype} {tuple(shape)}, its spec says {found[1]} {tuple(found[0])}.",
    )


def _check_values(env: EnvBase, rollout: TensorDictBase, costs: list[NestedKey]) -> None:
    observations = list(env.full_observation_spec.keys(True, True))
    for steps, keys in ((rollout, observations), (rollout["next"], observations + env.reward_keys)):
        for key in keys:
            value = steps.get(key)
            if value.is_floating_point():
                wrong = ~value.isfinite()
                _promise(not wrong.any(), f"{key!r} must be finite, it is not at {_where(wrong)}.")
    for cost in costs:
        negative = rollout["next"].get(cost) < 0
        _promise(not negative.any(), f"{cost!r} must not be negative, it is at {_where(negative)}.")


def _check_done(rollout: TensorDictBase) -> None:
    present = [key for key in _DONE_KEYS if key in rollout["next"].keys()]
    _promise(len(present) == 3, f"a step must return {_DONE_KEYS}, it returns {present}.")
    done, terminated, truncated = (rollout["next", key] for key in _DONE_KEYS)
    wrong = done != (terminated | truncated)
    _promise(not wrong.any(), f"done must be terminated | truncated, it is not in {_where(wrong)}.")


def _check_time_limit(rollout: TensorDictBase, time_limit: int) -> None:
    done = rollout["next", "done"].reshape(len(rollout), -1)
    last = rollout[time_limit - 1]["next"]
    whole = ~done[: time_limit - 1].any(0)
    _promise(
        last["truncated"].flatten()[whole].all(),
        f"a time limit of {time_limit} must truncate at step {time_limit}: it did not, "
        "or an earlier step did.",
    )
    early = rollout["next", "truncated"].reshape(len(rollout), -1)[: time_limit - 1]
    _promise(
        not early.any(), f"truncated at steps {_where(early)}, before the limit of {time_limit}."
    )
    terminated = last["terminated"].flatten()
    _promise(
        not terminated[whole].all() or not whole.any(),
        f"a time limit truncates and does not terminate: all that reached step {time_limit} are "
        "terminated.",
    )


def _check_partial_reset(
    env: EnvBase, actions: list[TensorDictBase], seed: int, rollout: TensorDictBase
) -> None:
    half = len(actions) // 2
    rows = torch.zeros(env.batch_size.numel(), dtype=torch.bool, device=env.device)
    rows[::2] = True
    rows = rows.reshape(env.batch_size)
    before = _advance(env, actions[:half], seed)
    td = env.reset(before.clone().set("_reset", rows[..., None]))
    # TorchRL itself puts the others' entries back: whether they were left alone, their steps tell.
    changed = any(
        bool((td.get(key) != before.get(key))[rows].any())
        for key in env.full_observation_spec.keys(True, True)
    )
    # Those whose episode was over are at a start already.
    over = half == 0 or rollout["next", "done"][half - 1][rows].all()
    _promise(changed or over, "a partial reset changes nothing where it was asked to reset.")
    for step, action in enumerate(actions[half:], half):
        stepped, td = env.step_and_maybe_reset(td.update(action.clone()))
        difference = _difference(stepped["next"][~rows], rollout[step]["next"][~rows])
        _promise(
            not difference,
            f"a partial reset after step {half} changes step {step} of those it leaves alone: "
            f"{difference}.",
        )


def _check_state(env: EnvBase, actions: list[TensorDictBase], seed: int) -> None:
    inner = env.base_env if isinstance(env, TransformedEnv) else env
    half = len(actions) // 2
    td = _advance(env, actions[:half], seed)
    state = inner.state_dict()
    if not _has_leaves(state):
        return
    expected = _continue(env, td.clone(), actions[half:])
    inner.load_state_dict(state)
    difference = _difference(_continue(env, td.clone(), actions[half:]), expected)
    _promise(not difference, f"load_state_dict(state_dict()) is no way back: {difference}.")


def _has_leaves(state: Mapping[str, Any]) -> bool:
    return any(
        _has_leaves(value) if isinstance(value, Mapping) else True for value in state.values()
    )


def _rollout(
    env: EnvBase,
    actions: list[TensorDictBase],
    seed: int,
    kept: list[TensorDictBase] | None = None,
) -> TensorDictBase:
    """Steps [T, *B] under fixed actions after seeding and a reset, as copies; and as returned."""
    env.set_seed(seed)
    return _continue(env, env.reset(), actions, kept)


def _continue(
    env: EnvBase,
    td: TensorDictBase,
    actions: list[TensorDictBase],
    kept: list[TensorDictBase] | None = None,
) -> TensorDictBase:
    steps = []
    for action in actions:
        stepped, td = env.step_and_maybe_reset(td.update(action.clone()))
        steps.append(stepped.clone())
        if kept is not None:
            kept.append(stepped)
    return torch.stack(steps)


def _advance(env: EnvBase, actions: list[TensorDictBase], seed: int) -> TensorDictBase:
    env.set_seed(seed)
    td = env.reset()
    for action in actions:
        _, td = env.step_and_maybe_reset(td.update(action.clone()))
    return td


def _difference(first: TensorDictBase, second: TensorDictBase) -> str:
    """What differs between two tensordicts, in words; empty if nothing does."""
    keys = set(first.keys(True, True)) ^ set(second.keys(True, True))
    if keys:
        return f"only one has the entries {sorted(map(str, keys))}"
    for key in sorted(first.keys(True, True), key=str):
        x, y = first.get(key), second.get(key)
        if x.shape != y.shape or x.dtype != y.dtype:
            return f"{key!r} is {x.dtype} {tuple(x.shape)} and {y.dtype} {tuple(y.shape)}"
        if not torch.equal(x, y):
            wrong = x != y
            return f"{key!r} differs at {_where(wrong)}"
    return ""


def _where(mask: torch.Tensor) -> str:
    """The first indices at which a mask is set."""
    indices = mask.nonzero().tolist()
    return str(indices[:3])[1:-1] + (f" and {len(indices) - 3} more" if len(indices) > 3 else "")


@contextmanager
def _quiet() -> Iterator[None]:
    """Without TorchRL's message that its own check succeeded."""
    level = torchrl_logger.level
    torchrl_logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        torchrl_logger.setLevel(level)
