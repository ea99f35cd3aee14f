"""What a run says to whoever looks, which can fail without harm: nobody may be there any more."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from contextlib import suppress
from types import FrameType
from typing import Any, TextIO

from tqdm import auto, tqdm

LINES = 20  # that a log gets of a whole run


class Lenient:
    """A text stream that may be closed, or whose reader may have left.

    Args:
        stream (TextIO, optional): where to; ``None`` is what Python has for a closed one.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """Write if somebody reads."""
        self._try("write", text)
        return len(text)

    def flush(self) -> None:
        """Flush if somebody reads."""
        self._try("flush")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _try(self, method: str, *args: str) -> None:
        if self._stream is None:
            return
        try:
            getattr(self._stream, method)(*args)
        except (OSError, ValueError):  # a broken pipe, a terminal hung up; a closed file
            # What is in its buffer is written once more when Python exits.
            with suppress(OSError, ValueError):
                nothing = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nothing, self._stream.fileno())
                os.close(nothing)
            self._stream = None


def is_terminal(stream: Any) -> bool:
    """Whether what is written is seen at once; not of a closed stream or none."""
    try:
        return bool(stream.isatty())
    except (AttributeError, ValueError):
        return False


def say(text: str) -> None:
    """A line on the terminal, if there is one."""
    print(text, file=Lenient(sys.stdout), flush=True)


class Progress:
    """How far a run is, on stderr; it ends nothing when it cannot be shown.

    A terminal and a notebook have a bar that moves. A file or a pipe gets a line every 5 %.

    Args:
        total (int): frames of the whole run.
        initial (int): frames that it has already. Defaults to 0.
        unit (str): what is counted. Defaults to frames.
    """

    def __init__(self, total: int, initial: int = 0, unit: str = "frames") -> None:
        self._unit = unit
        self._total, self._initial, self._frames = total, initial, initial
        self._started, self._said = time.perf_counter(), -1
        self._bar: Any = None
        if auto.notebook_tqdm is not tqdm:  # a notebook that has widgets
            self._bar = auto.tqdm(total=total, initial=initial, unit="", unit_scale=True)
        elif is_terminal(sys.stderr):
            self._bar = tqdm(
                total=total,
                initial=initial,
                file=Lenient(sys.stderr),
                unit="",
                unit_scale=True,
                dynamic_ncols=True,
                bar_format="{percentage:3.0f} %|{bar}| {n_fmt}/{total_fmt}, {remaining} left, "
                "{rate_fmt}{postfix}",
            )

    def update(self, frames: int, **numbers: str) -> None:
        """Go on by some frames.

        Args:
            frames (int): how many.
            **numbers: what is shown beside, by name.
        """
        self._frames += frames
        words = ", ".join(f"{name} {text}" for name, text in numbers.items())
        if self._bar is not None:
            self._bar.set_postfix_str(words, refresh=False)
            self._bar.update(frames)
            return
        if self._frames < self._total and self._frames * LINES // self._total <= self._said:
            return
        self._said = self._frames * LINES // self._total
        speed = (self._frames - self._initial) / max(time.perf_counter() - self._started, 1e-9)
        left = tqdm.format_interval(max(self._total - self._frames, 0) / max(speed, 1e-9))
        print(
            f"{self._frames:,} of {self._total:,} {self._unit}, {left} left, {speed:,.0f}/s, "
            f"{words}",
            file=Lenient(sys.stderr),
            flush=True,
        )

    def close(self) -> None:
        """Leave the line as it is."""
        if self._bar is not None:
            self._bar.close()


class GracefulStop:
    """Turns the first Ctrl-C, SIGTERM or SIGHUP into a flag: a run stops between updates.

    A second one interrupts at once. What ``nohup`` started outlives its terminal.
    """

    names = ("SIGINT", "SIGTERM", "SIGHUP")  # the last is unknown to Windows

    def __init__(self) -> None:
        self.requested = False
        self._previous: dict[signal.Signals, Any] = {}

    def __enter__(self) -> GracefulStop:
        if threading.current_thread() is not threading.main_thread():
            return self  # signals are the main thread's
        for number in (getattr(signal, name) for name in self.names if hasattr(signal, name)):
            if number.name == "SIGHUP" and signal.getsignal(number) is signal.SIG_IGN:
                continue
            self._previous[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        if self.requested:
            raise KeyboardInterrupt
        self.requested = True
