"""What a configuration may hold: every option of every example, checked before anything is made."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from numbers import Real
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from torchrl_safe.envs import RANDOMIZATIONS, ROBOTS
from torchrl_safe.trainers.collectors import BACKENDS
from torchrl_safe.trainers.options import flat
from torchrl_safe.trainers.policy_steps import DISTANCES

LARGEST = float(np.finfo(np.float32).max)


class Rule(NamedTuple):
    """What an option's value must be."""

    holds: Callable[[Any], bool]
    text: str


def integer(low: int, high: int = 2**31 - 1) -> Rule:
    """A whole number between ``low`` and ``high``, by default the largest that C's int holds."""
    return Rule(
        lambda v: isinstance(v, int) and not isinstance(v, bool) and low <= v <= high,
        f"an integer of at least {low} and at most {high}",
    )


def number(interval: str) -> Rule:
    """A finite number in an interval such as ``[0, 1)`` or ``(0, inf)``, in single precision."""
    low, high = (float(end) for end in interval[1:-1].split(","))
    above = float.__gt__ if interval[0] == "(" else float.__ge__
    below = float.__lt__ if interval[-1] == ")" else float.__le__

    def holds(value: Any) -> bool:
        if not isinstance(value, Real) or isinstance(value, bool):
            return False
        if not abs(value) <= LARGEST:
            return False
        value = float(np.float32(value))  # as networks will have it: 1 - 1e-9 is 1
        return above(value, low) and below(value, high)

    return Rule(holds, f"a number in {interval}")


def one_of(*choices: Any) -> Rule:
    """One of the given values."""
    return Rule(lambda v: v in choices, "one of " + ", ".join(map(repr, choices)))


def widths() -> Rule:
    """Sizes of hidden layers."""
    return Rule(
        lambda v: isinstance(v, list) and all(integer(1).holds(n) for n in v),
        "a list of integers of at least 1",
    )


def bounds() -> Rule:
    """A pair of rising numbers."""
    return Rule(
        lambda v: (
            isinstance(v, list)
            and len(v) == 2
            and all(number("(-inf, inf)").holds(n) for n in v)
            and v[0] < v[1]
        ),
        "two finite numbers, the smaller one first",
    )


def stages() -> Rule:
    """Stages of the cross-entropy method, each with the same entries."""
    counts = ("num_directions", "population", "elites", "num_steps", "generations")

    def holds(value: Any) -> bool:
        return isinstance(value, list) and all(
            isinstance(stage, Mapping)
            and stage.keys() == {*counts, "std"}
            and all(integer(1).holds(stage[name]) for name in counts)
            and 2 <= stage["elites"] <= stage["population"]
            and isinstance(stage["std"], list)
            and len(stage["std"]) == 2
            and all(number("[0, inf)").holds(std) for std in stage["std"])
            for stage in value
        )

    return Rule(
        holds,
        f"a list of stages with {', '.join(counts)} (integers of at least 1; 2 to population "
        "elites) and std (two numbers of at least 0)",
    )


def device() -> Rule:
    """Where tensors can be on this machine."""
    count = torch.cuda.device_count()
    names = ["cpu", *(["cuda"] if count else []), *(f"cuda:{i}" for i in range(count))]
    return one_of(*names)


def optional(rule: Rule) -> Rule:
    """As the rule says, or null."""
    return Rule(lambda v: v is None or rule.holds(v), f"null or {rule.text}")


BOOLEAN = Rule(lambda v: isinstance(v, bool), "one of True, False")  # 1 == True
PATH = Rule(lambda v: isinstance(v, str) and v != "", "a path")
NAME = Rule(lambda v: isinstance(v, str) and v != "", "a name")

FRAMES = 2**63 - 1  # what a counter of frames holds

EXTRAS = ("tensorboard", "wandb", "ray")  # packages that bear the name of the extra

