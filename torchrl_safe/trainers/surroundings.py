"""What a run ran on: versions, the commit if there is one, the machine."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from pathlib import Path
from typing import Any

import torch

import torchrl_safe

PACKAGES = ("torchrl-safe", "torch", "torchrl", "tensordict", "mujoco", "gymnasium", "numpy")


def surroundings() -> dict[str, Any]:
    """Versions, commit and machine, as plain values that JSON takes.

    Returns:
        dict: ``commit`` is ``None`` where the code is no checkout and was not installed from one,
        and ends with ``, changed`` where files differ from it. ``gpu`` is ``None`` without one.

    Examples:
        >>> sorted(surroundings())
        ['commit', 'cores', 'gpu', 'packages', 'processor', 'python', 'system']
    """
    return {
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "commit": commit(),
        "system": f"{platform.system()} {platform.release()}",
        "processor": _processor(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def commit() -> str | None:
    """The commit of the code that runs, of a checkout or of what pip was given."""
    root = Path(torchrl_safe.__file__).parents[1]
    if (root / ".git").exists():
        try:
            head, status = (
                subprocess.run(
                    ["git", "-C", str(root), *words], capture_output=True, text=True, timeout=10
                )
                for words in (
                    ["rev-parse", "HEAD"],
                    ["status", "--porcelain", "--untracked-files=no"],
                )
            )
        except (OSError, subprocess.TimeoutExpired):
            return None
        if head.returncode or status.returncode:
            return None
        return head.stdout.strip() + (", changed" if status.stdout else "")
    try:
        return _of_wheel(distribution("torchrl-safe"))
    except PackageNotFoundError:
        return None


def _of_wheel(package: Distribution) -> str | None:
    """The commit that pip installed from, which it notes (PEP 610)."""
    note = json.loads(package.read_text("direct_url.json") or "{}")
    return note.get("vcs_info", {}).get("commit_id")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            name, _, value = line.partition(":")
            if name.strip() == "model name":
                return value.strip()
    except OSError:  # no Linux
        pass
    return platform.processor() or platform.machine()
