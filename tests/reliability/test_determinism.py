"""The same seed, machine and number of threads give the same numbers, in every example.

Two processes run them all, in opposite orders, so that nothing that one example leaves behind can
go unnoticed, and with other hash seeds, so that no order of a set can.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import determinism
import numpy as np
import pytest

from torchrl_safe.trainers import METHODS

SCRIPT = Path(determinism.__file__)
EXAMPLES = sorted(determinism.CASES.keys() - {"another seed"})
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> list[Path]:
    """One after the other: all of it is one thread's work."""
    folders = []
    for hash_seed, order in (("1", []), ("2", ["--backwards"])):
        folder = tmp_path_factory.mktemp("examples")
        done = subprocess.run(
            [sys.executable, SCRIPT, folder, *order],
            env={**os.environ, "PYTHONHASHSEED": hash_seed, "OMP_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-3000:]
        folders.append(folder)
    return folders


def test_nothing_is_left_out():
    """Every method, every script of TorchRL's own loops, both scripts of the benchmarks."""
    examples = Path(__file__).parents[2] / "examples"
    trains = {*METHODS, "doggo_controller", "retrace_sac"}
    trains |= {path.stem for path in examples.glob("compose_*.py")}
    assert {name.split()[0] for name in EXAMPLES} == trains


@pytest.mark.parametrize("example", EXAMPLES)
def test_same_numbers(folders, example):
    one, other = (determinism.numbers(folder / example) for folder in folders)
    assert one.keys() == other.keys()
    assert sum(array.size for array in one.values()) > 3
    for name in one:
        np.testing.assert_array_equal(other[name], one[name], err_msg=name)


def test_another_seed_is_another_run(folders):
    """What is compared does depend on what happened in the run."""
    one, other = (determinism.numbers(folders[0] / n) for n in ("safetac", "another seed"))
    same = {name for name in one if np.array_equal(one[name], other[name], equal_nan=True)}
    assert {"update/kl", "update/loss_qvalue", "train/entropy", "eval/score"}.isdisjoint(same)
