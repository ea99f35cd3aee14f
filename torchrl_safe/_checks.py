"""Checks of arguments; their errors name the argument, what is allowed and what it was given."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

from torch import Tensor


def check_shape(
    name: str, tensor: Tensor, expected: Sequence[int], origin: str, *, hint: str = ""
) -> None:
    """Raise a ``ValueError`` unless a tensor has the shape that something else asks for.

    Args:
        name (str): of the argument.
        tensor (Tensor): what it was given.
        expected (sequence of int): the shape.
        origin (str): what asks for it, such as ``"that of reward"``.

    Keyword Args:
        hint (str): how to come by such a tensor, for the message.

    Examples:
        >>> import torch
        >>> check_shape("done", torch.zeros(2), (2, 1), "that of reward")
        Traceback (most recent call last):
            ...
        ValueError: done must have shape (2, 1), that of reward, got (2,).
    """
    if tensor.shape != tuple(expected):
        raise ValueError(
            f"{name} must have shape {tuple(expected)}, {origin}, got {tuple(tensor.shape)}"
            f"{hint and ': '}{hint}."
        )


def check_count(name: str, value: int) -> None:
    """Raise a ``ValueError`` unless ``value`` is an integer of at least 1."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 1:
        raise ValueError(f"{name} must be an integer, at least 1, got {value!r}.")


def check_number(
    name: str,
    value: Any,
    *,
    positive: bool = False,
    least: float = -math.inf,
    most: float = math.inf,
    instead: str = "",
) -> None:
    """Raise a ``ValueError`` unless ``value`` is a finite number, in a range if there is one.

    Args:
        name (str): of the argument.
        value (Any): what it was given. A bool is no number.

    Keyword Args:
        positive (bool): it must be larger than 0.
        least (float): it must be at least this.
        most (float): it must be at most this.
        instead (str): what is allowed besides, for the message.
    """
    is_number = isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    if is_number and least <= value <= most and (value > 0 or not positive):
        return
    low = f", at least {least:g}" if least > -math.inf else ""
    high = f", at most {most:g}" if most < math.inf else ""
    raise ValueError(
        f"{name} must be {instead}a {'positive ' if positive else ''}finite number{low}{high}, got "
        f"{value!r}."
    )
