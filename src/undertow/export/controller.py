"""What is exported, and its C99: templates filled from the tape.

The templates in ``templates/`` are C but for ``${…}``; every name in them begins with ``ut_`` or
``UT_``, which becomes the prefix of choice.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import metadata, resources
from string import Template
from typing import ClassVar

import numpy as np
import sympy as sp

from undertow.codegen.c99 import C99Emitter, Real, literal
from undertow.codegen.tape import Tape
from undertow.errors import InvalidInputError
from undertow.export.differentiators import DerivativeStep
from undertow.export.estimate import EstimatorStep, estimate_code
from undertow.export.observer import KalmanStep
from undertow.export.routh import lay_polynomial
from undertow.export.seal import FACTOR, WIDTH, as_held, seals
from undertow.export.twin import LARGEST
from undertow.mechanism import FloatArray, Mechanism
from undertow.plan import Plan
from undertow.sliding import LawSymbols, ReachingLaw, SlidingModeLaw, Surface, lay_law
from undertow.stability import check_surface

__all__ = ["EmbeddedController", "files"]


@dataclass(frozen=True, eq=False)
class EmbeddedController:
    """The inner loop of a mechanism, as it is to run on a microcontroller.

    Parameters
    ----------
    mechanism
        The controller's belief; its parameter values become constants of the C.
    surface
        The surface, or the plan of surfaces, that is built in.
    reaching
        Reaching law where the plan has none of its own.
    period
        Sample period, s.
    differentiator
        Where velocities come from when positions alone are measured: a differentiator, or the
        model itself, :class:`undertow.export.KalmanStep`.
    slew
        Largest rate of the inputs, their unit per second: one for all or one for each;
        ``None``: no limit.
    missed
        Periods for which a lost measurement is bridged by the last velocity.
    rows
        Most surfaces in a plan; 0: as many as are built in.
    real
        ``"double"`` or ``"float"``.
    prefix
        Beginning of every C name.

    Raises
    ------
    InvalidInputError
        When a number cannot be used, an input has no limit, or the boundary layer is too thin
        for the period.
    SingularSurfaceError, UnstableSurfaceError
        When Γ is singular at the target, or the motion on a surface does not die out there.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> controller = EmbeddedController(rig, ut.first_surface(rig))
    >>> sorted(files(controller))[:2]
    ['rotary_pendulum.c', 'rotary_pendulum.h']
    """

    mechanism: Mechanism
    surface: Surface | Plan
    reaching: ReachingLaw = ReachingLaw()
    period: float = 0.001
    differentiator: EstimatorStep = DerivativeStep()
    slew: float | tuple[float, ...] | None = None
    missed: int = 5
    rows: int = 0
    real: Real = "double"
    prefix: str = "ut"

    #: Sequence number of the plan that is built in.
    number: ClassVar[int] = 1

    @property
    def stem(self) -> str:
        """Name of the files: the mechanism's, as far as a file and ``#include`` can bear it."""
        stem = re.sub(r"[^A-Za-z0-9_]+", "_", "".join(map(_letter, self.mechanism.name)))
        return f"{stem}_rig" if stem in _HEADERS else stem[:60] or "rig"

    @cached_property
    def plan(self) -> Plan:
        """The plan that is built in."""
        return Plan.of(self.surface)

    @cached_property
    def slew_rates(self) -> FloatArray:
        """Largest rate of each input, its unit per second, (m,); infinite where there is none."""
        m = self.mechanism.m
        rates = np.atleast_1d(np.asarray(np.inf if self.slew is None else self.slew, dtype=float))
        if rates.shape not in {(1,), (m,)} or not (rates > 0).all():
            raise InvalidInputError(
                "slew rate",
                value=self.slew,
                limit=f"one number > 0, or {m} of them",
                remedy="Leave it out for no limit",
            )
        return np.array(np.broadcast_to(rates, (m,)))

    @property
    def most_rows(self) -> int:
        """Most surfaces in a plan."""
        return self.rows or len(self.plan.surfaces)

    def __post_init__(self) -> None:
        """Refuse what cannot run: see the class."""
        limits = self.mechanism.input_limits
        built_in = len(self.plan.surfaces)
        for what, value, good, limit in (
            ("period of the exported loop", self.period, 0 < self.period < 1, "0 to 1 s"),
            ("missed periods", self.missed, self.missed >= 0, "0 or more"),
            ("real", repr(self.real), self.real in ("double", "float"), "'double' or 'float'"),
            (
                "prefix",
                repr(self.prefix),
                re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,15}", self.prefix) is not None,
                "a C name of at most 16 letters",
            ),
            (
                "rows of the surface table",
                self.most_rows,
                built_in <= self.most_rows <= 64,
                f"{built_in} (those of the plan) to 64",
            ),
        ):
            if not good:
                raise InvalidInputError(what, value=value, limit=limit)
        if not np.isfinite(limits).all():
            raise InvalidInputError(
                f"input limits of '{self.mechanism.name}'",
                value=limits.tolist(),
                limit="finite",
                remedy="Name what the actuators can deliver: mechanism.with_input_limit",
            )
        for law in self.laws:
            check_surface(self.mechanism, law.surface)
            layer = law.reaching.vector(self.mechanism.m)[self.mechanism.m :]
            gains = law(0.0, np.zeros(2 * self.mechanism.n)).gains
            fast = self.period * gains >= 2 * layer
            if law.reaching.switching != "sign" and fast.any():
                raise InvalidInputError(
                    "period of the exported loop",
                    value=f"{self.period:g} s",
                    limit=f"below 2 ε/k = {np.min(2 * layer / gains):g} s",
                    remedy="Use a shorter period, a thicker boundary layer or smaller gains",
                )
        self.starts(self.plan)
        self.slew_rates  # noqa: B018  # refuses what cannot be used
        if isinstance(self.differentiator, KalmanStep):
            self.differentiator.noises(self.mechanism.n)
        else:
            self.differentiator.gains(self.mechanism.n)

    @cached_property
    def laws(self) -> tuple[SlidingModeLaw, ...]:
        """The laws of the plan, one for each surface."""
        plan = self.plan
        return tuple(
            SlidingModeLaw(self.mechanism, surface, plan.at(t)[1] or self.reaching)
            for surface, t in zip(plan.surfaces, plan.times, strict=True)
        )

    def starts(self, plan: Plan) -> list[int]:
        """Return the periods, from the start of a plan, at which its surfaces take over."""
        starts = [round(t / self.period) for t in plan.times]
        if len(starts) > self.most_rows or any(np.diff(starts) < 1) or starts[-1] >= 2**32:
            raise InvalidInputError(
                "times of an exported plan",
                value=list(plan.times),
                limit=f"at most {self.most_rows}, a period of {self.period:g} s apart or more, "
                "below 2^32 periods",
                remedy="Leave out the surfaces that never act, or ask for more rows",
            )
        return starts

    def limit(self, value: float) -> str:
        """Return a C literal that is nowhere above a positive value."""
        if self.real == "float":
            single = np.float32(value)
            if float(single) > value:
                single = np.nextafter(single, np.float32(0))
            value = float(single)
        return literal(value, self.real)


