"""Sphinx configuration: ``sphinx-build -W -b html docs docs/_build/html``."""

from __future__ import annotations

import json
import re
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

project = "torchrl_safe"
author = "the torchrl_safe authors"
copyright = f"2026, {author}"
html_title = project

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
]
exclude_patterns = ["_build"]
html_theme = "furo"
html_math_renderer = "mathml"
html_static_path = ["_static"]
html_css_files = ["site.css"]

myst_enable_extensions = ["amsmath", "dollarmath"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"members": True, "show-inheritance": True}
# A name is shown as its users import it, not as the file it lives in.
add_module_names = False
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_custom_sections = [("Keyword Args", "params_style")]
napoleon_use_ivar = True

# Links of readers of the repository, which the site has no page for: folders, other Markdown.
_LINK = re.compile(r"\[([^\]]+)\]\((\.\./[^)#\s]+)(?:#[^)]*)?\)")


def _name_what_has_no_page(app: Sphinx, docname: str, source: list[str]) -> None:
    """Such a link becomes its text; one that leads nowhere stays, and fails the build."""
    folder = Path(app.srcdir, docname).parent

    def replace(match: re.Match[str]) -> str:
        text, target = match.groups()
        path = (folder / target).resolve()
        outside = not path.is_relative_to(Path(app.srcdir).resolve())
        has_page = path.is_file() and path.suffix != ".md"
        return text if outside and path.exists() and not has_page else match.group()

    source[0] = _LINK.sub(replace, source[0])


# Pages that are notebooks, in jupytext's Markdown: text, and cells of Python.
_FRONT = re.compile(r"^---\n.*?^kernelspec:\n.*?^---\n", re.DOTALL | re.MULTILINE)
_CELL = re.compile(r"^```python\n(.*?)\n```\n", re.DOTALL | re.MULTILINE)


def _offer_notebook(app: Sphinx, docname: str, source: list[str]) -> None:
    """Below the title of such a page, a link to the file that Jupyter opens."""
    if _FRONT.match(source[0]):
        up, name = "../" * docname.count("/"), docname.rpartition("/")[2]
        link = f'<p><a href="{up}notebooks/{name}.ipynb" download>Download this notebook</a></p>'
        titled = r"\g<0>\n\n```{raw} html\n" + link + "\n```\n"
        source[0] = re.sub(r"^# .*$", titled, source[0], count=1, flags=re.MULTILINE)


def _write_notebooks(app: Sphinx, error: Exception | None) -> None:
    """Each page that is a notebook as a file, in the folder ``notebooks`` of the site."""
    if error is not None or app.builder.format != "html":
        return
    for docname in sorted(app.env.found_docs):
        page = app.env.doc2path(docname)
        text = Path(page).read_text() if str(page).endswith(".md") else ""
        if front := _FRONT.match(text):
            parts = _CELL.split(text[front.end() :])
            cells = [
                {
                    "id": str(i),
                    "cell_type": kind,
                    "metadata": {},
                    "source": part.strip("\n"),
                    **more,
                }
                for i, part in enumerate(parts)
                for kind, more in [
                    ("code", {"outputs": [], "execution_count": None})
                    if i % 2
                    else ("markdown", {})
                ]
                if part.strip()
            ]
            kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
            notebook = {
                "cells": cells,
                "metadata": {"kernelspec": kernel},
                "nbformat": 4,
                "nbformat_minor": 5,
            }
            folder = Path(app.outdir, "notebooks")
            folder.mkdir(exist_ok=True)
            (folder / f"{Path(page).stem}.ipynb").write_text(json.dumps(notebook, indent=1))


# To MathML these are identifiers, which stand close to what follows: "lnx".
_NAMED = re.compile(r"<m[io]>(ln|log|exp|tanh|min|max)</m[io]>")


def _formula(tex: str, display: str) -> str:
    """MathML with the space that TeX leaves around a function's name."""
    spaced = r'<mo lspace="0.167em" rspace="0.167em">\1</mo>'
    return _NAMED.sub(spaced, convert(tex, display=display)).replace(
        "<mi>&#x02032;</mi>", "<mo>&#x02032;</mo>"
    )


def _inline_math(translator: HTML5Translator, node: nodes.math) -> None:
    """Formulas as MathML, which browsers draw themselves: no script, no network."""
    translator.body.append(_formula(node.astext(), "inline"))
    raise nodes.SkipNode


def _display_math(translator: HTML5Translator, node: nodes.math_block) -> None:
    translator.body.append(f"<p>{_formula(node.astext(), 'block')}</p>")
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register the hooks and the formulas."""
    app.connect("source-read", _name_what_has_no_page)
    app.connect("source-read", _offer_notebook)
    app.connect("build-finished", _write_notebooks)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_display_math, None))
