"""Options of a run that goes on: what is not given again stays as it was."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from torch import nn

OF_THE_CALL = ("resume", "run_dir")  # and not of the run

# What a run cannot take another value of: the shapes of what a checkpoint holds, and what only its
# beginning depends on.
FIXED = (
    "script",
    "seed",
    "update",
    "env.name",
    "env.robot",
    "policy.num_cells",
    "policy.num_components",
    "policy.init_std",
    "critic.num_cells",
    "network.num_cells",
    "replay_buffer.size",
    "lagrangian.init",
    "gait",
)
LEARNED = {"loss.alpha": ("tac", "wcsac", "sac_lagrangian")}  # only the first value is an option


def flat(options: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Options by their dotted names."""
    for name, value in options.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def given(cfg: DictConfig) -> set[str]:
    """Names of the options that somebody has set.

    They are those on hydra's command line, and those that differ from the script's own files: a
    caller who composes a configuration leaves no other trace.
    """
    names = _differing(cfg, _defaults(cfg))
    if HydraConfig.initialized():
        words = OverridesParser.create().parse_overrides(list(HydraConfig.get().overrides.task))
        keys = [word.key_or_group for word in words]
        options = dict(flat(OmegaConf.to_container(cfg)))
        names |= {n for n in options if any(n == key or n.startswith(f"{key}.") for key in keys)}
    return names


def settle(saved: DictConfig, cfg: DictConfig) -> tuple[DictConfig, dict[str, tuple[Any, Any]]]:
    """The options with which a saved run goes on, and what of them changes.

    Args:
        saved (DictConfig): the run's options so far, resolved.
        cfg (DictConfig): those of the call.

    Returns:
        tuple: the options of now, and from the name of each that changes to its old and new value.

    Raises:
        ValueError: if an option is given another value that a run cannot take up, by its name.
    """
    old = dict(flat(OmegaConf.to_container(saved)))
    new = dict(flat(OmegaConf.to_container(cfg, resolve=True)))
    again = given(cfg) | {"script"}  # who starts another script says so
    settled = OmegaConf.create(OmegaConf.to_container(cfg, resolve=True))
    changed = {}
    for name, value in new.items():
        if name in OF_THE_CALL or name not in old or old[name] == value:
            continue
        if name in again:
            changed[name] = (old[name], value)
        else:
            OmegaConf.update(settled, name, old[name], force_add=True)
    script = settled.get("script")
    fixed = [n for n in changed if n in FIXED or script in LEARNED.get(n, ())]
    if fixed:
        values = ", ".join(f"{n} was {changed[n][0]!r} and is {changed[n][1]!r}" for n in fixed)
        raise ValueError(
            f"run_dir={cfg.run_dir} cannot go on with other values of {', '.join(fixed)}: "
            f"{values}. Leave them out, or start a new run in another run_dir."
        )
    return settled, changed


def settings_of(component: Any) -> Callable[[], None]:
    """Remembers what a component was made with, to put it back when a checkpoint is loaded.

    A checkpoint holds the settings of the time it was written at: those of an optimizer's groups
    (learning rates, ``max_kl``, damping), and numbers that a module keeps as buffers (discounts,
    the limit). The options of now are the ones that count.

    Args:
        component: an optimizer or a module; of anything else nothing is remembered.

    Returns:
        callable: puts the settings back.

    Examples:
        >>> weight = torch.nn.Parameter(torch.zeros(1))
        >>> old, new = (torch.optim.Adam([weight], lr=lr) for lr in (0.1, 0.2))
        >>> put_back = settings_of(new)
        >>> new.load_state_dict(old.state_dict())
        >>> new.param_groups[0]["lr"]
        0.1
        >>> put_back()
        >>> new.param_groups[0]["lr"]
        0.2
    """
    if isinstance(component, torch.optim.Optimizer):
        groups = [
            {name: value for name, value in group.items() if name != "params"}
            for group in component.param_groups
        ]

        def put_back() -> None:
            for group, settings in zip(component.param_groups, groups, strict=True):
                group.update(settings)

    elif isinstance(component, nn.Module):
        numbers = {n: b.clone() for n, b in component.named_buffers() if b.ndim == 0}

        def put_back() -> None:
            for name, buffer in component.named_buffers():
                if name in numbers:
                    buffer.copy_(numbers[name])

    else:

        def put_back() -> None:
            pass

    return put_back


def _defaults(cfg: DictConfig) -> DictConfig | None:
    """The options of the script's own files."""
    if "script" not in cfg:
        return None
    hydras = GlobalHydra.instance()
    running, hydras.hydra = hydras.hydra, None  # there is room for one, and hydra.main has it
    try:
        with hydra.initialize_config_dir(str(Path(__file__).resolve().parent), version_base="1.3"):
            return hydra.compose(cfg.script)
    finally:
        hydras.hydra = running


def _differing(cfg: DictConfig, defaults: DictConfig | None) -> set[str]:
    """Options with another value than the default one, written out and resolved."""
    if defaults is None:
        return {name for name, _ in flat(OmegaConf.to_container(cfg))}
    different: set[str] | None = None
    for resolve in (False, True):
        here, there = (
            dict(flat(OmegaConf.to_container(each, resolve=resolve))) for each in (cfg, defaults)
        )
        names = {n for n, value in here.items() if n not in there or there[n] != value}
        different = names if different is None else different & names
    return different
