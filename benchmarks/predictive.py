"""Predictive control as one runs it on a rig: a hundred times a second, one step each time.

* :class:`RealTimeIteration`: least energy by multiple shooting to the deadline.  Each sample
  linearises the shifted plan once and solves one quadratic programme (Diehl, Bock, Schlöder,
  *A real-time iteration scheme*, SIAM J. Control Optim. 43, 2005), Gauss-Newton: the cost is
  quadratic, so its Hessian is exact but for the curvature of the dynamics.  A step that makes
  cost and defects worse is shortened: with two motors and three links full steps never settle.
  CasADi; QRQP, warm-started, and HPIPM where that fails.  With a weight of the state it balances
  for ever instead: the horizon recedes, and the regulator's price stands for all that comes after.
* :class:`Acados`: the same in acados, with full steps, in a process of another Python that has it.
* :class:`AcadosShooting`: what :class:`rivals.ShootingMPC` plans for least energy, by acados.
* :class:`Sampled`: holds what a controller asks for from sample to sample, and has its model's
  parameters learnt from the motion where there is a belief, the library's own.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np

import undertow as ut
from harness import Clock, need
from rivals import Box, ShootingMPC, dynamics, ends, parameters, riccati, runge_kutta
from undertow.models import FloatArray, linearise

__all__ = ["PERIOD", "Acados", "AcadosShooting", "RealTimeIteration", "Sampled", "grid"]

#: Time between samples, s.
PERIOD = 0.01

#: Intervals of a plan, the longest one, s, and how soon before the deadline plans arrive, s.
INTERVALS, LONGEST, EARLY = 60, 0.3, 0.2

#: The parts of a step that are tried, until one betters the plan.
PARTS = (1.0, 0.5, 0.25, 0.1)

#: What has missed the target is to reach it so much later, s, again and again.
AGAIN = 0.5

#: Largest step of the integrator times the fastest rate of the linearised mechanism.
RESOLVED = 1.0

#: Weight of xᵀx beside u²/u_max² in the Riccati equation whose solution sizes the penalties.
SLOW = 1e-4

#: A miss of the terminal set by its own radius costs this part of the whole task, and leaving the
#: box by a hundredth of it this one: both are soft, as a programme without a solution is no help.
MISS, OUTSIDE = 0.1, 0.1


def grid(span: float, first: float = PERIOD) -> FloatArray:
    """Return the intervals of a plan over a span, s: the first a sample, each longer than the last.

    None is longer than ``LONGEST`` where the span allows that; short spans are divided evenly.
    """
    numbers = np.arange(INTERVALS)
    if span <= INTERVALS * first:
        return np.full(INTERVALS, span / INTERVALS)
    cap = max(LONGEST, 1.5 * span / INTERVALS)
    low, high = 1.0, 2.0
    for _ in range(60):
        ratio = (low + high) / 2
        total = np.minimum(first * ratio**numbers, cap).sum()
        low, high = (ratio, high) if total < span else (low, ratio)
    lengths = np.minimum(first * low**numbers, cap)
    return np.asarray(lengths * span / lengths.sum())


class Control(Protocol):
    """A controller whose model has parameters that may change."""

    values: FloatArray

    def due(self, t: float) -> bool:
        """Whether it is planned anew at t."""

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input."""


