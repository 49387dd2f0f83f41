"""Energies of a planar chain of links, shared by the pendulums of the library."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import accumulate, count, pairwise, product, takewhile
from typing import Any

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter


def chain_energies(
    p: Mapping[str, sp.Expr | float],
    angles: Sequence[sp.Expr],
    rates: Sequence[sp.Expr],
    base_rate: sp.Expr | int = 0,
) -> tuple[sp.Expr, sp.Expr]:
    """Return T and V, J, of links that stand on one another on a base that moves along x.

    Link i leans by φ_i from the upright towards +x (absolute angles).  Its centre of mass is
    at x + Σ_j a_ij sin φ_j, Σ_j a_ij cos φ_j with a_ij the length of link j < i and the
    distance of the centre of mass for j = i, so that

        T = ½ Σ_i [m_i (ẋ² + 2ẋ Σ_j a_ij cos φ_j φ̇_j + Σ_jk a_ij a_ik cos(φ_j − φ_k) φ̇_j φ̇_k)
            + J_i φ̇_i²],        V = g Σ_i m_i Σ_j a_ij cos φ_j.

    p has ``m_1`` …, kg; ``J_1`` … about the centres of mass, kg m²; ``a_1`` … from a link's joint
    to its centre of mass and ``l_1`` … to the next joint where there is one, m; ``g``, m/s². Angles
    and rates are φ_i and φ̇_i as expressions in the coordinates and their velocities, rad, rad/s;
    ``base_rate`` is ẋ of the first joint, m/s.
    """
    kinetic, potential = sp.Integer(0), sp.Integer(0)
    for i, rate in enumerate(rates, 1):
        m, J = p[f"m_{i}"], p[f"J_{i}"]
        arms = [*(p[f"l_{j}"] for j in range(1, i)), p[f"a_{i}"]]
        reach = range(i)
        coupled = sum(arms[j] * sp.cos(angles[j]) * rates[j] for j in reach)
        turning = sum(
            arms[j] * arms[k] * sp.cos(angles[j] - angles[k]) * rates[j] * rates[k]
            for j, k in product(reach, reach)
        )
        kinetic += m * (base_rate**2 + 2 * base_rate * coupled + turning) / 2 + J * rate**2 / 2
        potential += m * p["g"] * sum(arms[j] * sp.cos(angles[j]) for j in reach)
    return kinetic, potential


def _links(p: Mapping[str, sp.Symbol]) -> list[int]:
    """Return the numbers of the links that parameters describe."""
    return list(takewhile(lambda i: f"m_{i}" in p, count(1)))


def standing_links(
    name: str, motors: Mapping[int, Input], parameters: Sequence[Parameter], **rest: Any
) -> Mechanism:
    """Return links that stand on one another on a fixed joint, upright at the target.

    Link 1 leans by q_1 from the upright, link i by q_i against the one before.

    ``motors``: the number of each joint that is turned, whose angle is an actuated coordinate, to
    the torque that turns it. ``parameters``: ``m_i, l_i, a_i, J_i`` of each link as for
    :func:`chain_energies`, damping of its joint ``b_i``; gravity ``g``. ``rest``: further fields of
    :class:`undertow.Mechanism`.
    """
    p = {one.name: one.symbol for one in parameters}
    links = {
        i: Coordinate(
            f"q_{i}",
            "rad",
            f"angle of link {i} against link {i - 1}"
            if i > 1
            else "lean of link 1 from the upright",
        )
        for i in _links(p)
    }
    kinetic, potential = chain_energies(
        p,
        list(accumulate(link.symbol for link in links.values())),
        list(accumulate(link.velocity for link in links.values())),
    )
    return Mechanism.from_energies(
        name,
        [*(links[i] for i in motors), *(links[i] for i in links if i not in motors)],
        list(motors.values()),
        kinetic=kinetic,
        potential=potential,
        dissipation=sum(p[f"b_{i}"] * link.velocity**2 / 2 for i, link in links.items()),
        parameters=tuple(parameters),
        **rest,
    )


def links_on_a_cart(
    name: str, limit: float, parameters: Sequence[Parameter], **rest: Any
) -> Mechanism:
    """Return links that stand on a cart, upright at the target, moved by a force on the cart.

    ``limit`` is that of the force, N; ``parameters`` are those of the cart ``m_c, b_c``, mass and
    damping, and of the links as for :func:`standing_links`; ``rest`` are further fields of
    :class:`undertow.Mechanism`.
    """
    p = {one.name: one.symbol for one in parameters}
    numbers = _links(p)
    x = Coordinate("x", "m", "cart position", -1.5, 1.5)
    links = [
        Coordinate(f"phi_{i}", "rad", f"lean of link {i} from the upright, towards +x")
        for i in numbers
    ]
    v, rates = x.velocity, [link.velocity for link in links]
    kinetic, potential = chain_energies(p, [link.symbol for link in links], rates, v)
    turns = [rates[0], *(after - before for before, after in pairwise(rates))]
    damping = sum(p[f"b_{i}"] * w**2 / 2 for i, w in zip(numbers, turns, strict=True))
    return Mechanism.from_energies(
        name,
        [x, *links],
        [Input("force", "N", limit)],
        kinetic=kinetic + p["m_c"] * v**2 / 2,
        potential=potential,
        dissipation=p["b_c"] * v**2 / 2 + damping,
        parameters=tuple(parameters),
        **rest,
    )
