"""What a process leaves alone: things that it must neither use nor take apart."""

from __future__ import annotations

import ctypes


def keep_forever(thing: object) -> None:
    """Keeps an object out of the garbage collector's hands until the process is gone.

    For what would hang or crash if it was destroyed: a thread pool in a forked process, which has
    none of its threads, or an OpenGL context at exit, when somebody else may have ended OpenGL.
    """
    ctypes.pythonapi.Py_IncRef(ctypes.py_object(thing))
