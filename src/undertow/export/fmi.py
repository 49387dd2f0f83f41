"""Co-simulation units of the Functional Mock-up Interface 3.0: of the controller, of the plant.

A unit (``.fmu``) is a zip archive: ``modelDescription.xml``, the sources, and a library for the
platform that it was made on.  Both are the exported C behind the standard's functions.  The
controller is :func:`undertow.export.files`'s own, one period in each step; the plant is
M(q) q̈ = f(q, q̇) + B u by Runge and Kutta's fourth-order step.

Source: Modelica Association, *Functional Mock-up Interface Specification*, version 3.0,
fmi-standard.org.
"""

from __future__ import annotations

import hashlib
import io
import math
import platform
import re
import tempfile
import xml.etree.ElementTree as ET
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, MissingExtraError
from undertow.export.controller import EmbeddedController, plan_numbers
from undertow.export.estimate import build_acceleration_graph
from undertow.export.host import compile_c
from undertow.export.names import ascii_words
from undertow.export.sources import common, controller_files, helpers, render
from undertow.models import Coordinate, Mechanism
from undertow.symbolic import C99Emitter, Tape

#: SI units in the base units, and the radian, that FMI knows: their exponents.
BASE_UNITS: dict[str, dict[str, int]] = {
    **{name: {name: 1} for name in ("kg", "m", "s", "A", "K", "rad")},
    "N": {"kg": 1, "m": 1, "s": -2},
    "J": {"kg": 1, "m": 2, "s": -2},
    "W": {"kg": 1, "m": 2, "s": -3},
    "V": {"kg": 1, "m": 2, "s": -3, "A": -1},
    "Ω": {"kg": 1, "m": 2, "s": -3, "A": -2},
    "1": {},
}

_POWERS = str.maketrans("⁻¹²³⁴", "-1234")


def base_units(unit: str) -> dict[str, int] | None:
    """Return the exponents of a unit in SI base units; ``None`` for one that is not known.

    >>> base_units("N m s/rad")
    {'kg': 1, 'm': 2, 's': -1, 'rad': -1}
    """
    total: Counter[str] = Counter()
    above, *below = unit.split("/")
    for sign, words in ((1, above), *((-1, part) for part in below)):
        for word in words.replace("·", " ").split():
            found = re.fullmatch(r"([A-Za-zΩ1]+)(-?\d?)", word.translate(_POWERS))
            if found is None or found[1] not in BASE_UNITS:
                return None
            for name, power in BASE_UNITS[found[1]].items():
                total[name] += sign * power * int(found[2] or 1)
    return {name: power for name, power in total.items() if power}


@dataclass(frozen=True)
class Variable:
    """A variable of a unit, as FMI describes it.

    ``type`` is Float64, Int32 or Boolean; ``any_number``: NaN is accepted too, for measurements
    that may be lost.
    """

    name: str
    causality: str
    variability: str
    start: float = 0.0
    unit: str = ""
    description: str = ""
    type: str = "Float64"
    low: float = -math.inf
    high: float = math.inf
    any_number: bool = False

    @property
    def kind(self) -> str:
        """Who may set it, and when: a letter of the template ``unit.h``."""
        if self.causality == "independent":
            return "r"
        if self.causality == "input":
            return "m" if self.any_number else "i"
        return "t" if self.variability == "tunable" else "s"

    def element(self, reference: int) -> ET.Element:
        """Return its element of ``modelDescription.xml``."""
        node = ET.Element(self.type, name=self.name, valueReference=str(reference))
        if self.description:
            node.set("description", self.description)
        node.set("causality", self.causality)
        node.set("variability", self.variability)
        if self.causality == "output":
            node.set("initial", "exact")
        if self.unit:
            node.set("unit", self.unit)
        for bound, value in (("min", self.low), ("max", self.high)):
            if math.isfinite(value):
                node.set(bound, repr(value))
        if self.causality != "independent":
            start = {"Float64": repr(float(self.start)), "Int32": str(int(self.start))}
            node.set("start", start.get(self.type, str(bool(self.start)).lower()))
        return node


