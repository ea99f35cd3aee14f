"""Trained policies that come with the library, each with the options that it was trained with.

A policy is one file, ``<name>.safetensors``: weights, the run's configuration, and the command,
commit and figures beside them. ``torchrl-safe play <name>`` films one.
"""

from __future__ import annotations

from pathlib import Path

from torchrl_safe.trainers.saved_policies import SavedPolicy, read_policy

__all__ = ["load", "names"]

FOLDER = Path(__file__).parent


def names() -> list[str]:
    """The policies there are.

    Examples:
        >>> isinstance(names(), list)
        True
    """
    return sorted(path.stem for path in FOLDER.glob("*.safetensors"))


def load(name: str) -> SavedPolicy:
    """A policy by its name.

    Args:
        name (str): one of :func:`names`.

    Returns:
        SavedPolicy: the policy, its run's options, and what is known about it.

    Raises:
        KeyError: if there is none of that name.

    Examples:
        >>> for name in names():
        ...     policy, options, about = load(name)
    """
    if name not in names():
        raise KeyError(f"name must be one of {', '.join(names())}, got {name!r}.")
    # A package manager may have put a link there.
    return read_policy((FOLDER / f"{name}.safetensors").resolve())
