"""Drives: what stands between the amplifier and the joint.

A permanent-magnet DC motor at voltage V, its inductance neglected (it is far faster than
the mechanism), turning a joint at ω through a gear K_g:

    i = (V − k_m K_g ω) / R,        τ = η_g η_m K_g k_t i − β ω

so that a torque input τ becomes ``a V − b ω`` with a = η_g η_m K_g k_t / R and
b = β + η_g η_m K_g² k_t k_m / R, and the rotor adds η_g K_g² J_m to the joint's inertia.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace

import sympy as sp

from undertow.base import (
    InvalidInputError,
    ModelError,
    a_kind,
    check_fields,
    checked,
    one_of,
    positive,
)
from undertow.models.mechanism import Input, Mechanism, Parameter
from undertow.models.quantities import number_of
from undertow.models.validity import by_names


@dataclass(frozen=True)
class DCMotor:
    """A DC motor with its gear, from the data sheet.

    Parameters
    ----------
    torque_constant
        k_t, N m/A.
    resistance
        R of the armature, Ω.
    back_emf_constant
        k_m, V s/rad; equal to k_t where left out.
    gear_ratio
        K_g, motor turns per joint turn; for a slide joint, motor radians per metre.
    motor_efficiency, gear_efficiency
        η_m, η_g, in (0, 1].
    viscous_friction
        β, at the joint, N m s/rad (N s/m for a slide joint).
    rotor_inertia
        J_m of rotor and tachometer, kg m², on the motor's side of the gear.
    voltage_limit
        Largest magnitude that the amplifier delivers, V.
    source
        Where the numbers come from.

    Raises
    ------
    InvalidInputError
        For a constant that is not positive, or an efficiency outside (0, 1].
    """

    torque_constant: float
    resistance: float
    back_emf_constant: float | None = None
    gear_ratio: float = 1.0
    motor_efficiency: float = 1.0
    gear_efficiency: float = 1.0
    viscous_friction: float = 0.0
    rotor_inertia: float = 0.0
    voltage_limit: float = math.inf
    source: str = ""

    def __post_init__(self) -> None:
        """Refuse values that no motor has."""
        check_fields(self)
        for part in fields(self):
            if part.name != "source" and getattr(self, part.name) is not None:
                number_of(f"{part.name} of a DC motor", getattr(self, part.name))
        for name in ("torque_constant", "resistance", "gear_ratio", "voltage_limit"):
            positive(f"{name} of a DC motor", getattr(self, name), infinite=True)
        for name in ("motor_efficiency", "gear_efficiency"):
            if not 0 < getattr(self, name) <= 1:
                raise InvalidInputError(
                    f"{name} of a DC motor", value=getattr(self, name), limit="in (0, 1]"
                )
        for name in ("viscous_friction", "rotor_inertia", "k_m"):
            shown = name.replace("k_m", "back_emf_constant")
            positive(f"{shown} of a DC motor", getattr(self, name), zero=True)

    @property
    def k_m(self) -> float:
        """Back-EMF constant, V s/rad."""
        if self.back_emf_constant is None:
            return self.torque_constant
        return self.back_emf_constant

    @property
    def torque_per_volt(self) -> float:
        """A = η_g η_m K_g k_t / R, N m/V at the joint."""
        efficiency = self.motor_efficiency * self.gear_efficiency
        return efficiency * self.gear_ratio * self.torque_constant / self.resistance

    @property
    def damping(self) -> float:
        """B = β + a k_m K_g, N m s/rad at the joint, back-EMF included."""
        return self.viscous_friction + self.torque_per_volt * self.k_m * self.gear_ratio

    @property
    def reflected_inertia(self) -> float:
        """η_g K_g² J_m, kg m² at the joint."""
        return self.gear_efficiency * self.gear_ratio**2 * self.rotor_inertia


@checked
def voltage_driven(mechanism: Mechanism, motors: DCMotor | Mapping[str, DCMotor]) -> Mechanism:
    """Turn torque inputs into voltages: the same mechanism behind DC motors.

    Parameters
    ----------
    mechanism
        Driven by torques or forces: ``M q̈ = f + (B τ, 0)``.
    motors
        One motor for all inputs, or input name to motor; inputs left out stay as they are.

    Returns
    -------
    Mechanism
        ``(M + (B J Bᵀ, 0)) q̈ = f − (B b Bᵀ q̇_a, 0) + (B a V, 0)``: the motors turn with
        Bᵀ q̇_a, the velocities that the torques do work on.  The motors' data become
        parameters named ``<input>_k_t`` and so on; an input ``torque`` becomes ``voltage``,
        any other ``<input>_voltage``.

    Raises
    ------
    InvalidInputError
        For a motor on an input that does not exist.
    ModelError
        When an input is in volts already, or in kN or the like, in which no motor's data are.
    """
    names = [i.name for i in mechanism.inputs]
    each = dict.fromkeys(names, motors) if isinstance(motors, DCMotor) else motors
    chosen = by_names(f"motors of '{mechanism.name}'", each)
    for name, motor in chosen.items():
        if not isinstance(motor, DCMotor):
            raise InvalidInputError(
                f"motor of '{mechanism.name}' on '{name}'",
                value=f"{motor!r}, {a_kind(motor)}",
                limit="an undertow.models.importers.DCMotor",
                remedy="Write DCMotor(torque_constant, resistance), from the data sheet",
            )
        on = f"input of '{mechanism.name}' for a motor"
        one_of(on, name, names, "Name inputs of the mechanism")
    m = mechanism.m
    a, b, J = sp.eye(m), sp.zeros(m), sp.zeros(m)
    inputs, parameters = list(mechanism.inputs), list(mechanism.parameters)
    for j, given in enumerate(mechanism.inputs):
        if given.name not in chosen:
            continue
        motor = chosen[given.name]
        if given.unit not in ("N m", "Nm", "N·m", "N*m", "N.m", "N", ""):
            raise ModelError(
                f"input '{given.name}' of '{mechanism.name}'",
                value="in V already" if given.unit == "V" else f"in {given.unit}",
                limit="a torque in N m or a force in N, as a motor's data are",
                remedy="Put a motor on a mechanism that these drive",
            )
        data = _parameters(given.name, motor)
        parameters += data.values()
        symbol = {key: p.symbol for key, p in data.items()}
        efficiency = symbol["eta_g"] * symbol["eta_m"]
        a[j, j] = efficiency * symbol["K_g"] * symbol["k_t"] / symbol["R"]
        b[j, j] = symbol["beta"] + a[j, j] * symbol["k_m"] * symbol["K_g"]
        J[j, j] = symbol["eta_g"] * symbol["K_g"] ** 2 * symbol["J_m"]
        name = "voltage" if given.name == "torque" else f"{given.name}_voltage"
        inputs[j] = Input(name, "V", motor.voltage_limit)
    B = sp.Matrix(mechanism.input_matrix)
    rates = sp.Matrix([c.velocity for c in mechanism.coordinates[:m]])
    mass, force = sp.Matrix(mechanism.mass_matrix), sp.Matrix(mechanism.force)
    mass[:m, :m] += B * J * B.T
    force[:m, :] -= B * b * B.T * rates
    return replace(
        mechanism,
        inputs=tuple(inputs),
        mass_matrix=sp.ImmutableDenseMatrix(mass),
        force=sp.ImmutableDenseMatrix(force),
        input_matrix=sp.ImmutableDenseMatrix(B * a),
        parameters=tuple(parameters),
    )


def _parameters(prefix: str, motor: DCMotor) -> dict[str, Parameter]:
    """The motor's data as parameters, named after its input."""
    inf, tiny = math.inf, 1e-12
    rows = (
        ("k_t", motor.torque_constant, "N m/A", "torque constant", 0.0, inf),
        ("k_m", motor.k_m, "V s/rad", "back-EMF constant", -tiny, inf),
        ("R", motor.resistance, "Ω", "armature resistance", 0.0, inf),
        ("K_g", motor.gear_ratio, "", "gear ratio", 0.0, inf),
        ("eta_m", motor.motor_efficiency, "", "motor efficiency", 0.0, 1 + tiny),
        ("eta_g", motor.gear_efficiency, "", "gear efficiency", 0.0, 1 + tiny),
        ("beta", motor.viscous_friction, "N m s/rad", "viscous friction", -tiny, inf),
        ("J_m", motor.rotor_inertia, "kg m²", "rotor inertia", -tiny, inf),
    )
    return {
        key: Parameter(
            f"{prefix}_{key}", value, unit, f"{what}, motor of {prefix}", low, high, motor.source
        )
        for key, value, unit, what, low, high in rows
    }
