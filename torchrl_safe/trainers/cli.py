"""The command ``torchrl-safe``: train a method, or do something with a run.

    torchrl-safe train safetac env.robot=point
    torchrl-safe train safetac env.task=SafetyPointGoal1
    torchrl-safe train cpo env=gym env.id=Pendulum-v1 env.cost=my_costs:speed
    torchrl-safe train trc published=kim2022 --multirun seed=0,1,2
    torchrl-safe evaluate runs/safetac/point/seed_0
    torchrl-safe report runs/safetac/point/seed_0
    torchrl-safe play safetac-point

Options of training are hydra's grammar; the other commands have ``--help``.
"""

from __future__ import annotations

import argparse
import os
import re
import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Any

import hydra
from hydra.core.config_store import ConfigStore
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import CompactHydraException
from omegaconf import DictConfig, OmegaConf
from torchrl.checkpoint import CheckpointError

from torchrl_safe.trainers.commands import evaluate, export, play, report, watch
from torchrl_safe.trainers.methods import METHODS
from torchrl_safe.trainers.options import Options, flat
from torchrl_safe.trainers.published import PUBLISHED
from torchrl_safe.trainers.tasks import follows

CANNOT = (CheckpointError, ModuleNotFoundError, OSError, ValueError)  # with what to do about it

# Hydra itself writes no folder and no log: run_dir has everything.
HYDRA = {
    "output_subdir": None,
    "run": {"dir": "."},
    "sweep": {  # it insists on a folder for its own record of a sweep
        "dir": "${oc.env:TMPDIR,${oc.env:TEMP,/tmp}}/hydra-${oc.env:USER,${oc.env:USERNAME,user}}",
        "subdir": ".",
    },
}


