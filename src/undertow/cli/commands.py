"""Commands about mechanisms: what there is, its formulas, a survey, moving pictures.

Plain functions of plain arguments; :mod:`undertow.cli` gives them their options.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from undertow.base import artefacts as results
from undertow.closed_loop import ClosedLoop
from undertow.display.animation import Film, gif, still
from undertow.display.derivation import derivation
from undertow.display.plot import figure_bytes, style
from undertow.mechanisms import LIBRARY
from undertow.models import Mechanism
from undertow.objective import MinimumEnergy
from undertow.optimiser import Optimiser
from undertow.studies.survey import start_words

__all__ = ["animation_files", "derivation_files", "library_picture", "mechanism_table"]

#: Mechanisms side by side in the picture of the library.
COLUMNS = 5


def mechanism_table(width: int = 120) -> Table:
    """Return the mechanisms of the library with their inputs and what they are.

    Parameters
    ----------
    width
        Of the terminal; from 100 columns on there is room for the listed starts too.
    """
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0))
    wide = width >= 100
    for head in ("mechanism", "n, m", "inputs", *(["start"] if wide else []), "what it is"):
        table.add_column(head, no_wrap=head != "what it is")
    for build in LIBRARY.values():
        m = build()
        inputs = "\n".join(f"{i.name} ≤ {i.limit:g} {i.unit}" for i in m.inputs)
        start = start_words(m).replace(", ", "\n")
        cells = (m.name, f"{m.n}, {m.m}", inputs, *([start] if wide else []), m.description)
        table.add_row(*(Text(cell) for cell in cells))
    return table


def library_picture(progress: Callable[[str, float], None] | None = None) -> bytes:
    """Return a PNG of every mechanism on its way to the target, optimised once from its start."""
    rows = -(-len(LIBRARY) // COLUMNS)
    with style():
        figure = Figure(figsize=(3 * COLUMNS, 2.9 * rows), layout="constrained")
        for index, (name, build) in enumerate(LIBRARY.items()):
            if progress is not None:
                progress(name, index / len(LIBRARY))
            mechanism = build()
            loop = ClosedLoop(mechanism, MinimumEnergy())
            x0 = mechanism.usual_start
            plan = Optimiser(loop).require(x0).plan
            assert plan is not None  # require() raises otherwise
            film = Film.of(loop.simulate(x0, plan), longest=loop.objective.horizon)
            axes = figure.add_subplot(rows, COLUMNS, index + 1)
            axes.set_anchor("N")  # titles of a row stand side by side
            still(axes, film)
        return figure_bytes(figure)


def derivation_files(mechanism: Mechanism) -> dict[str, bytes]:
    """Return a mechanism's formulas as ``<name>.txt`` and ``<name>.tex``."""
    formulas = derivation(mechanism)
    return {
        f"{mechanism.name}.txt": formulas.text().encode(),
        f"{mechanism.name}.tex": formulas.latex().encode(),
    }


def animation_files(request: Mapping[str, object], film: Film) -> dict[str, bytes]:
    """Return a film as ``<name>.gif`` and ``<name>.png``, with ``<name>.json``."""
    with style():
        figure = Figure(figsize=(4.5, 4.5))
        still(figure.add_subplot(), film)
        picture = figure_bytes(figure)
    name = film.mechanism.name
    manifest = {
        "what": "undertow animate",
        "versions": results.versions(),
        "request": {k: str(v) if isinstance(v, Path) else v for k, v in request.items()},
        "frames": len(film.t),
        "shows": film.span,
    }
    return {
        f"{name}.gif": gif(film),
        f"{name}.png": picture,
        f"{name}.json": results.to_json(manifest),
    }
