"""The package page; everything else is in pyproject.toml.

The page has no repository beside it and, as long as that has no public address, nowhere to link
to: pictures are left out, and links to files or headings become their words.
"""

from __future__ import annotations

import re
from pathlib import Path

from setuptools import setup

WITHIN = r"(?!https?://)[^)\s]+"  # a path in the repository, or a heading
NOTE = "The pages and scripts that this one names are in the source distribution.\n\n"


def package_page(readme: str) -> str:
    """The README without what leads into the repository."""
    page = re.sub(r"<p .*?</p>\n+", "", readme, flags=re.DOTALL)
    page = re.sub(rf"\[([^]]+)\]\({WITHIN}\)", r"\1", page)
    return page.replace("\n\n", f"\n\n{NOTE}", 1)  # below the title


setup(
    long_description=package_page(Path(__file__).with_name("README.md").read_text("utf-8")),
    long_description_content_type="text/markdown",
)