#: The variables of a unit in groups that lie together; the C knows where each begins.
Groups = Mapping[str, Sequence[Variable]]


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
    whole = "use the measured rates; otherwise they are estimated from the positions"
    return {
        "MEASURED": [
            Variable(name, "input", "continuous", 0.0, unit, words, any_number=True)
            for name, unit, words in states
        ],
        "ARM": [
            Variable(
                "loop.arm", "input", "discrete", type="Boolean",
                description="rising: let the output on again after a lost sensor or a fault",
            )
        ],
        "RATES_MEASURED": [
            Variable("loop.rates_measured", "parameter", "fixed", 0.0, "", whole, "Boolean")
        ],
        "SURFACE": [
            *(
                Variable(name, "parameter", "tunable", float(v))
                for name, v in zip(entries, surface, strict=True)
            ),
            *(
                Variable(
                    f"reaching.{name}{index}", "parameter", "tunable", float(v), low=0.0,
                    description=words,
                )
                for name, values, words in (
                    ("eta", eta, "reaching gain, units of s per second"),
                    ("layer", layer, "half-width of the boundary layer, units of s"),
                )
                for index, v in zip(numbers, values, strict=True)
            ),
        ],
        "OUTPUTS": [
            Variable(u.name, "output", "discrete", 0.0, u.unit, f"at most {u.limit:g} {u.unit}")
            for u in mechanism.inputs
        ],
        "STATUS": [
            Variable(
                "loop.status", "output", "discrete", type="Int32",
                description="status bits of the last period, as in the C header",
            )
        ],
        "S": [
            Variable(f"loop.s{index}", "output", "discrete", description="value of the surface")
            for index in numbers
        ],
        "MARGIN": [
            Variable(
                "loop.margin", "output", "discrete",
                description="det Γ(q)/det Γ(0): > 0 where the law exists",
            )
        ],
        "ESTIMATE": [
            Variable(f"estimate.{name}", "output", "discrete", 0.0, unit)
            for name, unit, _ in states
        ],
    }  # fmt: skip


@dataclass(frozen=True)
class Unit:
    """A unit before it is built: its variables, what its templates are told, its C.

    ``model`` is the template of its model, ``extra`` are further sources, names to contents;
    ``any_step``: whether every positive communication step will do, or whole multiples of
    ``step``, s, alone.
    """

    name: str
    title: str
    groups: Groups
    model: str
    values: dict[str, str]
    extra: dict[str, bytes]
    step: float
    any_step: bool
    prefix: str

    @property
    def variables(self) -> list[Variable]:
        """All variables in the order of their value references, the time first."""
        names = [v.name for group in self.groups.values() for v in group]
        twice = [name for name, count in Counter([*names, "time"]).items() if count > 1]
        if twice:
            raise InvalidInputError(
                "names of the variables of a co-simulation unit",
                value=", ".join(twice),
                limit="each of them once; 'time' is the clock's",
                remedy="Rename the coordinate, input or parameter",
            )
        time = Variable("time", "independent", "continuous", unit="s")
        return [time, *(v for group in self.groups.values() for v in group)]

    @property
    def token(self) -> str:
        """What ties the description to the binary: a hash of all that they are made from."""
        parts = (self.name, self.variables, sorted(self.values.items()), sorted(self.extra.items()))
        return hashlib.sha256(repr(parts).encode()).hexdigest()[:32]

    def sources(self) -> dict[str, bytes]:
        """Return the sources: file names to contents."""
        variables = self.variables
        places, at = [], 1
        for name, group in self.groups.items():
            places.append(f"#define UT_AT_{name} {at}")
            at += len(group)

        def table(name: str, numbers: Sequence[float]) -> str:
            cells = [
                repr(v) if math.isfinite(v) else "INFINITY" if v > 0 else "-INFINITY"
                for v in map(float, numbers)
            ]
            rows = "".join(f"    {cell},\n" for cell in cells)
            return f"const double ut_{name}[UT_VALUES] = {{\n{rows}}};"

        values = self.values | {
            "title": ascii_words(self.title),
            "token": self.token,
            "step": repr(self.step),
            "places": "\n".join(places),
            "count": str(at),
            "types": "".join(v.type[0].lower().replace("f", "d") for v in variables),
            "kinds": "".join(v.kind for v in variables),
            "tables": "\n".join(
                table(name, [getattr(v, name) for v in variables])
                for name in ("start", "low", "high")
            ),
        }
        rounding = {
            True: ("fmax(1, ceil(steps - 1e-6))", "size > 0", "a positive number, or too many"),
            False: ("round(steps)", "fabs(steps - whole) <= 1e-6 * whole", "a whole multiple"),
        }
        keys = ("rounding", "good_size", "step_limit")
        values |= dict(zip(keys, rounding[self.any_step], strict=True))
        made = {
            "fmi3.h": render("fmi3.h", {}, self.prefix),
            "unit.h": render("unit.h", values, self.prefix),
            "unit.c": render("unit.c", values, self.prefix),
            "model.c": render(self.model, values, self.prefix),
        }
        return made | self.extra

    def description(self) -> bytes:
        """Return ``modelDescription.xml``."""
        variables = self.variables
        root = ET.Element(
            "fmiModelDescription",
            fmiVersion="3.0",
            modelName=self.name,
            instantiationToken=self.token,
            description=self.title,
            generationTool=f"undertow {self.values['version']}",
        )
        ET.SubElement(
            root,
            "CoSimulation",
            modelIdentifier=self.name,
            canGetAndSetFMUState="true",
            canSerializeFMUState="true",
            canHandleVariableCommunicationStepSize=str(self.any_step).lower(),
            fixedInternalStepSize=repr(self.step),
        )
        definitions = ET.SubElement(root, "UnitDefinitions")
        for name in sorted({v.unit for v in variables} - {""}):
            node = ET.SubElement(definitions, "Unit", name=name)
            exponents = base_units(name)
            if exponents is not None:
                ET.SubElement(node, "BaseUnit", {k: str(v) for k, v in exponents.items()})
        categories = ET.SubElement(root, "LogCategories")
        ET.SubElement(categories, "Category", name="logStatusError", description="what is refused")
        ET.SubElement(
            root, "DefaultExperiment", startTime="0", stopTime="5", stepSize=repr(self.step)
        )
        listed = ET.SubElement(root, "ModelVariables")
        structure = ET.SubElement(root, "ModelStructure")
        for reference, variable in enumerate(variables):
            listed.append(variable.element(reference))
            if variable.causality == "output":
                ET.SubElement(structure, "Output", valueReference=str(reference))
        return _xml(root)

    def build_description(self) -> bytes:
        """Return ``buildDescription.xml``, by which others compile the sources."""
        root = ET.Element("fmiBuildDescription", fmiVersion="3.0")
        configuration = ET.SubElement(root, "BuildConfiguration", modelIdentifier=self.name)
        files_ = ET.SubElement(configuration, "SourceFileSet", language="C99")
        for name in self.sources():
            if name.endswith(".c"):
                ET.SubElement(files_, "SourceFile", name=name)
        return _xml(root)

    def build(self, compiler: str = "gcc") -> bytes:
        """Return the unit: description, sources, and a library for this platform.

        Raises
        ------
        MissingExtraError
            When there is no such compiler, or FMI has no name for this platform.
        ArtefactError
            When the C does not compile.
        """
        tuple_, ending = platform_tuple()
        sources = self.sources()
        with tempfile.TemporaryDirectory(prefix="undertow-") as place:
            for name, content in sources.items():
                (Path(place) / name).write_bytes(content)
            units = [name for name in sources if name.endswith(".c")]
            library = compile_c(
                compiler, Path(place), units, self.name + ending, "-shared", "-fPIC",
                "-fvisibility=hidden",
            ).read_bytes()  # fmt: skip
        members = {
            "modelDescription.xml": self.description(),
            f"binaries/{tuple_}/{self.name}{ending}": library,
            "sources/buildDescription.xml": self.build_description(),
            **{f"sources/{name}": content for name, content in sources.items()},
        }
        archive = io.BytesIO()
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
            for name, content in members.items():
                packed.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
        return archive.getvalue()