class Sampled:
    """What a controller asks for, held; with a belief the plant's parameters are learnt first."""

    def __init__(
        self, control: Control, limits: FloatArray, belief: ut.Belief | None = None
    ) -> None:
        self.control, self.limits, self.belief = control, limits, belief
        self.known = None if belief is None else belief.prior
        self._rows: list[tuple[float, FloatArray, FloatArray]] = []

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at t, clipped."""
        if not self._rows or self.control.due(t):
            self._learn(t, x)
            self._u = np.clip(self.control(t, x), -self.limits, self.limits)
        self._rows.append((t, x, self._u))
        return self._u

    def _learn(self, t: float, x: FloatArray) -> None:
        if self.belief is None or self.known is None or not self._rows:
            return
        rows = [*self._rows, (t, x, self._u)]
        times, states, inputs = (np.array(column) for column in zip(*rows, strict=True))
        self.known = self.belief.learn(self.known, times, states, inputs, held=True)
        names, values = tuple(self.belief.tolerances), self.belief.values(self.known.offset)
        places = [p.name for p in self.belief.mechanism.parameters]
        self.control.values = np.array([values[places.index(name)] for name in names])
        self._rows = []


class _Task:
    """What both real-time iterations share: the grid, the penalties, the first guess."""

    def __init__(
        self,
        mechanism: ut.Mechanism,
        box: Box,
        deadline: float,
        radius: float,
        period: float,
        weight: float,
    ) -> None:
        self.mechanism, self.deadline = mechanism, deadline
        self.period, self.weight = period, weight
        self.limits = mechanism.input_limits
        self.low, self.high = ends(mechanism, box)
        self.boxed = np.flatnonzero(np.isfinite(self.low) | np.isfinite(self.high))
        self.lengths = self.left(0.0)
        rate = linearise(mechanism).fastest
        self.substeps = np.ceil(self.lengths * rate / RESOLVED).astype(int).clip(1, 40)
        self.radius = radius
        self.seconds: list[float] = []
        self.failures = 0
        #: Σ (u_i/u_i,max)² weighed so that it is proportional to uᵀu.
        self.weights = (self.limits / self.limits.max()) ** 2
        #: x_N in units in which the price of where a plan ends is a sum of squares.
        self.tip = np.eye(2 * mechanism.n)
        if weight:
            price = riccati(mechanism, weight)[0] / float(self.limits.max()) ** 2
            self.tip = np.linalg.inv(np.linalg.cholesky(price)).T

    def size(self, x: FloatArray) -> float:
        """Return about what the whole task costs, in units of the largest input squared."""
        P, _ = riccati(self.mechanism, SLOW * float(self.limits.max()) ** 2)
        return float(x @ P @ x) / float(self.limits.max()) ** 2

    def left(self, t: float) -> FloatArray:
        """Return the grid from t on, to the aim or to the next try; or as far as plans look."""
        if self.weight:
            return grid(self.deadline, self.period)
        span = self.deadline - EARLY - t
        half = self.period / 2
        return grid(span if span > half else AGAIN - (-span + half) % AGAIN + half, self.period)

    def due(self, t: float) -> bool:
        """Whether it is planned anew at t."""
        return abs(t / self.period - round(t / self.period)) < 1e-6

    def guess(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return states and inputs to start from: straight home."""
        nodes = np.concatenate([[0.0], np.cumsum(self.lengths)])
        fade = np.exp(-3.0 * nodes)[:, None]
        return x * fade, np.zeros((INTERVALS, self.mechanism.m))


