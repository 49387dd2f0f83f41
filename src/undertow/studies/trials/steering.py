"""Controllers for rigs in simulated time: one fixed surface, the cascade, LQR and NMPC.

NMPC at 10 Hz, to compare with, is direct multiple shooting: stage cost of the trial's objective
over a horizon, the linear-quadratic value at its end, the input held for 20 ms at a time.  The plan
is played open loop between two solutions; the solution is there at once, which flatters it: the
cascade's answers come a period late.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.linalg
import sympy as sp

from undertow.base import InvalidInputError, require_extra
from undertow.bounds.expressions import dynamics
from undertow.cascade import Cascade, CascadeState
from undertow.estimators import Estimator, StateFeedback
from undertow.law import InnerLoop, Plan, ReachingLaw, Surface, usual_reaching
from undertow.models import (
    UNCONTROLLABLE,
    FloatArray,
    Mechanism,
    linearise,
    require_smooth,
    uncontrollable,
)
from undertow.models.importers import holding_input
from undertow.objective import Objective, finite_limits
from undertow.optimiser import Proposal
from undertow.plants import Bench
from undertow.runtime import Settings, estimator_for, for_rig
from undertow.runtime.controller import EARLY_LEAD
from undertow.studies.trials.trial import MakeController


def keeping(
    mechanism: Mechanism, kept: Surface | Plan, reaching: ReachingLaw | None = None
) -> MakeController:
    """Return the maker of a controller that keeps one surface, or one plan with its own laws.

    A surface that has none is reached by ``reaching``, the usual law by default.
    """
    plan = kept if isinstance(kept, Plan) else Plan.of(kept)
    otherwise = reaching or usual_reaching(mechanism, plan.surfaces[0])

    def make(_start: FloatArray) -> StateFeedback:
        law = InnerLoop(mechanism, plan.surfaces[0], otherwise)

        def control(t: float, x: FloatArray) -> FloatArray:
            law.follow(plan, t, otherwise)
            return law(x)

        return control

    return make


class CascadeSteering:
    """The cascade in simulated time; its optimiser answers one period later, as on a real rig.

    Every period the answer asked for one period ago is judged from the present state, then the
    next one is asked for: for the state predicted one period ahead.  After a jump of the velocities
    a plan in reserve takes over at once, what was asked for before is given up, and the next answer
    is there after :data:`.EARLY_LEAD`.  Where it has a belief, its estimator learns what that
    leaves open, see :meth:`listen`.

    The first optimisation, ``start``, was made before the run by :meth:`Cascade.start`, as on a
    bench. ``admitted`` answers passed the gate, ``refused`` did not.
    """

    def __init__(self, cascade: Cascade, start: tuple[CascadeState, Proposal]) -> None:
        self.cascade = cascade
        self.memory = start[0]
        self.law = InnerLoop(cascade.mechanism, self.memory.surface, cascade.reaching)
        self._use(self.memory.since)
        self.waiting: Proposal | None = None
        self.ticks = self.admitted = self.refused = 0
        self.began = 0.0
        self.estimator: Estimator | None = None
        self.learning: Estimator | None = None
        self.jumps = 0

    def listen(self, estimator: Estimator) -> None:
        """Hear of jumps, and go on with the parameters that are learnt for the same belief."""
        self.estimator, self.jumps = estimator, estimator.jumps
        self.learning = estimator if self.cascade.learns_from(estimator) else None

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x)."""
        if self.learning is not None:
            self.law.believe(self.learning.parameters, x)
        due = self.began + self.ticks * self.cascade.period
        if self.estimator is not None and self.estimator.jumps > self.jumps:
            self.jumps = self.estimator.jumps
            self.began, self.ticks = t + EARLY_LEAD, 0
            self._take_reserve(t, x)
            self._ask(t, x, self.began)
        elif t >= due - 1e-9:
            self._slow(due, x)
            self.ticks += 1
        if len(self.memory.plan.surfaces) > 1:
            self._use(t)
        return self.law(x)

    def _use(self, t: float) -> None:
        self.law.follow(self.memory.plan, t - self.memory.since, self.cascade.reaching)

    def _take_reserve(self, t: float, x: FloatArray) -> None:
        """Go on with the plan in reserve, where its law exists."""
        plan = self.cascade.after_jump(self.memory, self.memory.error(t, x))
        self.law.follow(plan, 0.0, self.cascade.reaching)
        self.law(x)
        if self.law.margin[0] > Settings().min_margin:
            self.memory = replace(self.memory, plan=plan, since=t, x=())
        self._use(t)

    def _slow(self, t: float, x: FloatArray) -> None:
        cascade = self.cascade
        if not np.isfinite(x).all():
            return
        if self.learning is not None:
            self.memory = replace(self.memory, estimate=self.learning.learnt)
        if self.waiting is not None:
            self.memory, admission = cascade.apply_gate(self.memory, self.waiting, x)
            self.admitted += admission.accepted
            self.refused += not admission.accepted
            self._use(t)
        self._ask(t, x, t + cascade.period)

    def _ask(self, t: float, x: FloatArray, later: float) -> None:
        """Ask at the time t for a plan to be used at another, s."""
        if self.estimator is not None:
            felt = tuple(self.estimator.felt.tolist())
            self.memory = replace(self.memory, disturbance=felt)
        ahead = self.cascade.predicted_error(self.memory, x, t, later)
        self.waiting = self.cascade.propose(self.memory, ahead, later)


