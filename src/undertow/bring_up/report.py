"""What a bring-up found, for a terminal and for files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from rich import box
from rich.table import Table
from rich.text import Text

from undertow.base import artefacts as results
from undertow.bring_up.coverage import CoverageRow
from undertow.bring_up.identify import Identification
from undertow.bring_up.wizard import BringUp
from undertow.display.plot import figure_bytes, style
from undertow.models import FloatArray, Mechanism

__all__ = ["coverage_table", "files", "findings_table", "parameter_table", "plus_minus", "summary"]

_STYLES = {"right": "green", "wrong": "bold red", "unclear": "yellow"}


def findings_table(found: BringUp) -> Table:
    """Return the checks as a table, but for parameters that are right."""
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0), pad_edge=False)
    for head in ("check", "part", "measured", "expected", "verdict"):
        table.add_column(head, no_wrap=head in ("check", "part", "verdict"))
    for f in found.findings:
        if f.check != "parameter" or f.verdict != "right":
            row = (f.check, f.part, f.measured, f.expected)
            table.add_row(*map(Text, row), Text(f.verdict, style=_STYLES[f.verdict]))
    return table


def parameter_table(found: Identification) -> Table:
    """Return the identified quantities with half the width of their 95 % intervals."""
    table = Table(box=None, header_style="dim", padding=(0, 2, 0, 0), pad_edge=False)
    for head in ("identified", "value, 95 %", "unit", "model", "what it is"):
        right = head in ("value, 95 %", "model")
        table.add_column(head, no_wrap=head != "what it is", justify="right" if right else "left")
    for e in found.estimates.values():
        nominal = f"{e.nominal:.4g}" if math.isfinite(e.nominal) else ""
        row = (e.name, plus_minus(e.value, e.high - e.value), e.unit, nominal, e.description)
        table.add_row(*map(Text, row))
    return table


def coverage_table(rows: Sequence[CoverageRow]) -> Table:
    """Return how often intervals hold the truth, see :func:`undertow.bring_up.coverage`."""
    table = Table(
        title="95 % intervals of the bring-up wizard\nSRV02 rigs that its model contains\n",
        title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0),
        pad_edge=False, show_edge=False,
        caption="\nhold the truth: ± standard error of the share\nmean, deviation: of (estimate − "
        "truth)/(standard error)\nnoise: before counting, at 1.53 mrad per count",
        caption_justify="left",
    )  # fmt: skip
    for head in ("", "noise\nmrad", "intervals", "hold the truth", "mean", "deviation"):
        table.add_column(head, justify="right" if head else "left")
    for row in rows:
        table.add_row(
            row.name or "all", f"{1e3 * row.noise:g}", str(row.count),
            f"{100 * row.covered / row.count:.1f} ± {100 * row.error:.1f} %",
            f"{row.mean:+.2f}", f"{row.deviation:.2f}",
        )  # fmt: skip
    return table


def plus_minus(value: float, half: float) -> str:
    """Return value ± half, to two digits of the latter."""
    if not half > 0 or not math.isfinite(half):
        return f"{value:.4g}"
    power = math.floor(math.log10(max(abs(value), half)))
    shift = power if not -3 <= power < 5 else 0
    digits = max(0, 1 + shift - math.floor(math.log10(half)))
    text = f"{value / 10**shift:.{digits}f} ± {half / 10**shift:.{digits}f}"
    return f"({text})e{shift:+03d}" if shift else text


def summary(found: BringUp) -> tuple[str, ...]:
    """Return what is wrong and what to do, in lines."""
    lines = [""]
    identified = found.identification
    if identified is not None and identified.held:
        lines.append(
            f"Held at the model's values, for the motion does not tell them apart: "
            f"{', '.join(identified.held)}; what is identified is in proportion to them."
        )
    if not found.wrong:
        lines.append("Nothing is wrong.")
    lines += [f"Wrong: {f.check} of {f.part}: {f.measured}. {f.remedy}." for f in found.wrong]
    return tuple(lines)


def files(
    request: Mapping[str, object], belief: Mechanism, rest: FloatArray, found: BringUp
) -> dict[str, bytes]:
    """Return ``findings.json`` and, where there was a motion, ``motion.csv`` and its picture."""
    identified = found.identification
    content: dict[str, object] = {
        "what": "undertow bench",
        "versions": results.versions(),
        "request": dict(request),
        "findings": [vars(f) for f in found.findings],
        "identified": {}
        if identified is None
        else {
            name: {"value": e.value, "low": e.low, "high": e.high, "unit": e.unit}
            for name, e in identified.estimates.items()
        },
    }
    written = {"findings.json": results.to_json(content)}
    record = found.record
    if record is not None and identified is not None:
        names = [c.name for c in belief.coordinates]
        head = ["t", *names, *(f"{n}_predicted" for n in names), *(i.name for i in belief.inputs)]
        rows = np.column_stack([record.t, record.moved, identified.predicted, record.u])
        written["motion.csv"] = results.to_csv(head, rows.tolist())
        written["motion.png"] = _picture(belief, found)
    return written


def _picture(belief: Mechanism, found: BringUp) -> bytes:
    record, identified = found.record, found.identification
    assert record is not None  # the caller has looked
    assert identified is not None
    with style():
        figure = Figure(figsize=(7.0, 1.9 * (belief.n + 1)), layout="constrained")
        axes = figure.subplots(belief.n + 1, 1, sharex=True)
        t = record.t - record.t[0]
        for i, (axis, c) in enumerate(zip(axes, belief.coordinates, strict=False)):
            factor, unit = (180 / np.pi, "°") if c.unit == "rad" else (1.0, "m")
            axis.plot(t, factor * record.moved[:, i], lw=2.4, alpha=0.45, label="measured")
            axis.plot(t, factor * identified.predicted[:, i], lw=1.0, label="identified model")
            axis.set_ylabel(f"{c.name} ({unit})")
        for j, channel in enumerate(belief.inputs):
            axes[-1].step(t, record.u[:, j], where="post", lw=1.0, label=channel.name)
        axes[0].legend(loc="upper right", ncols=2)
        axes[-1].set_ylabel(f"input ({belief.inputs[0].unit})")
        axes[-1].set_xlabel("time (s)")
        if belief.m > 1:
            axes[-1].legend(loc="upper right", ncols=belief.m)
        figure.align_ylabels(axes)
        return figure_bytes(figure)
