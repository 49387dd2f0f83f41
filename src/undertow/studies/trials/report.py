"""Tables and figures of the trials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import degrees
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.console import Group, RenderableType
from rich.text import Text

from undertow.base import as_text, finite, number, table, to_csv
from undertow.cascade import problem_words
from undertow.closed_loop import Event, Trajectory
from undertow.closed_loop.figures import figure_files
from undertow.mechanisms import LIBRARY
from undertow.objective import Goal, objective_for
from undertow.plants import Bench, srv02_rig
from undertow.runtime import Recipe, default_gate, estimator_for
from undertow.studies.figures import REPEATS, ROW_LINES, beginning, rows_figure
from undertow.studies.paper.data import ROWS
from undertow.studies.trials.balance import GOALS, IDEAL, LIMIT, Balance
from undertow.studies.trials.estimation import EstimatorRow
from undertow.studies.trials.library import LibraryRow
from undertow.studies.trials.robustness import FACTORS, RANDOM, SEEDS, SINGLE
from undertow.studies.trials.trial import Outcome, Result, balanced, spread
from undertow.studies.trials.upright import SWING_SECONDS, EngineResult, SwingResult


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


def balance_report(asked: Balance, found: Mapping[Any, list[Any]]) -> RenderableType:
    """Return the tables of :class:`.balance.Balance` for the terminal, of what is finished.

    ``found`` are results by objective and controller: on the ideal rig, then on the others.
    """
    bench = srv02_rig()
    belief = bench.mechanism
    gate = default_gate(estimator_for(belief, bench))
    titles = {"bench-energy": "Minimum energy", "bench-time": "Minimum time"}
    parts: list[RenderableType] = []
    for goal, title in titles.items():
        objective, rows = objective_for(belief, goal), []
        for row in ROWS:
            alone, *runs = found.get((goal, row), [None])
            if runs:
                ideal = f"{alone.cost:.2f}" if alone.balanced else "lost"
                rows.append((row, ideal, f"{balanced(runs)} of {len(runs)}", *_means(runs)))
        if not rows:  # interrupted before
            continue
        parts.append(
            table(
                ("", f"ideal\n{objective.unit}", "balanced", *_heads(objective.unit)),
                rows,
                title=f"{title}\nSRV02, φ(0) = {degrees(asked.angle):g}° at rest, "
                f"{1e3 * bench.timing.period:g} ms, positions only",
                note="mean ± standard deviation over the balanced runs\n"
                f"{problem_words(belief, objective, gate)}",
                ruled=True,
            )
        )
    ends = [(row, *found[LIMIT, row]) for row in ROWS if len(found.get((LIMIT, row), ())) == 2]
    if ends:
        parts.append(
            table(
                ("", "ideal rig", f"at least 19 of 20 of {asked.seeds} rigs"),
                [
                    (row, _degrees(ideal), _degrees(real) if real else "below 20°")
                    for row, ideal, real in ends
                ],
                title="Largest φ(0) that is caught, minimum-energy surfaces",
                note="to 0.5°",
                ruled=True,
            )
        )
    parts.append(Text(f"Sources: {bench.source}", style="dim"))
    return Group(*parts)


def _degrees(angle: float) -> str:
    return f"{degrees(angle):.1f}°"


def balance_files(asked: Balance, found: Mapping[Any, list[Any]]) -> dict[str, bytes]:
    """Return the tables, ``balance.csv`` and the figures, by file name."""
    header = [
        "objective", "controller", "seed", "balanced", "cost", "effort_V2s", "settled_s",
        "chatter_V_per_s",
    ]  # fmt: skip
    runs = {key: some[1:] for key, some in found.items() if key[0] in GOALS}
    rows = [
        [*key, o.seed, int(o.balanced), *map(finite, (o.cost, o.effort, o.settled, o.chatter))]
        for key, some in runs.items()
        for o in some
    ]
    files = {
        "balance.txt": as_text(balance_report(asked, found)),
        "balance.csv": to_csv(header, rows),
    }
    if sum(map(len, runs.values())) == len(GOALS) * len(ROWS) * asked.seeds:  # not interrupted
        files |= figure_files(
            {"figure-3-bench": repeats_figure(asked), "figure-4-bench": comparison_figure(asked)}
        )
    return files


def repeats_figure(asked: Balance) -> Figure:
    """Return Figure 3 on the bench: one-time minimum time, three rigs and the ideal one."""
    looks: dict[int, dict[str, Any]] = {
        seed: {"color": colour, "linewidth": 0.8, "label": f"rig of seed {seed}"}
        for seed, colour in zip(range(asked.seeds), REPEATS, strict=False)
    }
    looks[IDEAL] = {"color": "black", "linestyle": (0, (4, 2)), "label": "ideal rig"}
    return rows_figure(
        [(_motion(asked.run("bench-time", "one-time", k)), look) for k, look in looks.items()],
        until=min(3.0, asked.seconds),
        title=f"One-time minimum-time surface on the SRV02 bench, φ(0) = "
        f"{degrees(asked.angle):g}°\n"
        "1 kHz, encoders only, friction, delay, parameters and hand by seed (simulated)",
        columns=2,
    )


def comparison_figure(asked: Balance) -> Figure:
    """Return Figure 4 on the bench: the three controllers for minimum energy on one rig."""
    motions = []
    for row, look in ROW_LINES.items():
        outcome = asked.run("bench-energy", row, 0)
        ended = "" if outcome.balanced else ", lost"
        motions.append(
            (_until_fallen(_motion(outcome)), {**look, "linewidth": 1.0, "label": row + ended})
        )
    return rows_figure(
        motions,
        until=min(6.0, asked.seconds),
        title=f"Minimum energy on the SRV02 bench, φ(0) = {degrees(asked.angle):g}°, rig of seed 0",
        columns=3,
    )


def _motion(outcome: Outcome) -> Trajectory:
    """Return the true motion of a run for plotting, every second sample."""
    record = outcome.record
    t, x, u = record.t[::2], record.truth[::2], record.u[::2]
    s, nothing, margin = np.zeros_like(u), np.zeros_like(t), np.ones_like(t)
    return Trajectory(srv02_rig().mechanism, t, x, u, s, nothing, margin, Event.HORIZON)


def _until_fallen(run: Trajectory) -> Trajectory:
    """Return a motion up to where the pendulum has fallen to the horizontal."""
    fallen = np.flatnonzero(np.abs(run["phi"]) > np.pi / 2)
    return beginning(run, int(fallen[0]) if len(fallen) else len(run.t))


def swing_report(found: Sequence[SwingResult]) -> RenderableType:
    """Return swing-ups for the terminal."""
    rows = []
    for result in found:
        times = np.array(result.catches or [np.nan])
        caught = f"{np.median(times):.2f}", f"{times.max():.2f}"
        held = f"{balanced(result.outcomes)} of {len(result.outcomes)}"
        rows.append((result.name, held, *caught, str(result.thrown), str(result.stops)))
    return table(
        ("", "balanced", "caught after\nmedian, s", "longest\ns", "thrown\nout", "end stop\nhit"),
        rows,
        title="From hanging at rest to balanced, realistic rigs, "
        f"{SWING_SECONDS:g} s, positions only",
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
        words = ", ".join(
            f"{degrees(v):.2f}°" if c.unit == "rad" else f"{1e3 * v:.1f} mm"
            for c, v in zip(LIBRARY[result.name]().coordinates, result.final, strict=True)
        )
        held, settled = "yes" if result.outcome.balanced else "no", f"{result.outcome.settled:.2f}"
        rows.append((result.name, held, settled, words, str(result.admitted)))
    return table(
        ("", "balanced", "settled\ns", "positions at the end", "surfaces\nadmitted"),
        rows,
        title="MuJoCo as the truth: the cascade from the listed starts, no retuning",
        note=_problem("effort", Bench(LIBRARY[found[0].name]())),
        ruled=True,
    )


def robustness_report(found: Mapping[Any, list[Any]]) -> RenderableType:
    """Return the tables of :func:`.robustness.robustness` for the terminal.

    ``found`` are results by controller and what was changed.
    """
    names = [name for name, what in found if what == RANDOM]
    # Costs are compared where all of them balanced, or the weaker one would have easier rigs.
    every = [found[name, RANDOM] for name in names]
    both = [all(o.balanced for o in runs) for runs in zip(*every, strict=True)]
    rows = []
    for name, runs in zip(names, every, strict=True):
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
    lines = []
    for factor, (_, _, unit, scale) in FACTORS.items():
        cells = []
        for one in (found[name, factor][0] for name in names if (name, factor) in found):
            broken = "" if one.seed is None else f" ({one.seed})"
            more = "≥ " if one.seed is None else ""
            cells.append(f"{more}{scale * one.survived:.3g}{broken}")
        lines.append((f"{factor}, {unit}", *cells))
    if len(found) > len(names):
        parts.append(
            table(
                ("", *(name.replace(" ", "\n", 1) for name in names)),
                lines,
                title=f"Largest single change from which all of {SEEDS} rigs "
                f"come home in {SINGLE:g} s",
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
