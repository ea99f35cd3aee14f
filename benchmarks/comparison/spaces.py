"""What is tuned, and over which range: the same range for every method that has an option.

    python benchmarks/comparison/spaces.py   # writes the tables of docs/protocol.md

``RANGES`` has a line for each option. A method's space is the lines of the options that it has, so
that a new method has one as soon as it is in ``torchrl_safe.trainers.METHODS``; an option that only
a new method has gets a line here.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from fill import ROOT

from torchrl_safe.trainers import METHODS
from torchrl_safe.trainers.options import Options, flat

PAGE = ROOT / "docs" / "protocol.md"
BEGIN = "<!-- From here on written by benchmarks/comparison/spaces.py. -->\n"
END = "<!-- Up to here. -->\n"


class Choice(NamedTuple):
    """One of some values, all alike."""

    values: tuple[float, ...]

    def draw(self, rng: np.random.Generator) -> float:
        """A value."""
        return self.values[rng.integers(len(self.values))]

    def __str__(self) -> str:
        return ", ".join(f"{value:,g}" for value in self.values)


class Uniform(NamedTuple):
    """Between two numbers."""

    low: float
    high: float

    def draw(self, rng: np.random.Generator) -> float:
        """A number, to three digits."""
        return float(f"{rng.uniform(self.low, self.high):.3g}")

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}"


class LogUniform(NamedTuple):
    """Between two numbers, their logarithm uniformly."""

    low: float
    high: float

    def draw(self, rng: np.random.Generator) -> float:
        """A number, to three digits."""
        return float(f"{math.exp(rng.uniform(math.log(self.low), math.log(self.high))):.3g}")

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}, log-uniform"


class Per(NamedTuple):
    """A share of another option's value."""

    option: str
    of: Choice

    def draw(self, rng: np.random.Generator) -> float:
        """The share."""
        return self.of.draw(rng)

    def __str__(self) -> str:
        return f"{self.of} times `{self.option}`"


Range: TypeAlias = "Choice | Uniform | LogUniform | Per"

MEAN_LIMIT = Uniform(1.5, 3.75)
"""Of methods that limit the mean: half of the cost that tuning is for, up to 1.25 times of it."""

CVAR_LIMIT = Uniform(3.0, 7.5)
"""Of methods that limit the CVaR: at 5, the realised means were 3.0 to 3.7 (docs/results.md)."""

RANGES: dict[str, Range] = {
    # Frames per update, and how much is made of them.
    "collector.frames_per_batch": Choice((4_000, 8_000, 20_000)),
    "optim.critic_rounds": Choice((4, 8, 16)),
    "optim.num_updates": Per("collector.frames_per_batch", Choice((0.015, 0.03, 0.06))),
    "safety_critic.num_updates": Per("collector.frames_per_batch", Choice((0.015, 0.03))),
    "optim.num_epochs": Choice((5, 10, 20)),
    "optim.minibatch_size": Choice((256, 512, 1_024)),
    # Learning rates.
    "optim.critic_lr": LogUniform(3e-4, 3e-3),
    "optim.policy_lr": LogUniform(1e-4, 1e-3),
    "optim.lr": LogUniform(3e-4, 3e-3),
    "optim.tau": LogUniform(0.005, 0.05),
    # Targets and advantages.
    "loss.lmbda": Choice((0.9, 0.95, 0.97)),
    "loss.alpha": LogUniform(3e-4, 3e-2),
    # The policy's step.
    "optim.max_kl": LogUniform(0.002, 0.05),
    "optim.damping": LogUniform(0.01, 0.3),
    "optim.recovery_ratio": Choice((0.5, 0.7, 1.0)),
    "loss.clip_epsilon": Choice((0.1, 0.2, 0.3)),
    "loss.kl_weight": LogUniform(0.5, 5.0),
    "loss.penalty": LogUniform(3.0, 100.0),
    "loss.tolerance": Choice((0.0, 0.25, 0.5)),
    "policy.noise": LogUniform(0.05, 0.4),
    # The limit: where it is, how it comes down, what corrects it.
    "loss.initial_cost_limit": Per("loss.cost_limit", Choice((1.0, 1.5, 3.0))),
    "loss.anneal_frames": Per("collector.total_frames", Choice((0.25, 0.5))),
    "loss.limit_gain": Choice((0.0, 0.03, 0.1)),
    # The multiplier.
    "lagrangian.init": LogUniform(0.01, 1.0),
    "lagrangian.lr": LogUniform(0.003, 0.3),
    "pid.kp": LogUniform(0.01, 0.3),
    "pid.ki": LogUniform(0.003, 0.1),
    "pid.kd": Choice((0.0, 0.05, 0.2)),
    # What a step costs once the budget is spent.
    "budget.unsafe_reward": Uniform(-2.0, 0.0),
    "budget.termination_reward": Uniform(-5.0, 0.0),
}