COMMANDS: dict[str, Any] = {
    module.__name__.rpartition(".")[2]: module for module in (evaluate, watch, report, export, play)
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Do what the command line says.

    Args:
        arguments (sequence of str, optional): defaults to the process's.

    Raises:
        SystemExit: if it cannot be done, with the reason.
    """
    parser = argparse.ArgumentParser(
        "torchrl-safe",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(dest="command", required=True)
    trains = commands.add_parser("train", help="train a method")
    trains.add_argument("method", choices=METHODS)
    trains.add_argument(
        "options", nargs=argparse.REMAINDER, help="such as loss.cost_limit=2.5, --multirun, --help"
    )
    for name, module in COMMANDS.items():
        summary = module.__doc__.splitlines()[0]
        module.add_arguments(commands.add_parser(name, help=summary, description=summary))
    given = vars(parser.parse_args(arguments))
    # Where module:function is looked for; last, so that nothing there passes for Python's own.
    sys.path.append(os.getcwd())
    command = given.pop("command")
    if command == "train":
        train(given["method"], given["options"])
        return
    try:
        COMMANDS[command].main(**given)
    except CANNOT as error:
        sys.exit(f"torchrl-safe {command}: {error}")


def train(method: str, arguments: Sequence[str] | None = None, **defaults: Any) -> None:
    """Train a method as hydra's arguments say: ``a.b=c``, ``--multirun``, ``--cfg job``.

    Args:
        method (str): a name in ``METHODS``.
        arguments (sequence of str, optional): defaults to the process's.
        **defaults: other defaults of options of the top level.
    """

    def go(options: Any) -> None:
        METHODS[method](options=options).train()

    run(method, go, arguments, **defaults)


def run(
    method: str,
    go: Callable[[Any], None],
    arguments: Sequence[str] | None = None,
    **defaults: Any,
) -> None:
    """Do something with options of hydra's arguments, which may ask for several runs.

    Args:
        method (str): which an :class:`~torchrl_safe.trainers.options.Options` has.
        go (callable): what is done with the options.
        arguments (sequence of str, optional): defaults to the process's.
        **defaults: other defaults of options of the top level.
    """
    arguments = [*map(spelled_out, sys.argv[1:] if arguments is None else arguments)]
    standard = defaults_for(method, arguments)
    name = register(standard, **defaults)

    def main(cfg: DictConfig) -> None:
        try:
            go(options_of(standard, cfg))
        except CANNOT as error:
            if not _is_ours(error):
                raise
            # Of which hydra shows the message alone, and with HYDRA_FULL_ERROR=1 everything.
            raise CompactHydraException(f"torchrl-safe train: {error}") from error

    before, sys.argv = sys.argv, [sys.argv[0], *arguments]
    try:
        hydra.main(config_path=None, config_name=name, version_base="1.3")(main)()
    finally:
        sys.argv = before


def compose(method: str, overrides: Sequence[str] = (), **defaults: Any) -> Any:
    """The options of a method with overrides as on the command line."""
    overrides = [*map(spelled_out, overrides)]
    standard = defaults_for(method, overrides)
    name = register(standard, **defaults)
    with hydra.initialize(config_path=None, version_base="1.3"):
        cfg = hydra.compose(name, overrides)
    return options_of(standard, cfg, overrides)


def defaults_for(method: str, arguments: Sequence[str]) -> Any:
    """The options of a method of which at most those are given that others follow from.

    What is printed by ``--cfg job`` is then what follows from the task, and what was published. A
    sweep over them prints the defaults of none, and every job of it follows its own.
    """
    options = Options.known[method]
    words = [word.lstrip("+").partition("=") for word in arguments]
    values = {name: value for name, _, value in words}
    known = {
        "env.task": bool(follows(values.get("env.task"))),
        "published": values.get("published") in PUBLISHED.get(method, {}),
    }
    return options.of(**{name: values[name] for name, is_one in known.items() if is_one})


def register(standard: Options, **defaults: Any) -> str:
    """Give hydra the defaults of a method; the name that it knows them by."""
    method, settings = standard.method, standard.model_dump() | defaults
    defaults_list = [
        "_self_",
        {"override hydra/job_logging": "none"},
        {"override hydra/hydra_logging": "none"},
    ]
    ConfigStore.instance().store(method, {**settings, "hydra": HYDRA, "defaults": defaults_list})
    return method


def options_of(standard: Options, cfg: DictConfig, overrides: Sequence[str] | None = None) -> Any:
    """Options of what hydra composed.

    Given are those that an override names, and those that differ from the defaults: a caller who
    composes a configuration leaves no other trace.
    """
    if overrides is None:
        overrides = list(HydraConfig.get().overrides.task) if HydraConfig.initialized() else []
    words = OverridesParser.create().parse_overrides(list(overrides))
    keys = [word.key_or_group for word in words]
    values: Any = OmegaConf.to_container(cfg, resolve=True)
    defaults = dict(flat(standard))

    def named(name: str) -> bool:
        return any(name == key or name.startswith(f"{key}.") for key in keys)

    given = {
        name: value
        for name, value in _leaves(values, defaults)
        if named(name) or name not in defaults or defaults[name] != value
    }
    return type(standard).of(**given)


def spelled_out(argument: str) -> str:
    """``env=gym`` is short for ``env.name=gym``."""
    return re.sub(r"^(\+*)env=(?!\{)", r"\1env.name=", argument)


def _is_ours(error: BaseException) -> bool:
    """Whether the library raised it: its messages say all; of others one wants the place."""
    *_, (frame, _) = traceback.walk_tb(error.__traceback__)
    return frame.f_globals["__name__"].startswith("torchrl_safe.")


def _leaves(values: Any, standard: Any, prefix: str = "") -> list[tuple[str, Any]]:
    """Options by their dotted names; an option's own mapping stays whole."""
    leaves: list[tuple[str, Any]] = []
    for name, value in values.items():
        full = prefix + str(name)
        if isinstance(value, dict) and full not in standard:
            leaves += _leaves(value, standard, f"{full}.")
        else:
            leaves.append((full, value))
    return leaves


if __name__ == "__main__":
    main()
