"""A co-simulation unit of the Functional Mock-up Interface 3.0: variables, description, build.

A unit (``.fmu``) is a zip archive: ``modelDescription.xml``, the sources, and a library for the
platform that it was made on.

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

from undertow.base import InvalidInputError, MissingExtraError
from undertow.export.host import compile_c
from undertow.export.names import ascii_words
from undertow.export.sources import render

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

        Raises MissingExtraError when there is no such compiler, or FMI has no name for this
        platform; ArtefactError when the C does not compile.
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