def cascade_and_kept(
    cascade: Cascade, told: Bench | Estimator, x0: FloatArray
) -> tuple[MakeController, MakeController]:
    """Return the makers of the cascade and of its first optimum, kept: one search from x0, (2n,).

    Both are as :func:`undertow.runtime.for_rig` makes them for an estimator: the one that is
    ``told``, or that of what is told of the bench.

    Raises
    ------
    InfeasibleError
        When the first optimisation finds no admissible surface.
    """
    if isinstance(told, Bench):
        told = estimator_for(cascade.mechanism, told, known=cascade.known)
    suited = for_rig(cascade, told)
    state, proposal = suited.start(x0)
    start = suited.prepared(state, x0), proposal
    kept = keeping(suited.mechanism, start[0].plan, suited.reaching)
    return lambda _: CascadeSteering(suited, start), kept


class NMPC:
    """The optimal-control problem of one mechanism, warm-started from solution to solution.

    The objective gives the stage cost, its quadratic part the terminal cost; inputs count from the
    one that holds the target. A solution is made every ``period``, s, by at most ``iterations`` of
    the interior-point method, for a ``horizon``, s, in which an input is held for ``step``, s, at a
    time.

    Raises
    ------
    InvalidInputError
        For a stage cost that does not rise with every input, such as least time.
    ModelError
        For one with kinks, and where no linear feedback stabilises the mechanism.
    """

    def __init__(
        self,
        belief: Mechanism,
        objective: Objective,
        *,
        period: float = 0.1,
        step: float = 0.02,
        horizon: float = 1.2,
        iterations: int = 40,
    ) -> None:
        ca = require_extra("casadi", "bounds", "CasADi is not installed")
        self.period, self.step, self.count = period, step, round(horizon / step)
        self.size, self.m = 2 * belief.n, belief.m
        limit = belief.input_limits
        self._held = holding_input(belief)
        stage = objective.stage_cost(belief)
        P = _terminal(belief, stage, objective.name)
        rates = dynamics(ca, belief, stage.subs(_shifted(belief, self._held), simultaneous=True))
        x, u = ca.SX.sym("x", self.size), ca.SX.sym("u", self.m)
        k1 = rates(0.0, x, u)[0]
        k2 = rates(0.0, x + step / 2 * k1, u)[0]
        k3 = rates(0.0, x + step / 2 * k2, u)[0]
        k4 = rates(0.0, x + step * k3, u)[0]
        ahead = ca.Function("ahead", [x, u], [x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
        X, U = ca.MX.sym("X", self.size, self.count + 1), ca.MX.sym("U", self.m, self.count)
        x0 = ca.MX.sym("x0", self.size)
        gaps = X[:, 1:] - ahead.map(self.count)(X[:, :-1], U)
        stages = rates.map(self.count)(0.0, X[:, :-1], U)[1]
        cost = step * ca.sum2(stages) + ca.bilin(ca.DM(P), X[:, -1], X[:, -1])
        unknowns = ca.veccat(X, U)
        problem = {"x": unknowns, "p": x0, "f": cost, "g": ca.veccat(X[:, 0] - x0, gaps)}
        options: Any = {
            "ipopt": {
                "print_level": 0, "sb": "yes", "max_iter": iterations, "tol": 1e-4,
                "warm_start_init_point": "yes", "mu_strategy": "adaptive",
            },
            "print_time": False,
        }  # fmt: skip
        self._solve: Any = ca.nlpsol("nmpc", "ipopt", problem, options)
        high = np.concatenate(
            [np.full(self.size * (self.count + 1), np.inf), np.tile(limit, self.count)]
        )
        self._box = {"lbx": -high, "ubx": high, "lbg": 0.0, "ubg": 0.0}
        self.reset()

    def reset(self) -> None:
        """Forget all plans, and count the time from 0 again."""
        self._plan: FloatArray = np.tile(self._held, (self.count, 1))
        self._guess: FloatArray | None = None
        self._due = self._began = 0.0

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x): of the newest plan."""
        if t >= self._due - 1e-9 and np.isfinite(x).all():
            if self._guess is None:
                self._guess = np.append(np.tile(x, self.count + 1), self._plan)
            answer = self._solve(x0=self._guess, p=x, **self._box)
            self._guess = np.asarray(answer["x"]).ravel()
            states = self.size * (self.count + 1)
            self._plan = self._guess[states:].reshape(self.count, self.m)
            self._began, self._due = t, self._due + self.period
        k = min(int((t - self._began) / self.step + 1e-6), self.count - 1)
        return np.asarray(self._plan[k])


def _shifted(belief: Mechanism, held: FloatArray) -> dict[sp.Symbol, sp.Expr]:
    """What an input becomes that counts from ``held``, (m,)."""
    return {u: u - rest for u, rest in zip(belief.u, held.tolist(), strict=True) if rest}


def _terminal(belief: Mechanism, stage: sp.Expr, name: str) -> FloatArray:
    """Return the value function at the target of the cost's second-order part, (2n, 2n)."""
    symbols = [*belief.x, *belief.u]
    require_smooth(f"stage cost of '{name}'", [stage], symbols)
    hessian = sp.hessian(stage, symbols).subs(dict.fromkeys(symbols, 0))
    H = 0.5 * np.array(hessian, dtype=float)
    size = 2 * belief.n
    Q, R = H[:size, :size] + 1e-6 * np.eye(size), H[size:, size:]
    limits = finite_limits(belief)
    if not np.linalg.eigvalsh(R * np.outer(limits, limits)).min() > 0:
        raise InvalidInputError(
            f"stage cost of '{name}' for model-predictive control",
            value=f"∂²Φ/∂u² = {(2 * R).tolist()}",
            limit="positive definite at the target",
            remedy="Take one in which every input costs something, for instance "
            "undertow.objective_for(mechanism, 'bench-time')",
        )
    return _value(belief, Q, R)


def _value(belief: Mechanism, Q: FloatArray, R: FloatArray) -> FloatArray:
    """Return P of the least ∫ (xᵀQx + uᵀRu) dt = x₀ᵀPx₀ near the target, (2n, 2n)."""
    lin = linearise(belief)
    try:
        return np.asarray(scipy.linalg.solve_continuous_are(lin.A, lin.input, Q, R), np.float64)
    except np.linalg.LinAlgError as error:
        raise uncontrollable(belief) from error


@dataclass(frozen=True, eq=False)
class LinearFeedback:
    """u = u_0 + K x within the inputs' limits: u_0 and ``limits`` (m,), ``gains`` K (m, 2n)."""

    rest: FloatArray
    gains: FloatArray
    limits: FloatArray

    def __call__(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input at (t, x), (m,)."""
        return np.clip(self.rest + self.gains @ x, -self.limits, self.limits)


@dataclass(frozen=True, eq=False)
class Made:
    """A maker of controllers that gives the same one to each run, set back; with a name."""

    label: str
    controller: StateFeedback = field(repr=False)

    @property
    def __name__(self) -> str:
        """Its name, as that of a function that makes controllers."""
        return self.label

    def __call__(self, start: FloatArray) -> StateFeedback:
        """Return the controller of a run from ``start``."""
        if isinstance(self.controller, NMPC):
            self.controller.reset()
        return self.controller


def predictive(belief: Mechanism, objective: Objective, **settings: Any) -> MakeController:
    """Return the maker of an NMPC controller: the same one for each run, set back."""
    return Made("NMPC", NMPC(belief, objective, **settings))


def clipped_regulator(belief: Mechanism, free: float = 10.0) -> MakeController:
    """Return a linear-quadratic regulator, its output clipped: Q of the first surface.

    It acts about the input that holds the target.  ``free`` is the weight of the free coordinates.

    Raises
    ------
    ModelError
        Where no linear feedback stabilises the mechanism.
    """
    lin, rest = linearise(belief), holding_input(belief)
    n, m = belief.n, belief.m
    limit = belief.input_limits
    Q = np.diag([1.0] * m + [free] * (n - m) + [0.1] * n)
    R = np.diag(1.0 / finite_limits(belief) ** 2)
    k = -np.linalg.solve(R, lin.input.T @ _value(belief, Q, R))
    slowest = np.linalg.eigvals(lin.A + lin.input @ k).real.max()
    if not slowest < -UNCONTROLLABLE * np.linalg.norm(lin.A, 2):  # a mode that k does not reach
        raise uncontrollable(belief)

    return Made("LQR, clipped", LinearFeedback(rest, np.asarray(k, np.float64), limit))
