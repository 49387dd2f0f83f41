"""A stick figure for a page that draws it many times a second, and that a mouse takes hold of.

Its points are compiled as functions of positions and parameters, in the plane of the view, with
their derivatives: a force F at a point p(q) of the picture is the generalised force (∂p/∂q)ᵀ F.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.display.sketches import Box, Disc, Label, Line, Sketch, projected
from undertow.models import FloatArray, Mechanism
from undertow.symbolic import compile_expressions

#: How far a travelling coordinate is shown at least, m, if it may go so far.
REACH = 0.05

#: Configurations of which the window shows all.
SAMPLES = 400


@dataclass(frozen=True)
class Grip:
    """A place that is held: a part of the way from one point of the figure to another."""

    a: int
    b: int
    part: float


class Scene:
    """A figure, compiled.

    Parameters
    ----------
    mechanism
        Whose coordinates and parameters the figure is in.
    figure
        What to draw.

    Attributes
    ----------
    parts
        What to draw, for the page: kind, which points, which further numbers, from back to front.
    window
        Left, right, bottom and top of all that it reaches, m.
    """

    def __init__(self, mechanism: Mechanism, figure: Sketch) -> None:
        self._n = mechanism.n
        points: list[tuple[sp.Expr, sp.Expr]] = []
        further: list[sp.Expr] = []
        self.parts: list[dict[str, Any]] = []
        self._segments: list[tuple[int, int]] = []
        for part in figure.parts:
            first = len(points)
            places = part.points if isinstance(part, Line) else (part.centre,)
            points += [projected(place, figure.view) for place in places]
            count = len(points) - first
            one: dict[str, Any] = {"at": first, "count": count}
            if isinstance(part, Line):
                one["kind"] = part.kind
                if part.kind in ("link", "rope"):
                    self._segments += [(first + k, first + k + 1) for k in range(count - 1)]
            elif isinstance(part, Disc):
                one |= {"kind": "disc", "more": len(further), "spoke": part.angle != 0}
                further += [sp.sympify(part.angle), sp.sympify(part.radius)]
                self._segments.append((first, first))
            elif isinstance(part, Box):
                one |= {"kind": "box", "width": part.width, "height": part.height}
                self._segments.append((first, first))
            elif isinstance(part, Label):
                one |= {"kind": "label", "text": part.text}
            self.parts.append(one)
        points.append(projected(figure.tip, figure.view))
        self.count = len(points)
        flat = [sp.sympify(value) for point in points for value in point]
        arguments = [*mechanism.q, *mechanism.parameter_symbols]
        self._places = compile_expressions(arguments, [*flat, *further])
        slopes = [sp.diff(value, q) for value in flat for q in mechanism.q]
        self._slopes = compile_expressions(arguments, slopes)
        self.window = self._reach(mechanism)

    def places(self, q: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return x and y of all points, the tip last, then angles and radii of discs, (K,), m."""
        return np.array(self._places(*q, *parameters), dtype=float)

    def points(self, q: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return all points, the tip last, (count, 2), m."""
        return self.places(q, parameters)[: 2 * self.count].reshape(-1, 2)

    def slopes(self, q: FloatArray, parameters: FloatArray, grip: Grip) -> FloatArray:
        """Return ∂p/∂q of a place that is held, (2, n)."""
        every = np.array(self._slopes(*q, *parameters), dtype=float).reshape(-1, 2, self._n)
        return np.asarray((1.0 - grip.part) * every[grip.a] + grip.part * every[grip.b])

    def held(self, q: FloatArray, parameters: FloatArray, grip: Grip) -> FloatArray:
        """Return where a place that is held is in the picture, (2,), m."""
        every = self.points(q, parameters)
        return np.asarray((1.0 - grip.part) * every[grip.a] + grip.part * every[grip.b])

    def nearest(
        self, q: FloatArray, parameters: FloatArray, at: ArrayLike, reach: float = math.inf
    ) -> Grip | None:
        """Return the place of a moving part that is nearest to a point of the picture.

        ``None`` where all are farther away than ``reach``, m.
        """
        every = self.points(q, parameters)
        here, best, least = np.asarray(at, dtype=float), None, reach
        for a, b in self._segments:
            way = every[b] - every[a]
            length = float(way @ way)
            part = float((here - every[a]) @ way) / length if length > 0 else 0.0
            part = min(max(part, 0.0), 1.0)
            off = float(np.linalg.norm(here - every[a] - part * way))
            if off < least and self._moves(q, parameters, grip := Grip(a, b, part)):
                best, least = grip, off
        return best

    def _moves(self, q: FloatArray, parameters: FloatArray, grip: Grip) -> bool:
        return bool(np.abs(self.slopes(q, parameters, grip)).max() > 1e-9)

    def _reach(self, mechanism: Mechanism) -> tuple[float, float, float, float]:
        """All that it reaches by turning, and half as far again by travelling.

        The page follows what travels farther.
        """
        turning = [math.pi if c.unit == "rad" else 0.0 for c in mechanism.coordinates]
        left, right, bottom, top = self._extent(mechanism, turning)
        travel = max(0.5 * max(right - left, top - bottom), REACH)
        both = [
            math.pi if c.unit == "rad" else min(travel, -c.low, c.high)
            for c in mechanism.coordinates
        ]
        return self._extent(mechanism, both)

    def _extent(
        self, mechanism: Mechanism, reach: Sequence[float]
    ) -> tuple[float, float, float, float]:
        rng, values = np.random.default_rng(0), mechanism.parameter_values
        q = rng.uniform(-1.0, 1.0, (SAMPLES, mechanism.n)) * reach
        moved = [part["at"] + k for part in self.parts if part["kind"] not in ("frame", "ground")
                 for k in range(part["count"])]  # fmt: skip
        every = np.array([self.places(one, values) for one in q])
        points = every[:, : 2 * self.count].reshape(SAMPLES, self.count, 2)
        cloud = points[:, moved].reshape(-1, 2)
        sizes = [max(p["width"], p["height"]) for p in self.parts if p["kind"] == "box"]
        sizes += [
            every[0, 2 * self.count + p["more"] + 1] for p in self.parts if p["kind"] == "disc"
        ]
        left, bottom = cloud.min(axis=0)
        right, top = cloud.max(axis=0)
        margin = 0.04 * max(right - left, top - bottom) + float(max(sizes, default=0.0))
        return left - margin, right + margin, bottom - margin, top + margin
