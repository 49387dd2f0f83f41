"""Tables and figures of the trials."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from math import degrees
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from undertow.base import artefacts as results
from undertow.cascade import problem_words
from undertow.closed_loop import Trajectory
from undertow.display.plot import COLOURS, figure_bytes, input_series, state_series, style
from undertow.objective import Goal, objective_for
from undertow.plants import Bench, srv02_rig
from undertow.runtime import Recipe
from undertow.runtime.controller_defaults import default_gate, estimator_for
from undertow.studies.trials.balance import GOALS, ROWS, BalanceResult
from undertow.studies.trials.estimation import EstimatorRow
from undertow.studies.trials.library import LibraryRow
from undertow.studies.trials.robustness import FACTORS, SINGLE, RobustnessResult
from undertow.studies.trials.trial import balanced, motion, spread
from undertow.studies.trials.upright import EngineResult, SwingResult

__all__ = [
    "balance_files",
    "balance_report",
    "comparison_figure",
    "engine_report",
    "estimator_report",
    "library_report",
    "repeats_figure",
    "robustness_report",
    "swing_report",
    "table",
]


def table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[str]], note: str = ""
) -> Table:
    """Return a table for the terminal, the first column to the left, the rest to the right.

    Two spaces between columns, so that seven of them fit a terminal of 80.
    """
    out = Table(
        title=title + "\n", title_justify="left", title_style="bold", box=box.SIMPLE_HEAD,
        caption=f"\n{note}\n" if note else "", caption_justify="left", padding=(0, 1, 0, 0),
        pad_edge=False, show_edge=False, min_width=max(map(len, title.splitlines())),
    )  # fmt: skip
    for number, column in enumerate(columns):
        out.add_column(column, justify="left" if number == 0 else "right", no_wrap=number == 0)
    for row in rows:
        out.add_row(*row)
    return out


def _problem(word: Goal, bench: Bench | None = None, horizon: float = 60.0) -> str:
    """Return what was minimised and who admitted surfaces, for a table of several mechanisms."""
    bench = srv02_rig() if bench is None else bench
    belief = bench.mechanism
    objective = replace(objective_for(belief, word, horizon=horizon), unit="")
    gate = default_gate(estimator_for(belief, bench))
    words = problem_words(belief, objective, gate)
    return f"{words}; each within 95 % of the travel that it declares"


def balance_report(result: BalanceResult) -> RenderableType:
    """Return the tables of :func:`undertow.studies.trials.balance.balance` for the terminal."""
    belief = result.bench.mechanism
    gate = default_gate(estimator_for(belief, result.bench))
    titles = {"bench-energy": "Minimum energy", "bench-time": "Minimum time"}
    parts: list[RenderableType] = []
    for goal, title in titles.items():
        objective, rows = objective_for(belief, goal), []
        for row in (row for row in ROWS if (goal, row) in result.outcomes):
            runs, alone = result.outcomes[goal, row], result.ideal[goal, row]
            rows.append(
                (
                    row,
                    f"{alone.cost:.2f}" if alone.balanced else "lost",
                    f"{balanced(runs)} of {len(runs)}",
                    *(str(spread(runs, w)) for w in ("cost", "effort", "settled", "chatter")),
                )
            )
        if not rows:  # interrupted before
            continue
        parts.append(
            table(
                f"{title}\nSRV02, φ(0) = {degrees(result.x0[1]):g}° at rest, "
                f"{1e3 * result.bench.timing.period:g} ms, positions only",
                (
                    "", f"ideal\n{objective.unit}", "balanced", f"cost\n{objective.unit}",
                    "∫u² dt\nV² s",
                    "settled\ns", "chatter\nV/s",
                ),
                rows,
                "mean ± standard deviation over the balanced runs\n"
                f"{problem_words(belief, objective, gate)}",
            )
        )  # fmt: skip
    if result.limits:
        parts.append(
            table(
                "Largest φ(0) that is caught, minimum-energy surfaces",
                ("", "ideal rig", f"at least 19 of 20 of {result.seeds} rigs"),
                [
                    (
                        row,
                        f"{degrees(limit.ideal):.1f}°",
                        f"{degrees(limit.realistic):.1f}°" if limit.realistic else "below 20°",
                    )
                    for row, limit in result.limits.items()
                ],
                "to 0.5°",
            )
        )
    parts.append(Text(f"Sources: {result.bench.source}", style="dim"))
    return Group(*parts)


def balance_files(result: BalanceResult) -> dict[str, bytes]:
    """Return figures and ``balance.csv``, by file name."""
    header = [
        "objective", "controller", "seed", "balanced", "cost", "effort_V2s", "settled_s",
        "chatter_V_per_s",
    ]  # fmt: skip
    rows = [
        [goal, row, o.seed, int(o.balanced), *_finite(o.cost, o.effort, o.settled, o.chatter)]
        for (goal, row), runs in result.outcomes.items()
        for o in runs
    ]
    files = {"balance.csv": results.to_csv(header, rows)}
    if len(result.outcomes) == len(GOALS) * len(ROWS):  # not interrupted
        files["figure-3-bench.png"] = figure_bytes(repeats_figure(result))
        files["figure-4-bench.png"] = figure_bytes(comparison_figure(result))
    return files


def _finite(*values: float) -> list[float | None]:
    return [float(v) if np.isfinite(v) else None for v in values]


def _rows(figure: Figure, motions: Sequence[tuple[Trajectory, dict[str, Any]]]) -> None:
    top, middle, bottom = figure.subplots(3, 1, sharex=True)
    for run, look in motions:
        state_series(top, run, "phi", **look)
        state_series(middle, run, "theta", **look)
        input_series(bottom, run, **look)
    bottom.set_xlabel("time (s)")
    figure.align_ylabels()


def repeats_figure(result: BalanceResult) -> Figure:
    """Return Figure 3 on the bench: one-time minimum time, three rigs and the ideal one."""
    mechanism = result.bench.mechanism
    colours = (COLOURS["orange"], COLOURS["green"], COLOURS["vermilion"])
    motions: list[tuple[Trajectory, dict[str, Any]]] = [
        (
            motion(mechanism, outcome.record, 2),
            {"color": colour, "linewidth": 0.8, "label": f"rig of seed {outcome.seed}"},
        )
        for outcome, colour in zip(result.outcomes["bench-time", "one-time"], colours, strict=False)
    ]
    ideal = motion(mechanism, result.ideal["bench-time", "one-time"].record, 2)
    motions.append((ideal, {"color": "black", "linestyle": (0, (4, 2)), "label": "ideal rig"}))
    with style():
        figure = Figure(figsize=(6.4, 5.2), layout="constrained")
        _rows(figure, motions)
        top = figure.axes[0]
        top.set_xlim(0, min(3.0, result.seconds))
        top.set_title(
            f"One-time minimum-time surface on the SRV02 bench, φ(0) = {degrees(result.x0[1]):g}°\n"
            "1 kHz, encoders only, friction, delay, parameters and hand by seed (simulated)",
            loc="left",
        )
        top.legend(loc="upper right", ncols=2)
    return figure


def comparison_figure(result: BalanceResult) -> Figure:
    """Return Figure 4 on the bench: the three controllers for minimum energy on one rig."""
    looks: dict[str, dict[str, Any]] = {
        "base": {"color": COLOURS["grey"], "linestyle": (0, (4, 1.5)), "linewidth": 1.0},
        "one-time": {"color": COLOURS["orange"], "linewidth": 1.0},
        "cascade": {"color": COLOURS["blue"], "linewidth": 1.0},
    }
    motions = []
    for row, look in looks.items():
        outcome = result.outcomes["bench-energy", row][0]
        ended = "" if outcome.balanced else ", lost"
        run = _until_fallen(motion(result.bench.mechanism, outcome.record, 2))
        motions.append((run, {**look, "label": row + ended}))
    with style():
        figure = Figure(figsize=(6.4, 5.2), layout="constrained")
        _rows(figure, motions)
        top = figure.axes[0]
        top.set_xlim(0, min(6.0, result.seconds))
        top.set_title(
            f"Minimum energy on the SRV02 bench, φ(0) = {degrees(result.x0[1]):g}°, rig of seed 0",
            loc="left",
        )
        top.legend(loc="upper right", ncols=3)
    return figure


def _until_fallen(run: Trajectory) -> Trajectory:
    """Return a motion up to where the pendulum has fallen to the horizontal."""
    fallen = np.flatnonzero(np.abs(run["phi"]) > np.pi / 2)
    end = int(fallen[0]) if len(fallen) else len(run.t)
    columns = ("t", "x", "u", "s", "cost", "margin")
    return replace(run, **{name: getattr(run, name)[:end] for name in columns})


def swing_report(found: Sequence[SwingResult], seconds: float) -> RenderableType:
    """Return swing-ups for the terminal."""
    rows = []
    for result in found:
        times = np.array(result.catches) if result.catches else np.array([np.nan])
        rows.append(
            (
                result.mechanism.name,
                f"{balanced(result.outcomes)} of {len(result.outcomes)}",
                f"{np.median(times):.2f}",
                f"{times.max():.2f}",
                str(result.thrown),
                str(result.stops),
            )
        )
    return table(
        f"From hanging at rest to balanced, realistic rigs, {seconds:g} s, positions only",
        ("", "balanced", "caught after\nmedian, s", "longest\ns", "thrown\nout", "end stop\nhit"),
        rows,
        "balanced: home for the last second",
    )


def library_report(rows: Sequence[LibraryRow]) -> RenderableType:
    """Return the table of :func:`undertow.studies.trials.library.through_the_runtime`."""
    return table(
        "Every mechanism through the runtime, realistic rigs, positions only",
        ("", "m", "ε", "held", "admitted", "limits/s", "else"),
        [
            (
                row.name,
                str(row.inputs),
                f"{row.layer:g}",
                f"{row.held} of {row.runs}",
                f"{row.applied:.0f}",
                f"{row.chatter:.1f}" if np.isfinite(row.chatter) else "—",
                ", ".join(f"{why}: {count}" for why, count in row.ends.items()),
            )
            for row in rows
        ],
        "m: inputs; ε: boundary layer; held: to the end, without a safe stop; "
        "admitted: surfaces; limits/s: total variation of the input that varies most, by its "
        f"limit\n{_problem('bench-energy', horizon=Recipe.horizon)}",
    )


def engine_report(found: Sequence[EngineResult]) -> RenderableType:
    """Return runs in MuJoCo for the terminal."""
    rows = []
    for result in found:
        final = result.outcome.record.truth[-1, : result.mechanism.n]
        words = ", ".join(
            f"{degrees(v):.2f}°" if c.unit == "rad" else f"{1e3 * v:.1f} mm"
            for c, v in zip(result.mechanism.coordinates, final, strict=True)
        )
        rows.append(
            (
                result.mechanism.name,
                "yes" if result.outcome.balanced else "no",
                f"{result.outcome.settled:.2f}",
                words,
                str(result.admitted),
            )
        )
    return table(
        "MuJoCo as the truth: the cascade from the listed starts, no retuning",
        ("", "balanced", "settled\ns", "positions at the end", "surfaces\nadmitted"),
        rows,
        _problem("effort", Bench(found[0].mechanism)) if found else "",
    )


def robustness_report(result: RobustnessResult) -> RenderableType:
    """Return the tables of :func:`.robustness.robustness` for the terminal."""
    # Costs are compared where all of them balanced, or the weaker one would have easier rigs.
    both = [all(o.balanced for o in runs) for runs in zip(*result.outcomes.values(), strict=True)]
    rows = []
    for name, runs in result.outcomes.items():
        fair = [run for run, keep in zip(runs, both, strict=True) if keep]
        rows.append(
            (
                name,
                f"{balanced(runs)}",
                f"{sum(run.caught for run in runs)}",
                *(str(spread(fair, what)) for what in ("cost", "effort", "settled", "chatter")),
            )
        )
    parts: list[RenderableType] = [
        table(
            "Random rigs: masses ±20 %, friction up to twice, delay up to 5 ms, a knock",
            (
                "",
                f"balanced\nof {len(both)}",
                "caught",
                "cost\nV² s",
                "∫u² dt\nV² s",
                "settled\ns",
                "chatter\nV/s",
            ),
            rows,
            f"mean ± standard deviation over the rigs that all of them balanced: {sum(both)}\n"
            f"caught: the pendulum is up, wherever the arm is\n{_problem('bench-energy')}",
        )
    ]
    if result.breaking:
        names = list(result.outcomes)
        lines = []
        for factor, (_, _, unit, scale) in FACTORS.items():
            cells = []
            for name in names:
                found = result.breaking[name, factor]
                broken = "" if found.seed is None else f" ({found.seed})"
                more = "≥ " if found.seed is None else ""
                cells.append(f"{more}{scale * found.survived:.3g}{broken}")
            lines.append((f"{factor}, {unit}", *cells))
        parts.append(
            table(
                f"Largest single change from which all of {result.seeds} rigs come home in "
                f"{SINGLE:g} s",
                ("", *(name.replace(" ", "\n", 1) for name in names)),
                lines,
                "(n): what the rig of seed n does not survive is larger by 1/32\n"
                "of the largest change tried; ≥: that was survived",
            )
        )
    return Group(*parts)


def estimator_report(rows: Sequence[EstimatorRow]) -> RenderableType:
    """Return the comparison of estimators for the terminal."""

    def number(value: float, digits: int) -> str:
        return f"{value:.{digits}f}" if np.isfinite(value) else "—"

    return table(
        "Estimators on the SRV02 bench, designed surface, positions measured only",
        (
            "",
            "balanced",
            "θ̇ off by\nrad/s",
            "φ̇ off by\nrad/s",
            "∫u² dt\nV² s",
            "chatter\nV/s",
            "µs",
        ),
        [
            (
                row.name,
                f"{row.balanced} of {row.seeds}",
                *(number(v, 4) for v in row.errors),
                number(row.effort, 2),
                number(row.chatter, 0),
                number(row.microseconds, 1),
            )
            for row in rows
        ],
        "off by: root mean square while balancing, against the present state, where a filter "
        "that knows the delay is ahead of it; µs: processor time of one estimate",
    )
