"""The environments of a run, by ``env.name`` or as somebody hands them over."""

from __future__ import annotations

import copy
import inspect
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite, TensorSpec
from torchrl.envs import (
    CatTensors,
    Compose,
    DoubleToFloat,
    EnvBase,
    GymWrapper,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
)
from torchrl.envs.batched_envs import BatchedEnvBase

from torchrl_safe._costs import violation_key
from torchrl_safe.envs import RANDOMIZATIONS, SafetyBudget
from torchrl_safe.envs.tasks import SAFETY_TASKS, get_task
from torchrl_safe.trainers.options import MethodOptions, per_episode
from torchrl_safe.trainers.tasks import RUNNERS
from torchrl_safe.trainers.threads import most_threads

MakeEnv = Callable[..., EnvBase]
NOT_INPUTS = ("violation", "violations", "goal_met", "diverged", "step_count")


class UntrustedError(ValueError):
    """A configuration names code that nobody here has agreed to run."""


def make_env(
    options: MethodOptions,
    num_envs: int,
    seed: int,
    *,
    training: bool = False,
    source: MakeEnv | None = None,
    trust: bool = True,
    **how: Any,
) -> EnvBase:
    """A batch of environments, ``[num_envs]``.

    They have a float32 ``"observation"`` (or what the networks read), a reward, a cost beside it in
    the reward spec, and a ``"violation"``: where one that is not ours has none, a step violates if
    it costs.

    Args:
        options (MethodOptions): ``env.name`` says which, ``env`` how.
        num_envs (int): how many.
        seed (int): of their layouts and initial states.

    Keyword Args:
        training (bool): whether they are to train in: with ``env.episode_length``, staggered and
            randomized where they can be. Defaults to False.
        source (callable, optional): makes them, in place of ``env.name``, from the keywords
            ``num_envs`` and ``seed`` if it has them. One environment without a batch is taken
            ``num_envs`` times.
        trust (bool): whether functions that the options name may be imported. Defaults to True;
            false for options that come with somebody's files.
        **how: of the constructor, where ``env.name`` is ``robot``: ``episode_length`` is
            ``eval.num_steps`` where it is not to train in.

    Raises:
        UntrustedError: if ``trust`` is false and the options name code.
        ValueError: if there is no such environment, or it has no cost.
    """
    env = _make_env(options, num_envs, seed, training, source, trust, how)
    rewards = list(env.full_reward_spec.keys(True, True))
    if missing := [name for name in cost_names(options) if name not in rewards]:
        raise ValueError(
            f"the environment must have a cost {missing[0]!r} beside the reward in its reward "
            f"spec, which has {rewards}. loss.cost_limit names others: {{name: limit}}."
        )
    return _budgeted(env, options, training, how)


def _budgeted(env: EnvBase, options: MethodOptions, training: bool, how: dict[str, Any]) -> EnvBase:
    """The environment with the budget that a method's options may ask for."""
    budget: Any = getattr(options, "budget", None)
    if budget is None:
        return env
    loss: Any = options.loss  # type: ignore[attr-defined]
    whole = options.eval.num_steps
    rate = per_episode(loss.cost_limit, loss.limit_unit, loss.cost_gamma, whole) / whole
    steps = how.get("episode_length", options.env.episode_length if training else whole)
    seen = ["observation"] if "observation" in env.full_observation_spec.keys() else []
    transform = budget.transform(rate, steps, training=training, in_keys=seen)
    return TransformedEnv(env, transform, auto_unwrap=True)


def _make_env(
    options: MethodOptions,
    num_envs: int,
    seed: int,
    training: bool,
    source: MakeEnv | None,
    trust: bool,
    how: dict[str, Any],
) -> EnvBase:
    name = options.env.name
    if source is None and not trust and (code := names_code(options)) is not None:
        raise UntrustedError(
            f"the configuration names code, {code}: pass the environment itself (env, or --env "
            "module:function), or say that you trust it (trust=True, or --trust)."
        )
    if source is not None:
        return _completed(_batched(source, num_envs, seed, options), options)
    if name == "robot":
        return _ours(options, num_envs, seed, training, how)
    if name == "python":
        raise ValueError("the run's environment was made in Python: pass it as env.")
    if name == "gym" and options.env.id is None:
        raise ValueError("env.id must name an environment for env=gym, got null.")
    if name == "gym":
        env = _batched(_gym_maker(options), num_envs, seed, options)
        if training:
            env = TransformedEnv(env, StepCounter(max_steps=options.env.episode_length))
        return _completed(env, options)
    return _completed(_batched(imported("env.name", name), num_envs, seed, options), options)


