r"""Peers in the league, entered as anybody's controllers are: ``FILE.py:NAME``.

* :class:`RTI`: the real-time iteration of :mod:`predictive` at 100 Hz, CasADi and QRQP; it balances
  for ever, by the regulator's price at the end of its horizon.
* :class:`AcadosRTI`: the same by acados, where ``UNDERTOW_ACADOS`` names a Python that has it.
* :class:`ILQR`: iterative linear-quadratic regulation with its input box (Tassa, Mansard, Todorov,
  *Control-limited differential dynamic programming*, ICRA 2014), Gauss-Newton, five iterations at
  50 Hz, and its own feedback in between.
* :class:`MPPI`: path integral control (Williams et al., *Information-theoretic MPC*, ICRA 2017),
  256 rollouts of the compiled model at 50 Hz around the regulator's feedback.

    undertow campaign examples/campaigns/league.toml --out league.zarr --workers 2 \
        --entrant benchmarks/entrants.py:RTI --entrant benchmarks/entrants.py:ILQR \
        --entrant benchmarks/entrants.py:MPPI
"""

from __future__ import annotations

import os
from typing import Any, ClassVar

import numpy as np
import scipy.linalg

import undertow as ut
from predictive import Acados, RealTimeIteration
from rivals import dynamics
from undertow.models import FloatArray, linearise
from undertow.objective.named import ERROR_PRICE, finite_limits
from undertow.plants.stepping import compiled_module

__all__ = ["ILQR", "MPPI", "RTI", "AcadosRTI"]


def error_weight(mechanism: ut.Mechanism) -> float:
    """Return the weight of xᵀx beside uᵀu in the league's usual objective, ``effort``."""
    return ERROR_PRICE * float(finite_limits(mechanism).max()) ** 2


