"""Every Python block of the pages runs, on its own, as a reader would paste it."""

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
BLOCKS = [
    pytest.param(block, id=f"{page.relative_to(ROOT)}:{number}")
    for page in PAGES
    for number, block in enumerate(BLOCK.findall(page.read_text()), 1)
    if "import " in block  # or it is a fragment of a script
]


@pytest.mark.parametrize("block", BLOCKS)
def test_block_runs(block, tmp_path, monkeypatch):
    if "interfaces import suite" in block:
        pytest.importorskip("dm_control")
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    # Not "__main__": what starts processes is for a script of its own.
    page = ModuleType("page")
    monkeypatch.setitem(sys.modules, "page", page)  # dataclasses look their module up
    exec(compile(block, "block", "exec"), vars(page))
