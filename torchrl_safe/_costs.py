"""How the costs of an environment are called: the one convention that every room reads.

One cost is the entry ``"cost"``, and ``"violation"`` says whether its constraint is violated. Of
several, each is an entry ``"<name>_cost"`` with a flag ``"<name>_violation"``.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

__all__ = ["cost_key", "costs_among", "prefix_of", "violation_key"]


def cost_key(name: str) -> str:
    """The entry of a cost by its name; that of the only one is ``""``.

    Examples:
        >>> cost_key("speed"), cost_key("")
        ('speed_cost', 'cost')
    """
    return f"{name}_cost" if name else "cost"


def prefix_of(cost: str) -> str:
    """What stands before every entry that belongs to a cost.

    Examples:
        >>> prefix_of("speed_cost"), prefix_of("cost")
        ('speed_', '')
    """
    return cost.removesuffix("cost")


def violation_key(cost: str) -> str:
    """The entry that says whether a cost's constraint is violated.

    Examples:
        >>> violation_key("speed_cost"), violation_key("cost")
        ('speed_violation', 'violation')
    """
    return f"{prefix_of(cost)}violation"


def costs_among(keys: Iterable[Any]) -> tuple[str, ...]:
    """The costs among entries.

    Examples:
        >>> costs_among(["reward", "cost"]), costs_among(["collision_cost", "speed_cost", "reward"])
        (('cost',), ('collision_cost', 'speed_cost'))
    """
    strings = [key for key in keys if isinstance(key, str)]
    return tuple(key for key in strings if key == "cost" or key.endswith("_cost"))