def _ours(
    options: MethodOptions, num_envs: int, seed: int, training: bool, how: dict[str, Any]
) -> EnvBase:
    """Robots of ours, by robot and task."""
    from torchrl_safe.envs import SafeRobotEnv, SafeVelocityEnv

    env = options.env
    how = {
        "num_envs": num_envs,
        "num_threads": most_threads(options),
        "seed": seed,
        "device": options.device,
        "episode_length": env.episode_length if training else options.eval.num_steps,
        "stagger": training,
        **how,
    }
    if env.task in RUNNERS:
        return SafeVelocityEnv(RUNNERS[env.task], **how)
    if training:
        how = {"randomization": RANDOMIZATIONS.get(env.randomization or "")} | how
    robot: Any = env.robot
    task: Any = env.task
    if task in SAFETY_TASKS:
        robot, task = get_task(task)
    return SafeRobotEnv(robot, task=task, **how)


def names_code(options: MethodOptions) -> str | None:
    """What of the environment's options would be imported, if anything."""
    return next(
        (
            f"env.{name}={value}"
            for name in ("name", "id", "cost")
            if (value := getattr(options.env, name)) is not None and ":" in value
        ),
        None,
    )


def imported(option: str, name: str) -> Callable[..., Any]:
    """The function ``module:function``.

    Raises:
        ValueError: if the name is none of that form, or there is no such function.
    """
    module, colon, function = name.partition(":")
    if not colon:
        raise ValueError(
            f"{option} must be one of 'robot', 'gym' or module:function, got {name!r}."
            if option == "env.name"
            else f"{option} must be module:function, got {name!r}."
        )
    try:
        found = getattr(import_module(module), function, None)
    except ModuleNotFoundError as error:
        raise ValueError(f"{option}={name} cannot be imported: {error}.") from error
    if not callable(found):
        raise ValueError(f"{option}={name} must be a function, {module} has none of this name.")
    return found


def has_state(env: EnvBase) -> bool:
    """Whether an environment's future depends on its ``state_dict`` alone, and on the last step.

    Of ours it does, also with a budget, which is in the step.
    """
    from torchrl_safe.envs._batched import BatchedEnv

    if isinstance(env, TransformedEnv) and isinstance(env.transform, SafetyBudget):
        return has_state(env.base_env)
    return isinstance(env, BatchedEnv)


def source_of(env: EnvBase | MakeEnv) -> tuple[MakeEnv, int | None]:
    """What makes environments like the given one, and how many it is of if that is settled.

    Raises:
        TypeError: if it is neither an environment nor a function.
        ValueError: if the environment cannot be made again.
    """
    if not isinstance(env, EnvBase):
        if not callable(env):
            raise TypeError(
                "env must be a robot's name, a TorchRL environment or a function that makes one, "
                f"got {type(env).__name__}."
            )
        return env, None
    if isinstance(env, BatchedEnvBase):
        kind, creators, kwargs = type(env), env.create_env_fn, env.create_env_kwargs

        def again() -> EnvBase:
            return kind(len(creators), creators, create_env_kwargs=kwargs)

        return again, env.batch_size.numel()
    try:
        pristine = copy.deepcopy(env)
    except Exception as error:
        raise ValueError(
            f"{type(env).__name__} cannot be copied, and a run needs several of them, for training "
            "and evaluation: pass a function that makes one, of num_envs and seed."
        ) from error
    return lambda: copy.deepcopy(pristine), env.batch_size.numel() if env.batch_size else None


def _gym_maker(options: MethodOptions) -> MakeEnv:
    """Makes the environment of ``env.id``, so that it can be filmed if it can draw."""
    from gymnasium.error import Error
    from torchrl.envs import GymEnv

    from torchrl_safe.envs.transforms import CostFunction

    cost = None if options.env.cost is None else imported("env.cost", options.env.cost)
    try:
        env = GymEnv(options.env.id, device=options.device)
    except Error as error:
        raise ValueError(f"env.id={options.env.id}: {error}") from error
    draws = "rgb_array" in (env.metadata.get("render_modes") or ())
    env.close()
    how = {"render_mode": "rgb_array"} if draws else {}

    def make() -> EnvBase:
        env = GymEnv(options.env.id, device=options.device, **how)
        return env if cost is None else TransformedEnv(env, CostFunction(cost))

    return make


