"""Writes the tables of two pages: options as they are declared, settings as they were published.

python docs/write_options.py
"""

from __future__ import annotations

import json
import textwrap
from collections.abc import Callable, Iterable
from pathlib import Path

from torchrl_safe.trainers import METHODS
from torchrl_safe.trainers.options import Description, describe
from torchrl_safe.trainers.published import PUBLISHED, Published

DOCS = Path(__file__).parent
MARK = "<!-- The rest is written by docs/write_options.py. -->\n"


def table(head: str, rows: Iterable[tuple[str, ...]]) -> list[str]:
    """A head, its cells parted by ``|``, and rows of cells."""
    cells = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in rows)
    return [f"| {head} |", f"|{'---|' * (head.count('|') + 1)}", *(f"| {row} |" for row in cells)]


def shown(option: Description) -> tuple[str, ...]:
    """Cells of an option; what a machine has or lacks is no part of it."""
    allowed = "a device of this machine" if option.name == "device" else option.allowed
    return (
        f"`{option.name}`",
        f"`{json.dumps(option.default)}`",
        option.meaning,
        allowed + ("; a resumed run keeps it" if option.fixed else ""),
    )


def option_tables() -> list[str]:
    """Of SafeTAC all options; of the others those that it lacks, or has another default of."""
    head = "Option | Default | Meaning | Allowed"
    methods = {name: describe(method.Options) for name, method in METHODS.items()}
    known = methods["safetac"]
    lines = ["## All options of `safetac`", ""]
    lines += [*table(head, map(shown, methods.pop("safetac"))), ""]
    for name, options in methods.items():
        lines += [f"## What `{name}` has otherwise", ""]
        lines += [*table(head, (shown(option) for option in options if option not in known)), ""]
    return lines


def published_tables() -> list[str]:
    """What was published of each method, beside its default."""
    lines = []
    for name, each in PUBLISHED.items():
        defaults = {row.name: row.default for row in describe(METHODS[name].Options)}
        for which, published in each.items():
            lines += [f"## `{name} published={which}`", ""]
            lines += [*textwrap.wrap(f"{published.source}.", 100), ""]
            head = "Option | Published | Default | There called"
            lines += [*table(head, published_rows(published, defaults)), ""]
            lines += [*textwrap.wrap(published.differs, 100), ""]
    return lines


def published_rows(published: Published, defaults: dict[str, object]) -> Iterable[tuple[str, ...]]:
    """Cells of each option that was published."""
    for option, (value, called) in published.values.items():
        yield f"`{option}`", f"`{json.dumps(value)}`", f"`{json.dumps(defaults[option])}`", called


PAGES: dict[Path, Callable[[], list[str]]] = {
    DOCS / "configuration.md": option_tables,
    DOCS / "published.md": published_tables,
}


def text(page: Path) -> str:
    """A page as it should be."""
    return "\n".join([page.read_text().partition(MARK)[0] + MARK, *PAGES[page]()])


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(text(page))