# -- the generated parts --------------------------------------------------------------------------


def _lay(controller: EmbeddedController) -> dict[str, str]:
    """Return the statements of the law and of det Γ(0), and the estimator."""
    mechanism, switching = controller.mechanism, controller.reaching.switching
    n, m = mechanism.n, mechanism.m
    symbols = LawSymbols.of(n, m)
    names: dict[sp.Symbol, str] = {x: f"x[{i}]" for i, x in enumerate(mechanism.x)}
    names |= {s: f"row->surface[{i}]" for i, s in enumerate(symbols.surface)}
    names |= {s: f"row->eta[{i}]" for i, s in enumerate(symbols.eta)}
    names |= {s: f"row->layer[{i}]" for i, s in enumerate(symbols.layer)}
    names[symbols.gamma_target] = "row->gamma"
    names |= {p.symbol: _macro(i, p.name) for i, p in enumerate(mechanism.parameters)}

    tape = Tape()
    law = lay_law(
        mechanism.partition(tape), mechanism.x, symbols, switching, mechanism.disturbance_bounds
    )
    results = {f"out->demand[{i}]": e for i, e in enumerate(law.u)}
    results |= {f"out->s[{i}]": e for i, e in enumerate(law.s)}
    results |= {f"out->gain[{i}]": e for i, e in enumerate(law.gains)}
    results["out->margin"] = law.margin
    evaluate = C99Emitter(tape, names, controller.real).statements(results)

    tape = Tape()
    target = mechanism.partition(tape, dict.fromkeys(mechanism.x, sp.Integer(0)))
    entries = list(symbols.surface)
    alpha_a = sp.Matrix(m, m, entries[: m * m])
    alpha_u = sp.Matrix(m, n - m, entries[2 * m * m : m * m + m * n])
    _, determinant = tape.adjugate(tape.matrix(alpha_a - alpha_u * target.X))
    gamma = C99Emitter(tape, names, controller.real).statements({"value": determinant})

    estimate = estimate_code(
        controller.differentiator,
        mechanism,
        controller.period,
        {p.symbol: names[p.symbol] for p in mechanism.parameters},
        controller.real,
    )
    tape = Tape()
    powers = tape.let_all(lay_polynomial(mechanism, symbols.surface))
    powers += [sp.Integer(0)] * (2 * n + 2 - len(powers))
    polynomial = C99Emitter(tape, names, controller.real).statements(
        {f"a[{k}]": a for k, a in enumerate(powers)}
    )
    return {"law": evaluate, "gamma": gamma, "polynomial": polynomial, **estimate}


