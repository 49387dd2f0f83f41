"""The documentation site: ``make docs`` builds it into build/docs, without a network."""

from __future__ import annotations

import re
import sys
from importlib import import_module
from importlib.metadata import version as installed
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

DOCS = Path(__file__).parent
sys.path.insert(0, str(DOCS))


def _shown_before() -> dict[str, dict[str, str]]:
    """Return, for each package of the reference, the names that an earlier page has, and where."""
    shown: dict[int, str] = {}
    elsewhere: dict[str, dict[str, str]] = {}
    text = (DOCS / "api.md").read_text(encoding="utf-8")
    for name in re.findall(r"^   (undertow[\w.]*)$", text, re.MULTILINE):
        package = import_module(name)
        own = [n for n, thing in vars(package).items() if getattr(thing, "__module__", "") == name]
        found = {public: getattr(package, public) for public in getattr(package, "__all__", own)}
        elsewhere[name] = {p: shown[id(thing)] for p, thing in found.items() if id(thing) in shown}
        shown |= {id(thing): f"{name}.{p}" for p, thing in found.items() if id(thing) not in shown}
    return elsewhere


def _escape_bars(
    app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]
) -> None:
    """Keep |u| a magnitude: reST would take it for the name of a substitution."""
    for index, line in enumerate(lines):
        if not line.lstrip().startswith(">>>"):
            parts = re.split("(``.*?``)", line)
            lines[index] = "".join(p if p[:2] == "``" else p.replace("|", r"\|") for p in parts)


project = "Undertow"
author = "The Undertow developers"
copyright = "The Undertow developers, Apache-2.0"
version = release = installed("undertow")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_gallery.gen_gallery",
]
exclude_patterns = ["README.md", "_templates"]
templates_path = ["_templates"]
suppress_warnings = [
    "ref.python",  # a name of the top level is also one of its package's: both are pages
    "config.cache",
]

# Pages in Markdown. What is indented, and output, is text and not Python.
myst_enable_extensions = ["dollarmath", "amsmath", "deflist"]
myst_heading_anchors = 4
highlight_language = "text"

# The reference: what the packages export, in the order of __all__.
autodoc_default_options = {"members": True}
autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autosummary_generate = True
autosummary_imported_members = True
autosummary_ignore_module_all = False
autosummary_context = {
    "elsewhere": _shown_before(),
    "exports": {name for name in _shown_before() if hasattr(import_module(name), "__all__")},
}
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_attr_annotations = False
maximum_signature_line_length = 80

# The gallery: each script is run, and the figures among its variables are its pictures.
sphinx_gallery_conf = {
    "examples_dirs": ["../examples/gallery"],
    "gallery_dirs": ["gallery"],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "FileNameSortKey",
    "image_scrapers": ["gallery_pictures.figures"],
    "capture_repr": (),
    "reset_modules": ["gallery_pictures.look"],
    "abort_on_example_error": True,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "show_signature": False,
    "thumbnail_size": (480, 336),
    "write_computation_times": False,
}

html_theme = "furo"
html_title = f"Undertow {release}"
html_static_path = ["_static"]
html_css_files = ["undertow.css"]
html_copy_source = False
html_show_sphinx = False
html_show_search_summary = False  # summaries are fetched, which a browser refuses from file://
html_theme_options = {"navigation_with_keys": True}


def _mathml(tex: str, display: str = "inline") -> str:
    r"""Return a formula as MathML, which browsers draw by themselves.

    The index of an accented letter is written ``\dot q{}_a``: beside it, and not underneath.
    """
    formula = tex2mathml(tex, as_block=display == "block")
    # As an accent a dot sits too low where the font is not made for mathematics.
    return formula.replace('accent="true"', 'accent="false"')


def _inline_formula(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext()))
    raise nodes.SkipNode


def _formula(writer: Any, node: nodes.math_block) -> None:
    """Write a formula on lines of its own; its label is its number in the paper."""
    label = node.get("label")
    number = f'<span class="eqno">({label})</span>' if label else ""
    here = f' id="{node["ids"][0]}"' if node["ids"] else ""
    formula = _mathml(node.astext(), "block")
    writer.body.append(f'<div class="formula"{here}>{formula}{number}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> None:
    """Draw formulas as MathML: nothing has to be loaded for them. Keep bars in docstrings."""
    app.connect("autodoc-process-docstring", _escape_bars, priority=900)
    app.add_html_math_renderer("mathml", (_inline_formula, None), (_formula, None))


html_math_renderer = "mathml"