UNUSED = {"safetac": ("lagrangian.", "pid.")}
"""Options that a method has for its ablations alone."""


class Row(NamedTuple):
    """What a line of the comparison is: a method, and what makes a variant of it."""

    method: str
    fixed: tuple[tuple[str, Any], ...] = ()

    @property
    def space(self) -> dict[str, Range]:
        """The ranges of what is tuned, by option."""
        values = dict(flat(Options.known[self.method]()))
        limit = MEAN_LIMIT if values.get("loss.risk_level", 1.0) == 1.0 else CVAR_LIMIT
        return {
            name: each
            for name, each in {"loss.cost_limit": limit, **RANGES}.items()
            if name in values.keys() - dict(self.fixed).keys()
            and not name.startswith(UNUSED.get(self.method, ()))
        }

    def draw(self, trial: int) -> dict[str, float]:
        """Values and shares of a trial: they depend on its number, the method and the ranges."""
        return {
            name: each.draw(np.random.default_rng([trial, *f"{self.method} {name}".encode()]))
            for name, each in self.space.items()
        }

    def settled(self, drawn: dict[str, float], frames: int) -> dict[str, Any]:
        """Options of values and shares, for a run of so many frames."""
        standard = dict(flat(Options.known[self.method]()))
        values: dict[str, Any] = {**dict(self.fixed), "collector.total_frames": frames}
        shares = {n: each.option for n, each in self.space.items() if isinstance(each, Per)}
        for name in sorted(drawn, key=lambda name: name in shares):  # shares after what they are of
            value = drawn[name]
            if name in shares:
                value = float(f"{value * values[shares[name]]:.12g}")  # .03 x 4,000 is 120
            whole = type(standard[name]) is int
            values[name] = round(value) if whole else float(value)
        return values


ROWS: dict[str, Row] = {
    **{
        name: Row(name)
        for name, method in METHODS.items()
        if "loss.cost_limit" in dict(flat(method.Options()))
    },
    "safetac_no_mirror": Row("safetac", (("optim.mirror", False),)),
    "safetac_paper": Row(
        "safetac",
        (
            ("safety_critic.kind", "gaussian"),
            ("safety_critic.num_updates", 120),  # of quantiles alone
            ("optim.mirror", False),
            ("loss.limit_gain", 0.0),
        ),
    ),
}
"""All lines of the comparison: every method with a limit, and SafeTAC without what only it has."""


def word(name: str, value: Any) -> str:
    """An option on the command line."""
    return f"{name}={value if isinstance(value, str) else json.dumps(value)}"


def shortest(rows: Sequence[str]) -> str:
    """Names of some lines of the comparison, or of those that are missing where these are fewer."""
    others = [name for name in ROWS if name not in rows]
    if len(others) < len(rows):
        return f"all but {', '.join(others)}" if others else "all"
    return ", ".join(rows)


def tables() -> str:
    """The ranges, and who has which, in Markdown."""
    owners = {
        name: [row for row, each in ROWS.items() if name in each.space]
        for name in ("loss.cost_limit", *RANGES)
    }
    lines = ["| Option | Range | Of |", "|---|---|---|"]
    for name, rows in owners.items():
        ranges = {str(ROWS[row].space[name]): None for row in rows}
        if len(ranges) > 1:  # the limit: on the mean, or on the CVaR
            for each in ranges:
                own = [row for row in rows if str(ROWS[row].space[name]) == each]
                lines.append(f"| `{name}` | {each} | {shortest(own)} |")
        else:
            lines.append(f"| `{name}` | {next(iter(ranges))} | {shortest(rows)} |")
    lines += ["", "| Line | Trained as |", "|---|---|"]
    for name, row in ROWS.items():
        words = " ".join([row.method, *(word(*each) for each in row.fixed)])
        lines.append(f"| {name} | `torchrl-safe train {words}` |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """The page of the protocol with the tables of now."""
    before, _, rest = PAGE.read_text().partition(BEGIN)
    return f"{before}{BEGIN}\n{tables()}\n{END}{rest.partition(END)[2]}"


def main(argv: Sequence[str] | None = None) -> None:
    """Write the tables."""
    PAGE.write_text(page())


if __name__ == "__main__":
    main()
