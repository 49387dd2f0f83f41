"""What a log holds of a run: columns of its steps; plans, memories and answers as JSON."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, NamedTuple, Self, TypeGuard

import numpy as np

from undertow.cascade import Admission, CascadeState, Legs
from undertow.estimators import ParameterEstimate
from undertow.law import Plan, ReachingLaw, Reference, ReferenceMotion, Surface
from undertow.law.reference import Ramp, Sine, Spline
from undertow.models import FloatArray, Mechanism
from undertow.optimiser import Proposal
from undertow.plants import Measurement
from undertow.runtime.controller import Controller, Inputs
from undertow.runtime.slow_loop import Answer

#: Columns of whole numbers; the first one is the key of a row.
WHOLE = ("k", "mode", "surface")

#: What the names of columns are made of: measured states, demanded inputs, surface values.
_MEASURED, _DEMAND, _SURFACE = "_measured", "_demand", "s_"


class Stamps(NamedTuple):
    """When the parts of a step were due or done, s, on the clock of the loop."""

    due: float
    began: float
    read: float
    computed: float
    written: float


def sql_type(name: str) -> str:
    """Return the type in SQL of a column."""
    if name not in WHOLE:
        return "REAL"
    return "INTEGER PRIMARY KEY" if name == WHOLE[0] else "INTEGER"


@dataclass(frozen=True)
class Columns:
    """Where each quantity stands in a row of ``steps``.

    Every name of a coordinate, state or input of the mechanism gives a column, with an underscore
    behind it where that is the name of another one.

    ``k``, ``t``, ``clock``: number of the step, its time since the start of the run, s, and on the
    clock, s. ``mode``, ``surface``: state of the run, and sequence number of the plan in use.
    ``rig_t``, ``q``, ``v``: the measurement: time on the rig's clock, s, positions (n,) and
    velocities (n,). ``x``, ``s``, ``demand``, ``u``: estimate (2n,), surface values (m,), unlimited
    output of the law (m,), output (m,). ``margin``: det Γ(q)/det Γ(0). ``late_us``, ``read_us``,
    ``step_us``, ``write_us``: how late the step began, and how long reading, computing and writing
    took, µs.
    """

    names: tuple[str, ...]
    k: int
    t: int
    clock: int
    mode: int
    surface: int
    rig_t: int
    q: slice
    v: slice
    x: slice
    s: slice
    demand: slice
    u: slice
    margin: int
    late_us: int
    read_us: int
    step_us: int
    write_us: int

    @classmethod
    def of(cls, mechanism: Mechanism) -> Self:
        """Return the columns for a mechanism."""
        n, surfaces = mechanism.n, [f"{_SURFACE}{i}" for i in range(mechanism.m)]
        several = {"names", "q", "v", "x", "s", "demand", "u"}
        single = {name: name for name in cls.__dataclass_fields__}
        taken = {*surfaces, *single} - several
        states = _free(mechanism.state_names, _MEASURED, taken)
        inputs = _free([i.name for i in mechanism.inputs], _DEMAND, taken)
        del single["names"]
        groups: dict[str, str | list[str]] = single | {
            "q": [f"{name}{_MEASURED}" for name in states[:n]],
            "v": [f"{name}{_MEASURED}" for name in states[n:]],
            "x": states,
            "s": surfaces,
            "demand": [f"{name}{_DEMAND}" for name in inputs],
            "u": inputs,
        }
        names: list[str] = []
        places: dict[str, int | slice] = {}
        for key, group in groups.items():
            if isinstance(group, str):
                places[key] = len(names)
                names.append(group)
            else:
                places[key] = slice(len(names), len(names) + len(group))
                names += group
        return cls(tuple(names), **places)  # type: ignore[arg-type]

    def fill(self, row: FloatArray, k: int, at: Stamps, inputs: Inputs, after: Controller) -> None:
        """Write a step into a row.

        Number ``k``; when its parts were due or done; what it was given, and the controller
        ``after`` it.
        """
        row[self.k], row[self.t], row[self.clock] = k, inputs.t, at.began
        row[self.mode], row[self.surface] = after.mode, after.memory.sequence
        measurement = inputs.measurement
        if measurement is None:
            row[self.rig_t] = row[self.q] = row[self.v] = np.nan
        else:
            row[self.rig_t], row[self.q] = measurement.t, measurement.q
            row[self.v] = np.nan if measurement.v is None else measurement.v
        row[self.x], row[self.s] = after.x, after.s
        row[self.demand], row[self.u] = after.demand, after.u
        row[self.margin] = after.margin[0]
        row[self.late_us] = 1e6 * (at.began - at.due)
        row[self.read_us] = 1e6 * (at.read - at.began)
        row[self.step_us] = 1e6 * (at.computed - at.read)
        row[self.write_us] = 1e6 * (at.written - at.computed)

    def measures_velocities(self, rows: FloatArray) -> bool:
        """Whether any of the rows has a measured velocity: then one that is NaN was lost."""
        return not np.isnan(rows[:, self.v]).all()

    def measurement(self, row: FloatArray, *, velocities: bool) -> Measurement | None:
        """Return the measurement of a step; ``None`` where the rig had failed.

        ``velocities``: whether the rig measures them.
        """
        if math.isnan(row[self.rig_t]) and np.isnan(row[self.q]).all():
            return None
        v = row[self.v] if velocities else None
        return Measurement(float(row[self.rig_t]), row[self.q], v)

    def agrees(self, row: FloatArray, controller: Controller) -> bool:
        """Whether a controller is, bit for bit, where the step of a row had left it."""
        names = ("u", "x", "s", "demand")
        same = all(
            np.array_equal(getattr(controller, k), row[getattr(self, k)], equal_nan=True)
            for k in names
        )
        same = same and controller.mode == row[self.mode]
        return same and controller.memory.sequence == row[self.surface]

    @staticmethod
    def quantity(name: str) -> str:
        """Return the state or input that a column is about, its name where it is neither."""
        return name.removesuffix(_MEASURED).removesuffix(_DEMAND)

    @staticmethod
    def groups(names: tuple[str, ...]) -> dict[str, list[str]]:
        """Return the columns of a log but for k and t by what they are about.

        ``state``, ``measured``, ``input``, ``demand``, ``surface`` and, of the loop, all others.
        """
        measured = [name for name in names if name.endswith(_MEASURED)]
        demand = [name for name in names if name.endswith(_DEMAND)]
        found = {
            "state": [Columns.quantity(name) for name in measured],
            "measured": ["rig_t", *measured],
            "input": [Columns.quantity(name) for name in demand],
            "demand": demand,
        }
        own = {"margin", "surface"}.union(*found.values())
        surface = [name for name in names if name.startswith(_SURFACE) and name not in own]
        found["surface"] = [*surface, "margin", "surface"]
        taken = {"k", "t"}.union(*found.values())
        return {**found, "loop": [name for name in names if name not in taken]}

    @staticmethod
    def shown(names: tuple[str, ...]) -> tuple[list[str], list[str], list[str]]:
        """Return which columns of a log are positions, inputs and surface values, by name."""
        groups = Columns.groups(names)
        positions = [name for name in groups["state"] if not name.endswith("_dot")]
        surfaces = [name for name in groups["surface"] if name.startswith(_SURFACE)]
        return positions, groups["input"], surfaces


def _free(names: Iterable[str], suffix: str, taken: set[str]) -> list[str]:
    """Return names for columns, alone and with a suffix, and add them to those that are taken.

    SQLite takes capitals for small letters: an input T would be the time t.  What is taken, or
    would be, has underscores behind it.
    """
    found = []
    for name in names:
        free = name
        while taken & {free.lower(), f"{free}{suffix}".lower()}:
            free += "_"
        taken |= {free.lower(), f"{free}{suffix}".lower()}
        found.append(free)
    return found


#: Paths of references that are data, by name.
PATHS: Mapping[str, type[Any]] = {"Ramp": Ramp, "Sine": Sine, "Spline": Spline}

#: What stands for the target of a run that moves.
MOVING = "reference"

#: Kind of the events that hold the targets which were asked for during a run.
TOLD = "set-points"

#: Keys of an answer's ``body`` in logs before version 0.2.0, and what they are now.
OLD_KEYS = {"lanes": "law_vectors"}


def _plain(value: Any) -> Any:
    """Return data classes, arrays and tuples as what JSON has: fields by name, lists."""
    if is_dataclass(value):
        return {item.name: _plain(getattr(value, item.name)) for item in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(one) for one in value] if isinstance(value, tuple) else value


def _plan_from(value: Mapping[str, Any]) -> Plan:
    def numbers(v: float | list[float]) -> float | tuple[float, ...]:
        return tuple(v) if isinstance(v, list) else v

    laws = None
    if value["reaching"] is not None:
        laws = tuple(
            ReachingLaw(numbers(r["eta"]), numbers(r["layer"]), r["switching"])
            for r in value["reaching"]
        )
    surfaces = tuple(Surface(**blocks) for blocks in value["surfaces"])
    return Plan(surfaces, tuple(value["times"]), laws)


def memory_to(memory: CascadeState) -> dict[str, Any]:
    """Return a memory of the cascade as JSON values.

    Of a target that moves it only says that it does: the recipe has it.
    """
    target, kept = memory.target, _plain(replace(memory, target=None))
    if target is not None:
        kept["target"] = MOVING if target.moves else list(target.position(0.0))
    return dict(kept)


def _estimate_from(value: Mapping[str, Any]) -> ParameterEstimate:
    """Return the estimate that was encoded; logs before 0.2.0 say nothing of a bound."""
    arrays = {name: np.array(v) for name, v in value.items() if isinstance(v, list)}
    return ParameterEstimate(**{**value, **arrays})


def memory_from(value: Mapping[str, Any], reference: ReferenceMotion | None = None) -> CascadeState:
    """Return the memory that was encoded, in a run whose target moved as ``reference`` does."""
    x, q = tuple(value.get("x", ())), value.get("target")  # logs before this one have none
    target = None if q is None else reference
    if q == MOVING and reference is None:
        raise ValueError("a target that moves, in a run without one")
    if q is not None and q != MOVING:
        target = ReferenceMotion.at_rest(np.array(q, dtype=float))
    learnt = value.get("estimate")
    ahead, jumps = value.get("ahead"), value.get("after_jump") or ()
    if isinstance(jumps, dict):  # logs before this one have one plan for all speeds
        jumps = ((math.inf, jumps),)
    changed = {
        "plan": _plan_from(value["plan"]),
        "ahead": None if ahead is None else _plan_from(ahead),
        "after_jump": tuple((speed, _plan_from(plan)) for speed, plan in jumps),
        "x": x,
        "target": target,
        "estimate": None if learnt is None else _estimate_from(learnt),
        "disturbance": tuple(value.get("disturbance", ())),
    }
    return CascadeState(**{**value, **changed})


def legs_to(legs: Legs) -> str:
    """Return the set-points that were asked for during a run as JSON: times, s, and positions."""
    return json.dumps([[begin, list(motion.position(0.0))] for begin, motion in legs])


def legs_from(text: str) -> Legs:
    """Return the set-points that were encoded."""
    return tuple(
        (float(begin), ReferenceMotion.at_rest(np.array(q, dtype=float)))
        for begin, q in json.loads(text)
    )


def reference_to(reference: Reference) -> dict[str, Any] | None:
    """Return a reference as JSON values; ``None`` for functions of somebody's own."""
    paths = {}
    for name, path in reference.paths.items():
        kind = type(path).__name__
        if PATHS.get(kind) is not type(path):
            return None
        paths[name] = {"kind": kind, **_plain(path)}
    return {"paths": paths, "period": reference.period}


