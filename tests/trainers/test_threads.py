"""Threads of torch: taken and given back by how long threads wait for a core."""

from __future__ import annotations

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch
from torch.optim.optimizer import _global_optimizer_post_hooks as hooks

from torchrl_safe.trainers import threads as module
from torchrl_safe.trainers.threads import SpareThreads, most_threads, threads

linux = pytest.mark.skipif(not any(module.TASKS.glob("*/schedstat")), reason="Linux alone tells")


@pytest.fixture(autouse=True)
def as_it_was(monkeypatch):
    """As a user's process is: without the tests' own setting, and torch as found afterwards."""
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


class Machine:
    """Seconds go by, in a part of which threads wait."""

    now = ran = waited = 0.0

    def go(self, seconds, waiting):
        self.now += seconds
        self.ran += seconds * (1 - waiting)
        self.waited += seconds * waiting

    def spare(self, most):
        return SpareThreads(most, lambda: self.now, lambda: (self.ran, self.waited))


def test_one_thread_while_others_want_the_cores():
    machine = Machine()
    spare = machine.spare(3)
    seen = []
    # seconds, share of waiting
    for step in [(1, 0.1), (0.1, 0.9), (0.1, 0.9), (0.1, 0.9), (29, 0.0), (1.5, 0.0), (1, 0.3)]:
        machine.go(*step)
        spare.look()
        seen.append(torch.get_num_threads())
    # Quiet; not time to look yet, twice; busy; a rest; quiet, so all are tried; busy again.
    assert seen == [3, 3, 3, 1, 1, 3, 1]


def test_no_trial_while_one_thread_has_to_wait():
    machine = Machine()
    spare = machine.spare(2)
    for _ in range(5):
        machine.go(31, 0.5)
        spare.look()
        assert torch.get_num_threads() == 1


def test_a_process_that_stood_still_has_not_waited():
    machine = Machine()
    spare = machine.spare(2)
    machine.now += 1000  # stopped
    spare.look()
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(
    ("num_threads", "compiles", "number", "watched"),
    [
        (None, False, 2, True),
        (None, True, 2, False),  # another number would compile anew
        (2, False, 2, False),  # asked for: the same bits
        (1, False, 1, False),
    ],
)
@linux
def test_who_is_watched(num_threads, compiles, number, watched):
    options = SimpleNamespace(num_threads=num_threads, optim=SimpleNamespace(compile=compiles))
    before = len(hooks)
    with threads(options):
        assert most_threads(options) == torch.get_num_threads() == number
        assert len(hooks) - before == watched
    assert len(hooks) == before


def test_the_variable_has_its_way(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    torch.set_num_threads(3)
    before = len(hooks)
    with threads(SimpleNamespace(num_threads=None)):
        assert torch.get_num_threads() == 3
        assert len(hooks) == before


@linux
@pytest.mark.slow
def test_beside_busy_programs(monkeypatch):
    """Real ones: more than there are cores, so that some thread waits wherever it runs."""
    monkeypatch.setattr(module, "LOOK", 0.05)
    busy = [sys.executable, "-c", "while True: pass"]
    others = [subprocess.Popen(busy) for _ in range(2 * (os.cpu_count() or 1))]
    try:
        parameter = torch.nn.Parameter(torch.ones(200_000))
        sgd = torch.optim.SGD([parameter], lr=1e-3)
        with threads(SimpleNamespace(num_threads=None)):
            for _ in range(100_000):
                sgd.zero_grad()
                parameter.square().sum().backward()
                sgd.step()
                if torch.get_num_threads() == 1:
                    return
            pytest.fail("several threads beside busy programs")
    finally:
        for other in others:
            other.kill()
            other.wait()
