"""The rotary (Furuta) pendulum of the paper's Sec. 4, driven by a DC motor's voltage.

An arm of length r_o turns about the vertical by θ; a uniform rod of length 2l hangs
from its tip, turned by φ from the upright.  Energies, with θ positive in the paper's
sense (opposite to the usual sketch, hence the sign of b):

    T = ½ (a + c sin² φ) θ̇² − b cos φ θ̇ φ̇ + ½ c φ̇²,     V = d cos φ
    a = I_e + m r_o²,   b = m l r_o,   c = (4/3) m l²,   d = m g l

Lagrange's equations give (32) exactly, and (33) with its first term −b cos φ · φ̈.

Errata of the paper, where they touch this file:

* c is printed ½ m l² (scan); the value that the appendix uses, 0.0047, is (4/3) m l².
* (33) prints −b cos φ · φ̇ for −b cos φ · φ̈.
* b_e in (33) and d_e in the text are one quantity, back-EMF included.
* The appendix computes with b = 0.0033; the parameters of Sec. 4 give b = 0.0045016.
* With the printed d_e = 0.073 the printed totals cannot occur; d_e ≈ 0.025 gives all six.
"""

from __future__ import annotations

import math

import sympy as sp

from undertow.mechanism import Coordinate, Input, Mechanism, Parameter

__all__ = ["rotary_pendulum"]

PAPER = "Sec. 4 of doi:10.1115/1.4005367 (Quanser SRV-02)"


def rotary_pendulum(**values: float) -> Mechanism:
    """Return the rotary pendulum with the paper's parameters.

    Parameters
    ----------
    **values
        Parameter values to replace, SI units: ``l, r_o, m, I_e, d_e, a_e, g``.

    Returns
    -------
    Mechanism
        Coordinates (θ, φ), rad; one input, the motor voltage, limited to ±15 V.

    Raises
    ------
    InvalidInputError
        For an unknown parameter or a value outside its bounds.

    Examples
    --------
    >>> rotary_pendulum(d_e=0.025).inputs[0].limit
    15.0
    """
    parameters = (
        Parameter("l", 0.1675, "m", "half-length of the pendulum", 0, math.inf, PAPER),
        Parameter("r_o", 0.215, "m", "length of the rotating arm", 0, math.inf, PAPER),
        Parameter("m", 0.125, "kg", "mass of the pendulum", 0, math.inf, PAPER),
        Parameter("I_e", 0.0036, "kg m²", "inertia of arm, motor, gears", 0, math.inf, PAPER),
        Parameter("d_e", 0.073, "N m s/rad", "damping with back-EMF", -1e-12, math.inf, PAPER),
        Parameter("a_e", 0.1285, "N m/V", "motor torque constant", 0, math.inf, PAPER),
        Parameter("g", 9.81, "m/s²", "gravity", 0, math.inf, "standard, as d = 0.2054 implies"),
    )
    l, r_o, m, I_e, d_e, a_e, g = (p.symbol for p in parameters)  # noqa: E741
    theta = Coordinate("theta", "rad", "arm angle about the vertical")
    phi = Coordinate("phi", "rad", "pendulum angle from the upright")
    w, p, p_dot = theta.velocity, phi.symbol, phi.velocity
    a, b, c, d = I_e + m * r_o**2, m * l * r_o, sp.Rational(4, 3) * m * l**2, m * g * l
    return Mechanism.from_energies(
        "rotary_pendulum",
        [theta, phi],
        [Input("voltage", "V", 15.0)],
        kinetic=(a + c * sp.sin(p) ** 2) * w**2 / 2 - b * sp.cos(p) * w * p_dot + c * p_dot**2 / 2,
        potential=d * sp.cos(p),
        dissipation=d_e * w**2 / 2,
        input_matrix=sp.ImmutableDenseMatrix([[a_e]]),
        parameters=parameters,
        start={"phi": math.radians(35)},
        description="rotary (Furuta) pendulum, voltage-driven",
        source=PAPER,
    ).with_parameters(**values)