RULES: dict[str, Rule] = {
    "seed": integer(0, 2**64 - 1),
    "num_threads": integer(1),
    "device": device(),
    "script": one_of(*sorted(file.stem for file in Path(__file__).parent.glob("*.yaml"))),
    "run_dir": PATH,
    "resume": BOOLEAN,
    "update": one_of("trust_region", "lagrangian", "pid"),
    "env.name": NAME,
    "env.robot": one_of(*ROBOTS),
    "env.num_envs": integer(1),
    "env.episode_length": integer(1),
    "env.randomization": optional(one_of(*RANDOMIZATIONS)),
    "task.top_speed": number("(0, inf)"),
    "task.tilt_cost": number("[0, inf)"),
    "gait": stages(),
    "collector.backend": one_of(*BACKENDS),
    "collector.num_workers": integer(1),
    "collector.frames_per_batch": integer(1),
    "collector.total_frames": integer(1, FRAMES),
    "collector.init_frames": integer(0, FRAMES),
    "replay_buffer.storage": one_of("memory", "memmap"),
    "replay_buffer.size": integer(1),
    "replay_buffer.slice_len": integer(1),
    "replay_buffer.batch_size": integer(1),
    "estimator.name": one_of("retrace", "td0"),
    "estimator.gamma": number("[0, 1)"),
    "estimator.lmbda": number("[0, 1]"),
    "network.num_cells": widths(),
    "policy.num_cells": widths(),
    "policy.num_components": integer(1),
    "policy.relaxation": one_of("gumbel_softmax", "straight_through", "implicit"),
    "policy.temperature": number("(0, inf)"),
    "policy.log_std_bounds": bounds(),
    "policy.init_std": number("(0, inf)"),
    "critic.num_cells": widths(),
    "loss.entropic_index": number("(0, inf)"),
    "loss.alpha": number("(0, inf)"),
    "loss.alpha_init": number("(0, inf)"),
    "loss.target_update_tau": number("(0, 1]"),
    "loss.gamma": number("[0, 1)"),
    "loss.cost_gamma": number("[0, 1)"),
    "loss.lmbda": number("[0, 1]"),
    "loss.risk_level": number("(0, 1]"),
    "loss.cost_limit": number("[0, inf)"),
    "loss.initial_cost_limit": number("[0, inf)"),
    "loss.anneal_frames": integer(0, FRAMES),
    "loss.variance_reward": one_of("td_error", "second_moment"),
    "loss.clip_epsilon": number("(0, 1)"),
    "loss.entropy_coeff": number("[0, inf)"),
    "lagrangian.policy_lr": number("(0, inf)"),
    "lagrangian.minibatch_size": integer(1),
    "lagrangian.init": number("(0, inf)"),
    "lagrangian.lr": number("(0, inf)"),
    "pid.kp": number("[0, inf)"),
    "pid.ki": number("(0, inf)"),
    "pid.kd": number("[0, inf)"),
    "optim.num_epochs": integer(1),
    "optim.num_updates": integer(1),
    "optim.tau": number("(0, 1]"),
    "optim.lr": number("(0, inf)"),
    "optim.updates_per_frame": number("(0, inf)"),
    "optim.critic_lr": number("(0, inf)"),
    "optim.max_grad_norm": number("(0, inf)"),
    "optim.max_skipped": integer(0),
    "optim.critic_rounds": integer(1),
    "optim.critic_frames": integer(1),
    "optim.minibatch_size": integer(1),
    "optim.compile": BOOLEAN,
    "optim.cuda_graphs": BOOLEAN,
    "optim.policy_frames": integer(1),
    "optim.curvature_frames": optional(integer(1)),
    "optim.max_kl": number("(0, inf)"),
    "optim.kl": one_of("auto", *DISTANCES),
    "optim.damping": number("[0, inf)"),
    "optim.cg_iters": integer(1),
    "optim.backtrack_ratio": number("(0, 1)"),
    "optim.max_backtracks": integer(0),
    "optim.recovery_ratio": number("(0, 1]"),
    "logger.backend": one_of("csv", "tensorboard", "wandb", ""),
    "logger.project_name": NAME,
    "eval.interval": integer(1, FRAMES),
    "eval.num_episodes": integer(1),
    "eval.final_episodes": integer(1),
    "eval.num_directions": integer(1),
    "eval.num_steps": integer(1),
    "checkpoint.interval": integer(1, FRAMES),
    "checkpoint.keep_last": integer(1),
    "video.num_steps": integer(0),
}


