"""What rollouts return: how each ended, results of a batch, one recorded motion."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from undertow.base import at_least, checked, one_of, require_extra
from undertow.models import FloatArray, Mechanism
from undertow.objective.objective import Objective, margins_at
from undertow.symbolic import compiled

if TYPE_CHECKING:
    from undertow.closed_loop.figures import MotionFigure

#: Scores from here on mark inadmissible motions, see :meth:`Batch.score`: those that break off or
#: do not arrive, and the highest, an unstable surface's.  No cost comes near, whatever its unit:
#: that of a crane's kilonewtons, ∫u² dt, is 1e9 N² s.
INADMISSIBLE, PENALTY, UNSTABLE = 1e100, 1e101, 1e102

#: What a motion broke that broke none of its path constraints.
INPUT_LIMIT = "the hard input limit"

#: Rows at either end of a trajectory that a notebook shows.
SHOWN = 3


class Event(IntEnum):
    """Why a rollout ended."""

    HORIZON = 0
    REACHED = 1
    CONSTRAINT = 2
    SINGULAR = 3
    DIVERGED = 4
    COSTLY = 5
    UNSTABLE = 6


@dataclass(frozen=True, eq=False)
class Batch:
    """Results of N rollouts; arrays of length N.

    ``cost`` is ∫Φ dt until the end; ``time`` the end, s; ``event`` an :class:`Event`;
    ``radius`` the final ‖x‖₂; ``singular`` the smallest det Γ(q)/det Γ(0) met;
    ``input`` the smallest u_max − |demand| (only with a hard input limit);
    ``path`` (N, w) the smallest margins of the path constraints at the instants of its steps; ``x``
    (N, 2n) final states.
    ``closest``, ``closest_time`` and ``closest_x`` (N, 2n): the smallest ‖x‖₂ met, when and
    where, if it was asked for.  ``steps``: how many it took, small ones (four evaluations of
    law and plant) and large ones (two) alike.
    """

    cost: FloatArray
    time: FloatArray
    event: NDArray[np.int64]
    radius: FloatArray
    singular: FloatArray
    input: FloatArray
    path: FloatArray
    closest: FloatArray
    closest_time: FloatArray
    closest_x: FloatArray
    x: FloatArray
    steps: FloatArray

    def __repr__(self) -> str:
        """Show how many there are, and how they ended."""
        codes, counts = np.unique(self.event, return_counts=True)
        ends = [
            f"{count} {Event(int(code)).name.lower()}"
            for code, count in zip(codes, counts, strict=True)
        ]
        return f"Batch({len(self.cost)} rollouts: {', '.join(ends)})"

    @property
    def reached(self) -> NDArray[np.bool_]:
        """Whether the terminal set was reached without breaking any constraint."""
        return np.asarray(self.event == Event.REACHED)

    def score(self, horizon: float) -> FloatArray:
        """Return the cost where admissible, else a graded penalty from ``PENALTY`` on.

        The penalty falls with survival time and then with the final distance, so that a
        search can climb out of a region without admissible surfaces.
        """
        scores = np.empty(len(self.cost))
        _score(self.cost, self.time, self.event, self.radius, horizon, scores)
        return scores


@compiled()
def _score(cost, time, event, radius, horizon, scores):  # type: ignore[no-untyped-def]
    for i in range(len(scores)):
        if event[i] == Event.REACHED:
            scores[i] = cost[i]
        elif event[i] == Event.HORIZON:
            near = math.tanh(radius[i]) if math.isfinite(radius[i]) else 1.0
            scores[i] = PENALTY * (1.0 + near)
        elif event[i] == Event.UNSTABLE:
            scores[i] = UNSTABLE
        else:
            scores[i] = PENALTY * (3.0 - time[i] / horizon)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """One recorded motion: named columns over time.

    Attributes
    ----------
    t
        Times, (N,), s.
    x
        States (q, q̇), (N, 2n), SI units; ``trajectory["phi"]`` is one of them by name.
    u
        Inputs after the actuator, (N, m).
    s
        Surface values, (N, m).
    accumulated_cost
        Cost so far, (N,).
    margin
        det Γ(q)/det Γ(0), (N,): positive where the law exists.
    event
        Why it ended.
    cost_unit
        Unit of the cost, as text.
    broken
        The constraints that ended it, by name, where some did.
    """

    mechanism: Mechanism
    t: FloatArray
    x: FloatArray
    u: FloatArray
    s: FloatArray
    accumulated_cost: FloatArray
    margin: FloatArray
    event: Event
    cost_unit: str = ""
    broken: str = ""

    def __repr__(self) -> str:
        """Show whose it is, how long it is and how it ended."""
        return (
            f"Trajectory({self.mechanism.name}, {len(self.t)} rows, {self.t[0]:g} to "
            f"{self.time:.4g} s, {self.ending}, "
            f"cost {self.cost:.6g}{f' {self.cost_unit}' if self.cost_unit else ''})"
        )

    def _repr_html_(self) -> str:
        """Show the first and the last rows in a notebook, with units."""
        rows = range(len(self.t))
        shown = [*rows] if len(rows) <= 2 * SHOWN else [*rows[:SHOWN], -1, *rows[-SHOWN:]]
        columns = {"t": (self.t, "s"), **self.columns}
        heads = "".join(
            f"<th>{escape(name)}{f'<br>{escape(unit)}' if unit else ''}</th>"
            for name, (_, unit) in columns.items()
        )

        def line(row: int) -> str:
            cells = ("…" if row < 0 else f"{values[row]:.4g}" for values, _ in columns.values())
            return f"<tr>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"

        body = "".join(line(row) for row in shown)
        return f"<p>{escape(repr(self))}</p><table><tr>{heads}</tr>{body}</table>"

    @property
    def ending(self) -> str:
        """Why it ended, in words: the event, and what was broken."""
        return f"{self.event.name.lower()} {self.broken}".strip()

    @property
    def cost(self) -> float:
        """Cost of the whole motion, in ``cost_unit``."""
        return float(self.accumulated_cost[-1])

    @property
    def time(self) -> float:
        """Time at the end, s."""
        return float(self.t[-1])

    def __getitem__(self, name: str) -> FloatArray:
        """Return the time series of a named state or input."""
        names = [*self.mechanism.state_names, *(i.name for i in self.mechanism.inputs)]
        one_of("state or input of a trajectory", name, names)
        return np.hstack([self.x, self.u])[:, names.index(name)]

    @property
    def columns(self) -> dict[str, tuple[FloatArray, str]]:
        """Everything over time but ``t``: name to values, (N,), and unit.

        States and inputs have the mechanism's names; then come ``s_0`` …, ``cost`` (so far) and
        ``margin``.
        """
        mechanism = self.mechanism
        named = [
            *zip(mechanism.state_names, self.x.T, mechanism.state_units, strict=True),
            *((i.name, self.u[:, k], i.unit) for k, i in enumerate(mechanism.inputs)),
            *((f"s_{k}", self.s[:, k], "") for k in range(mechanism.m)),
            ("cost", self.accumulated_cost, self.cost_unit),
            ("margin", self.margin, ""),
        ]
        columns: dict[str, tuple[FloatArray, str]] = {}
        for name, values, unit in named:
            free = name
            while free in columns or free == "t":  # a mechanism may have a state called cost
                free += "_"
            columns[free] = values, unit
        return columns

    @checked
    def plot(self, title: str = "") -> MotionFigure:
        """Return a figure of the motion: a row for each coordinate and each input, over time.

        A Matplotlib figure: save it with ``.savefig("motion.png")``; a notebook shows it.
        """
        from undertow.closed_loop.figures import motion_figure

        return motion_figure({"motion": self}, title=title)

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame`` with the index t, s; ``.attrs["units"]`` has the units.

        Raises
        ------
        MissingExtraError
            Without pandas.
        """
        pandas = require_extra("pandas", "interop", "data frames need pandas")
        columns = self.columns
        table = pandas.DataFrame(
            {name: values for name, (values, _) in columns.items()},
            index=pandas.Index(self.t, name="t"),
        )
        table.attrs = {**self._facts, "units": {k: unit for k, (_, unit) in columns.items()}}
        return table

    def to_xarray(self) -> Any:
        """Return an ``xarray.Dataset`` over t; each variable has its unit in ``.attrs["units"]``.

        Raises
        ------
        MissingExtraError
            Without xarray.
        """
        xarray = require_extra("xarray", "interop", "labelled arrays need xarray")
        return xarray.Dataset(
            {k: ("t", values, {"units": unit}) for k, (values, unit) in self.columns.items()},
            coords={"t": ("t", self.t, {"units": "s"})},
            attrs=self._facts,
        )

    @property
    def _facts(self) -> dict[str, str]:
        return {"mechanism": self.mechanism.name, "event": self.event.name.lower()}

    @classmethod
    @checked
    def join(cls, pieces: Sequence[Trajectory]) -> Trajectory:
        """Join consecutive pieces; costs add up, doubled end points are dropped."""
        at_least("number of pieces", len(pieces), 1, "Give at least one")
        first, spent = pieces[0], 0.0
        columns: dict[str, list[FloatArray]] = {k: [] for k in ("t", "x", "u", "s", "margin")}
        costs = []
        for index, piece in enumerate(pieces):
            end = len(piece.t) if index == len(pieces) - 1 else -1
            for key, parts in columns.items():
                parts.append(getattr(piece, key)[:end])
            costs.append(piece.accumulated_cost[:end] + spent)
            spent += piece.cost
        joined = {key: np.concatenate(parts) for key, parts in columns.items()}
        return cls(
            first.mechanism,
            **joined,
            accumulated_cost=np.concatenate(costs),
            event=pieces[-1].event,
            cost_unit=first.cost_unit,
            broken=pieces[-1].broken,
        )


def broken_words(names: Iterable[str], margins: Iterable[float]) -> str:
    """Return what a motion broke that a constraint ended: those whose margin is not ≥ 0."""
    named = zip(names, margins, strict=True)
    return " and ".join(name for name, margin in named if not margin >= 0) or INPUT_LIMIT


def recorded(
    mechanism: Mechanism, t: FloatArray, rows: FloatArray, event: int, objective: Objective
) -> Trajectory:
    """Return the motion of a kernel's record: x, u, s, cost, margin, (N, 2n + 2m + 2)."""
    n, m = mechanism.n, mechanism.m
    parts = np.split(rows, [2 * n, 2 * n + m, 2 * n + 2 * m, 2 * n + 2 * m + 1], axis=1)
    x, u, s, cost, margin = parts
    broken = ""
    if event == Event.CONSTRAINT:
        names = [constraint.words for constraint in objective.constraints]
        broken = broken_words(names, margins_at(objective, mechanism, x[-1], u[-1]))
    return Trajectory(
        mechanism, t, x, u, s, cost[:, 0], margin[:, 0], Event(event), objective.unit, broken
    )
