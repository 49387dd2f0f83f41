"""The C99 of a controller: templates filled from the tape.

The templates in ``templates/`` are C but for ``${…}``; every name in them begins with ``ut_`` or
``UT_``, which becomes the prefix of choice.
"""

from __future__ import annotations

import math
import re
import textwrap
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import sympy as sp

from undertow.base import checked, one_of, versions, write_files
from undertow.export.controller import FACTOR, WIDTH, EmbeddedController, plan_text
from undertow.export.estimate import estimate_code
from undertow.export.names import LARGEST, ascii_words, at_most, c_name, macros, prefixed, template
from undertow.export.routh import characteristic_polynomial
from undertow.export.twin import vectors
from undertow.law import LawSymbols, Plan, Surface, Switching, build_law_graph
from undertow.models import Mechanism
from undertow.symbolic import C99Emitter, Real, Tape, literal

#: Values of the templates that hold a user's words: their ``ut_`` stays as it is.
_WORDS = {
    "name",
    "title",
    "about",
    "coordinates",
    "inputs",
    "estimator",
    "gain_meaning",
    "include",
    "package",
    "joints",
}


def render(name: str, values: dict[str, str], prefix: str) -> bytes:
    """Fill a template and give its names their prefix."""
    text = template(name, prefix).substitute(
        {key: value if key in _WORDS else prefixed(value, prefix) for key, value in values.items()}
    )
    return re.sub(r"[ \t]+$", "", text, flags=re.MULTILINE).encode("ascii")


def common(controller: EmbeddedController) -> dict[str, str]:
    """Return what every template is told."""
    mechanism = controller.mechanism
    title = f"{mechanism.name}: sliding-mode law, n = {mechanism.n}, m = {mechanism.m}"
    version = versions()["undertow"] or "(from source)"
    return {"name": controller.stem, "title": ascii_words(title), "version": version}


@checked
def export_c(
    mechanism: Mechanism, surface: Surface | Plan, folder: str | Path, **settings: Any
) -> Path:
    """Write the inner loop in C99: no heap, no dependencies, limits, estimator, surface table.

    Parameters
    ----------
    mechanism, surface
        The controller's belief, whose inputs have limits, and the surface or plan that is built in.
    folder
        Where NAME.c, NAME.h and what tests them go; earlier files are moved aside.
    **settings
        Further fields of :class:`undertow.export.EmbeddedController`: ``period``, ``reaching``,
        ``differentiator``, ``slew``, ``real``, ….

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ArtefactError
        When the files cannot be written.
    InvalidInputError
        When a number cannot be used or an input has no limit.
    SingularSurfaceError, UnstableSurfaceError
        When the law does not exist at the target, or the motion does not die out there.
    """
    known = [field.name for field in fields(EmbeddedController)][2:]
    for name in settings:
        one_of("setting of export_c", name, known)
    write_files(Path(folder), files(EmbeddedController(mechanism, surface, **settings)))
    return Path(folder)


def files(controller: EmbeddedController) -> dict[str, bytes]:
    """Return the C of a controller: file names to contents, ASCII.

    ``<name>.h`` and ``<name>.c`` are the controller; ``<name>_vectors.h`` and
    ``<name>_test.c`` test it on any machine; ``<name>_pipe.c`` speaks to it in lines of text.
    """
    name, prefix = controller.stem, controller.prefix
    shared = common(controller)
    place = _estimator(controller)["place"]
    return controller_files(controller) | {
        f"{name}_vectors.h": render("vectors.h", shared | vectors(controller), prefix),
        f"{name}_test.c": render("test.c", shared, prefix),
        f"{name}_pipe.c": render("pipe.c", shared | {"place": place}, prefix),
    }


def controller_files(controller: EmbeddedController) -> dict[str, bytes]:
    """Return ``<name>.h`` and ``<name>.c`` alone."""
    mechanism, real = controller.mechanism, controller.real
    name, prefix = controller.stem, controller.prefix
    shared = common(controller) | {"about": _about(mechanism)}
    plan = plan_text(controller, controller.plan, controller.number)
    code = _generated_parts(controller)
    used = "\n".join(code.values())
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
        "estimator": ascii_words(controller.differentiator.description),
        "gain_meaning": ascii_words(controller.differentiator.meaning),
        "limits": ", ".join(controller.limit(v) for v in limits),
        "slews": ", ".join(controller.limit(v) for v in slew),
        "largest": literal(LARGEST, real),
        "tiny": literal(1e-12, real),
        "fabs": "fabsf" if real == "float" else "fabs",
        "rate_check": "UT_PERIOD * out.gain[i] < 2 * row->layer[i]"
        if controller.reaching.has_layer
        else "1",
        "helpers": helpers(used),
        **code,
    }
    return {
        f"{name}.h": render("controller.h", values, prefix),
        f"{name}.c": render("controller.c", values, prefix),
    }


