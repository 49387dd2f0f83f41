"""Plans as an exported controller holds them: rounded to its numbers, and sealed."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from undertow.export.controller import EmbeddedController
from undertow.export.seal import as_held, seals
from undertow.law import Plan
from undertow.models import FloatArray
from undertow.symbolic import Real, literal

__all__ = ["plan_numbers", "plan_text"]


def plan_numbers(
    controller: EmbeddedController, plan: Plan
) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
    """Return what the C holds of each row of a plan: surface (2mn,), η (m,) and ε (m,)."""
    m = controller.mechanism.m
    rows = []
    for surface, t in zip(plan.surfaces, plan.times, strict=True):
        law = plan.at(t)[1] or controller.reaching
        values = np.concatenate([surface.vector, law.vector(m)])
        held = np.array([as_held(v, controller.real) for v in values.tolist()])
        rows.append((held[: -2 * m], held[-2 * m : -m], held[-m:]))
    return rows


def plan_text(controller: EmbeddedController, plan: Plan, number: int) -> dict[str, str]:
    """Return the C initialisers of a plan: count, starts and rows, sealed."""
    whole = controller if plan is controller.plan else replace(controller, surface=plan)
    starts, numbers = whole.starts(plan), plan_numbers(whole, plan)
    checks = seals(number, starts, numbers, controller.real)
    rows = []
    for law, row, check in zip(whole.laws, numbers, checks, strict=True):
        parts = [f"{{{_listed(v, controller.real)}}}" for v in row]
        gamma = literal(law.gamma_target, controller.real)
        rows.append(f"        {{{', '.join([*parts, gamma, f'{check:#x}u'])}}},")
    return {
        "count": str(len(rows)),
        "starts": ", ".join(f"{k}UL" for k in starts),
        "rows": "\n".join(rows),
    }


def _listed(values: Iterable[float], real: Real) -> str:
    return ", ".join(literal(v, real) for v in values)