class RTI:
    """The real-time iteration, 100 Hz; its answers count as there at once."""

    settings: ClassVar = [{"horizon": h} for h in (1.0, 2.0, 4.0)]

    def __init__(self, mechanism: ut.Mechanism, objective: ut.Objective, horizon: float) -> None:
        self.mechanism = mechanism
        self.control = self._made(mechanism, horizon)

    def _made(self, mechanism: ut.Mechanism, horizon: float) -> RealTimeIteration:
        return RealTimeIteration(mechanism, {}, horizon, weight=error_weight(mechanism))

    def reset(self, x0: FloatArray) -> None:
        """Forget all plans."""
        self.control.forget()
        self.ticks = 0

    def step(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input of the newest plan; none where the mechanism has fallen."""
        if not np.all(np.abs(x) < 1e3):
            return np.zeros(self.mechanism.m)
        if t >= self.ticks * self.control.period - 1e-9:
            self.u = np.asarray(
                np.clip(self.control(t, x), -self.control.limits, self.control.limits)
            )
            self.ticks += 1
        return self.u


class AcadosRTI(RTI):
    """The real-time iteration by acados, 100 Hz."""

    def _made(self, mechanism: ut.Mechanism, horizon: float) -> RealTimeIteration:
        python = os.environ.get("UNDERTOW_ACADOS", "")
        return Acados(python, mechanism, {}, horizon, weight=error_weight(mechanism))


class _Receding:
    """A plan of held inputs that is bettered 50 times a second: ``improve`` is its method."""

    period, held = 0.02, 0.02

    def __init__(self, mechanism: ut.Mechanism, objective: ut.Objective, horizon: float) -> None:
        self.mechanism, self.count = mechanism, round(horizon / self.held)
        self.limits = finite_limits(mechanism)
        lin = linearise(mechanism)
        size = 2 * mechanism.n
        system = np.zeros((size + mechanism.m,) * 2)
        system[:size] = np.hstack([lin.A, lin.input]) * self.held
        moved = scipy.linalg.expm(system)
        self.Q, self.R = (
            ERROR_PRICE * self.held * np.eye(size),
            self.held * np.diag(self.limits**-2.0),
        )
        A, B = moved[:size, :size], moved[:size, size:]
        self.P = scipy.linalg.solve_discrete_are(A, B, self.Q, self.R)
        self.K = np.linalg.solve(self.R + B.T @ self.P @ B, B.T @ self.P @ A)

    def reset(self, x0: FloatArray) -> None:
        """Forget the plan."""
        self.U: FloatArray = np.zeros((self.count, self.mechanism.m))
        self.ticks = 0
        self.begin()

    def begin(self) -> None:
        """Begin a run."""

    def improve(self, x: FloatArray) -> None:
        """Better the plan ``U`` from the state."""
        raise NotImplementedError

    def between(self, x: FloatArray) -> FloatArray:
        """Return the input between two improvements."""
        raise NotImplementedError

    def step(self, t: float, x: FloatArray) -> FloatArray:
        """Return the input; none where the mechanism has fallen."""
        if not np.all(np.abs(x) < 1e3):
            return np.zeros(self.mechanism.m)
        if t >= self.ticks * self.period - 1e-9:
            if self.ticks:
                self.U = np.vstack([self.U[1:], self.U[-1:]])
            self.improve(x)
            self.ticks += 1
        return np.asarray(np.clip(self.between(x), -self.limits, self.limits))


class ILQR(_Receding):
    """Iterative LQR with clipped gains, and its feedback along the plan."""

    settings: ClassVar = [{"horizon": h} for h in (0.6, 1.0, 2.0)]

    def __init__(self, mechanism: ut.Mechanism, objective: ut.Objective, horizon: float) -> None:
        import casadi as ca

        super().__init__(mechanism, objective, horizon)
        f = dynamics(ca, mechanism)
        x, u = ca.SX.sym("x", 2 * mechanism.n), ca.SX.sym("u", mechanism.m)
        end, h = x, self.held / 2
        for _ in range(2):
            k1 = f(end, u)
            k2 = f(end + h / 2 * k1, u)
            k3 = f(end + h / 2 * k2, u)
            end = end + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(end + h * k3, u))
        self._move = ca.Function("move", [x, u], [end])
        slopes = ca.Function("slopes", [x, u], [ca.jacobian(end, x), ca.jacobian(end, u)])
        self._slopes = slopes.map(self.count)

    def begin(self) -> None:
        """Begin with the regulator's own plan."""
        self.cold = True
        self.X: FloatArray = np.zeros((self.count + 1, 2 * self.mechanism.n))
        self.gains: FloatArray = np.tile(-self.K, (self.count, 1, 1))

    def _cost(self, X: FloatArray, U: FloatArray) -> float:
        stage = np.einsum("ki,ij,kj", X[:-1], self.Q, X[:-1]) + np.einsum("ki,ij,kj", U, self.R, U)
        return float(stage + X[-1] @ self.P @ X[-1])

    def _policy(
        self, x: FloatArray, X: FloatArray, U: FloatArray, k: FloatArray, K: FloatArray, part: float
    ) -> tuple[FloatArray, FloatArray]:
        states, inputs = [x], []
        for i in range(self.count):
            u = np.clip(U[i] + part * k[i] + K[i] @ (states[-1] - X[i]), -self.limits, self.limits)
            inputs.append(u)
            states.append(np.array(self._move(states[-1], u)).ravel())
        return np.array(states), np.array(inputs)

    def improve(self, x: FloatArray) -> None:
        """Take some iterations from the plan as it is."""
        size, m = len(x), self.mechanism.m
        if self.cold:
            gains, X = self.gains, self.X
        else:
            gains = np.concatenate([self.gains[1:], self.gains[-1:]])
            X = np.vstack([self.X[1:], self.X[-1:]])
        X, U = self._policy(x, X, self.U, np.zeros((self.count, m)), gains, 0.0)
        for _ in range(20 if self.cold else 5):
            A, B = (np.array(part) for part in self._slopes(X[:-1].T, U.T))
            V, v = self.P, self.P @ X[-1]
            k, K = np.zeros((self.count, m)), np.zeros((self.count, m, size))
            for i in range(self.count - 1, -1, -1):
                Ai, Bi = A[:, i * size : (i + 1) * size], B[:, i * m : (i + 1) * m]
                qx, qu = self.Q @ X[i] + Ai.T @ v, self.R @ U[i] + Bi.T @ v
                H, G = self.R + Bi.T @ V @ Bi, Bi.T @ V @ Ai
                k[i] = np.clip(U[i] - np.linalg.solve(H, qu), -self.limits, self.limits) - U[i]
                free = np.abs(U[i] + k[i]) < self.limits * (1 - 1e-9)
                K[i] = -np.linalg.solve(H, G) * free[:, None]
                v = qx + K[i].T @ (H @ k[i] + qu) + G.T @ k[i]
                V = self.Q + Ai.T @ V @ Ai + K[i].T @ H @ K[i] + K[i].T @ G + G.T @ K[i]
                V = (V + V.T) / 2
            before = self._cost(X, U)
            for part in (1.0, 0.5, 0.25, 0.1):
                states, inputs = self._policy(x, X, U, k, K, part)
                after = self._cost(states, inputs)
                if np.isfinite(states).all() and after < before:
                    break
            else:
                break
            X, U, gains = states, inputs, K
            if after > (1 - 1e-4) * before:
                break
        self.X, self.U, self.gains, self.cold = X, U, gains, False

    def between(self, x: FloatArray) -> FloatArray:
        """Return the plan's input with its feedback."""
        return np.asarray(self.U[0] + self.gains[0] @ (x - self.X[0]))


_ROLL = """
@numba.njit(cache=True, error_model="numpy")
def roll(x0, U, noise, K, limits, h, parameters, Q, R, P, costs):
    # u = U + noise − K x, clipped; half a sample a step of Runge-Kutta.
    viscous, stage, total = np.zeros(n), np.zeros(2 * n), np.zeros(2 * n)
    qdd, u, x = np.zeros(n), np.zeros(m), np.zeros(2 * n)
    for s in range(noise.shape[0]):
        x[:] = x0
        cost = 0.0
        for k in range(U.shape[0]):
            for i in range(m):
                u[i] = U[k, i] + noise[s, k, i]
                for j in range(2 * n):
                    u[i] -= K[i, j] * x[j]
                u[i] = max(-limits[i], min(limits[i], u[i]))
                cost += R[i] * u[i] * u[i]
            for j in range(2 * n):
                cost += Q * x[j] * x[j]
            rk4_step(0.0, 0.5 * h, 0.0, n, x, u, viscous, parameters, stage, total, qdd)
            rk4_step(0.0, 0.5 * h, 0.0, n, x, u, viscous, parameters, stage, total, qdd)
        for i in range(2 * n):
            for j in range(2 * n):
                cost += x[i] * P[i, j] * x[j]
        costs[s] = cost if cost < 1e300 else 1e300
"""


class MPPI(_Receding):
    """Path integral control around the regulator: u = U + ε − K x, what is sampled is ε.

    Without the feedback no plan of an unstable mechanism survives a second of noise.
    """

    samples = 256
    settings: ClassVar = [
        {"horizon": h, "sigma": s} for h in (0.6, 1.2) for s in (0.05, 0.2)
    ]  # fmt: skip

    def __init__(
        self, mechanism: ut.Mechanism, objective: ut.Objective, horizon: float, sigma: float
    ) -> None:
        super().__init__(mechanism, objective, horizon)
        self.sigma = sigma * self.limits
        self._module: Any = compiled_module(mechanism, "mppi", "Path integral control", _ROLL)
        self._costs = np.zeros(self.samples)

    def begin(self) -> None:
        """Draw the same numbers in every run."""
        self._rng = np.random.default_rng(0)

    def improve(self, x: FloatArray) -> None:
        """Weigh random changes of the plan by what they cost."""
        shape = (self.samples, self.count, self.mechanism.m)
        noise = self._rng.standard_normal(shape) * self.sigma
        noise[0] = 0.0
        self._module.roll(
            x, self.U, noise, self.K, self.limits, self.held, self.mechanism.parameter_values,
            ERROR_PRICE * self.held, self.held * self.limits**-2.0, self.P, self._costs,
        )  # fmt: skip
        best = self._costs.min()
        spread = max(float(np.quantile(self._costs, 0.1)) - best, 1e-12)
        weights = np.exp(-(self._costs - best) / spread)
        self.U = self.U + np.tensordot(weights / weights.sum(), noise, 1)

    def between(self, x: FloatArray) -> FloatArray:
        """Return the plan's input with the regulator's feedback."""
        return np.asarray(self.U[0] - self.K @ x)
