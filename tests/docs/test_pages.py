"""The Python blocks of the pages run: one by one, as a reader pastes them; notebooks as a whole."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)

PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")))
NOTEBOOKS = [page for page in PAGES if "\nkernelspec:\n" in page.read_text()]
BLOCKS = [
    pytest.param(block, id=f"{page.relative_to(ROOT)}:{number}")
    for page in PAGES
    if page not in NOTEBOOKS
    for number, block in enumerate(BLOCK.findall(page.read_text()), 1)
    if "import " in block  # or it is a fragment of a script
]


def run(code, folder, monkeypatch):
    monkeypatch.chdir(folder)
    torch.manual_seed(0)
    # Not "__main__": what starts processes is for a script of its own.
    page = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", page)  # dataclasses look their module up
    exec(compile(code, "page", "exec"), vars(page))


@pytest.mark.parametrize("block", BLOCKS)
def test_block_runs(block, tmp_path, monkeypatch):
    if "interfaces import suite" in block:
        pytest.importorskip("dm_control")
    run(block, tmp_path, monkeypatch)


@pytest.mark.slow
@pytest.mark.parametrize("page", NOTEBOOKS, ids=lambda page: page.stem)
def test_notebook_runs(page, tmp_path, monkeypatch, capsys):
    run("\n".join(BLOCK.findall(page.read_text())), tmp_path, monkeypatch)
    assert capsys.readouterr().out  # it shows something
