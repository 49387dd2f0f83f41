"""Acados behind two pipes, SQP or its real-time iteration: predictive.py starts it elsewhere.

acados comes without the library, and the library without acados: this file needs acados, CasADi
and NumPy alone, and a C compiler.  Each line in is a JSON object and is answered by one: the first
describes the problem, each further one is a sample.  ``pip install comma-deps-acados casadi`` makes
a Python that can run it.
"""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any


def template() -> Any:
    """Return acados' Python interface, from wherever its wheel has put it."""
    with contextlib.suppress(ImportError):
        return importlib.import_module("acados_template")
    root = Path(importlib.import_module("acados").__path__[0])
    installed = root / "install"
    os.environ["ACADOS_SOURCE_DIR"] = str(installed)
    os.environ["PATH"] = f"{installed / 'bin'}{os.pathsep}{os.environ['PATH']}"
    expected = installed / "interfaces" / "acados_template" / "acados_template"
    if not expected.exists():
        expected.parent.mkdir(parents=True, exist_ok=True)
        expected.symlink_to(root / "acados_template")
    sys.path.insert(0, str(root))
    return importlib.import_module("acados_template")


def programme(acados: Any, asked: dict[str, Any], kind: str) -> Any:
    """Return acados' solver for a problem: ``"SQP"`` or ``"SQP_RTI"``."""
    import casadi as ca
    import numpy as np

    n, m, grid = asked["n"], asked["m"], np.array(asked["lengths"])
    x, v, slope = ca.SX.sym("x", n), ca.SX.sym("v", m), ca.SX.sym("slope", n)
    p = ca.SX.sym("p", len(asked["values"]))
    rates = ca.Function.deserialize(asked["rates"])(x, v, p)
    ocp, model = acados.AcadosOcp(), acados.AcadosModel()
    model.name, model.x, model.u, model.xdot, model.p = f"rig_{kind}", x, v, slope, p
    ocp.parameter_values = np.array(asked["values"])
    model.f_expl_expr, model.f_impl_expr = rates, slope - rates
    ocp.model, ocp.dims.N = model, len(grid)
    cost, limits, options = ocp.cost, ocp.constraints, ocp.solver_options
    cost.cost_type, cost.cost_type_e = "LINEAR_LS", "LINEAR_LS"
    state = asked["weight"]
    both = np.eye(n + m) if state else np.eye(n + m)[n:]  # inputs alone, where states are free
    cost.Vx, cost.Vu, cost.Vx_e = both[:, :n], both[:, n:], np.eye(n)
    cost.W = 2 * np.diag([state] * (len(both) - m) + asked["weights"])
    cost.W_e, cost.yref, cost.yref_e = np.eye(n), np.zeros(len(both)), np.zeros(n)
    limits.x0, limits.idxbu = np.zeros(n), np.arange(m)
    limits.lbu, limits.ubu = -np.ones(m), np.ones(m)
    boxed = np.array(asked["boxed"], dtype=int)
    if len(boxed):
        limits.idxbx, limits.idxsbx = boxed, np.arange(len(boxed))
        limits.lbx, limits.ubx = np.array(asked["low"]), np.array(asked["high"])
        cost.zl = cost.zu = np.zeros(len(boxed))
        cost.Zl = cost.Zu = np.array(asked["out"])
    options.tf, options.time_steps = float(grid.sum()), grid
    options.qp_solver, options.hessian_approx = "PARTIAL_CONDENSING_HPIPM", "GAUSS_NEWTON"
    options.integrator_type, options.sim_method_num_stages = "ERK", 4
    options.sim_method_num_steps = np.array(asked["substeps"])
    options.nlp_solver_type, options.print_level = kind, 0
    for name, value in asked["options"].items():
        setattr(options, name, value)
    return acados.AcadosOcpSolver(ocp, json_file=f"{kind}.json")


def sample(solver: Any, asked: dict[str, Any]) -> dict[str, Any]:
    """Solve, or take one real-time iteration: from a plan that is told, or the last solution."""
    import numpy as np

    told = "states" in asked
    states, inputs = np.array(asked.get("states", [])), np.array(asked.get("inputs", []))
    if told:
        solver.set_new_time_steps(np.array(asked["lengths"]))
        solver.cost_set(len(inputs), "W", np.array(asked["end"]))
    for k, state in enumerate(states):
        solver.set(k, "x", state)
    for k, value in enumerate(inputs):
        solver.set(k, "u", value)
    for k in range(asked["nodes"]):
        solver.set(k, "p", np.array(asked["values"]))
    for bound in ("lbx", "ubx"):
        solver.set(0, bound, np.array(asked["x"]))
    began = time.process_time()
    status = solver.solve()
    seconds = time.process_time() - began
    return {
        "states": [solver.get(k, "x").tolist() for k in range(len(states))],
        "inputs": [solver.get(k, "u").tolist() for k in range(max(1, len(inputs)))],
        "prices": [solver.get(k, "pi").tolist() for k in range(len(inputs))],
        "iterations": int(np.max(solver.get_stats("sqp_iter"))),
        "good": status == 0,
        "seconds": seconds,
    }


def main() -> int:
    """Answer line by line until there are no more."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what compilers and acados print
    acados = template()
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        asked = json.loads(sys.stdin.readline())
        solvers = {kind: programme(acados, asked, kind) for kind in asked["kinds"]}
        print(json.dumps({"ready": True}), file=answers, flush=True)
        for line in sys.stdin:
            asked = json.loads(line)
            print(json.dumps(sample(solvers[asked["kind"]], asked)), file=answers, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
