"""How the gallery looks: pictures are the figures among an example's variables, in one style."""

from __future__ import annotations

from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst


def look(gallery_conf: dict[str, Any], name: str) -> None:
    """Take the package's own style before each example."""
    mpl.rcdefaults()
    mpl.use("agg")
    mpl.style.use("undertow.closed_loop.undertow")
    mpl.rcParams["savefig.dpi"] = 110


def figures(block: Any, variables: dict[str, Any], gallery_conf: dict[str, Any]) -> str:
    """Save the figures that a block of an example has made, and return their reST."""
    paths = []
    for value in variables["example_globals"].values():
        if isinstance(value, Figure) and not hasattr(value, "_in_gallery"):
            value._in_gallery = True  # type: ignore[attr-defined]
            paths.append(next(variables["image_path_iterator"]))
            value.savefig(paths[-1])
    return figure_rst(paths, gallery_conf["src_dir"])
