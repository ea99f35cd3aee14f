"""What a run says to whoever looks, which can fail without harm: nobody may be there any more."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import suppress
from types import FrameType
from typing import Any, TextIO

from tqdm import tqdm


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


def say(text: str) -> None:
    """A line on the terminal, if there is one."""
    print(text, file=Lenient(sys.stdout), flush=True)


def progress_bar(**options: Any) -> tqdm:
    """A progress bar that ends nothing when it cannot be drawn."""
    return tqdm(file=Lenient(sys.stderr), **options)


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
