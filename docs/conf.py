"""Sphinx configuration: ``sphinx-build -W -b html docs docs/_build/html``."""

from __future__ import annotations

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
    """Register the hook and the formulas."""
    app.connect("source-read", _name_what_has_no_page)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_display_math, None))
