"""The earliest arrival over all inputs, as motions that a schedule of surfaces can follow.

Multiple shooting with inputs held between nodes, solved by sequential linear programs: what is
earliest lies at corners of its bounds, where linear programs converge fast.  A step is taken when
the gaps between the pieces stay within a funnel, which closes at the end, or shrink [1]_; one that
opens them is tried once more with the gaps that it made [2]_.

References
----------
.. [1] Gould and Toint, "Nonlinear programming without a penalty function or a filter",
   Math. Program. 122 (2010) 155-196.
.. [2] Fletcher, "Second order corrections for non-differentiable optimization", LNM 912 (1982).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undertow.closed_loop import Trajectory
from undertow.models import FloatArray, Mechanism

#: Nodes of a motion, and the longest Runge-Kutta step between them, s.
NODES, LONGEST = 30, 0.01

#: Samples of a part of a motion.
SAMPLES = 12

#: Sequential linear programs at most.
PROGRAMS = 200

#: Gaps between the pieces, as parts of the scale of the states, that a step may leave: while the
#: time shrinks, and in the end.
FUNNEL, CLOSED = 0.1, 1e-4

#: How much narrower a funnel wider than that gets with each step.
NARROWS = 0.9

#: Part of the terminal radius that is aimed for, and what missing it by itself counts as a gap.
INSIDE, MISS = 0.8, 0.05

#: How long a faster motion takes, in parts of what it is guessed from.
SOONER = 0.85

#: Step of the differences of the derivatives, in parts of the scales.
PROBE = 1e-6

#: The first trust region, in parts of the scales, and when it is given up.
TRUST, LOST = 0.3, 1e-5

#: A gain below this part of the time closes the funnel.
WORTHWHILE = 1e-3

#: What a gap costs in a linear program, in parts of the time.
PRICE = 100.0


@dataclass(frozen=True, eq=False)
class OpenLoopMotion:
    """States (N + 1, 2n) at equally spaced nodes until ``time``, s; inputs (N, m) between them."""

    time: float
    x: FloatArray
    u: FloatArray

    @classmethod
    def of(cls, trajectory: Trajectory, time: float) -> OpenLoopMotion:
        """Return a simulated motion until a time, s, as a guess."""
        nodes = np.linspace(0.0, time, NODES + 1)
        middles = (nodes[1:] + nodes[:-1]) / 2
        x = [np.interp(nodes, trajectory.t, column) for column in trajectory.x.T]
        u = [np.interp(middles, trajectory.t, column) for column in trajectory.u.T]
        return cls(time, np.array(x).T, np.array(u).T)

    def after(self, t: float, x: FloatArray) -> OpenLoopMotion:
        """Return what is left of it t seconds later, from a state x, (2n,): a guess."""
        nodes = np.linspace(t, self.time, NODES + 1)
        grid = np.linspace(0.0, self.time, NODES + 1)
        states = np.array([np.interp(nodes, grid, column) for column in self.x.T]).T
        states[0] = x
        pieces = ((nodes[1:] + nodes[:-1]) / 2 / self.time * NODES).astype(int)
        return OpenLoopMotion(self.time - t, states, self.u[np.minimum(pieces, NODES - 1)])

    def faster(self) -> OpenLoopMotion:
        """Return the same path in less time, a guess: there may be an earlier arrival nearby."""
        return self._in(SOONER, self.u)

    def with_inputs(self, part: float) -> OpenLoopMotion:
        """Return the same path with a part of the inputs, slower, a guess."""
        return self._in(1.0 / math.sqrt(part), part * self.u)

    def _in(self, times: float, u: FloatArray) -> OpenLoopMotion:
        """Return the same path in so many times the time, with other inputs."""
        x, n = self.x.copy(), self.x.shape[1] // 2
        x[1:, n:] /= times
        return OpenLoopMotion(times * self.time, x, u)

    def mirrored(self) -> OpenLoopMotion:
        """Return it reflected in the straight line to its end, a guess: the other way round."""
        straight = np.linspace(self.x[0], np.zeros_like(self.x[0]), NODES + 1)
        return OpenLoopMotion(self.time, 2 * straight - self.x, -self.u)


@dataclass(frozen=True, eq=False)
class EarliestArrival:
    """Looks for the inputs that bring a mechanism to ‖x‖₂ ≤ radius in the least time.

    ``mechanism``: the model, every input limited. ``radius``: ν of the terminal set. ``low``,
    ``high``: bounds of the states at the nodes, (2n,); infinite where there are none. ``late``:
    whether there is no time left for another linear program. ``part``: of the input limits, that
    the motion may take up.
    """

    mechanism: Mechanism
    radius: float
    low: FloatArray
    high: FloatArray
    late: Callable[[], bool] = lambda: False
    part: float = 1.0

    @property
    def limits(self) -> FloatArray:
        """Largest inputs of its motions, (m,)."""
        return self.part * self.mechanism.input_limits

    def state_at(self, motion: OpenLoopMotion, t: float) -> FloatArray:
        """Return the state of a motion at a time before its end, s: (2n,)."""
        piece = motion.time / NODES
        k = min(int(t / piece), NODES - 1)
        return self._flow(motion.x[k][:, None], motion.u[k][:, None], np.array([t - k * piece]))[
            :, 0
        ]

    def along(self, motion: OpenLoopMotion, t: float, end: float) -> tuple[FloatArray, FloatArray]:
        """Return states (2n, K) and accelerations (n, K) within a part of a motion, from t, s."""
        times = t + (np.arange(SAMPLES) + 0.5) / SAMPLES * (min(end, motion.time) - t)
        piece = motion.time / NODES
        k = np.clip((times / piece).astype(int), 0, NODES - 1)
        u = motion.u[k].T
        x = self._flow(motion.x[k].T, u, times - k * piece)
        return x, self._accelerations(x, u)

    def switches(self, motion: OpenLoopMotion) -> tuple[FloatArray, FloatArray]:
        """Return where inputs pass from one limit to the other: states (2n, K), (n, K).

        The latter are the accelerations with that input at zero.  A switch within a piece is
        where the limits before and after it make the piece's input in the mean.
        """
        limits, piece = self.limits, motion.time / NODES
        part = motion.u / limits
        states, inputs = [np.empty((2 * self.mechanism.n, 0))], [np.empty((len(limits), 0))]
        for k, i in zip(*np.nonzero(part[:-1] * part[1:] < 0), strict=True):
            mixed = k if abs(part[k, i]) < abs(part[k + 1, i]) else k + 1
            before = np.sign(part[k, i])
            u = motion.u[mixed].copy()
            u[i] = before * limits[i]
            passed = 0.5 * (1.0 + before * part[mixed, i]) * piece
            states.append(self._flow(motion.x[mixed][:, None], u[:, None], np.array([passed])))
            u[i] = 0.0
            inputs.append(u[:, None])
        x, u = np.hstack(states), np.hstack(inputs)
        return x, self._accelerations(x, u)

    def _accelerations(self, x: FloatArray, u: FloatArray) -> FloatArray:
        qdd = self.mechanism.function("dynamics")(0.0, *x, *u, *self.mechanism.parameter_values)
        return np.vstack([np.broadcast_to(entry, x.shape[1:]) for entry in qdd])

    def _flow(self, x: FloatArray, u: FloatArray, time: FloatArray) -> FloatArray:
        """Return the states (2n, K) after the times (K,), with the inputs (m, K) held."""
        n = self.mechanism.n

        def rate(x: FloatArray) -> FloatArray:
            return np.vstack([x[n:], self._accelerations(x, u)])

        steps = max(1, math.ceil(float(time.max()) / LONGEST))
        h = time / steps
        with np.errstate(all="ignore"):
            for _ in range(steps):
                k1 = rate(x)
                k2 = rate(x + h / 2 * k1)
                k3 = rate(x + h / 2 * k2)
                x = x + h / 6 * (k1 + 2 * (k2 + k3) + rate(x + h * k3))
        return x

    def improve(self, guess: OpenLoopMotion) -> OpenLoopMotion | None:
        """Return the earliest arrival near a guess, from its first state; ``None`` if it has gaps.

        What is found is a local optimum.
        """
        limits, radius = self.limits, INSIDE * self.radius
        x, u, T = (
            guess.x.T.copy(),
            np.clip(guess.u.T, -limits[:, None], limits[:, None]),
            guess.time,
        )
        cuts: list[FloatArray] = []

        def sized(x: FloatArray) -> FloatArray:
            """Scale of each state: an early motion is faster than its guess."""
            return np.asarray(np.maximum(np.abs(x).max(axis=1), radius))

        scale = sized(x)

        def gaps(x: FloatArray, u: FloatArray, T: float) -> tuple[FloatArray, float]:
            """Gaps between the pieces (N, 2n), and their sum, with what misses the target."""
            ends = self._flow(x[:, :-1], u, np.full(NODES, T / NODES))
            gap = ((ends - x[:, 1:]) / scale[:, None]).T
            miss = max(0.0, float(np.linalg.norm(x[:, -1])) / radius - 1.0)
            total = float(np.abs(gap).sum()) + MISS * miss
            return gap, total if math.isfinite(total) else math.inf

        gap, total = gaps(x, u, T)
        trust, funnel = TRUST, max(FUNNEL, total)
        retries = 0
        for _ in range(PROGRAMS):
            if self.late() or not math.isfinite(total):
                break
            program = self._program(x, u, T, gap, scale)
            taken = False
            while trust > LOST and not taken:
                corrected = gap
                for corrects in (False, True):
                    step = program.solve(corrected, trust, cuts, radius)
                    if step is None:
                        break
                    dx, du, dT = step
                    nx, nu, nT = x.copy(), u + du * limits[:, None], T * (1.0 + dT)
                    nx[:, 1:] += dx * scale[:, None]
                    miss = float(np.linalg.norm(nx[:, -1]))
                    if miss > radius:
                        cuts.append(nx[:, -1] / miss)
                    opened, sum_ = gaps(nx, nu, nT)
                    earlier = nT <= T or total > 0.5 * funnel
                    taken = (sum_ <= funnel and earlier) or (total > funnel and sum_ < 0.7 * total)
                    if taken or not math.isfinite(sum_):
                        break
                    if corrects:
                        break
                    corrected = corrected + opened - program.left(corrected, step)
                if step is None:
                    break
                trust = trust if taken else 0.4 * trust
            if not taken:
                if total <= CLOSED or retries == 2:
                    break
                retries, trust, funnel = retries + 1, TRUST, 0.3 * total
                continue
            gain = 1.0 - nT / T
            funnel = max(min(FUNNEL, funnel), NARROWS * funnel)
            x, u, T = nx, nu, nT
            scale = sized(x)
            gap, total = gaps(x, u, T)
            if not corrects:
                trust = min(1.0, 1.7 * trust)
            if abs(gain) < WORTHWHILE:
                if total <= CLOSED:
                    break
                funnel = max(0.1 * funnel, 0.5 * CLOSED)
        return OpenLoopMotion(T, x.T, u.T) if total <= 100 * CLOSED else None

    def _program(
        self, x: FloatArray, u: FloatArray, T: float, gap: FloatArray, scale: FloatArray
    ) -> _Program:
        """Linearise about nodes (2n, N + 1), inputs (m, N) and a time."""
        states, inputs = len(x), len(u)
        limits, columns = self.limits, states + inputs + 1
        moved, pushed = np.repeat(x[:, :-1], columns, axis=1), np.repeat(u, columns, axis=1)
        times = np.full(NODES * columns, T / NODES)
        for j in range(states):
            moved[j, j::columns] += PROBE * scale[j]
        for j in range(inputs):
            pushed[j, states + j :: columns] += PROBE * limits[j]
        times[columns - 1 :: columns] *= 1.0 + PROBE
        ends = self._flow(moved, pushed, times).reshape(states, NODES, columns)
        here = gap.T + x[:, 1:] / scale[:, None]
        slopes = (ends / scale[:, None, None] - here[:, :, None]) / PROBE
        room = (u / limits[:, None], (self.low[:, None] - x) / scale[:, None],
                (self.high[:, None] - x) / scale[:, None])  # fmt: skip
        return _Program(slopes, *room, x[:, -1], scale)


class _Program:
    """The linear program of one step: unknown are dx (2n, N), du (m, N), dT and moduli of gaps."""

    def __init__(
        self,
        slopes: FloatArray,
        used: FloatArray,
        low: FloatArray,
        high: FloatArray,
        end: FloatArray,
        scale: FloatArray,
    ) -> None:
        from scipy import sparse  # slow to import

        self.states, self.inputs = len(low), len(used)
        self.used, self.low, self.high, self.end, self.scale = used, low, high, end, scale
        states, inputs, count = self.states, self.inputs, self.states * NODES
        columns = count + inputs * NODES + 1
        node = np.arange(NODES)
        rows: list[NDArray[np.intp]] = []
        places: list[NDArray[np.intp]] = []
        values: list[FloatArray] = []

        def put(row: NDArray[np.intp], place: NDArray[np.intp], value: FloatArray) -> None:
            rows.append(row)
            places.append(place)
            values.append(value)

        for i in range(states):
            row = node * states + i
            for j in range(states):
                put(row[1:], (node[1:] - 1) * states + j, slopes[i, 1:, j])
            put(row, row, -np.ones(NODES))
            for j in range(inputs):
                put(row, count + node * inputs + j, slopes[i, :, states + j])
            put(row, np.full(NODES, columns - 1), slopes[i, :, -1])
        at = (np.concatenate(rows), np.concatenate(places))
        self._moves = sparse.csc_matrix((np.concatenate(values), at), shape=(count, columns))
        whole = sparse.identity(count, format="csc")
        self._equations = sparse.hstack([self._moves, whole, -whole], format="csc")
        self._prices = np.concatenate([np.zeros(columns - 1), [1.0], np.full(2 * count, PRICE)])

    def left(self, gap: FloatArray, step: tuple[FloatArray, FloatArray, float]) -> FloatArray:
        """Gaps (N, 2n) that a step leaves by the linear model."""
        dx, du, dT = step
        moved = self._moves @ np.concatenate([dx.T.ravel(), du.T.ravel(), [dT]])
        return np.asarray(gap + moved.reshape(NODES, self.states))

    def solve(
        self, gap: FloatArray, trust: float, cuts: list[FloatArray], radius: float
    ) -> tuple[FloatArray, FloatArray, float] | None:
        """Return the step (dx, du, dT), in parts of the scales, that closes the gaps (N, 2n).

        The end stays within a box of ``radius`` and on the near side of the cuts, directions (2n,):
        tangents to the terminal ball where earlier steps left it.
        """
        from scipy import sparse  # slow to import
        from scipy.optimize import linprog

        low = np.maximum(np.minimum(self.low[:, 1:], 0.0), -trust)
        high = np.minimum(np.maximum(self.high[:, 1:], 0.0), trust)
        low[:, -1] = (-radius - self.end) / self.scale
        high[:, -1] = (radius - self.end) / self.scale
        joined = np.concatenate
        count = self.states * NODES
        below = joined([low.T.ravel(), np.maximum(-1 - self.used, -4 * trust).T.ravel(),
                      [-0.5 * trust], np.zeros(2 * count)])  # fmt: skip
        above = joined([high.T.ravel(), np.minimum(1 - self.used, 4 * trust).T.ravel(),
                      [0.5 * trust], np.full(2 * count, math.inf)])  # fmt: skip
        sides: Any = None
        reach: Any = None
        bounds: Any = np.column_stack([below, above])
        if cuts:
            normals = np.array(cuts)
            near_end = sparse.csc_matrix(normals * self.scale)
            widths = count - self.states, len(below) - count
            empty = [sparse.csc_matrix((len(cuts), width)) for width in widths]
            sides = sparse.hstack([empty[0], near_end, empty[1]], format="csc")
            reach = radius - normals @ self.end
        found: Any = linprog(
            self._prices, A_ub=sides, b_ub=reach, A_eq=self._equations, b_eq=-gap.ravel(),
            bounds=bounds, method="highs-ds",
        )  # fmt: skip
        if found.status != 0:
            return None
        dx = found.x[:count].reshape(NODES, self.states).T
        du = found.x[count : count + self.inputs * NODES].reshape(NODES, self.inputs).T
        return dx, du, float(found.x[count + self.inputs * NODES])
