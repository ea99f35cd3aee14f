"""For every test: one thread, a checkout left as it was, dm-control where it can be installed."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parent
LEFT_BEHIND = pytest.StashKey[set[str]]()

# Workers share the cores, and sums have the same last bits on every machine. Read when torch loads.
os.environ.setdefault("OMP_NUM_THREADS", "1")

if importlib.util.find_spec("dm_control") is None:
    collect_ignore = ["torchrl_safe/envs/interfaces/suite.py"]  # its examples


@pytest.fixture
def suite() -> ModuleType:
    """The dm_control interface, from Python 3.13 on a reason to skip."""
    pytest.importorskip("dm_control")
    return importlib.import_module("torchrl_safe.envs.interfaces.suite")


def untracked() -> set[str]:
    """What git neither tracks nor ignores in the checkout, empty folders included."""
    if shutil.which("git") is None:
        return set()
    listing = subprocess.run(
        ["git", "clean", "--dry-run", "-d"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    return set(listing.stdout.splitlines())  # none in a source distribution


def is_worker(config: pytest.Config) -> bool:
    return hasattr(config, "workerinput")  # one of pytest-xdist's, of whom several run at a time


def pytest_sessionstart(session: pytest.Session) -> None:
    if not is_worker(session.config):
        session.config.stash[LEFT_BEHIND] = untracked()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Tests write to `tmp_path`: what they leave here changes what lint and imports see."""
    if is_worker(session.config):
        return
    left = session.config.stash[LEFT_BEHIND] = untracked() - session.config.stash[LEFT_BEHIND]
    if left and session.exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    if left := config.stash[LEFT_BEHIND]:
        terminalreporter.section("tests left files in the checkout", red=True, bold=True)
        terminalreporter.write_line("\n".join(sorted(left)))