def check_config(cfg: DictConfig) -> None:
    """Fail at once, with the name of the option and what is allowed.

    Raises:
        ValueError: if an option is unknown, its value is impossible, or two do not go together.
        ModuleNotFoundError: if the package of a logger or collector is not installed.
    """
    options = check_options(cfg)
    for name, plain in (("logger.backend", "csv"), ("collector.backend", "single")):
        extra = options.get(name)
        if extra in EXTRAS and find_spec(extra) is None:
            raise ModuleNotFoundError(
                f"{name}={extra} needs a package: pip install 'torchrl-safe[{extra}]'; "
                f"{name}={plain} needs none."
            )


def check_options(cfg: DictConfig) -> dict[str, Any]:
    """What of :func:`check_config` does not depend on the installed packages.

    Returns:
        dict: the options by their dotted names.

    Raises:
        ValueError: if an option is unknown, its value is impossible, or two do not go together.
    """
    options = dict(flat(OmegaConf.to_container(cfg, resolve=True)))
    for name, value in options.items():
        if name not in RULES:
            close = difflib.get_close_matches(name, RULES) or sorted(RULES)
            raise ValueError(f"{name} is not an option; there are {', '.join(close)}.")
        rule = RULES[name]
        if not rule.holds(value):
            raise ValueError(f"{name} must be {rule.text}, got {_shown(value)}.")
    _check_together(options)
    return options


def _shown(value: Any) -> str:
    """A value as it was written, and where it differs visibly, as networks will have it."""
    if not isinstance(value, float):
        return repr(value)
    with np.errstate(over="ignore", under="ignore"):
        single = np.float32(value)
    rounded = value not in (0, 1) and single in (0, 1, np.inf, -np.inf) and abs(value) < np.inf
    return f"{value!r}, which is {single} in single precision" if rounded else repr(value)


def _check_together(options: Mapping[str, Any]) -> None:
    """Options that depend on one another; those that a configuration lacks are not checked."""
    if options.get("replay_buffer.storage") == "memmap" and options.get("device", "cpu") != "cpu":
        raise ValueError(
            "replay_buffer.storage=memmap keeps the replay on the CPU, so that device must be cpu, "
            f"got {options['device']!r}."
        )
    workers = options.get("collector.backend", "single") != "single"
    for name, divisor in (
        ("collector.frames_per_batch", "env.num_envs"),
        *((("env.num_envs", "collector.num_workers"),) if workers else ()),
        ("optim.critic_frames", "replay_buffer.slice_len"),
        ("replay_buffer.batch_size", "replay_buffer.slice_len"),
    ):
        if {name, divisor} <= options.keys() and options[name] % options[divisor]:
            raise ValueError(
                f"{name} must be a multiple of {divisor}={options[divisor]}, got {options[name]}."
            )
    if {"replay_buffer.slice_len", "env.num_envs"} <= options.keys():
        _check_slices(options)
    for name, ceiling in (
        ("replay_buffer.slice_len", "env.episode_length"),
        ("collector.frames_per_batch", "replay_buffer.size"),
        ("optim.critic_frames", "replay_buffer.size"),
    ):
        if {name, ceiling} <= options.keys() and options[name] > options[ceiling]:
            raise ValueError(
                f"{name} must be at most {ceiling}={options[ceiling]}, got {options[name]}."
            )


def _check_slices(options: Mapping[str, Any]) -> None:
    """The first update replays slices of trajectories that must be there by then."""
    frames, slice_len = options["collector.frames_per_batch"], options["replay_buffer.slice_len"]
    num_envs = options["env.num_envs"]
    batches = max(1, -(-options["collector.init_frames"] // frames))
    if options["collector.backend"] == "multi_async":  # the next batch is another worker's
        num_envs, batches = num_envs // options["collector.num_workers"], 1
    steps = frames // num_envs
    if steps < 2 or batches * steps < slice_len:
        least = num_envs * max(2, -(-slice_len // batches))
        raise ValueError(
            f"collector.frames_per_batch must be at least {least}, got {frames}: {num_envs} "
            f"environments must take {slice_len} steps (replay_buffer.slice_len), and 2 in every "
            f"batch, before the first update at collector.init_frames="
            f"{options['collector.init_frames']}."
        )