def _about(mechanism: Mechanism) -> str:
    """Return what the mechanism's description says: of a file's where zero is, how inputs scale."""
    lines = [ascii_words(line) for line in mechanism.description.splitlines()]
    return "".join(f"\n *   {part}" for line in lines for part in textwrap.wrap(line, 94))


def _coordinates(mechanism: Mechanism) -> str:
    width = max(len(c.name) for c in mechanism.coordinates)
    return "\n".join(
        f" *   q[{i}]  {c_name(c.name):{width}}  {c.unit:3}  {ascii_words(c.description)}"
        for i, c in enumerate(mechanism.coordinates)
    )


def _inputs(controller: EmbeddedController) -> str:
    lines = []
    for i, (channel, slew) in enumerate(
        zip(controller.mechanism.inputs, controller.slew_rates, strict=True)
    ):
        line = f" *   u[{i}]  {c_name(channel.name)}, {ascii_words(at_most(channel))}"
        lines.append(line + f", {slew:g} {ascii_words(channel.unit)}/s" * math.isfinite(slew))
    return "\n".join(lines)


def _parameters(controller: EmbeddedController) -> str:
    lines, parameters = [], controller.mechanism.parameters
    for p, name in zip(parameters, macros(parameters).values(), strict=True):
        define = f"#define {name} {literal(p.value, controller.real)}"
        words = ": ".join(filter(None, (ascii_words(p.unit), ascii_words(p.description))))
        lines.append(f"{define} /* {words} */" if words else define)
    return "\n".join(lines)


# -- the generated parts --------------------------------------------------------------------------


def _generated_parts(controller: EmbeddedController) -> dict[str, str]:
    """Return the statements of the law and of det Γ(0), and the estimator."""
    law = _law_code(controller.mechanism, controller.reaching.switching, controller.real)
    return law | _estimator(controller)


@lru_cache(maxsize=16)
def _law_code(mechanism: Mechanism, switching: Switching, real: Real) -> dict[str, str]:
    n, m = mechanism.n, mechanism.m
    symbols = LawSymbols.of(n, m)
    names: dict[sp.Symbol, str] = {x: f"x[{i}]" for i, x in enumerate(mechanism.x)}
    names |= {s: f"row->surface[{i}]" for i, s in enumerate(symbols.surface)}
    names |= {s: f"row->eta[{i}]" for i, s in enumerate(symbols.eta)}
    names |= {s: f"row->layer[{i}]" for i, s in enumerate(symbols.layer)}
    names[symbols.gamma_target] = "row->gamma"
    names |= macros(mechanism.parameters)

    tape = Tape()
    law = build_law_graph(
        mechanism.partition(tape), mechanism.x, symbols, switching, mechanism.disturbance_bounds
    )
    results = {f"out->demand[{i}]": e for i, e in enumerate(law.u)}
    results |= {f"out->s[{i}]": e for i, e in enumerate(law.s)}
    results |= {f"out->gain[{i}]": e for i, e in enumerate(law.gains)}
    results["out->margin"] = law.margin
    evaluate = C99Emitter(tape, names, real).statements(results)

    tape = Tape()
    target = mechanism.partition(tape, dict.fromkeys(mechanism.x, sp.Integer(0)))
    blocks = symbols.blocks
    _, determinant = tape.adjugate(tape.matrix(blocks.alpha_a - blocks.alpha_u * target.X))
    gamma = C99Emitter(tape, names, real).statements({"value": determinant})

    tape = Tape()
    powers = tape.let_all(characteristic_polynomial(mechanism, symbols.surface))
    powers += [sp.Integer(0)] * (2 * n + 2 - len(powers))
    polynomial = C99Emitter(tape, names, real).statements(
        {f"a[{k}]": a for k, a in enumerate(powers)}
    )
    return {"law": evaluate, "gamma": gamma, "polynomial": polynomial}


def _estimator(controller: EmbeddedController) -> dict[str, str]:
    """Return what the templates ask of the estimator."""
    return estimate_code(
        controller.differentiator, controller.mechanism, controller.period, controller.real
    )


def helpers(used: str) -> str:
    """Return the functions that C99 lacks, of those that are used."""
    functions = template("helpers.c").template.rstrip().split("\n\n")
    names = (re.findall(r"ut_\w+\(", function)[0] for function in functions)
    wanted = zip(names, functions, strict=True)
    return "\n".join(f"{function}\n" for name, function in wanted if name in used)
