"""What an extra installs is imported by those who use it, and an error says which extra it is."""

from __future__ import annotations

import importlib.util


def need(what: str, extra: str, *packages: str) -> None:
    """Says how to install what is missing.

    Args:
        what (str): what needs the packages, for the error.
        extra (str): the extra of ``torchrl-safe`` that has them.
        *packages (str): top-level names, which are looked for and not imported.

    Raises:
        ModuleNotFoundError: if one is not installed.

    Examples:
        >>> need("a sum", "train", "math")
        >>> need("a picture", "train", "paint_box")
        Traceback (most recent call last):
        ...
        ModuleNotFoundError: a picture needs paint_box: pip install 'torchrl-safe[train]'.
    """
    missing = [package for package in packages if importlib.util.find_spec(package) is None]
    if missing:
        raise ModuleNotFoundError(
            f"{what} needs {' and '.join(missing)}: pip install 'torchrl-safe[{extra}]'."
        )
