"""The experiments of ``undertow trials``, by name."""

from __future__ import annotations

import math
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


def balance(
    *, seeds: int = 20, angle: float = math.radians(35), limits: bool = True
) -> Experiment[Any, Any]:
    """Return the paper's experiment on the SRV02, see :class:`.balance.Balance`."""
    asked = Balance(angle=angle, seeds=seeds, limits=limits)
    return Experiment(
        "balance", tuple[str, str, int, Result | float], asked.tasks(), {"asked": asked},
        lambda found: [report.balance_report(asked, found)],
        partial(report.balance_files, asked), gather=grouped,
    )  # fmt: skip


def random_rigs(*, rigs: int = 200, single: bool = True) -> Experiment[Any, Any]:
    """Return the controllers on rigs that they do not know, see :func:`.robustness.robustness`."""
    constants = robustness.ANGLE, robustness.BUDGET, robustness.SECONDS, robustness.SINGLE
    return Experiment(
        "robustness", tuple[str, str, int, Result | robustness.Breaking],
        robustness.robustness(rigs, single),
        {"constants": constants, "model": srv02_rig().mechanism.fingerprint},
        lambda found: [report.robustness_report(found)], gather=grouped, whole=True,
    )  # fmt: skip


def swing_ups(*, seeds: int = 20, fresh: int | None = None) -> Experiment[Any, Any]:
    """Return swing-ups with the library's gains, or with those of a new search, by its seed."""
    return _table_of(
        "swing-up", tuple[str, upright.SwingResult], upright.searched, upright.SWINGING,
        report.swing_report, seeds=seeds, fresh=fresh,
    )  # fmt: skip


def engines() -> Experiment[Any, Any]:
    """Return the cascade in MuJoCo."""
    return _table_of(
        "mujoco", tuple[str, upright.EngineResult], upright.engine_trial, upright.ENGINES,
        report.engine_report,
    )  # fmt: skip


def estimators(*, seeds: int = 5) -> Experiment[Any, Any]:
    """Return the same law with each estimator."""
    return _table_of(
        "estimators", tuple[str, estimation.EstimatorRow], estimation.compared,
        estimation.ESTIMATORS, report.estimator_report, seeds=seeds,
    )  # fmt: skip


def mechanisms(*, seeds: int = 5) -> Experiment[Any, Any]:
    """Return every mechanism through the runtime."""
    return _table_of(
        "library", tuple[str, library.LibraryRow], library.through_the_runtime, LIBRARY,
        report.library_report, seeds=seeds,
    )  # fmt: skip


#: By name, each made with the options that it takes.
EXPERIMENTS: dict[str, Callable[..., Experiment[Any, Any]]] = {
    "balance": balance, "swing-up": swing_ups, "mujoco": engines, "robustness": random_rigs,
    "estimators": estimators, "library": mechanisms, "coverage": coverage,
}  # fmt: skip


def _table_of(
    what: str,
    line: Any,
    task: Callable[..., Any],
    names: Collection[str],
    shown: Callable[[Any], RenderableType],
    **given: Any,
) -> Experiment[Any, Any]:
    """Return an experiment with a row for each name: ``line`` is the type of a ledger's line."""
    return Experiment(
        what, line, {(name,): partial(task, name, **given) for name in names}, given,
        lambda rows: [shown(rows)],
        lambda rows: _gains(rows) | {f"{what}.txt": as_text(shown(rows))},
    )  # fmt: skip


def _gains(rows: tuple[Any, ...]) -> dict[str, bytes]:
    """Return the gains of swing-ups as the library keeps them."""
    found = {LIBRARY[row.name](): row.gains for row in rows if isinstance(row, upright.SwingResult)}
    return {KEPT.name: kept_text(found).encode()} if found else {}
