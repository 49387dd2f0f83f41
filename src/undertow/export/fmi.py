"""The co-simulation units of the controller and of its plant: the exported C as FMI 3.0 has it.

The controller is that of :func:`undertow.export.files`, one step in each period; the plant is
M(q) q̈ = f(q, q̇) + B u by Runge and Kutta's fourth-order step.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from numpy.typing import ArrayLike

from undertow.export.co_simulation import Groups, Unit, Variable
from undertow.export.controller import EmbeddedController, plan_numbers
from undertow.export.estimate import acceleration_code
from undertow.export.names import at_most
from undertow.export.sources import common, controller_files, helpers
from undertow.models import Coordinate, Mechanism, longest_step


def _states(coordinates: Sequence[Coordinate]) -> list[tuple[str, str, str]]:
    """Return name, unit and description of positions, then of their rates."""
    positions = [(c.name, c.unit, c.description) for c in coordinates]
    return positions + [(f"{c.name}_dot", f"{c.unit}/s", f"rate of {c.name}") for c in coordinates]


def plant_variables(mechanism: Mechanism, start: ArrayLike | None = None) -> Groups:
    """Return the plant's: inputs, states, which are its outputs, and tunable parameters."""
    x0 = mechanism.state(**mechanism.start) if start is None else mechanism.check_state(start)
    return {
        "INPUTS": [Variable(u.name, "input", "continuous", unit=u.unit) for u in mechanism.inputs],
        "STATES": [
            Variable(name, "output", "continuous", float(at), unit, words)
            for (name, unit, words), at in zip(_states(mechanism.coordinates), x0, strict=True)
        ],
        "PARAMETERS": [
            Variable(
                p.name, "parameter", "tunable", p.value, p.unit, p.description, low=p.low,
                high=p.high,
            )
            for p in mechanism.parameters
        ],
    }  # fmt: skip


def controller_variables(controller: EmbeddedController) -> Groups:
    """Return the controller's: what it measures and puts out, and its tunable surface."""
    mechanism = controller.mechanism
    n, m = mechanism.n, mechanism.m
    states = _states(mechanism.coordinates)
    surface, eta, layer = plan_numbers(controller, controller.plan)[0]
    shapes = {"alpha_a": m, "lambda_a": m, "alpha_u": n - m, "lambda_u": n - m}
    entries = [
        f"surface.{block}[{i},{k}]"
        for block, columns in shapes.items()
        for i in range(1, m + 1)
        for k in range(1, columns + 1)
    ]
    numbers = [f"[{i}]" for i in range(1, m + 1)]
    gains = {
        "eta": (eta, "reaching gain, units of s per second"),
        "layer": (layer, "half-width of the boundary layer, units of s"),
    }
    arm = "rising: let the output on again after a lost sensor or a fault"
    whole = "use the measured rates; otherwise they are estimated from the positions"
    bits = "status bits of the last period, as in the C header"

    def tunable(name: str, value: float, words: str = "", low: float = -math.inf) -> Variable:
        return Variable(name, "parameter", "tunable", float(value), "", words, low=low)

    def output(name: str, unit: str = "", words: str = "", kind: str = "Float64") -> Variable:
        return Variable(name, "output", "discrete", 0.0, unit, words, kind)

    return {
        "MEASURED": [
            Variable(name, "input", "continuous", 0.0, unit, words, any_number=True)
            for name, unit, words in states
        ],
        "ARM": [Variable("loop.arm", "input", "discrete", 0.0, "", arm, "Boolean")],
        "RATES_MEASURED": [
            Variable("loop.rates_measured", "parameter", "fixed", 0.0, "", whole, "Boolean")
        ],
        "SURFACE": [
            *(tunable(name, v) for name, v in zip(entries, surface, strict=True)),
            *(
                tunable(f"reaching.{name}{index}", v, words, 0.0)
                for name, (values, words) in gains.items()
                for index, v in zip(numbers, values, strict=True)
            ),
        ],
        "OUTPUTS": [output(u.name, u.unit, at_most(u)) for u in mechanism.inputs],
        "STATUS": [output("loop.status", "", bits, "Int32")],
        "S": [output(f"loop.s{index}", "", "value of the surface") for index in numbers],
        "MARGIN": [output("loop.margin", "", "det Γ(q)/det Γ(0): > 0 where the law exists")],
        "ESTIMATE": [output(f"estimate.{name}", unit) for name, unit, _ in states],
    }


def plant_unit(controller: EmbeddedController, start: ArrayLike | None = None) -> Unit:
    """Return the plant's unit: the controller's belief as it moves, no limit on the inputs.

    The longest internal step is the controller's period, or shorter where a mode of the plant is
    fast; ``start`` is where it starts, (2n,), by default the mechanism's usual start.
    """
    mechanism = controller.mechanism
    parameters = {p.symbol: f"p[{i}]" for i, p in enumerate(mechanism.parameters)}
    body = acceleration_code(mechanism, parameters, "double")
    values = common(controller) | {
        "n": str(mechanism.n),
        "states": str(2 * mechanism.n),
        "rates": body,
        "helpers": helpers(body),
        "include": "",
        "memory": "",
        "step_meaning": "longest internal step",
    }
    return Unit(
        f"{controller.stem}_plant",
        f"{mechanism.name}: the plant, n = {mechanism.n}, m = {mechanism.m}",
        plant_variables(mechanism, start),
        "unit_plant.c",
        values,
        {},
        longest_step(mechanism, controller.period),
        True,
        controller.prefix,
    )


def controller_unit(controller: EmbeddedController) -> Unit:
    """Return the controller's unit: one step of the exported C in each period."""
    mechanism, stem = controller.mechanism, controller.stem
    numbers = 2 * mechanism.m * (mechanism.n + 1)
    values = common(controller) | {
        "include": f'#include "{stem}.h"\n',
        "memory": "    ut_controller controller;\n"
        f"    double used[{numbers}]; /* the surface and reaching law in use */\n"
        "    int armed; /* the last value of loop.arm */\n",
        "step_meaning": "the controller's period",
    }
    return Unit(
        f"{stem}_controller",
        f"{mechanism.name}: the controller, n = {mechanism.n}, m = {mechanism.m}",
        controller_variables(controller),
        "unit_controller.c",
        values,
        controller_files(controller),
        controller.period,
        False,
        controller.prefix,
    )


def fmi_units(
    controller: EmbeddedController, compiler: str = "gcc", start: ArrayLike | None = None
) -> dict[str, bytes]:
    """Return ``<name>_controller.fmu`` and ``<name>_plant.fmu``, built here: names to contents.

    ``start`` is where the plant starts, (2n,), by default the mechanism's usual start. Raises
    MissingExtraError when there is no such compiler, or FMI has no name for this platform;
    InvalidInputError when two variables would have one name; ArtefactError when the C does not
    compile.
    """
    units = (controller_unit(controller), plant_unit(controller, start))
    return {f"{unit.name}.fmu": unit.build(compiler) for unit in units}
