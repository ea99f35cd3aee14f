"""How many threads torch has: two on a quiet machine, one while others want the cores.

Threads of torch wait for each other many thousand times a second, and burn their part of the
processor meanwhile: beside two busy programs on two cores, two threads get almost nothing done,
where one gets what it is due (docs/performance.md, "A busy machine").
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
from torch.optim.optimizer import register_optimizer_step_post_hook

MOST = 2  # where nobody says how many

TASKS = Path("/proc/self/task")  # Linux alone tells how long threads had to wait for a core
LOOK = 0.25  # seconds between looks while there are several threads
REST = 30.0  # and while there is one: to try several costs up to seconds where others are busy
# Of the time in which threads have work to do, the part in which they wait for a core. One busy
# program on one of two cores makes it .4 of that of two threads; quiet, it is about nothing.
BUSY = 0.2


def most_threads(options: Any) -> int:
    """How many threads there are at most, of torch and of the simulator."""
    return options.num_threads or MOST


@contextmanager
def threads(options: Any) -> Iterator[None]:
    """Gives torch its threads, while a run goes on; ``OMP_NUM_THREADS`` has its way, if it is set.

    A number that was asked for stays, because sums of another number of threads have other last
    bits. So it does with compiled losses, which another number of threads would compile anew.
    """
    if "OMP_NUM_THREADS" in os.environ:
        yield
        return
    most = most_threads(options)
    torch.set_num_threads(most)
    compiles = getattr(getattr(options, "optim", None), "compile", False)
    if options.num_threads is not None or compiles or not any(TASKS.glob("*/schedstat")):
        yield
        return
    spare = SpareThreads(most)
    hook = register_optimizer_step_post_hook(lambda *_: spare.look())
    try:
        yield
    finally:
        hook.remove()


class SpareThreads:
    """Takes threads from torch while others want the cores, and gives them back.

    Whoever is at work calls :meth:`look` often.

    Args:
        most (int): threads of torch on a quiet machine, at least 2.
        clock (callable, optional): seconds. Defaults to :func:`time.monotonic`.
        ran_and_waited (callable, optional): how long this process's threads have had a core, and
            how long they have had to wait for one. By default as Linux says.
    """

    def __init__(
        self,
        most: int,
        clock: Callable[[], float] = time.monotonic,
        ran_and_waited: Callable[[], tuple[float, float]] | None = None,
    ) -> None:
        self.most = most
        self._clock = clock
        self._ran_and_waited = ran_and_waited or _ran_and_waited
        self._start(several=True)

    def look(self) -> None:
        """Measures anew if it is time, and acts on it."""
        if self._clock() < self._next_look:
            return
        ran, waited = (
            now - then for now, then in zip(self._ran_and_waited(), self._then, strict=True)
        )
        self._start(several=waited <= BUSY * (ran + waited))

    def _start(self, *, several: bool) -> None:
        number = self.most if several else 1
        if torch.get_num_threads() != number:
            torch.set_num_threads(number)
        self._then = self._ran_and_waited()
        self._next_look = self._clock() + (LOOK if several else REST)


def _ran_and_waited() -> tuple[float, float]:
    """Nanoseconds of all threads of this process."""
    ran = waited = 0
    for file in TASKS.glob("*/schedstat"):
        with suppress(OSError):  # of a thread that has ended meanwhile
            words = file.read_text().split()
            ran, waited = ran + int(words[0]), waited + int(words[1])
    return ran, waited
