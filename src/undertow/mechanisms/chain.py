"""Energies of a planar chain of links, shared by the pendulums of the library."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any, Literal

import sympy as sp

from undertow.models import Coordinate, Input, Mechanism, Parameter

__all__ = ["chain_energies", "two_link"]


def chain_energies(
    angles: Sequence[sp.Expr],
    rates: Sequence[sp.Expr],
    masses: Sequence[sp.Expr],
    inertias: Sequence[sp.Expr],
    centres: Sequence[sp.Expr],
    lengths: Sequence[sp.Expr],
    gravity: sp.Expr,
    base_rate: sp.Expr | int = 0,
) -> tuple[sp.Expr, sp.Expr]:
    """Return T and V, J, of links that stand on one another on a base that moves along x.

    Link i leans by φ_i from the upright towards +x (absolute angles).  Its centre of mass is
    at x + Σ_j a_ij sin φ_j, Σ_j a_ij cos φ_j with a_ij the length of link j < i and the
    distance of the centre of mass for j = i, so that

        T = ½ Σ_i [m_i (ẋ² + 2ẋ Σ_j a_ij cos φ_j φ̇_j + Σ_jk a_ij a_ik cos(φ_j − φ_k) φ̇_j φ̇_k)
            + J_i φ̇_i²],        V = g Σ_i m_i Σ_j a_ij cos φ_j.

    Parameters
    ----------
    angles, rates
        φ_i and φ̇_i as expressions in the coordinates and their velocities, rad, rad/s.
    masses, inertias
        m_i, kg; J_i about the centre of mass, kg m².
    centres, lengths
        From a link's joint to its centre of mass and to the next joint, m; the last length is
        not used.
    gravity
        m/s².
    base_rate
        ẋ of the first joint, m/s.
    """
    kinetic, potential = sp.Integer(0), sp.Integer(0)
    for i, (m, J) in enumerate(zip(masses, inertias, strict=True)):
        arms = [*lengths[:i], centres[i]]
        reach = range(i + 1)
        coupled = sum(arms[j] * sp.cos(angles[j]) * rates[j] for j in reach)
        turning = sum(
            arms[j] * arms[k] * sp.cos(angles[j] - angles[k]) * rates[j] * rates[k]
            for j, k in product(reach, reach)
        )
        kinetic += (
            m * (base_rate**2 + 2 * base_rate * coupled + turning) / 2 + J * rates[i] ** 2 / 2
        )
        potential += m * gravity * sum(arms[j] * sp.cos(angles[j]) for j in reach)
    return kinetic, potential


def two_link(
    name: str,
    motor: Literal["shoulder", "elbow"],
    limit: float,
    parameters: Sequence[Parameter],
    **rest: Any,
) -> Mechanism:
    """Return two links on a fixed shoulder, upright at the target, with one motor.

    Link 1 leans by q_1 from the upright, link 2 by q_2 against link 1.

    Parameters
    ----------
    name
        Of the mechanism.
    motor
        The joint that is turned, whose angle is the actuated coordinate.
    limit
        Of its torque, N m.
    parameters
        ``m_1, m_2, l_1, a_1, a_2, J_1, J_2, b_1, b_2, g``: masses, length of link 1, joint to
        centre of mass, inertias about the centre, damping of the joints, gravity.
    **rest
        Further fields of :class:`undertow.Mechanism`.
    """
    v = {p.name: p.symbol for p in parameters}
    shoulder = Coordinate("q_1", "rad", "lean of link 1 from the upright")
    elbow = Coordinate("q_2", "rad", "angle of link 2 against link 1")
    kinetic, potential = chain_energies(
        [shoulder.symbol, shoulder.symbol + elbow.symbol],
        [shoulder.velocity, shoulder.velocity + elbow.velocity],
        [v["m_1"], v["m_2"]],
        [v["J_1"], v["J_2"]],
        [v["a_1"], v["a_2"]],
        [v["l_1"], v["l_1"]],
        v["g"],
    )
    return Mechanism.from_energies(
        name,
        [shoulder, elbow] if motor == "shoulder" else [elbow, shoulder],
        [Input("torque", "N m", limit)],
        kinetic=kinetic,
        potential=potential,
        dissipation=v["b_1"] * shoulder.velocity**2 / 2 + v["b_2"] * elbow.velocity**2 / 2,
        parameters=tuple(parameters),
        **rest,
    )
