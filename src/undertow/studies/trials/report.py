"""Tables and figures of the trials."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import degrees
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Group, RenderableType
from rich.text import Text

from undertow.base import finite, number, table, to_csv
from undertow.cascade import problem_words
from undertow.closed_loop import Trajectory
from undertow.closed_loop.figures import figure_files
from undertow.objective import Goal, objective_for
from undertow.plants import Bench, srv02_rig
from undertow.runtime import Recipe, default_gate, estimator_for
from undertow.studies.figures import REPEATS, ROW_LINES, beginning, rows_figure
from undertow.studies.trials.balance import GOALS, ROWS, BalanceResult
from undertow.studies.trials.estimation import EstimatorRow
from undertow.studies.trials.library import LibraryRow
from undertow.studies.trials.robustness import FACTORS, SINGLE, RobustnessResult
from undertow.studies.trials.trial import Result, balanced, motion, spread
from undertow.studies.trials.upright import EngineResult, SwingResult


def _problem(word: Goal, bench: Bench | None = None, horizon: float = 60.0) -> str:
    """Return what was minimised and who admitted surfaces, for a table of several mechanisms."""
    bench = srv02_rig() if bench is None else bench
    belief = bench.mechanism
    objective = replace(objective_for(belief, word, horizon=horizon), unit="")
    gate = default_gate(estimator_for(belief, bench))
    words = problem_words(belief, objective, gate)
    return f"{words}; each within 95 % of the travel that it declares"


def _heads(unit: str) -> tuple[str, ...]:
    """Return the heads of the columns of :func:`_means`."""
    return (f"cost\n{unit}", "∫u² dt\nV² s", "settled\ns", "chatter\nV/s")


def _means(runs: Sequence[Result]) -> list[str]:
    """Return mean ± standard deviation over the balanced runs, a column each."""
    return [str(spread(runs, what)) for what in ("cost", "effort", "settled", "chatter")]


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
            ideal = f"{alone.cost:.2f}" if alone.balanced else "lost"
            rows.append((row, ideal, f"{balanced(runs)} of {len(runs)}", *_means(runs)))
        if not rows:  # interrupted before
            continue
        parts.append(
            table(
                ("", f"ideal\n{objective.unit}", "balanced", *_heads(objective.unit)),
                rows,
                title=f"{title}\nSRV02, φ(0) = {degrees(result.x0[1]):g}° at rest, "
                f"{1e3 * result.bench.timing.period:g} ms, positions only",
                note="mean ± standard deviation over the balanced runs\n"
                f"{problem_words(belief, objective, gate)}",
                ruled=True,
            )
        )
    if result.limits:
        parts.append(
            table(
                ("", "ideal rig", f"at least 19 of 20 of {result.seeds} rigs"),
                [
                    (
                        row,
                        f"{degrees(limit.ideal):.1f}°",
                        f"{degrees(limit.realistic):.1f}°" if limit.realistic else "below 20°",
                    )
                    for row, limit in result.limits.items()
                ],
                title="Largest φ(0) that is caught, minimum-energy surfaces",
                note="to 0.5°",
                ruled=True,
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
        [goal, row, o.seed, int(o.balanced), *map(finite, (o.cost, o.effort, o.settled, o.chatter))]
        for (goal, row), runs in result.outcomes.items()
        for o in runs
    ]
    files = {"balance.csv": to_csv(header, rows)}
    if len(result.outcomes) == len(GOALS) * len(ROWS):  # not interrupted
        drawn = {
            "figure-3-bench": repeats_figure(result),
            "figure-4-bench": comparison_figure(result),
        }
        files |= figure_files(drawn)
    return files


def repeats_figure(result: BalanceResult) -> Figure:
    """Return Figure 3 on the bench: one-time minimum time, three rigs and the ideal one."""
    mechanism = result.bench.mechanism
    motions: list[tuple[Trajectory, dict[str, Any]]] = [
        (
            motion(mechanism, outcome.record, 2),
            {"color": colour, "linewidth": 0.8, "label": f"rig of seed {outcome.seed}"},
        )
        for outcome, colour in zip(result.outcomes["bench-time", "one-time"], REPEATS, strict=False)
    ]
    ideal = motion(mechanism, result.ideal["bench-time", "one-time"].record, 2)
    motions.append((ideal, {"color": "black", "linestyle": (0, (4, 2)), "label": "ideal rig"}))
    return rows_figure(
        motions,
        until=min(3.0, result.seconds),
        title=f"One-time minimum-time surface on the SRV02 bench, φ(0) = "
        f"{degrees(result.x0[1]):g}°\n"
        "1 kHz, encoders only, friction, delay, parameters and hand by seed (simulated)",
        columns=2,
    )


def comparison_figure(result: BalanceResult) -> Figure:
    """Return Figure 4 on the bench: the three controllers for minimum energy on one rig."""
    motions = []
    for row, look in ROW_LINES.items():
        outcome = result.outcomes["bench-energy", row][0]
        ended = "" if outcome.balanced else ", lost"
        run = _until_fallen(motion(result.bench.mechanism, outcome.record, 2))
        motions.append((run, {**look, "linewidth": 1.0, "label": row + ended}))
    return rows_figure(
        motions,
        until=min(6.0, result.seconds),
        title=f"Minimum energy on the SRV02 bench, φ(0) = {degrees(result.x0[1]):g}°, "
        "rig of seed 0",
        columns=3,
    )


def _until_fallen(run: Trajectory) -> Trajectory:
    """Return a motion up to where the pendulum has fallen to the horizontal."""
    fallen = np.flatnonzero(np.abs(run["phi"]) > np.pi / 2)
    return beginning(run, int(fallen[0]) if len(fallen) else len(run.t))


def swing_report(found: Sequence[SwingResult], seconds: float) -> RenderableType:
    """Return swing-ups for the terminal."""
    rows = []
    for result in found:
        times, name = np.array(result.catches or [np.nan]), result.mechanism.name
        caught = f"{np.median(times):.2f}", f"{times.max():.2f}"
        held = f"{balanced(result.outcomes)} of {len(result.outcomes)}"
        rows.append((name, held, *caught, str(result.thrown), str(result.stops)))
    return table(
        ("", "balanced", "caught after\nmedian, s", "longest\ns", "thrown\nout", "end stop\nhit"),
        rows,
        title=f"From hanging at rest to balanced, realistic rigs, {seconds:g} s, positions only",
        note="balanced: home for the last second",
        ruled=True,
    )


def library_report(rows: Sequence[LibraryRow]) -> RenderableType:
    """Return the table of :func:`undertow.studies.trials.library.through_the_runtime`."""
    return table(
        ("", "m", "ε", "held", "admitted", "limits/s", "else"),
        [
            (
                row.name,
                str(row.inputs),
                f"{row.layer:g}",
                f"{row.held} of {row.runs}",
                f"{row.applied:.0f}",
                number(row.chatter, ".1f"),
                ", ".join(f"{why}: {count}" for why, count in row.ends.items()),
            )
            for row in rows
        ],
        title="Every mechanism through the runtime, realistic rigs, positions only",
        note=(
            "m: inputs; ε: boundary layer; held: to the end, without a safe stop; "
            "admitted: surfaces; limits/s: total variation of the input that varies most, by its "
            f"limit\n{_problem('bench-energy', horizon=Recipe.horizon)}"
        ),
        ruled=True,
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
        held, settled = "yes" if result.outcome.balanced else "no", f"{result.outcome.settled:.2f}"
        rows.append((result.mechanism.name, held, settled, words, str(result.admitted)))
    return table(
        ("", "balanced", "settled\ns", "positions at the end", "surfaces\nadmitted"),
        rows,
        title="MuJoCo as the truth: the cascade from the listed starts, no retuning",
        note=_problem("effort", Bench(found[0].mechanism)) if found else "",
        ruled=True,
    )


def robustness_report(result: RobustnessResult) -> RenderableType:
    """Return the tables of :func:`.robustness.robustness` for the terminal."""
    # Costs are compared where all of them balanced, or the weaker one would have easier rigs.
    both = [all(o.balanced for o in runs) for runs in zip(*result.outcomes.values(), strict=True)]
    rows = []
    for name, runs in result.outcomes.items():
        fair = [run for run, keep in zip(runs, both, strict=True) if keep]
        rows.append(
            (name, f"{balanced(runs)}", f"{sum(run.caught for run in runs)}", *_means(fair))
        )
    parts: list[RenderableType] = [
        table(
            ("", f"balanced\nof {len(both)}", "caught", *_heads("V² s")),
            rows,
            title="Random rigs: masses ±20 %, friction up to twice, delay up to 5 ms, a knock",
            note=(
                f"mean ± standard deviation over the rigs that all of them balanced: {sum(both)}\n"
                f"caught: the pendulum is up, wherever the arm is\n{_problem('bench-energy')}"
            ),
            ruled=True,
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
                ("", *(name.replace(" ", "\n", 1) for name in names)),
                lines,
                title=(
                    f"Largest single change from which all of {result.seeds} rigs come home in "
                    f"{SINGLE:g} s"
                ),
                note=(
                    "(n): what the rig of seed n does not survive is larger by 1/32\n"
                    "of the largest change tried; ≥: that was survived"
                ),
                ruled=True,
            )
        )
    return Group(*parts)


def estimator_report(rows: Sequence[EstimatorRow]) -> RenderableType:
    """Return the comparison of estimators for the terminal."""
    return table(
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
                *(number(v, ".4f") for v in row.errors),
                number(row.effort, ".2f"),
                number(row.chatter, ".0f"),
                number(row.microseconds, ".1f"),
            )
            for row in rows
        ],
        title="Estimators on the SRV02 bench, designed surface, positions measured only",
        note=(
            "off by: root mean square while balancing, against the present state, where a filter "
            "that knows the delay is ahead of it; µs: processor time of one estimate"
        ),
        ruled=True,
    )
