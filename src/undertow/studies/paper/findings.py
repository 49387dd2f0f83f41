"""What came out and what did not, in sentences made from the numbers of the run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import degrees

from undertow.studies.paper.data import CONDITIONS, HORIZON_CLAIM, OBJECTIVES, ROWS
from undertow.studies.paper.experiment import Reproduction, Row

#: Deviation from the paper's total, relative, that still counts as reproduced.
TOLERANCE = 0.15


@dataclass(frozen=True)
class Finding:
    """One statement; ``agrees`` says whether it speaks for the paper's figures."""

    agrees: bool
    text: str


def findings(result: Reproduction) -> tuple[Finding, ...]:
    """Return what the run says about the paper's figures, the good and the bad."""
    return tuple(
        finding
        for part in (
            _matched_totals(result),
            _descent(result),
            _base_at_40(result),
            _at_45(result),
            _bounds(result),
            _horizon(result),
            _base_sensitivity(result),
        )
        for finding in part
    )


def _matched_totals(result: Reproduction) -> Iterator[Finding]:
    if "matched" not in result.effort.conditions:
        return
    deviations: dict[str, float] = {}
    for goal in OBJECTIVES:
        for row in ROWS:
            line = result.row("matched", goal, row)
            if line.printed.total is None:
                yield Finding(False, f"Matched, {goal}, {row}: {line.printed.reason}.")
                return
            deviations[f"{row} {goal}"] = line.printed.total / line.paper - 1
    worst = max(deviations, key=lambda name: abs(deviations[name]))
    within = abs(deviations[worst]) <= TOLERANCE
    yield Finding(
        within,
        f"Matched condition, printed surfaces: {'all six' if within else 'not all'} totals "
        f"within {100 * TOLERANCE:.0f} % of the paper's; the furthest is the {worst}, "
        f"{100 * deviations[worst]:+.1f} %.",
    )


def _descent(result: Reproduction) -> Iterator[Finding]:
    runs = [own for own in result.own.values() if own.slack]
    if not runs:
        return
    # What is left of double precision after a horizon's worth of Runge-Kutta steps.
    worst = min(min(own.slack) / own.predicted for own in runs)
    count = sum(len(own.slack) for own in runs)
    kept = worst > -1e-9
    yield Finding(
        kept,
        f"Lemma 3 {'holds' if kept else 'does not hold'} at all {count} re-optimisations of "
        f"our cascades: smallest slack {worst:.0e} of the first prediction.",
    )


def _base_at_40(result: Reproduction) -> Iterator[Finding]:
    base = result.limits[0]
    for d_e, limit in sorted(base.caught.items(), reverse=True):
        if limit < CONDITIONS["as-printed-40"].phi:
            yield Finding(
                False,
                f"With d_e = {d_e:g} the base case catches less than "
                f"{degrees(limit):.1f}°, so the printed 44.7 V² s and 16.2 s from 40° or "
                "more cannot occur.",
            )


def _at_45(result: Reproduction) -> Iterator[Finding]:
    condition = CONDITIONS["as-printed-45"]
    limits = {limit.case: limit.caught[condition.d_e] for limit in result.limits}
    best = max(limits, key=lambda case: limits[case])
    if limits[best] < condition.phi:
        yield Finding(
            False,
            f"No printed surface survives 45° with d_e = {condition.d_e:g}: the best, case "
            f"{best}, catches less than {degrees(limits[best]):.1f}°.",
        )
    reach = result.reach[condition.d_e]
    if reach < condition.phi:
        yield Finding(
            False,
            f"Our own search finds no surface there either; it does up to "
            f"{degrees(reach):.1f}°, and up to "
            f"{degrees(result.reach[CONDITIONS['matched'].d_e]):.1f}° with d_e = "
            f"{CONDITIONS['matched'].d_e:g}.",
        )


def _bounds(result: Reproduction) -> Iterator[Finding]:
    for line in result.rows:
        if line.bound.value is not None and line.row == "one-time":
            yield from _against_bound(result, line, line.bound.value)


def _against_bound(result: Reproduction, line: Row, bound: float) -> Iterator[Finding]:
    unit = OBJECTIVES[line.objective].unit
    totals = [result.row(line.condition, line.objective, row).paper for row in ROWS]
    below = [total for total in totals if total < bound]
    if not below:
        return
    yield Finding(
        False,
        f"{CONDITIONS[line.condition].title.capitalize()}: the optimal-control bound, "
        f"{bound:.1f} {unit}, is above the paper's {' and '.join(f'{v:g}' for v in below)}.",
    )


def _horizon(result: Reproduction) -> Iterator[Finding]:
    if "matched" not in result.effort.conditions:
        return
    cascade = result.row("matched", "energy", "cascade").printed
    if cascade.trajectory is None or cascade.trajectory.time <= HORIZON_CLAIM:
        return
    slow = cascade.surfaces[-1]
    rate = float(slow.lambda_a[0, 0] / slow.alpha_a[0, 0])
    yield Finding(
        False,
        f"The horizon “never exceeds {HORIZON_CLAIM:g} s” does not go with Table 1: its "
        f"cascade needs {cascade.trajectory.time:.0f} s to ‖x‖ ≤ 0.01, because "
        f"λ_a/α_a = {rate:.2g} 1/s.",
    )


def _base_sensitivity(result: Reproduction) -> Iterator[Finding]:
    matched = CONDITIONS["matched"]
    limit = degrees(result.limits[0].caught[matched.d_e])
    change = result.sensitivity
    yield Finding(
        True,
        f"The base case is the least certain: at {degrees(matched.phi):g}° it is "
        f"{limit - degrees(matched.phi):.1f}° short of its catch limit, {limit:.1f}°, and "
        f"0.1° more or 1 % more damping add {0.1 * change.energy_per_degree:.1f} or "
        f"{change.energy_per_percent:.2f} V² s to its energy, "
        f"{0.1 * change.time_per_degree:.2f} or {change.time_per_percent:.2f} s to its time.",
    )
