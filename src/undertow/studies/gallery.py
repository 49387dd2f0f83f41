"""The library of mechanisms as a table and as a picture: `undertow mechanisms`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table

from undertow.base import Progress, no_progress, table
from undertow.closed_loop import ClosedLoop
from undertow.closed_loop.figures import figure_bytes, state_words, style
from undertow.display.animation import Film, gif_of, snapshot, still
from undertow.mechanisms import LIBRARY
from undertow.objective import MinimumTime
from undertow.optimiser import Optimiser

#: Mechanisms side by side in the picture of the library.
COLUMNS = 5

#: Pictures in a second of their film, which a GIF counts in hundredths of a second; and motion
#: seconds in one: a third of real time.
FPS, SPEED = 12.5, 1.0 / 3.0


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


def library_files(progress: Progress = no_progress) -> dict[str, bytes]:
    """Return every mechanism on its way to the target in least time, optimised once at its start.

    ``mechanisms.png``: in one picture, with ghosts. ``mechanisms.gif``: as films side by side, on
    one clock, that say how much slower they are.
    """
    films: list[Film] = []
    arrivals: list[float] = []
    for index, (name, build) in enumerate(LIBRARY.items()):
        progress(name, index / (len(LIBRARY) + 1))
        mechanism = build()
        loop = ClosedLoop(mechanism, MinimumTime())
        x0 = mechanism.usual_start
        plan = Optimiser(loop).require(x0).plan
        assert plan is not None  # require() raises otherwise
        motion = loop.simulate(x0, plan)
        arrivals.append(float(motion.t[-1]))
        films.append(Film.of(motion, fps=FPS, longest=arrivals[-1] / SPEED, speed=SPEED))
    progress("drawing", len(LIBRARY) / (len(LIBRARY) + 1))
    return {"mechanisms.png": _picture(films), "mechanisms.gif": _film(films, arrivals)}


def _picture(films: Sequence[Film]) -> bytes:
    rows = -(-len(films) // COLUMNS)
    with style():
        figure = Figure(figsize=(3 * COLUMNS, 2.9 * rows), layout="constrained")
        for index, film in enumerate(films):
            axes = figure.add_subplot(rows, COLUMNS, index + 1)
            axes.set_anchor("N")  # titles of a row stand side by side
            still(axes, film)
        return figure_bytes(figure)


def _film(films: Sequence[Film], arrivals: Sequence[float]) -> bytes:
    """Return a grid of films; each stays at its target until all are there."""
    rows, images = -(-len(films) // COLUMNS), []
    with style():
        figure = Figure(figsize=(1.9 * COLUMNS, 1.9 * rows), dpi=100)
        canvas: Any = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(
            rows, COLUMNS, left=0.01, right=0.99, bottom=0.01, top=0.94, hspace=0.25, wspace=0.08
        )
        scenes = [figure.add_subplot(grid[k // COLUMNS, k % COLUMNS]) for k in range(len(films))]
        for axes in scenes:
            axes.set_anchor("N")
        clock = figure.text(0.79, 0.2, "", ha="center", fontsize=18)  # where the grid is empty
        figure.text(0.79, 0.14, f"{films[0].pace} than real time", ha="center", fontsize=10)
        for k in range(max(len(film.t) for film in films)):
            clock.set_text(f"{k * SPEED / FPS:.2f} s")
            for axes, film, arrival in zip(scenes, films, arrivals, strict=True):
                axes.clear()
                last = len(film.t) - 1
                film.draw(axes, min(k, last))
                film.frame(axes, words=False)
                name = film.mechanism.name.replace("_", " ")
                there = f"there after {arrival:.2f} s" if k >= last else ""
                axes.set_title(f"{name}\n{there}", fontsize=7.5, pad=2)
            canvas.draw()
            images.append(snapshot(canvas))
    return gif_of(images, 1.0 / FPS)