def _xml(root: ET.Element) -> bytes:
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="UTF-8", xml_declaration=True)) + b"\n"


def platform_tuple() -> tuple[str, str]:
    """Return FMI's name for this platform, and how a library's file name ends on it."""
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(
        platform.machine().lower(), platform.machine().lower()
    )
    systems = {
        "Linux": ("linux", ".so"),
        "Darwin": ("darwin", ".dylib"),
        "Windows": ("windows", ".dll"),
    }
    known = ("x86_64", "aarch64", "x86", "aarch32", "riscv64", "riscv32", "ppc64", "ppc32")
    if platform.system() not in systems or machine not in known:
        raise MissingExtraError(
            "platform of a co-simulation unit",
            value=f"{platform.machine()} under {platform.system()}",
            limit=f"one that FMI 3.0 names: {', '.join(known)} under Linux, macOS, Windows",
            remedy="Export on another machine, or compile the unit's sources by hand",
        )
    system, ending = systems[platform.system()]
    return f"{machine}-{system}", ending


def plant_unit(controller: EmbeddedController, start: ArrayLike | None = None) -> Unit:
    """Return the plant's unit: the controller's belief as it moves, no limit on the inputs.

    The longest internal step is the controller's period; ``start`` is where it starts, (2n,), by
    default the mechanism's usual start.
    """
    mechanism = controller.mechanism
    tape = Tape()
    names = {x: f"x[{i}]" for i, x in enumerate(mechanism.x)}
    names |= {u: f"u[{i}]" for i, u in enumerate(mechanism.u)}
    names |= {p.symbol: f"p[{i}]" for i, p in enumerate(mechanism.parameters)}
    rates = {f"rate[{i}]": a for i, a in enumerate(build_acceleration_graph(mechanism, tape))}
    body = C99Emitter(tape, names, "double").statements(rates)
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
        controller.period,
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

    ``start`` is where the plant starts, (2n,), by default the mechanism's usual start.

    Raises
    ------
    MissingExtraError
        When there is no such compiler, or FMI has no name for this platform.
    InvalidInputError
        When two variables would have one name.
    ArtefactError
        When the C does not compile.
    """
    units = (controller_unit(controller), plant_unit(controller, start))
    return {f"{unit.name}.fmu": unit.build(compiler) for unit in units}
