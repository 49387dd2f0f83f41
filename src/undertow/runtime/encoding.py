"""Plans, memories and answers to JSON and back, number by number: floats survive exactly."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any, TypeGuard

import numpy as np

from undertow.cascade import Admission, CascadeState
from undertow.law import Plan, ReachingLaw, Surface
from undertow.optimiser import Proposal
from undertow.runtime.slow import Answer

__all__ = ["answer_from", "answer_row", "memory_from", "memory_to"]


def _plan_to(plan: Plan) -> dict[str, Any]:
    laws = None
    if plan.reaching is not None:
        laws = [{"eta": r.eta, "layer": r.layer, "switching": r.switching} for r in plan.reaching]
    surfaces = [
        {name: getattr(s, name).tolist() for name in ("alpha_a", "lambda_a", "alpha_u", "lambda_u")}
        for s in plan.surfaces
    ]
    return {"surfaces": surfaces, "times": list(plan.times), "reaching": laws}


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
    """Return a memory of the cascade as JSON values."""
    return {
        "plan": _plan_to(memory.plan),
        "sequence": memory.sequence,
        "predicted": memory.predicted,
        "scale": memory.scale,
        "since": memory.since,
        "x": list(memory.x),
    }


def memory_from(value: Mapping[str, Any]) -> CascadeState:
    """Return the memory that was encoded."""
    x = tuple(value.get("x", ()))  # logs before this one have none
    return CascadeState(**{**value, "plan": _plan_from(value["plan"]), "x": x})


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
        "lanes": answer.lanes.tolist(),
        # What an optimiser says may be anything: only what can be judged again is kept.
        "plan": _plan_to(plan) if _is_sound(plan) else None,
        "number": proposal.sequence,
        "computed_for": proposal.computed_for,
        "message": proposal.message,
        "swing": answer.swing,
    }
    return (
        k, answer.sequence, answer.use, int(admission.accepted), admission.reason, proposal.status,
        proposal.cost, proposal.incumbent_cost, admission.cost, proposal.evaluations,
        answer.seconds, json.dumps(body, ensure_ascii=False),
    )  # fmt: skip


def answer_from(row: Mapping[str, Any]) -> Answer:
    """Return the answer that a line of the log tells of."""

    def number(name: str) -> float:
        return math.nan if row[name] is None else float(row[name])

    body = json.loads(row["body"])
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
        memory_from(body["before"]),
        memory_from(body["after"]),
        np.array(body["lanes"]),
        row["seconds"],
        body["swing"],
    )