def shifted(
    states: FloatArray, inputs: FloatArray, lengths: FloatArray, by: float, later: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a plan moved on by some seconds, on another grid."""
    nodes = np.concatenate([[0.0], np.cumsum(lengths)])
    wanted = by + np.concatenate([[0.0], np.cumsum(later)])
    moved = np.column_stack([np.interp(wanted, nodes, column) for column in states.T])
    middles = (wanted[:-1] + wanted[1:]) / 2
    index = np.clip(np.searchsorted(nodes, middles, side="right") - 1, 0, len(inputs) - 1)
    return moved, inputs[index]


class RealTimeIteration(_Task):
    """Least energy by the deadline, one quadratic programme a sample.

    Where that programme fails, or its steps have led to what is no number, IPOPT plans anew from
    cold: ``failures`` counts how often.

    Parameters
    ----------
    mechanism
        The controller's model.
    box
        How far coordinates may go, softly.
    deadline
        When the terminal set is to be reached, s; plans aim at it a fifth of a second sooner.  With
        a weight, how far each plan looks ahead, s.
    radius
        ν of the terminal set.
    names
        Parameters whose ``values`` may change from sample to sample.
    now
        Clock for the seconds of each planning.
    period
        Time between samples, s.
    weight
        Of xᵀx beside uᵀu: then x = 0 is approached for ever, and nothing is to be reached.
    """

    def __init__(
        self,
        mechanism: ut.Mechanism,
        box: Box,
        deadline: float,
        radius: float = 0.01,
        names: Sequence[str] = (),
        now: Clock = time.perf_counter,
        period: float = PERIOD,
        weight: float = 0.0,
    ) -> None:
        super().__init__(mechanism, box, deadline, radius, period, weight)
        self.ca, self._now = need("casadi", "compare"), now
        self.names = tuple(names)
        self._build()
        self.forget()

    def forget(self) -> None:
        """Start from cold, with the model's own parameters."""
        self._plan: tuple[FloatArray, FloatArray, FloatArray] | None = None
        self._since = 0.0
        self._prices: dict[str, Any] = {}
        self.values = parameters(self.mechanism, self.names)

    def _move(self, substeps: int) -> Any:
        """Return (x, v, h, p) -> x after h, with inputs in parts of their limits."""
        ca, n, m = self.ca, 2 * self.mechanism.n, self.mechanism.m
        x, v, h = ca.SX.sym("x", n), ca.SX.sym("v", m), ca.SX.sym("h")
        p = ca.SX.sym("p", len(self.names))
        f = dynamics(ca, self.mechanism, self.names)
        u = v * self.limits
        end = x
        for _ in range(substeps):
            end = runge_kutta(lambda y: f(y, u, p) if self.names else f(y, u), end, h / substeps)
        return ca.Function("move", [x, v, h, p], [end])

    def _build(self) -> None:
        """Build defects, their Jacobian and the solver.

        Unknowns are x_0, (v_0, s_0), x_1, …, x_N: s relaxes the box of its stage.
        """
        ca, n, m, b = self.ca, 2 * self.mechanism.n, self.mechanism.m, len(self.boxed)
        X = [ca.MX.sym(f"x{k}", n) for k in range(INTERVALS + 1)]
        V = [ca.MX.sym(f"v{k}", m + b) for k in range(INTERVALS)]
        h, p = ca.MX.sym("h", INTERVALS), ca.MX.sym("p", len(self.names))
        moves = {count: self._move(int(count)) for count in set(self.substeps)}
        self._forward = self._move(2)
        rows = []
        for k, count in enumerate(self.substeps):
            end = moves[count](X[k], V[k][:m], h[k], p)
            if k == INTERVALS - 1 and self.weight:
                end = ca.DM(np.linalg.inv(self.tip)) @ end
            rows.append(end - X[k + 1])
            rows += [X[k][i] + V[k][m + j] for j, i in enumerate(self.boxed)]
        z = ca.vertcat(*(part for pair in zip(X, V, strict=False) for part in pair), X[-1])
        g = ca.vertcat(*rows)
        self._rows = ca.Function("rows", [z, h, p], [g, ca.jacobian(g, z)])
        self._defects = ca.Function("defects", [z, h, p], [g])
        low = np.concatenate([np.zeros(n), self.low[self.boxed]])
        high = np.concatenate([np.zeros(n), self.high[self.boxed]])
        self._below, self._above = np.tile(low, INTERVALS), np.tile(high, INTERVALS)
        sizes = [n] * (INTERVALS + 1)
        self._H = ca.Sparsity.diag(z.numel())
        shape = {"h": self._H, "a": self._rows.sparsity_out(1)}
        quiet = {"print_iter": False, "print_header": False, "print_info": False}
        self._solvers = [
            ca.conic("active", "qrqp", shape, {**quiet, "max_iter": 60, "error_on_fail": False}),
            ca.conic("interior", "hpipm", shape, {
                "N": INTERVALS, "nx": sizes, "nu": [m + b] * INTERVALS + [0],
                "ng": [b] * INTERVALS + [0], "inf": 1e4, "error_on_fail": False,
            }),
        ]  # fmt: skip
        weights, scale = ca.MX.sym("w", z.numel()), ca.MX.sym("f")
        cost = ca.dot(weights, z**2) / 2 / scale
        self._nlp = ca.nlpsol("nlp", "ipopt", {
            "x": z, "f": cost, "g": g, "p": ca.vertcat(h, p, weights, scale),
        }, {
            "print_time": False, "error_on_fail": False, "show_eval_warnings": False,
            "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-6, "max_iter": 300},
        })  # fmt: skip

    def ahead(self, x: FloatArray, u: FloatArray, seconds: float) -> FloatArray:
        """Return the state after some seconds under an input that is held."""
        end = self._forward(x, u / self.limits, seconds, self.values)
        return np.asarray(end, dtype=float).ravel()

    def _weights(self, lengths: FloatArray) -> FloatArray:
        """Return the diagonal of the Hessian."""
        n = 2 * self.mechanism.n
        width = (self.high - self.low)[self.boxed]
        out = 2 * OUTSIDE * self._size / (0.01 * np.where(np.isfinite(width), width, 1.0)) ** 2
        state = np.full(n, 2 * self.weight / float(self.limits.max()) ** 2)
        stage = np.concatenate([state, 2 * self.weights, out])
        body = lengths[:, None] * np.tile(stage, (INTERVALS, 1))
        end = np.full(n, 2.0 if self.weight else 2 * MISS * self._size / self.radius**2)
        return np.concatenate([body.ravel(), end])

    def _bounds(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        n, m, b = 2 * self.mechanism.n, self.mechanism.m, len(self.boxed)
        stage = np.concatenate([np.full(n, np.inf), np.ones(m), np.full(b, np.inf)])
        high = np.concatenate([np.tile(stage, INTERVALS), np.full(n, np.inf)])
        low = -high
        low[:n] = high[:n] = x
        return low, high

    def _packed(self, states: FloatArray, inputs: FloatArray) -> FloatArray:
        slack = np.zeros((INTERVALS, len(self.boxed)))
        last = np.linalg.solve(self.tip, states[-1]) if self.weight else states[-1]
        return np.concatenate([np.hstack([states[:-1], inputs, slack]).ravel(), last])

    def _unpacked(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        n, m = 2 * self.mechanism.n, self.mechanism.m
        body = z[:-n].reshape(INTERVALS, -1)
        return np.vstack([body[:, :n], self.tip @ z[-n:]]), body[:, n : n + m]

    def plan(self, t: float, x: FloatArray) -> bool:
        """Take one step towards the best plan from x; False where the programme failed."""
        began = self._now()
        lengths = self.left(t)
        if self._plan is None:
            self._size = self.size(x)
            z, good = self._cold(x, lengths)
        else:
            states, inputs, before = self._plan
            states, inputs = shifted(states, inputs, before, t - self._since, lengths)
            states[0] = x
            z, good = self._step(self._packed(states, inputs), x, lengths)
            if not good:  # full steps may lead astray
                self.failures += 1
                z, good = self._cold(x, lengths)
        if good or self._plan is None:
            self._plan, self._since = (*self._unpacked(z), lengths), t
        self.seconds.append(self._now() - began)
        return good

    def _step(self, z: FloatArray, x: FloatArray, lengths: FloatArray) -> tuple[FloatArray, bool]:
        """Return the solution of one quadratic programme, linearised at z."""
        g, J = self._rows(z, lengths, self.values)
        if not (np.isfinite(np.array(g)).all() and np.isfinite(np.array(J.nonzeros())).all()):
            return z, False
        low, high = self._bounds(x)
        weights = self._weights(lengths)
        rest = np.array(g).ravel() - np.array(J @ z).ravel()
        for solve in self._solvers:  # warm-started; should that fail, from cold
            found = solve(
                h=self.ca.DM(self._H, weights), g=np.zeros(len(z)), a=J, x0=z, **self._prices,
                lba=self._below - rest, uba=self._above - rest, lbx=low, ubx=high,
            )  # fmt: skip
            new = np.array(found["x"]).ravel()
            if solve.stats()["success"] and np.isfinite(new).all():
                self._prices = {"lam_x0": found["lam_x"], "lam_a0": found["lam_a"]}
                price = 1.5 * float(np.abs(np.array(found["lam_a"])).max())
                return self._shortened(z, new, lengths, weights, price), True
        self._prices = {}
        return new, False

    def _shortened(
        self, z: FloatArray, new: FloatArray, lengths: FloatArray, weights: FloatArray, price: float
    ) -> FloatArray:
        """Return the longest of some parts of a step that betters cost and defects together."""

        def merit(at: FloatArray) -> float:
            rows = np.array(self._defects(at, lengths, self.values)).ravel()
            off = np.maximum(self._below - rows, 0.0) + np.maximum(rows - self._above, 0.0)
            return float(weights @ at**2 / 2 + price * off.sum())

        before = merit(z)
        for part in PARTS:
            at = z + part * (new - z)
            if merit(at) <= before:
                break
        return at

    def _cold(self, x: FloatArray, lengths: FloatArray) -> tuple[FloatArray, bool]:
        """Return the first plan, converged: there is time for it before anything moves."""
        low, high = self._bounds(x)
        known = [lengths, self.values, self._weights(lengths), np.array([self._size])]
        found = self._nlp(
            x0=self._packed(*self.guess(x)), p=np.concatenate(known),
            lbg=self._below, ubg=self._above, lbx=low, ubx=high,
        )  # fmt: skip
        new = np.array(found["x"]).ravel()
        return new, bool(self._nlp.stats()["success"]) and bool(np.isfinite(new).all())

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at t, for one sample; after a failure what was planned."""
        self.plan(t, x)
        assert self._plan is not None
        _, inputs, lengths = self._plan
        nodes = np.concatenate([[0.0], np.cumsum(lengths)])
        area = np.vstack([np.zeros(inputs.shape[1]), np.cumsum(lengths[:, None] * inputs, axis=0)])
        span = t - self._since + np.array([0.0, self.period])
        spent = np.stack([np.interp(span, nodes, column) for column in area.T])
        return np.asarray(np.diff(spent, axis=1)[:, 0] / self.period * self.limits)


class _Server:
    """acados_server.py in a process of another Python."""

    def __init__(self, python: str, problem: dict[str, Any]) -> None:
        if shutil.which(python) is None:
            sys.exit(f"error: there is no Python at {python}, where acados was to be")
        server = Path(__file__).with_name("acados_server.py")
        self._process = subprocess.Popen(
            [python, str(server)], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
            env=os.environ | {"LD_LIBRARY_PATH": self._libraries(python), "PYTHONPATH": ""},
        )  # fmt: skip
        self.ask(problem)

    @staticmethod
    def _libraries(python: str) -> str:
        """Return where acados' libraries are: the loader wants to know before Python starts."""
        find = "import acados, pathlib; print(pathlib.Path(acados.__path__[0]) / 'install/lib')"
        done = subprocess.run([python, "-c", find], capture_output=True, text=True, check=False)
        known = os.environ.get("LD_LIBRARY_PATH", "")
        return os.pathsep.join(filter(None, [done.stdout.strip(), known]))

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a question, or end with one line where there is none."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        with contextlib.suppress(BrokenPipeError):
            print(json.dumps(question), file=self._process.stdin, flush=True)
        line = self._process.stdout.readline()
        if not line:
            words = self._process.communicate()[1].strip().splitlines()
            sys.exit(f"error: acados did not answer: {words[-1] if words else 'no words'}")
        answer: dict[str, Any] = json.loads(line)
        return answer

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


class Acados(RealTimeIteration):
    """The same programme by acados (HPIPM), in a process of another Python that has it.

    The first plan is the one of :class:`RealTimeIteration`; steps are full; ``seconds`` are
    acados' own, without the pipe.  Faster than ``PERIOD`` it starts each step from its own last
    solution, which is not shifted: the way of its examples.

    Parameters
    ----------
    python
        The other Python, with acados, CasADi and NumPy; a C compiler besides.
    mechanism, box, deadline, radius, names, period, weight
        As for :class:`RealTimeIteration`.
    """

    def __init__(
        self,
        python: str,
        mechanism: ut.Mechanism,
        box: Box,
        deadline: float,
        radius: float = 0.01,
        names: Sequence[str] = (),
        period: float = PERIOD,
        weight: float = 0.0,
    ) -> None:
        super().__init__(mechanism, box, deadline, radius, names, period=period, weight=weight)
        ca, n, m = self.ca, 2 * mechanism.n, mechanism.m
        x, v, p = ca.SX.sym("x", n), ca.SX.sym("v", m), ca.SX.sym("p", len(self.names))
        f = dynamics(ca, mechanism, self.names)
        rates = f(x, v * self.limits, p) if self.names else f(x, v * self.limits)
        self._said: FloatArray
        self._going: bool
        self._size = self.size(mechanism.usual_start)
        weights = self._weights(self.lengths)[n + m : n + m + len(self.boxed)] / self.lengths[0]
        self._server = _Server(python, {
            "kinds": ["SQP_RTI"], "options": {},
            "rates": ca.Function("rates", [x, v, p], [rates]).serialize(), "n": n, "m": m,
            "values": self.values.tolist(), "weight": self.weight / float(self.limits.max()) ** 2,
            "lengths": self.lengths.tolist(), "substeps": self.substeps.tolist(),
            "weights": self.weights.tolist(), "boxed": self.boxed.tolist(),
            "low": self.low[self.boxed].tolist(), "high": self.high[self.boxed].tolist(),
            "out": weights.tolist(),
        })  # fmt: skip

    def _step(self, z: FloatArray, x: FloatArray, lengths: FloatArray) -> tuple[FloatArray, bool]:
        """Return what one real-time iteration of acados makes of z."""
        states, inputs = self._unpacked(z)
        tip = np.linalg.inv(self.tip)
        end = tip.T @ np.diag(self._weights(lengths)[-len(x) :]) @ tip
        found = self._server.ask({
            "x": x.tolist(), "lengths": lengths.tolist(), "states": states.tolist(),
            "inputs": inputs.tolist(), "end": end.tolist(), **self._told(),
        })  # fmt: skip
        self._spent, self._going = found["seconds"], found["good"]
        new = self._packed(np.array(found["states"]), np.array(found["inputs"]))
        return new, found["good"] and bool(np.isfinite(new).all())

    def _told(self) -> dict[str, Any]:
        """Return what acados is told of the parameters: nothing while they stay."""
        nodes = INTERVALS + 1 if not np.array_equal(self.values, self._said) else 0
        self._said = self.values.copy()
        return {"kind": "SQP_RTI", "values": self.values.tolist(), "nodes": nodes}

    def forget(self) -> None:
        """Start from cold, with the model's own parameters."""
        super().forget()
        self._going = False
        self._said = np.full(len(self.values), math.nan)

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at t, for one sample."""
        if self._going and self.period < PERIOD:
            found = self._server.ask({"x": x.tolist(), **self._told()})
            u = np.array(found["inputs"][0]) * self.limits
            if found["good"] and np.isfinite(u).all():
                self.seconds.append(found["seconds"])
                return u
            self.failures += 1
            self._plan, self._going = None, False
        return super().__call__(t, x)

    def plan(self, t: float, x: FloatArray) -> bool:
        """Take one step towards the best plan from x; False where acados failed."""
        self._spent = math.nan
        good = super().plan(t, x)
        if not math.isnan(self._spent):
            self.seconds[-1] = self._spent
        return good


class AcadosShooting(ShootingMPC):
    """The least energy of :class:`rivals.ShootingMPC` by acados, in another Python that has it.

    From cold by SQP with the Gauss-Newton Hessian, until it has converged; then one real-time
    iteration for each planning, from the shifted plan.  ``seconds`` are acados' own, preparation
    and feedback together.  A plan of one iteration leaves defects: ``cost`` counts them at acados'
    own prices, all as if they were to be paid.

    Parameters
    ----------
    python
        The other Python, with acados, CasADi and NumPy; a C compiler besides.
    mechanism, tolerance
        As for :class:`rivals.ShootingMPC`.
    """

    def __init__(self, python: str, mechanism: ut.Mechanism, tolerance: float = 1e-4) -> None:
        super().__init__(mechanism, "energy", tolerance=tolerance)
        ca, n, m = self.ca, 2 * mechanism.n, mechanism.m
        x, v, p = ca.SX.sym("x", n), ca.SX.sym("v", m), ca.SX.sym("p", 0)
        rates = dynamics(ca, mechanism)(x, v * self.limits)
        #: The largest input: acados plans inputs as parts of their limits.
        self._unit = float(self.limits.max())
        self._moves = self._move.map(len(self.grid))
        self.server = _Server(python, {
            "kinds": ["SQP", "SQP_RTI"],
            "options": {"tol": tolerance, "hpipm_mode": "SPEED", "qp_solver_cond_N": 10},
            "rates": ca.Function("rates", [x, v, p], [rates]).serialize(), "n": n, "m": m,
            "values": [], "weight": 0.0, "lengths": self.grid.tolist(),
            "substeps": [2] * len(self.grid), "weights": ((self.limits / self._unit) ** 2).tolist(),
            "boxed": [], "low": [], "high": [], "out": [],
        })  # fmt: skip

    def _solve(
        self, x: FloatArray, guess: tuple[FloatArray, FloatArray, float], free: bool
    ) -> tuple[FloatArray, FloatArray, float] | None:
        found = self.server.ask({
            "kind": "SQP" if self._plan is None else "SQP_RTI",
            "x": x.tolist(), "lengths": self.grid.tolist(), "states": guess[0].tolist(),
            "inputs": (guess[1] / self.limits).tolist(),
            "end": (2 * self.P / self._unit**2).tolist(), "values": [], "nodes": 0,
        })  # fmt: skip
        states, inputs = np.array(found["states"]), np.array(found["inputs"]) * self.limits
        self._spent += found["seconds"]
        self.iterations[-1] += found["iterations"]
        ends = self._moves(states[:-1].T, inputs.T, self.grid, np.zeros((0, len(self.grid))))
        defects = np.array(ends).T - states[1:]
        owed = self._unit**2 * np.abs(np.array(found["prices"]) * defects).sum()
        self.cost = float(
            self.grid @ (inputs**2).sum(axis=1) + states[-1] @ self.P @ states[-1] + owed
        )
        return (states, inputs, guess[2]) if found["good"] else None

    def plan(self, t: float, x: FloatArray) -> bool:
        """Plan from x; False where acados failed."""
        self._spent = 0.0
        good = super().plan(t, x)
        self.seconds[-1] = self._spent
        return good
