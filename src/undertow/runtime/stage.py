"""The stage cost of an objective as one compiled number, for the bill of a run."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import sympy as sp

from undertow.models import Mechanism
from undertow.objective import Objective
from undertow.symbolic import PREAMBLE, Tape, content_key, function_source, generated

__all__ = ["stage_module"]


@lru_cache(maxsize=64)
def stage_module(mechanism: Mechanism, objective: Objective) -> Any:
    """Return the compiled module of Φ(x, u), (21): ``stage(x, u, parameters, cost)``.

    Parameters
    ----------
    mechanism
        The controller's belief.
    objective
        Whose stage cost it is; ``cost``, (1,), is filled with it.
    """
    stage = objective.stage_cost(mechanism)
    key = content_key(mechanism.structure, mechanism.name, sp.srepr(stage))

    def write() -> str:
        tape = Tape()
        body = function_source(
            "stage",
            tape,
            {"x": mechanism.x, "u": mechanism.u, "parameters": mechanism.parameter_symbols},
            {"cost": tape.let_all([stage])},
        )
        header = f'"""Stage cost of {mechanism.name}; generated, do not edit."""\n\n'
        return f"{header}{PREAMBLE}\n\n{body}"

    return generated("stage", mechanism.name, key, write)
