"""Names that are somewhere else now: they still work, with a warning that says where."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def moved(module: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """A module's ``__getattr__`` for what has moved.

    What is imported only when it is asked for makes no room depend on another.

    Args:
        module (str): ``__name__`` of the module that had it.
        names (mapping of str to str): from old names to whole new ones, module included.

    Examples:
        >>> __getattr__ = moved("old_home", {"root": "math.sqrt"})
        >>> import warnings
        >>> with warnings.catch_warnings(record=True) as caught:
        ...     warnings.simplefilter("always")
        ...     __getattr__("root")(4.0)
        2.0
        >>> str(caught[0].message)
        'old_home.root is deprecated: it is math.sqrt now.'
    """

    def __getattr__(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        new = names[name]
        # Of the caller: an attribute's access, or an import statement's.
        warnings.warn(
            f"{module}.{name} is deprecated: it is {new} now.", DeprecationWarning, stacklevel=2
        )
        home, _, attribute = new.rpartition(".")
        return getattr(import_module(home), attribute)

    return __getattr__