def _batched(make: MakeEnv, num_envs: int, seed: int, options: MethodOptions) -> EnvBase:
    """``num_envs`` environments of a function that makes one, or as many as it is asked for."""
    takes = inspect.signature(make).parameters
    if "num_envs" in takes:
        how = {"num_envs": num_envs} | ({"seed": seed} if "seed" in takes else {})
        env = make(**how)
    else:
        env = make()
    _check_episode(env, options)
    if "num_envs" not in takes and not env.batch_size:
        env.close()
        env = SerialEnv(num_envs, make)
    if "seed" not in takes or "num_envs" not in takes:
        env.set_seed(seed % 2**31)
    if len(env.batch_size) != 1:
        raise ValueError(
            f"env must have a batch of one dimension or none, got {tuple(env.batch_size)}."
        )
    return env


def _check_episode(env: EnvBase, options: MethodOptions) -> None:
    """A limit on an episode of ``eval.num_steps`` is another one where episodes are shorter."""
    if getattr(options.loss, "limit_unit", None) != "episode":  # type: ignore[attr-defined]
        return
    steps, longest = options.eval.num_steps, _time_limit(env)
    if longest is not None and steps > longest:
        env.close(raise_if_closed=False)  # one that has not begun counts as closed
        raise ValueError(
            f"eval.num_steps must be at most {longest}, the length of the environment's episodes, "
            f"for loss.limit_unit=episode, got {steps}."
        )


def _time_limit(env: EnvBase) -> int | None:
    """The steps after which an environment truncates its episodes, where it tells."""
    from torchrl_safe.envs._batched import BatchedEnv

    limits = []
    while isinstance(env, TransformedEnv):
        transform = env.transform
        parts = transform if isinstance(transform, Compose) else [transform]
        limits += [part.max_steps for part in parts if isinstance(part, StepCounter)]
        env = env.base_env
    if isinstance(env, GymWrapper):
        limits.append(getattr(env.spec, "max_episode_steps", None))
    elif isinstance(env, BatchedEnv):
        limits.append(env.episode_length)
    elif isinstance(env, BatchedEnvBase):
        kinds: list[tuple[Any, Any]] = []  # mostly one: each is made once, not each environment
        for kind in zip(env.create_env_fn, env.create_env_kwargs, strict=True):
            if kind not in kinds:
                kinds.append(kind)
        for make, kwargs in kinds:
            single = make(**kwargs)
            limits.append(_time_limit(single))
            single.close()
    return min((limit for limit in limits if limit is not None), default=None)


def _completed(env: EnvBase, options: MethodOptions) -> EnvBase:
    """With all entries that training, evaluation and plots read."""
    costs = cost_names(options)
    rewards = list(env.full_reward_spec.keys(True, True))
    observations = env.full_observation_spec
    doubles = [key for key, spec in _leaves(observations) if spec.dtype == torch.float64]
    doubles += [key for key in rewards if env.full_reward_spec[key].dtype == torch.float64]
    if doubles:
        env = TransformedEnv(env, DoubleToFloat(in_keys=doubles))
    vectors = [
        key
        for key, spec in _leaves(observations)
        if spec.dtype.is_floating_point
        and spec.ndim == 1 + len(env.batch_size)
        and key not in NOT_INPUTS
    ]
    if "observation" not in observations.keys() and vectors:
        together = CatTensors(in_keys=vectors, out_key="observation", del_keys=False)
        env = TransformedEnv(env, together)
    flags = {violation_key(cost) for cost in costs}
    if not {"violation", *flags} & set(observations.keys()):
        env = TransformedEnv(env, _ViolationOfCosts(costs))
    return env


def cost_names(options: MethodOptions) -> list[str]:
    """The costs that are limited; without limits, ``"cost"``."""
    limit = getattr(options.loss, "cost_limit", None)  # type: ignore[attr-defined]
    return list(limit) if isinstance(limit, dict) else ["cost"]


def _leaves(spec: Composite) -> Sequence[tuple[Any, TensorSpec]]:
    return list(spec.items(True, True))


class _ViolationOfCosts(Transform):
    """A step that costs violates, where the environment does not say it."""

    def __init__(self, costs: list[str]) -> None:
        super().__init__(in_keys=costs, out_keys=["violation"])

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        costs = torch.stack([next_tensordict[key] for key in self.in_keys])
        return next_tensordict.set("violation", (costs > 0).any(0))

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        shape = (*tensordict_reset.batch_size, 1)
        no = torch.zeros(shape, dtype=torch.bool, device=tensordict_reset.device)
        return tensordict_reset.set("violation", no)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        shape = (*observation_spec.shape, 1)
        observation_spec["violation"] = Binary(
            1, shape=shape, dtype=torch.bool, device=observation_spec.device
        )
        return observation_spec