_HELPERS = {
    "ut_max": """static ut_real ut_max(ut_real a, ut_real b)
{
    return a > b || isnan(a) ? a : b;
}
""",
    "ut_min": """static ut_real ut_min(ut_real a, ut_real b)
{
    return a < b || isnan(a) ? a : b;
}
""",
    "ut_mod": """static ut_real ut_mod(ut_real remainder, ut_real b)
{
    return (remainder < 0 && b > 0) || (remainder > 0 && b < 0) ? remainder + b : remainder;
}
""",
    "ut_sign": """static ut_real ut_sign(ut_real a)
{
    return (ut_real)((a > 0) - (a < 0));
}
""",
}


#: Headers that the generated C includes: a file of its own under such a name would hide them.
_HEADERS = {"math", "signal", "stdio", "stdlib"}


def _letter(sign: str) -> str:
    """Return an ASCII spelling of one letter: Greek by its name, others without accents."""
    if sign.isascii():
        return sign
    *kind, name = unicodedata.name(sign, "unnamed").split()
    if kind[:1] == ["GREEK"] and kind[-1:] == ["LETTER"]:
        return name.lower() if "SMALL" in kind else name.title()
    plain = unicodedata.normalize("NFKD", sign).encode("ascii", "ignore").decode()
    return plain or f"u{ord(sign):x}"


def _c_name(name: str) -> str:
    """Return a Python identifier in ASCII."""
    return "".join(map(_letter, name))


def _macro(index: int, name: str) -> str:
    """Return the C name of a parameter: its place makes it one of a kind, its name readable."""
    return f"UT_PARAMETER_{index}_{_c_name(name)[:32]}"


def _ascii(text: str) -> str:
    """Return words in ASCII that neither begin nor end a comment, and hold no trigraph."""
    for sign, words in {"²": "^2", "³": "^3", "·": " ", "Ω": "Ohm"}.items():
        text = text.replace(sign, words)
    plain = "".join(map(_letter, text)).replace("\\", "/")  # first: "*\" would become an end
    return " ".join(re.sub(r"[*](?=/)|/(?=[*])|[?](?=[?])", r"\g<0> ", plain).split())


def _listed(values: Iterable[float], real: Real) -> str:
    return ", ".join(literal(v, real) for v in values)


