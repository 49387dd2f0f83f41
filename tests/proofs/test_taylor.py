"""Taylor models enclose what they stand for, err by third order, and prove nothing undefined."""

from __future__ import annotations

import numpy as np
import pytest
import sympy as sp

from undertow.base import InvalidInputError
from undertow.proofs.intervals.interval import ball, compile_outward
from undertow.proofs.intervals.taylor import TaylorProgram
from undertow.proofs.intervals.taylor_kernel import bounds, excluded
from undertow.symbolic import Tape

pytest.importorskip("flint", reason="ball arithmetic is the extra undertow[certify]")

x, y, z = sp.symbols("x y z", real=True)
p = sp.Symbol("p", real=True)
EXPRESSIONS = (
    x * y + z * sp.sin(x) * p,
    1 / (2 + x * y - z),
    sp.sqrt(3 + x + y**2),
    sp.exp(x - y) * sp.cos(z) - sp.cos(3 * z),
    sp.log(3 + x * z),
    sp.tanh(x + y + z),
    x**5 * y**2 - z**3 + sp.Rational(1, 3),
    sp.Abs(x + y),
    sp.Max(x, y * z) + sp.Min(x**2, y, sp.Rational(1, 10)),
    sp.tan(x / 2) ** 5 / (1 - p),
    sp.sin(p) ** 3 + sp.sqrt(p) + sp.Abs(-p) + sp.Max(p, 2) - sp.exp(p) * sp.log(p),
)  # the last is a number, folded before anything runs


def programs() -> tuple[TaylorProgram, object]:
    """The expressions on Taylor models (p = 0.7) and on balls."""
    tape = Tape()
    outputs = tape.let_all(EXPRESSIONS)
    models = TaylorProgram.of(tape, [x, y, z], [(p, 0.7)], outputs)
    return models, compile_outward(tape, [x, y, z, p], outputs)


def polynomial(model: np.ndarray, at: np.ndarray) -> float:
    """The polynomial part of one model of three variables."""
    i, j = np.triu_indices(3)
    return float(model[0] + model[1:4] @ at + model[4:10] @ (at[i] * at[j]))


def test_models_enclose_the_exact_values() -> None:
    """At random points and corners of random boxes: polynomial ± e holds the exact value."""
    models, exact = programs()
    rng = np.random.default_rng(0)
    for width in (0.8, 0.1, 1e-3, 1e-7, 0.0):
        middle, radius = rng.uniform(-1, 1, (3, 37)), width * rng.uniform(0.1, 1, (3, 37))
        a, b = middle - radius, middle + radius
        found = models(a, b)
        low, high = bounds(found, 3)
        for box in range(37):
            for part in (rng.uniform(-1, 1, 3), np.sign(rng.normal(size=3))):
                at = np.clip(middle[:, box] + part * radius[:, box], a[:, box], b[:, box])
                values = exact(*(ball(float(v)) for v in at), ball(0.7))  # type: ignore[operator]
                for o, value in enumerate(map(float, values)):
                    model = found[o, :, box]
                    if not np.isfinite(model[-1]):
                        continue
                    assert low[o, box] <= value <= high[o, box]
                    if width >= 1e-3:  # below, `part` itself is rounded too much
                        assert abs(polynomial(model, part) - value) <= model[-1] + 1e-12


def test_the_error_is_of_third_order() -> None:
    """Boxes of half the width: e falls to an eighth; small boxes end at rounding."""
    tape = Tape()
    outputs = tape.let_all(EXPRESSIONS[:7])
    models = TaylorProgram.of(tape, [x, y, z], [(p, 0.7)], outputs)
    middle = np.array([[0.3], [-0.4], [0.5]])
    rests = [models(middle - r, middle + r)[:, -1, 0] for r in (0.04, 0.02, 0.01, 1e-9)]
    assert (rests[0] / rests[1] > 7.0).all()
    assert (rests[1] / rests[2] > 7.0).all()
    assert (rests[3] < 3e-10).all()


def test_what_is_undefined_on_a_box_has_no_bounds() -> None:
    """Poles, roots and logarithms of what may be negative, overflow: never a finite claim."""
    tape = Tape()
    rows = [1 / x, sp.sqrt(x), sp.log(x), sp.sin(1 / x), (1 / x) ** 3, sp.exp(900 + x) * x]
    program = TaylorProgram.of(tape, [x], [], tape.let_all(rows))
    low, high = bounds(program(np.array([[-1.0, np.nan]]), np.array([[1.0, np.nan]])), 1)
    with np.errstate(invalid="ignore"):
        assert not (low > -1e100).any()
        assert not (high < 1e100).any()


@pytest.mark.parametrize("centre", [1e80, 1.1e127, 1e-80])
def test_magnitudes_whose_powers_vanish_have_no_bounds(centre: float) -> None:
    """Remainders of roots, reciprocals and logarithms underflow there: none is claimed."""
    tape = Tape()
    program = TaylorProgram.of(tape, [x], [], tape.let_all([1 / x, sp.sqrt(x), sp.log(x)]))
    low, high = bounds(program(np.array([[0.9 * centre]]), np.array([[1.1 * centre]])), 1)
    assert not np.isfinite(low).any()
    assert not np.isfinite(high).any()


def test_a_program_of_too_many_variables_is_refused() -> None:
    """The bound on rounding errors is for sums of few terms."""
    many = sp.symbols("v0:9", real=True)
    with pytest.raises(InvalidInputError, match="variables"):
        TaylorProgram.of(Tape(), many, [], [many[0]])


def test_excluded_boxes_hold_no_point_of_the_ring() -> None:
    """f ≥ 0, a ≤ 1 ≤ b with rests at their worst: never on an excluded box; many are excluded.

    Random models near the place where all three signs change, at random points and corners;
    where no bound alone settles it too.
    """
    rng = np.random.default_rng(2)
    models = rng.normal(size=(3, 11, 20_000)) * rng.uniform(0.01, 1, (3, 1, 20_000))
    models[:, 4:10] *= 0.3
    models[:, 10] = np.abs(models[:, 10]) * 0.2
    models[1:, 0] += 1.0
    out = excluded(models, 3)
    at = rng.uniform(-1, 1, (400, 3))
    at[:200] = np.sign(at[:200]) * np.abs(at[:200]) ** 0.1
    i, j = np.triu_indices(3)
    monomials = np.hstack([np.ones((400, 1)), at, at[:, i] * at[:, j]])
    f, a, b = np.einsum("pk,okb->opb", monomials, models[:, :10])
    ring = (f + models[0, 10] >= 0) & (a - models[1, 10] <= 1) & (b + models[2, 10] >= 1)
    empty = ~ring.any(axis=0)
    assert empty[out].all()
    low, high = bounds(models, 3)
    plain = (high[0] < 0) | (low[1] > 1) | (high[2] < 1)
    assert (out & ~plain).sum() > 400
