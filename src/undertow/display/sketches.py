"""Stick figures of the library's mechanisms, as data: points in space as SymPy expressions.

A point is (x, y, z), m, in the mechanism's coordinates and parameters; z points up.  Sizes that
the equations do not know (a beam's length, a cart's box) are numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import sympy as sp

from undertow.closed_loop.figures import display
from undertow.mechanisms import LIBRARY
from undertow.models import Mechanism

#: x, y, z as numbers or expressions, m.
Point = tuple[Any, Any, Any]

#: front: x to the right, z up.  top: x to the right, y up.  oblique: all three.
View = Literal["front", "top", "oblique"]


#: Direction of the y axis in the oblique view: to the right and up, shortened.
OBLIQUE = (0.42, 0.30)


def projected(point: Point, view: View) -> tuple[Any, Any]:
    """Return a point, or many as arrays, in the plane of a view."""
    x, y, z = point
    if view == "top":
        return x, y
    if view == "front":
        return x, z
    return x + OBLIQUE[0] * y, z + OBLIQUE[1] * y


@dataclass(frozen=True)
class Line:
    """A line through points: a ``"link"``, a ``"rope"``, or part of the ``"frame"``.

    ``"ground"`` is drawn from side to side at the height of its one point.
    """

    points: tuple[Point, ...]
    kind: Literal["link", "rope", "frame", "ground"] = "link"


@dataclass(frozen=True)
class Disc:
    """A disc with a spoke at ``angle`` from the upright, rad, towards +x; radius in m."""

    centre: Point
    radius: Any
    angle: Any = 0


@dataclass(frozen=True)
class Box:
    """An upright box: centre and half-sizes in the plane of the view, m."""

    centre: Point
    width: float
    height: float


@dataclass(frozen=True)
class Label:
    """Words, centred below a point."""

    centre: Point
    text: str


@dataclass(frozen=True)
class Sketch:
    """What to draw of a mechanism.

    The parts come from back to front; ``tip`` is the point whose path is shown, ``view`` from where
    it is seen.
    """

    parts: tuple[Line | Disc | Box | Label, ...]
    tip: Point
    view: View = "front"


def sketch(mechanism: Mechanism) -> Sketch:
    """Return the stick figure of a mechanism of the library, or dials for any other.

    One about another target, or with another potential, is another.  A dial is a hand that turns
    with an angle, or a bead on a rail: one for each coordinate, with its name and unit below.
    """
    known = _SKETCHES.get(mechanism.name)
    if known is not None and mechanism.potential == LIBRARY[mechanism.name]().potential:
        try:
            return known(_Symbols(mechanism))
        except KeyError:  # a mechanism of one's own under a name of the library
            pass
    return _dials(mechanism)


class _Symbols:
    """The coordinates and parameters of a mechanism as attributes."""

    def __init__(self, mechanism: Mechanism) -> None:
        self._symbols = {str(s): s for s in (*mechanism.q, *mechanism.parameter_symbols)}

    def __getattr__(self, name: str) -> sp.Symbol:
        return self._symbols[name]


def _dials(mechanism: Mechanism) -> Sketch:
    parts: list[Line | Disc | Box] = []
    labels: list[Label] = []
    hand: Point = (0.0, 0.0, 0.0)
    for index, coordinate in enumerate(mechanism.coordinates):
        o, q = 2.5 * index, coordinate.symbol
        if coordinate.unit == "rad":
            hand = (o + sp.sin(q), 0, sp.cos(q))
            parts += [Disc((o, 0, 0), 1.0), Line(((o, 0, 0), hand))]
        else:
            hand = (o + q, 0, 0)
            parts += [Line(((o - 1, 0, 0), (o + 1, 0, 0)), "frame"), Box(hand, 0.12, 0.12)]
        labels.append(Label((o, 0, -1.1), f"{coordinate.name}, {display(coordinate.unit)[1]}"))
    return Sketch((*parts, *labels), hand)


def _chain(
    base: Point, leans: Sequence[Any], lengths: Sequence[Any]
) -> tuple[tuple[Line, ...], Point]:
    """Links that stand on one another, each leaning from the upright towards +x."""
    lines, (x, y, z) = [], base
    for lean, length in zip(leans, lengths, strict=True):
        end = (x + length * sp.sin(lean), y, z + length * sp.cos(lean))
        lines.append(Line(((x, y, z), end)))
        x, y, z = end
    return tuple(lines), (x, y, z)


def _ground(z: float = 0.0) -> Line:
    return Line(((0, 0, z),), "ground")


def _on_a_cart(v: _Symbols, leans: Sequence[Any], lengths: Sequence[Any]) -> Sketch:
    links, tip = _chain((v.x, 0, 0), leans, lengths)
    return Sketch((_ground(-0.05), Box((v.x, 0, 0), 0.12, 0.05), *links), tip)


def _standing(leans: Sequence[Any], lengths: Sequence[Any]) -> Sketch:
    links, tip = _chain((0, 0, 0), leans, lengths)
    return Sketch((_ground(0.0), *links), tip)


def _rotary_pendulum(v: _Symbols) -> Sketch:
    # θ and φ as in (32)-(33): for positive φ the rod leans against the sense of θ.
    c, s = sp.cos(v.theta), sp.sin(v.theta)
    hinge = (v.r_o * c, v.r_o * s, 0)
    reach, rise = 2 * v.l * sp.sin(v.phi), 2 * v.l * sp.cos(v.phi)
    tip = (hinge[0] + reach * s, hinge[1] - reach * c, rise)
    pillar = Line(((0, 0, -0.2), (0, 0, 0)), "frame")
    return Sketch((pillar, Line(((0, 0, 0), hinge)), Line((hinge, tip))), tip, "oblique")


def _overhead_crane(v: _Symbols) -> Sketch:
    x = v.x
    load = (x + v.l * sp.sin(v.theta), 0, -v.l * sp.cos(v.theta))
    rope = Line(((x, 0, 0), load), "rope")
    return Sketch((_ground(0.05), Box((x, 0, 0), 0.12, 0.05), rope, Disc(load, 0.05)), load)


def _reaction_wheel_pendulum(v: _Symbols) -> Sketch:
    axle = (v.l_r * sp.sin(v.phi), 0, v.l_r * sp.cos(v.phi))
    wheel = Disc(axle, 0.35 * v.l_r, v.phi + v.psi)
    return Sketch((_ground(0.0), Line(((0, 0, 0), axle)), wheel), axle)


def _tora(v: _Symbols) -> Sketch:
    x = v.x
    mass = (x + v.e * sp.sin(v.theta), -v.e * sp.cos(v.theta), 0)
    wall, near = -0.16, x - 0.05
    coils = [
        (wall + (near - wall) * sp.Rational(k, 12), (0.012 if k % 2 else -0.012), 0)
        for k in range(1, 12)
    ]
    spring = Line(((wall, 0, 0), *coils, (near, 0, 0)), "rope")
    frame = Line(((wall, -0.08, 0), (wall, 0.08, 0)), "frame")
    arm = Line(((x, 0, 0), mass))
    return Sketch((frame, spring, Box((x, 0, 0), 0.05, 0.05), arm, Disc(mass, 0.012)), mass, "top")


def _ball_and_beam(v: _Symbols) -> Sketch:
    c, s, radius = sp.cos(v.theta), sp.sin(v.theta), 0.03
    beam = Line(((-0.5 * c, 0, -0.5 * s), (0.5 * c, 0, 0.5 * s)))
    ball = (v.r * c - radius * s, 0, v.r * s + radius * c)
    pivot = Line(((-0.05, 0, -0.1), (0, 0, 0), (0.05, 0, -0.1)), "frame")
    return Sketch((pivot, beam, Disc(ball, radius, v.r / radius + v.theta)), ball)


def _wheeled_inverted_pendulum(v: _Symbols) -> Sketch:
    turn = v.phi + v.psi
    axle = (v.R * turn, 0, v.R)
    links, tip = _chain(axle, [v.psi], [2 * v.l])
    return Sketch((_ground(0.0), *links, Disc(axle, v.R, turn)), tip)


def _gantry_crane(v: _Symbols) -> Sketch:
    x, y, a, b = v.x, v.y, v.theta_x, v.theta_y
    swing = v.l * sp.cos(b)
    load = (x + swing * sp.sin(a), y + v.l * sp.sin(b), -swing * sp.cos(a))
    rails = (Line(((-0.8, side, 0), (0.8, side, 0)), "frame") for side in (-0.6, 0.6))
    bridge = Line(((x, -0.6, 0), (x, 0.6, 0)))
    rope = Line(((x, y, 0), load), "rope")
    return Sketch(
        (*rails, bridge, Box((x, y, 0), 0.07, 0.04), rope, Disc(load, 0.05)), load, "oblique"
    )


def _two_link(v: _Symbols) -> Sketch:
    return _standing([v.q_1, v.q_1 + v.q_2], [v.l_1, 2 * v.a_2])


_SKETCHES: dict[str, Callable[[_Symbols], Sketch]] = {
    "rotary_pendulum": _rotary_pendulum,
    "cart_pendulum": lambda v: _on_a_cart(v, [v.phi], [2 * v.l]),
    "overhead_crane": _overhead_crane,
    "pendubot": _two_link,
    "acrobot": _two_link,
    "reaction_wheel_pendulum": _reaction_wheel_pendulum,
    "tora": _tora,
    "ball_and_beam": _ball_and_beam,
    "wheeled_inverted_pendulum": _wheeled_inverted_pendulum,
    "double_pendulum_on_a_cart": lambda v: _on_a_cart(v, [v.phi_1, v.phi_2], [v.l_1, 2 * v.a_2]),
    "two_motor_three_link": lambda v: _standing(
        [v.q_1, v.q_1 + v.q_2, v.q_1 + v.q_2 + v.q_3], [v.l_1, v.l_2, 2 * v.a_3]
    ),
    "gantry_crane": _gantry_crane,
    "triple_pendulum_on_a_cart": lambda v: _on_a_cart(
        v, [v.phi_1, v.phi_2, v.phi_3], [v.l_1, v.l_2, 2 * v.a_3]
    ),
}