def plan_numbers(
    controller: EmbeddedController, plan: Plan
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return what the C holds of each row of a plan: surface (2mn,), η (m,) and ε (m,)."""
    m = controller.mechanism.m
    rows = []
    for surface, t in zip(plan.surfaces, plan.times, strict=True):
        law = plan.at(t)[1] or controller.reaching
        values = np.concatenate([surface.vector, law.vector(m)])
        held = np.array([as_held(v, controller.real) for v in values.tolist()])
        rows.append((held[: -2 * m], held[-2 * m : -m], held[-m:]))
    return rows


def plan_text(controller: EmbeddedController, plan: Plan, number: int) -> dict[str, str]:
    """Return the C initialisers of a plan: count, starts and rows, sealed."""
    whole = controller if plan is controller.plan else replace(controller, surface=plan)
    starts, numbers = whole.starts(plan), plan_numbers(whole, plan)
    checks = seals(number, starts, numbers, controller.real)
    rows = []
    for law, row, check in zip(whole.laws, numbers, checks, strict=True):
        parts = [f"{{{_listed(v, controller.real)}}}" for v in row]
        gamma = literal(law.gamma_target, controller.real)
        rows.append(f"        {{{', '.join([*parts, gamma, f'{check:#x}u'])}}},")
    return {
        "count": str(len(rows)),
        "starts": ", ".join(f"{k}UL" for k in starts),
        "rows": "\n".join(rows),
    }


#: Values of the templates that hold a user's words: their ``ut_`` stays as it is.
_WORDS = {"name", "title", "coordinates", "inputs", "estimator", "gain_meaning"}


def prefixed(text: str, prefix: str) -> str:
    """Give the names of C their prefix."""
    text = re.sub(r"\but_", f"{prefix}_", text)
    return re.sub(r"\bUT_", f"{prefix.upper()}_", text)


def render(name: str, values: dict[str, str], prefix: str) -> bytes:
    """Fill a template and give its names their prefix."""
    source = resources.files("undertow.export") / "templates" / name
    text = Template(prefixed(source.read_text(encoding="ascii"), prefix)).substitute(
        {key: value if key in _WORDS else prefixed(value, prefix) for key, value in values.items()}
    )
    return re.sub(r"[ \t]+$", "", text, flags=re.MULTILINE).encode("ascii")


def _version() -> str:
    try:
        return metadata.version("undertow")
    except metadata.PackageNotFoundError:
        return "(from source)"


def common(controller: EmbeddedController) -> dict[str, str]:
    """Return what every template is told."""
    mechanism = controller.mechanism
    title = f"{mechanism.name}: sliding-mode law, n = {mechanism.n}, m = {mechanism.m}"
    return {"name": controller.stem, "title": _ascii(title), "version": _version()}


def files(controller: EmbeddedController) -> dict[str, bytes]:
    """Return the C of a controller: file names to contents, ASCII.

    ``<name>.h`` and ``<name>.c`` are the controller; ``<name>_vectors.h`` and
    ``<name>_test.c`` test it on any machine; ``<name>_pipe.c`` speaks to it in lines of text.
    """
    from undertow.export.vectors import vectors

    mechanism, real = controller.mechanism, controller.real
    name, prefix = controller.stem, controller.prefix
    shared = common(controller)
    plan = plan_text(controller, controller.plan, controller.number)
    code = _lay(controller)
    used = "\n".join(code.values())
    sharp = controller.reaching.switching == "sign"
    limits = mechanism.input_limits
    slew = np.minimum(controller.slew_rates * controller.period, 2 * limits)
    values = shared | {
        "real": real,
        "word": f"uint{WIDTH[real]}_t",
        "turn": str(WIDTH[real] - 5),
        "factor": f"{FACTOR[real]:#x}",
        "fingerprint": mechanism.fingerprint[:16],
        "coordinates": _coordinates(mechanism),
        "inputs": _inputs(controller),
        "n": str(mechanism.n),
        "m": str(mechanism.m),
        "states": str(2 * mechanism.n),
        "surface": str(2 * mechanism.m * mechanism.n),
        "rows": str(controller.most_rows),
        "period": literal(controller.period, real),
        "missed": str(controller.missed),
        "parameters": _parameters(controller),
        "number": str(controller.number),
        "count": plan["count"],
        "starts": plan["starts"],
        "plan": plan["rows"],
        "estimator": _ascii(controller.differentiator.description),
        "gain_meaning": _ascii(controller.differentiator.meaning),
        "limits": ", ".join(controller.limit(v) for v in limits),
        "slews": ", ".join(controller.limit(v) for v in slew),
        "largest": literal(LARGEST, real),
        "tiny": literal(1e-12, real),
        "fabs": "fabsf" if real == "float" else "fabs",
        "rate_check": "1" if sharp else "UT_PERIOD * out.gain[i] < 2 * row->layer[i]",
        "helpers": "\n".join(v for k, v in _HELPERS.items() if f"{k}(" in used),
        **code,
    }
    return {
        f"{name}.h": render("controller.h", values, prefix),
        f"{name}.c": render("controller.c", values, prefix),
        f"{name}_vectors.h": render("vectors.h", shared | vectors(controller), prefix),
        f"{name}_test.c": render("test.c", shared, prefix),
        f"{name}_pipe.c": render("pipe.c", shared | {"place": code["place"]}, prefix),
    }


def _coordinates(mechanism: Mechanism) -> str:
    width = max(len(c.name) for c in mechanism.coordinates)
    return "\n".join(
        f" *   q[{i}]  {_c_name(c.name):{width}}  {c.unit:3}  {_ascii(c.description)}"
        for i, c in enumerate(mechanism.coordinates)
    )


def _inputs(controller: EmbeddedController) -> str:
    lines = []
    for i, (channel, slew) in enumerate(
        zip(controller.mechanism.inputs, controller.slew_rates, strict=True)
    ):
        unit = _ascii(channel.unit)
        line = f" *   u[{i}]  {_c_name(channel.name)}, {unit}, at most {channel.limit:g} {unit}"
        lines.append(line + f", {slew:g} {unit}/s" * math.isfinite(slew))
    return "\n".join(lines)


def _parameters(controller: EmbeddedController) -> str:
    lines = []
    for i, p in enumerate(controller.mechanism.parameters):
        define = f"#define {_macro(i, p.name)} {literal(p.value, controller.real)}"
        words = ": ".join(filter(None, (_ascii(p.unit), _ascii(p.description))))
        lines.append(f"{define} /* {words} */" if words else define)
    return "\n".join(lines)
