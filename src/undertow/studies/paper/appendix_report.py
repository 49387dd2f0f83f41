"""The appendix's five cases as a table: which of the paper's claims hold.

``undertow reproduce`` writes the tables of ``docs/appendix.md`` and redraws Figures 7-11.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from matplotlib.figure import Figure

from undertow.base import Verdict, inward, markdown_table
from undertow.closed_loop.figures import figure_files, style
from undertow.mechanisms import rotary_pendulum
from undertow.proofs.claims.stability import hurwitz
from undertow.studies.paper.appendix import (
    CASES,
    PRINTED,
    AppendixCase,
    Constants,
    Lyapunov,
    false_bound,
    largest_interval,
    paper_rate,
    two_vertex,
)
from undertow.studies.paper.appendix_search import search_interval, search_rate


@dataclass(frozen=True)
class CaseReport:
    """One case with one set of constants, the paper's P against ours.

    With b in kg m². ``epsilon``, ``beta``, ``limit``: ε, β = p₂₂ g with the printed p₂₂, and arccos
    ε in rad, recomputed. With the printed P: ``printed_test``, R ≻ 0 on the printed Ĩ;
    ``printed_width``, half-width up to which R ≻ 0 is proved, rad; ``printed_sigma``, (A27)'s σ
    with λ_max(P̃); ``false_bound``, (A20) at the worst point found. ``ours``, ``our_rate``: the P
    of the best rate on the printed Ĩ, and its σ; ``our_width``: widest half-width that some P
    serves, rad.
    """

    case: AppendixCase
    b: float
    epsilon: float
    beta: float
    limit: float
    printed_test: Verdict
    printed_width: float
    printed_sigma: Verdict
    false_bound: Verdict
    ours: Lyapunov
    our_rate: Verdict
    our_width: float


@cache
def report(case: AppendixCase, constants: Constants) -> CaseReport:
    """Decide all claims of one case for given constants."""
    reduced = case.reduced(constants)
    ours, rate = search_rate(reduced, case.half_width)
    return CaseReport(
        case,
        float(constants.b),
        float(reduced.epsilon),
        float(case.P.p22 * reduced.g),
        reduced.limit,
        two_vertex(reduced, case.P, case.half_width),
        largest_interval(reduced, case.P)[0],
        paper_rate(reduced, case.P, case.half_width),
        _worst_point(case, constants),
        ours,
        rate,
        search_interval(reduced)[0],
    )


def _worst_point(case: AppendixCase, constants: Constants) -> Verdict:
    """(A20) at the point of a coarse grid inside D̃ where it fails by most."""
    reduced, width = case.reduced(constants), float(case.half_width)
    points = [
        (-part * width, velocity, 0.0) for part in (0.25, 0.5, 0.9) for velocity in (2.0, 6.0, 20.0)
    ]
    return min((false_bound(reduced, case.P, y) for y in points), key=lambda v: v.margin)


def _mark(verdict: Verdict) -> str:
    return {"proved": "yes", "refuted": "**no**"}.get(verdict.kind, verdict.kind)


def _rows(reports: Sequence[CaseReport]) -> list[str]:
    heads = (
        "case", "ε: printed / is", "β: printed / is", "Ĩ", "R ≻ 0 on Ĩ", "inf λ_min(R)",
        "holds up to", "σ, λ_max(P̃)", "(A20): V̇ / its bound",
    )  # fmt: skip
    rows = []
    for r in reports:
        gap = r.false_bound.details
        place = tuple(round(v, 3) for v in r.false_bound.witness.values())
        rows.append(
            (
                f"{r.case.number} {r.case.title}",
                f"{r.case.epsilon} / {r.epsilon:.4f}",
                f"{r.case.beta} / {r.beta:.4g}",
                f"±{float(r.case.half_width):g}",
                _mark(r.printed_test),
                inward(r.printed_test.margin, 2),
                inward(r.printed_width),
                inward(r.printed_sigma.margin, 2) if r.printed_sigma else "none",
                f"{_mark(r.false_bound)}: {gap['V̇']:.3g} / {gap['claimed bound']:.3g} at {place}",
            )
        )
    return markdown_table(heads, rows)


def _our_rows(reports: Sequence[CaseReport]) -> list[str]:
    heads = (
        "case", "our P: p₁₁, p₁₂, p₁₃, p₂₂, p₃₃", "R ≻ 0 on Ĩ", "σ proved, 1/s",
        "widest Ĩ / arccos ε",
    )  # fmt: skip
    rows = [
        (
            r.case.number,
            ", ".join(f"{float(v):.4g}" for v in r.ours),
            _mark(r.our_rate),
            inward(r.our_rate.margin, 3),
            f"{inward(r.our_width)} / {r.limit:.4f}",
        )
        for r in reports
    ]
    return markdown_table(heads, rows)


def markdown() -> str:
    """Return the tables of ``docs/appendix.md``."""
    rig = rotary_pendulum()
    parts = []
    for title, constants in (
        ("b = 0.0033, the appendix's", PRINTED),
        ("b = 0.0045016, from the parameters of Sec. 4", Constants.of(rig)),
    ):
        reports = [report(case, constants) for case in CASES]
        parts += [f"### {title}", "", "The printed P:", "", *_rows(reports), ""]
        parts += ["Ours:", "", *_our_rows(reports), ""]
    parts += ["### Local exponential stability, b = 0.0045016", ""]
    verdicts = {case.number: hurwitz(rig, case.surface) for case in CASES}
    parts += markdown_table(
        ("case", "verdict", "proved rate, 1/s"),
        [(number, verdict.kind, inward(verdict.margin)) for number, verdict in verdicts.items()],
    )
    return "\n".join(parts) + "\n"


def figures() -> dict[str, Figure]:
    """Redraw Figures 7-11: λ_min(R(y₁)), b as the appendix has it against b as it is."""
    constants, drawn = Constants.of(rotary_pendulum()), {}
    for case in CASES:
        y1 = np.linspace(-1, 1, 401) * float(case.half_width)
        before, after = case.reduced(PRINTED), case.reduced(constants)
        # P has no scale of its own: ours takes the printed p₁₁.
        ours = Lyapunov(*(v * case.P.p11 for v in report(case, constants).ours))
        with style():
            figure = Figure(figsize=(5, 3.6), layout="constrained")
            axes = figure.subplots()
            axes.plot(y1, before.R_curve(case.P, y1), "--", label="printed P, b = 0.0033")
            axes.plot(y1, after.R_curve(case.P, y1), label="printed P, b = 0.0045016")
            axes.plot(y1, after.R_curve(ours, y1), label="our P, b = 0.0045016")
            axes.axhline(0, color="0.6", linewidth=0.8)
            axes.set_yscale("symlog", linthresh=1e-2)
            axes.set_xlabel("y₁ = φ, rad")
            axes.set_ylabel("λ_min(R(y₁))")
            axes.set_title(f"Figure {case.number + 6}: {case.title}")
            axes.legend(fontsize="small")
        drawn[f"figure-{case.number + 6}-appendix"] = figure
    return drawn


def files() -> dict[str, bytes]:
    """Return the tables and Figures 7-11 as files, by name.

    Raises
    ------
    MissingExtraError
        Where ``undertow[appendix]`` is not installed.
    """
    return {"appendix.md": markdown().encode(), **figure_files(figures(), ("png", "pdf"))}