def reference_from(value: Mapping[str, Any]) -> Reference:
    """Return the reference that was encoded."""
    paths = {}
    for name, path in value["paths"].items():
        fields = {k: tuple(v) if isinstance(v, list) else v for k, v in path.items() if k != "kind"}
        paths[name] = PATHS[path["kind"]](**fields)
    return Reference(paths, value["period"])


def _is_sound(plan: object) -> TypeGuard[Plan]:
    """Whether it is a plan with numbers in it."""
    if not isinstance(plan, Plan):
        return False
    return all(bool(np.isfinite(surface.vector).all()) for surface in plan.surfaces)


def answer_row(k: int, answer: Answer) -> tuple[object, ...]:
    """Return the line of the log for an answer that arrived in step k."""
    proposal, admission = answer.proposal, answer.admission
    plan = getattr(proposal, "plan", None)
    body = {
        "x": answer.x.tolist(),
        "before": memory_to(answer.before),
        "after": memory_to(answer.memory),
        "law_vectors": answer.law_vectors.tolist(),
        # What an optimiser says may be anything: only what can be judged again is kept.
        "plan": _plain(plan) if _is_sound(plan) else None,
        "number": proposal.sequence,
        "computed_for": proposal.computed_for,
        "message": proposal.message,
        "swing": answer.swing,
        "jump": answer.jump,
        "gains": answer.gains,
    }
    return (
        k, answer.sequence, answer.use, int(admission.accepted), admission.reason, proposal.status,
        proposal.cost, proposal.incumbent_cost, admission.cost, proposal.evaluations,
        answer.seconds, json.dumps(body, ensure_ascii=False),
    )  # fmt: skip


def answer_from(row: Mapping[str, Any], reference: ReferenceMotion | None = None) -> Answer:
    """Return the answer that a line of the log tells of, see :func:`memory_from`."""

    def number(name: str) -> float:
        return math.nan if row[name] is None else float(row[name])

    body = {OLD_KEYS.get(key, key): value for key, value in json.loads(row["body"]).items()}
    proposal = Proposal(
        None if body["plan"] is None else _plan_from(body["plan"]),
        row["status"],
        number("cost"),
        number("incumbent_cost"),
        (),
        row["evaluations"],
        row["seconds"],
        body["number"],
        body["computed_for"],
        body["message"],
    )
    return Answer(
        row["sequence"],
        row["use"],
        np.array(body["x"]),
        proposal,
        Admission(bool(row["accepted"]), row["reason"], number("predicted")),
        memory_from(body["before"], reference),
        memory_from(body["after"], reference),
        np.array(body["law_vectors"]),
        row["seconds"],
        body["swing"],
        body.get("jump", False),
        body.get("gains", body["swing"]),
    )
