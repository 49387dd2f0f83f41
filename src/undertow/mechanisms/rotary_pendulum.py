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
from dataclasses import dataclass, replace

import sympy as sp

from undertow.base import checked, one_of
from undertow.models import Coordinate, Input, Mechanism, Parameter
from undertow.models.importers.drives import DCMotor

PAPER = "Sec. 4 of doi:10.1115/1.4005367 (Quanser SRV-02)"


@dataclass(frozen=True)
class QuanserRig:
    """A rotary pendulum as its user manual describes it, SI units.

    The pendulum has mass ``m_p``, its centre at ``l_p`` from the pivot and ``J_p`` about that
    centre; the arm, of length ``L_r``, has ``J_r`` about the vertical and damping ``B_r``.
    The pendulum's own small pivot damping is left out: the paper's model has none.
    """

    m_p: float
    l_p: float
    J_p: float
    L_r: float
    J_r: float
    B_r: float
    motor: DCMotor
    start: float
    source: str

    def values(self) -> dict[str, float]:
        """The same motion in the parameters of the paper's uniform rod.

        A rod of mass m' and half-length l' with m' l' = m_p l_p and (4/3) m' l'² =
        J_p + m_p l_p² has the same b, c and d; the arm's inertia makes up for m' in a.
        """
        moment = self.m_p * self.l_p
        half = 0.75 * (self.J_p + self.m_p * self.l_p**2) / moment
        mass = moment / half
        arm = self.J_r + self.motor.reflected_inertia + (self.m_p - mass) * self.L_r**2
        return {
            "l": half,
            "m": mass,
            "r_o": self.L_r,
            "I_e": arm,
            "d_e": self.B_r + self.motor.damping,
            "a_e": self.motor.torque_per_volt,
        }


#: Parameter sets from Quanser's public manuals, besides the paper's.
PARAMETER_SETS = {
    "srv02": QuanserRig(
        m_p=0.127,
        l_p=0.156,
        J_p=0.0012,
        L_r=0.216,
        J_r=0.0020,
        B_r=0.0024,
        motor=DCMotor(
            torque_constant=0.00768,
            resistance=2.6,
            gear_ratio=70.0,
            motor_efficiency=0.69,
            gear_efficiency=0.90,
            rotor_inertia=3.9e-7,
            voltage_limit=10.0,
        ),
        start=math.radians(20),
        source="Quanser SRV02 and Rotary Pendulum user manuals, high gear; limit chosen",
    ),
    "qube_servo_2": QuanserRig(
        m_p=0.024,
        l_p=0.0645,
        J_p=0.024 * 0.129**2 / 12,
        L_r=0.085,
        J_r=0.095 * 0.085**2 / 3,
        B_r=0.0015,
        motor=DCMotor(
            torque_constant=0.042, resistance=8.4, rotor_inertia=4e-6, voltage_limit=10.0
        ),
        start=math.radians(20),
        source="Quanser QUBE-Servo 2 user manual and Rotary Pendulum courseware; limit chosen",
    ),
}


@checked
def rotary_pendulum(parameter_set: str = "paper", **values: float) -> Mechanism:
    """Return the rotary pendulum with the paper's parameters, or another set's.

    Parameters
    ----------
    parameter_set
        ``"paper"``, or one of Quanser's rigs: ``"srv02"``, ``"qube_servo_2"``.
    **values
        Parameter values to replace, SI units: ``l, r_o, m, I_e, d_e, a_e, g``.

    Returns
    -------
    Mechanism
        Coordinates (θ, φ), rad; one input, the motor voltage, limited to ±15 V (paper) or
        ±10 V.

    Raises
    ------
    InvalidInputError
        For an unknown set or parameter, or a value outside its bounds.

    Examples
    --------
    >>> rotary_pendulum(d_e=0.025).inputs[0].limit
    15.0
    >>> round(rotary_pendulum("qube_servo_2").parameters[5].value, 6)
    0.005
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
    rig = Mechanism.from_energies(
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
    )
    if parameter_set != "paper":
        rig = _quanser(rig, parameter_set)
    return rig.with_parameters(**values)


def _quanser(rig: Mechanism, name: str) -> Mechanism:
    """The paper's equations with the numbers of one of Quanser's rigs."""
    one_of("parameter set of the rotary pendulum", name, ["paper", *PARAMETER_SETS])
    chosen = PARAMETER_SETS[name]
    numbers = chosen.values()
    parameters = tuple(
        replace(p, value=numbers[p.name], source=chosen.source) if p.name in numbers else p
        for p in rig.parameters
    )
    return replace(
        rig,
        parameters=parameters,
        inputs=(Input("voltage", "V", chosen.motor.voltage_limit),),
        start={"phi": chosen.start},
        source=chosen.source,
    )
