"""How the costs of an environment are called: the one convention that every room reads.

One cost is the entry ``"cost"``, and ``"violation"`` says whether its constraint is violated. Of
several, each is an entry ``"<name>_cost"`` with a flag ``"<name>_violation"``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

__all__ = ["cost_key", "names_among", "violation_key"]


def cost_key(name: str) -> str:
    """The entry of a cost by its name; that of the only one is ``""``.

    Examples:
        >>> cost_key("speed"), cost_key("")
        ('speed_cost', 'cost')
    """
    return f"{name}_cost" if name else "cost"


def violation_key(name: str) -> str:
    """The entry that says whether a cost's constraint is violated.

    Examples:
        >>> violation_key("speed"), violation_key("")
        ('speed_violation', 'violation')
    """
    return f"{name}_violation" if name else "violation"


def names_among(keys: Iterable[Any]) -> tuple[str, ...]:
    """The names of several costs among entries; none where there is one, or no cost.

    Examples:
        >>> names_among(["reward", "cost"]), names_among(["collision_cost", "speed_cost", "reward"])
        ((), ('collision', 'speed'))
    """
    strings = [key for key in keys if isinstance(key, str)]
    return tuple(key.removesuffix("_cost") for key in strings if key.endswith("_cost"))
