"""The reference has an entry for every public object, and none for what is gone."""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import re
from pathlib import Path

import pytest

import torchrl_safe

pytest.importorskip("dm_control")  # its interface has entries, too

REFERENCE = Path(__file__).parents[2] / "docs" / "reference"
ENTRY = re.compile(r"^\.\. (?:auto\w+|py:\w+):: (torchrl_safe\S+)", re.MULTILINE)


def entries() -> list[str]:
    pages = sorted(REFERENCE.glob("*.md"))
    return [name for page in pages for name in ENTRY.findall(page.read_text())]


def resolve(name: str) -> object:
    module, _, attribute = name.rpartition(".")
    return getattr(importlib.import_module(module), attribute)


def public_modules() -> list[str]:
    """The package and every module with a name and an ``__all__`` of its own."""
    found = pkgutil.walk_packages(torchrl_safe.__path__, "torchrl_safe.")
    names = [m.name for m in found if not any(p.startswith("_") for p in m.name.split("."))]
    return ["torchrl_safe", *(n for n in names if hasattr(importlib.import_module(n), "__all__"))]


@pytest.mark.parametrize("module", public_modules())
def test_every_public_object_has_an_entry(module):
    documented = [resolve(name) for name in entries()]
    package = importlib.import_module(module)
    missing = [
        name
        for name in package.__all__
        if not any(getattr(package, name) is thing for thing in documented)
    ]
    assert not missing, f"docs/reference has no entry for {missing} of {module}"


def test_every_entry_exists_once():
    names = entries()
    things = [resolve(name) for name in names]  # raises for what is gone
    assert len(names) == len(set(names)) == len({id(thing) for thing in things})


@pytest.mark.parametrize("name", entries())
def test_every_entry_explains_itself(name):
    thing = resolve(name)
    if inspect.isclass(thing) or inspect.isfunction(thing):
        assert (thing.__doc__ or "").strip(), f"{name} has no docstring"
