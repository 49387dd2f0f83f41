"""The experiments of ``undertow trials``, and reports of what is finished of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import RenderableType

from undertow.base import Progress, as_text
from undertow.cascade.swing_up import SwingUp
from undertow.cascade.swing_up.search import KEPT, kept_text
from undertow.studies.rigs.bring_up import coverage, coverage_table
from undertow.studies.trials import balance, estimation, library, report, robustness, upright


@dataclass
class Campaign:
    """One experiment, and what is finished of it: all, or what an interruption leaves.

    Parameters
    ----------
    seeds
        Rigs, one for each seed.
    angle
        ``balance``: φ(0), rad.
    limits
        ``balance``: also search for the catch limits.
    rigs, single
        ``robustness``: random rigs, and whether to look for the largest single changes.
    fresh
        ``swing-up``: seed of a new search for gains; ``None`` takes those of the library.
    folder
        ``robustness`` and ``coverage``: where every run is kept as it is made.
    """

    seeds: int = 20
    angle: float = 0.0
    limits: bool = True
    rigs: int = 200
    single: bool = True
    fresh: int | None = None
    folder: Path | None = None
    _what: str = field(default="", init=False)
    _rows: list[Any] = field(default_factory=list, init=False)
    _whole: RenderableType | None = field(default=None, init=False)
    _files: dict[str, bytes] = field(default_factory=dict, init=False)

    def run(self, what: str, progress: Progress) -> None:
        """Run an experiment by its name: a method below, with ``-`` for ``_``."""
        self._what = what
        getattr(self, what.replace("-", "_"))(progress)

    def finished(self) -> tuple[RenderableType | None, dict[str, bytes]]:
        """Return what is finished as a report and as files; experiments by rows may be cut."""
        by_rows: dict[str, Callable[[list[Any]], RenderableType]] = {
            "balance": lambda made: report.balance_report(made[0]),
            "swing-up": lambda made: report.swing_report(made, upright.SWING_SECONDS),
            "estimators": report.estimator_report,
            "library": report.library_report,
            "mujoco": report.engine_report,
        }
        shown, files = self._whole, dict(self._files)
        if self._what in by_rows and self._rows:
            shown = by_rows[self._what](self._rows)
            files[f"{self._what}.txt"] = as_text(shown)
        if self._what == "balance" and self._rows:
            files |= report.balance_files(self._rows[0])
        return shown, files

    def balance(self, progress: Progress) -> None:
        """Run the paper's experiment on the SRV02 bench."""
        balance.balance(
            angle=self.angle,
            seeds=self.seeds,
            limits=self.limits,
            progress=progress,
            begun=self._rows.append,
        )

    def swing_up(self, progress: Progress) -> None:
        """Swing up from hanging at rest, and balance."""
        searched = upright.searched(upright.SWINGING, self.fresh, progress)
        self._files[KEPT.name] = kept_text(searched).encode()
        for i, (mechanism, found) in enumerate(searched.items()):
            progress(mechanism.name, i / len(searched))
            swing = SwingUp(mechanism, tuple(one.gains for one in found))
            self._rows.append(upright.swing_trials(mechanism, swing=swing, seeds=self.seeds))

    def mujoco(self, progress: Progress) -> None:
        """Balance in MuJoCo, without retuning."""
        for i, mechanism in enumerate(upright.all_of(upright.ENGINES)):
            progress(mechanism.name, i / len(upright.ENGINES))
            self._rows.append(upright.engine_trial(mechanism))

    def estimators(self, progress: Progress) -> None:
        """Run the same law with each estimator."""
        progress("estimators", 0.0)
        estimation.compared(seeds=min(self.seeds, 5), done=self._rows.append)

    def library(self, progress: Progress) -> None:
        """Run every mechanism through the runtime."""
        library.through_the_runtime(
            seeds=min(self.seeds, 5), progress=progress, done=self._rows.append
        )

    def robustness(self, progress: Progress) -> None:
        """Run all controllers on random rigs, and look for what makes each fail."""
        found = robustness.robustness(
            rigs=self.rigs,
            seeds=3 if self.single else 0,
            ledger=self._kept("robustness.jsonl"),
            progress=progress,
        )
        self._whole = report.robustness_report(found)

    def coverage(self, progress: Progress) -> None:
        """Count how often the intervals of the bring-up hold the truth."""
        rows = coverage(self.seeds, keep=self._kept("coverage.jsonl"), progress=progress)
        self._whole = coverage_table(rows)

    def _kept(self, name: str) -> Path | None:
        return None if self.folder is None else self.folder / name
