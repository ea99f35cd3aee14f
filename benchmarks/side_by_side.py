"""Trainings in processes of their own, some at a time; a stop saves all of them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple


class Job(NamedTuple):
    """A training: how it is called, its folder, and what runs it or goes on with it.

    Attributes:
        name: of messages.
        run_dir: its folder.
        command: what starts it.
        product: the file in the folder that is there when it is finished.
    """

    name: str
    run_dir: Path
    command: tuple[str, ...]
    product: str = "results.json"

    @property
    def finished(self) -> bool:
        """Whether its product is there."""
        return (self.run_dir / self.product).exists()

    def line(self) -> list[str]:
        """What is to be started; one that was stopped before its first checkpoint begins again."""
        begun = (self.run_dir / "config.yaml").exists()
        return [*self.command, f"run_dir={self.run_dir}", *(["resume=true"] if begun else [])]


def run_jobs(
    jobs: Sequence[Job],
    at_once: int,
    threads: int = 1,
    before: Callable[[Job], None] = lambda job: None,
    after: Callable[[Job], None] = lambda job: None,
) -> int:
    """Run those that are not finished; the number of those that failed.

    What a job prints goes to ``<run_dir>.log``. A Ctrl-C or SIGTERM reaches each as a Ctrl-C.

    Args:
        jobs (sequence of Job): in this order.
        at_once (int): how many at a time.
        threads (int): of each, as OpenMP is told; ``num_threads`` is the command's.
        before (callable, optional): is told what is about to start.
        after (callable, optional): is told what is finished, also where it was already.

    Raises:
        SystemExit: after a Ctrl-C or SIGTERM, when all have saved and ended.
    """
    running: set[subprocess.Popen[bytes]] = set()
    stopping = False

    def stop(number: int, frame: object) -> None:
        nonlocal stopping
        stopping = True
        for process in tuple(running):
            process.send_signal(signal.SIGINT)  # the run saves and ends

    def run(job: Job) -> int:
        if job.finished:
            after(job)
            return 0
        if stopping:
            return 0
        log = job.run_dir.with_name(f"{job.run_dir.name}.log")
        log.parent.mkdir(parents=True, exist_ok=True)
        before(job)
        env = {"OMP_NUM_THREADS": str(threads), **os.environ}
        with log.open("ab") as file:
            # Of a session of its own: a Ctrl-C reaches it once, from here.
            process = subprocess.Popen(
                job.line(), stdout=file, stderr=file, env=env, start_new_session=True
            )
            running.add(process)
            status = process.wait()
            running.discard(process)
        outcome = "done" if job.finished else "stopped"
        print(f"{f'status {status}' if status else outcome:10}{job.name}", flush=True)
        if job.finished:
            after(job)
        return int(status != 0)

    previous = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with ThreadPoolExecutor(at_once) as pool:
            failed = sum(pool.map(run, jobs))
        if stopping:
            sys.exit("stopped; the same command goes on")
        return failed
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
