"""The experiments of ``undertow trials``, by name."""

from __future__ import annotations

from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from rich.console import RenderableType

from undertow.base import as_text
from undertow.cascade.swing_up.search import KEPT, kept_text
from undertow.mechanisms import LIBRARY
from undertow.plants import srv02_rig
from undertow.studies.experiment import Experiment, grouped
from undertow.studies.rigs.bring_up import coverage
from undertow.studies.trials import estimation, library, report, robustness, upright
from undertow.studies.trials.balance import Balance
from undertow.studies.trials.trial import Result

#: Experiments with a row for each name: type of a line, what gives a row, names, the table.
ROWS: dict[str, tuple[Any, Callable[..., Any], Collection[str], Callable[[Any], RenderableType]]]
ROWS = {
    "swing-up": (
        tuple[str, upright.SwingResult], upright.searched, upright.SWINGING, report.swing_report,
    ),
    "mujoco": (
        tuple[str, upright.EngineResult], upright.engine_trial, upright.ENGINES,
        report.engine_report,
    ),
    "estimators": (
        tuple[str, estimation.EstimatorRow], estimation.compared, estimation.ESTIMATORS,
        report.estimator_report,
    ),
    "library": (
        tuple[str, library.LibraryRow], library.through_the_runtime, LIBRARY, report.library_report,
    ),
}  # fmt: skip


def experiment(
    what: str,
    *,
    seeds: int | None = None,
    angle: float = 0.0,
    limits: bool = True,
    rigs: int = 200,
    single: bool = True,
    fresh: int | None = None,
) -> Experiment[Any, Any]:
    """Return one of the experiments.

    Parameters
    ----------
    what
        Its name.
    seeds
        Rigs, one for each seed: ``None`` for five with ``estimators`` and ``library``, else 20.
    angle
        ``balance``: φ(0), rad.
    limits
        ``balance``: also search for the catch limits.
    rigs, single
        ``robustness``: random rigs, and whether to look for the largest single changes.
    fresh
        ``swing-up``: seed of a new search for gains; ``None`` takes those of the library.
    """
    if seeds is None:
        seeds = 5 if what in ("estimators", "library") else 20
    if what == "coverage":
        return coverage(seeds)
    if what == "balance":
        asked = Balance(angle=angle, seeds=seeds, limits=limits)
        return Experiment(
            what, tuple[str, str, int, Result | float], asked.tasks(), {"asked": asked},
            lambda found: [report.balance_report(asked, found)],
            partial(report.balance_files, asked), gather=grouped,
        )  # fmt: skip
    if what == "robustness":
        constants = robustness.ANGLE, robustness.BUDGET, robustness.SECONDS, robustness.SINGLE
        return Experiment(
            what, tuple[str, str, int, Result | robustness.Breaking],
            robustness.robustness(rigs, single),
            {"constants": constants, "model": srv02_rig().mechanism.fingerprint},
            lambda found: [report.robustness_report(found)], gather=grouped, whole=True,
        )  # fmt: skip
    line, task, names, shown = ROWS[what]
    given: dict[str, Any] = {"seeds": seeds}
    if what == "mujoco":
        given = {}
    if what == "swing-up":
        given = {"seeds": seeds, "fresh": fresh}
    return Experiment(
        what, line, {(name,): partial(task, name, **given) for name in names}, given,
        lambda rows: [shown(rows)],
        lambda rows: _gains(rows) | {f"{what}.txt": as_text(shown(rows))},
    )  # fmt: skip


def _gains(rows: tuple[Any, ...]) -> dict[str, bytes]:
    """Return the gains of swing-ups as the library keeps them."""
    found = {LIBRARY[row.name](): row.gains for row in rows if isinstance(row, upright.SwingResult)}
    return {KEPT.name: kept_text(found).encode()} if found else {}
