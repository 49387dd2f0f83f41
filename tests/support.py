"""Factories shared by the tests: random mechanisms, surfaces for them, reference integrators."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.export import host
from undertow.models import FloatArray

#: (n, m) of the random systems on which the formulas are checked.
SHAPES = ((2, 1), (3, 1), (3, 2), (4, 2), (5, 2))

#: (t, x) to u: a control law as the reference integrators take it.
Feedback = Callable[[float, FloatArray], FloatArray]


def rest_slow(cases: Iterable[object], *quick: object) -> list[object]:
    """Parameters of a test: those that are not among the ``quick`` ones run with the slow tests."""
    return [
        case
        if case in quick
        else pytest.param(*(case if isinstance(case, tuple) else (case,)), marks=pytest.mark.slow)
        for case in cases
    ]


@contextmanager
def unoptimised() -> Iterator[None]:
    """C is compiled as it is for users, but for the time that optimising takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "FLAGS", (*host.FLAGS, "-Og"))
        yield


@lru_cache(maxsize=32)
def random_mechanism(
    n: int, m: int, seed: int = 0, *, damped: bool = True, prismatic: bool = False
) -> ut.Mechanism:
    """A mechanism drawn at random: Lagrangian, M(q) > 0 for every q, no input limit met easily.

    ``T = ½ Σ μ_i q̇_i² + ½ Σ_k M (1 + c_k cos(q_k)) (r_k · q̇)²`` with 0.5 ≤ μ_i and |c_k| < 1:
    a positive definite part plus positive semidefinite ones.  Coefficients are rationals, so
    symbolic results are exact.
    """
    rng = np.random.default_rng([n, m, seed])

    def draw(low: float, high: float) -> sp.Rational:
        return sp.Rational(round(100 * rng.uniform(low, high)), 100)

    unit = "m" if prismatic else "rad"
    coordinates = [ut.Coordinate(f"q{i}", unit if i == 0 else "rad") for i in range(n)]
    q = [c.symbol for c in coordinates]
    qd = [c.velocity for c in coordinates]
    scale = ut.Parameter("scale", 1.3, "kg", "size of the coupled inertia", low=0)
    friction = ut.Parameter("friction", 0.05 if damped else 0.0, "N m s/rad", low=-1e-12)
    kinetic = sum(draw(0.5, 1.5) * v**2 for v in qd) / 2
    for k in range(n):
        row = sum(draw(-1, 1) * v for v in qd)
        kinetic += scale.symbol * (1 + draw(-0.8, 0.8) * sp.cos(q[k])) * row**2 / 2
    potential = sum(draw(-2, 2) * sp.cos(angle) for angle in q)
    potential += draw(-1, 1) * sp.cos(q[0] - q[-1])
    gains = [[draw(0.5, 1.5) if i == j else draw(-0.3, 0.3) for j in range(m)] for i in range(m)]
    return ut.Mechanism.from_energies(
        f"random_{n}_{m}",
        coordinates,
        [ut.Input(f"u{i}", "N m", 1e4) for i in range(m)],
        kinetic,
        potential,
        dissipation=friction.symbol * sum(v**2 for v in qd) / 2,
        input_matrix=sp.ImmutableDenseMatrix(gains),
        parameters=(scale, friction),
    )


def random_surface(n: int, m: int, seed: int = 0) -> ut.Surface:
    """A surface with α_a near −I and a small α_u, so that Γ is seldom near singular."""
    rng = np.random.default_rng([n, m, seed, 7])
    return ut.Surface(
        -np.eye(m) + 0.2 * rng.standard_normal((m, m)),
        -np.eye(m) + 0.2 * rng.standard_normal((m, m)),
        0.3 * rng.standard_normal((m, n - m)),
        rng.standard_normal((m, n - m)),
    )


def random_states(
    mechanism: ut.Mechanism, count: int, seed: int = 0, *, position: float = 3.0, speed: float = 3.0
) -> FloatArray:
    """States (count, 2n), uniform in |q_i| ≤ position, |q̇_i| ≤ speed."""
    rng = np.random.default_rng([mechanism.n, seed, 11])
    reach = np.repeat([position, speed], mechanism.n)
    return rng.uniform(-reach, reach, (count, 2 * mechanism.n))


