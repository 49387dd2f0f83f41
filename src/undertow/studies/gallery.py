"""The library of mechanisms as a table and as a picture: `undertow mechanisms`."""

from __future__ import annotations

from matplotlib.figure import Figure
from rich.table import Table

from undertow.base import Progress, no_progress, table
from undertow.closed_loop import ClosedLoop
from undertow.closed_loop.figures import figure_bytes, state_words, style
from undertow.display.animation import Film, still
from undertow.mechanisms import LIBRARY
from undertow.objective import MinimumEnergy
from undertow.optimiser import Optimiser

#: Mechanisms side by side in the picture of the library.
COLUMNS = 5


def mechanism_table(width: int = 120) -> Table:
    """Return the mechanisms of the library with their inputs, starts and descriptions.

    From a ``width`` of 100 columns on there is room for the listed starts too.
    """
    heads = ["mechanism", "n, m", "inputs", "start", "what it is"]
    if width < 100:
        heads.remove("start")
    rows = []
    for build in LIBRARY.values():
        m = build()
        cells = {
            "mechanism": m.name,
            "n, m": f"{m.n}, {m.m}",
            "inputs": "\n".join(f"{i.name} ≤ {i.limit:g} {i.unit}" for i in m.inputs),
            "start": state_words(m, m.usual_start).replace(", ", "\n"),
            "what it is": m.description,
        }
        rows.append([cells[head] for head in heads])
    return table(heads, rows, left=heads, whole=heads[:-1])


def library_picture(progress: Progress = no_progress) -> bytes:
    """Return a PNG of every mechanism on its way to the target, optimised once from its start."""
    rows = -(-len(LIBRARY) // COLUMNS)
    with style():
        figure = Figure(figsize=(3 * COLUMNS, 2.9 * rows), layout="constrained")
        for index, (name, build) in enumerate(LIBRARY.items()):
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
