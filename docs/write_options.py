"""Writes the tables of configuration.md: every option of every method, as it is declared.

python docs/write_options.py
"""

from __future__ import annotations

import json
from pathlib import Path

from torchrl_safe.trainers import METHODS
from torchrl_safe.trainers.options import Description, describe

PAGE = Path(__file__).parent / "configuration.md"
MARK = "<!-- The rest is written by docs/write_options.py. -->\n"


def row(option: Description) -> str:
    """A line of a table; what a machine has or lacks is no part of it."""
    allowed = "a device of this machine" if option.name == "device" else option.allowed
    cells = (
        f"`{option.name}`",
        f"`{json.dumps(option.default)}`",
        option.meaning,
        allowed + ("; a resumed run keeps it" if option.fixed else ""),
    )
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def table(options: list[Description]) -> list[str]:
    """Options, one a line."""
    return ["| Option | Default | Meaning | Allowed |", "|---|---|---|---|", *map(row, options)]


def tables() -> str:
    """Of SafeTAC all options; of the others those that it lacks, or has another default of."""
    methods = {name: describe(method.Options) for name, method in METHODS.items()}
    known = methods["safetac"]
    lines = [MARK, "## All options of `safetac`", "", *table(methods.pop("safetac")), ""]
    for name, options in methods.items():
        lines += [f"## What `{name}` has otherwise", ""]
        lines += [*table([option for option in options if option not in known]), ""]
    return "\n".join(lines)


def text() -> str:
    """The page as it should be."""
    return PAGE.read_text().partition(MARK)[0] + tables()


if __name__ == "__main__":
    PAGE.write_text(text())