def corners(bounds: tuple[float, ...]) -> FloatArray:
    """All sign combinations of the bounds, (2ⁿ, n)."""
    return np.array(list(itertools.product(*((-b, b) for b in bounds))))


def derivative(mechanism: ut.Mechanism, t: float, x: FloatArray, u: FloatArray) -> FloatArray:
    """ẋ = (q̇, q̈) at states (…, 2n)."""
    return np.concatenate(
        [x[..., mechanism.n :], mechanism.accelerations(t, x, u)], axis=-1, dtype=float
    )


def runge_kutta(
    mechanism: ut.Mechanism,
    law: Feedback,
    x0: FloatArray,
    step: float,
    steps: int,
    *,
    hold: int = 0,
    start: float = 0.0,
) -> FloatArray:
    """The classical fourth-order method in NumPy, states at every step, (steps + 1, …, 2n).

    ``hold = 0`` evaluates ``law`` in every stage, otherwise every ``hold`` steps.
    """
    states = [np.asarray(x0, dtype=float)]
    u = np.zeros(mechanism.m)
    for k in range(steps):
        t, x = start + k * step, states[-1]
        if hold and k % hold == 0:
            u = law(t, x)

        def rate(time: float, state: FloatArray, held: FloatArray = u) -> FloatArray:
            return derivative(mechanism, time, state, held if hold else law(time, state))

        k1 = rate(t, x)
        k2 = rate(t + step / 2, x + step / 2 * k1)
        k3 = rate(t + step / 2, x + step / 2 * k2)
        k4 = rate(t + step, x + step * k3)
        states.append(x + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    return np.stack(states)


def observed_order(steps: FloatArray, errors: FloatArray) -> float:
    """Slope of log error over log step: the order of convergence."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def interpreted(loop: ut.ClosedLoop) -> ut.ClosedLoop:
    """The loop in fixed steps, its generated kernel run by Python: nothing is compiled."""
    loop = replace(loop, rtol=0.0)
    vars(loop)["_kernels"] = SimpleNamespace(rollout=loop._kernels.rollout.py_func)
    return loop


def runge_kutta_step(
    rate: Callable[[FloatArray, FloatArray], FloatArray],
    x: FloatArray,
    u: FloatArray,
    later: FloatArray,
    h: float,
) -> FloatArray:
    """One classical Runge-Kutta step of ẋ = rate(x, u), the input straight from u to ``later``."""
    middle = 0.5 * (u + later)
    first = rate(x, u)
    second = rate(x + 0.5 * h * first, middle)
    third = rate(x + 0.5 * h * second, middle)
    last = rate(x + h * third, later)
    return x + h / 6.0 * (first + 2.0 * second + 2.0 * third + last)


def bar(name: str, coordinates: tuple[str, str], channel: str, names: str) -> ut.Mechanism:
    """A pendulum on a cart under names of one's own, its two coordinates' and its parameters'."""
    x, tilt = ut.Coordinate(coordinates[0], "m", "*/ ??/"), ut.Coordinate(coordinates[1], "rad")
    values = zip(names.split(), (0.8, 0.3, 0.25), strict=True)
    M, m, l = (ut.Parameter(name, value, "kg\\", low=0) for name, value in values)  # noqa: E741
    moment, rate = m.symbol * l.symbol * sp.cos(tilt.symbol), tilt.velocity
    kinetic = (M.symbol + m.symbol) * x.velocity**2 / 2 + moment * x.velocity * rate
    return ut.Mechanism.from_energies(
        name, [x, tilt], [ut.Input(channel, "N", 10.0)],
        kinetic=kinetic + 2 * m.symbol * l.symbol**2 * rate**2 / 3, potential=9.81 * moment,
        parameters=(M, m, l), start={tilt.name: 0.1},
    )  # fmt: skip
