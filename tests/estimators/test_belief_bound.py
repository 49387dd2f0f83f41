"""What a bound on the unexplained rules out, on many random runs: never the truth.

Samples leave slabs of parameters, |Δq̇ − predicted(θ)| ≤ w, and what all slabs leave lies in the box
that a belief with a bound keeps (bounded-error estimation: E. Fogel and Y. F. Huang,
*Automatica* 18(2), 1982; L. Jaulin, M. Kieffer, O. Didrit and É. Walter, *Applied Interval
Analysis*, 2001).  The figures are printed by

    python -m pytest -s -m slow tests/estimators/test_belief_bound.py
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import linprog

import undertow as ut
from support import runge_kutta_step
from undertow.base import InvalidInputError
from undertow.estimators import Belief, KalmanFilter, ParameterEstimate
from undertow.estimators.belief import AXES, LEAST, SLIPS, _contracted
from undertow.models import FloatArray
from undertow.runtime.encoding import _estimate_from, _plain

SPREAD = {
    "cart_pendulum": {"m_c": 0.1, "m_p": 0.2, "b_c": 0.5},
    "rotary_pendulum": {"m": 0.2, "l": 0.05, "I_e": 0.2, "a_e": 0.1, "d_e": 0.5},
}
KINDS = ("none", "even", "signs", "one sign", "outward")
#: Runs of each mechanism and kind of noise; samples, in two pieces, and how long each is, s.
RUNS, SAMPLES, PERIOD = 1000, 50, 0.002


def bounded(name: str, part: float = 1.0) -> Belief:
    """Return a belief with a bound, by default the usual deviation of the noise."""
    belief = Belief.relative(ut.mechanisms.LIBRARY[name](), **SPREAD[name])
    return replace(belief, bound=tuple((part * belief.deviations).tolist()))


def motions(
    belief: Belief, truth: FloatArray, kind: str, rng: np.random.Generator, size: float = 1.0
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return t, (N + 1,), states and inputs, (runs, N + 1, …), of plants with offsets (runs, p).

    Inputs wander; velocities change by up to ``size`` bounds more than the model says in each
    sample: as if the truth were farther out, in the noise ``"outward"``.
    """
    rig, runs = belief.mechanism, len(truth)
    n, rates = rig.n, rig.function("dynamics")
    t: FloatArray = np.linspace(0.0, SAMPLES * PERIOD, SAMPLES + 1)
    waves = np.multiply.outer(t, np.array([9.0, 23.0, 51.0]))[:, None, None]
    shift = rng.uniform(0.0, 6.0, (runs, rig.m, 3))
    u = 0.3 * rig.input_limits * np.sin(waves + shift).sum(axis=-1)
    x: FloatArray = np.empty((SAMPLES + 1, runs, 2 * n))
    x[0] = rng.uniform(-0.5, 0.5, x[0].shape)
    farther = truth + 1e-4 * np.sign(truth)
    constant = rng.choice([-1.0, 1.0], (runs, n))
    most = size * np.broadcast_to(np.asarray(belief.bound, dtype=float), n)

    def rate(y: FloatArray, v: FloatArray, offsets: FloatArray = truth) -> FloatArray:
        values = belief.values(offsets).T
        qdd = [np.broadcast_to(row, runs) for row in rates(0.0, *y.T, *v.T, *values)]
        return np.column_stack([y[:, n:], *qdd])

    for k in range(SAMPLES):
        x[k + 1] = runge_kutta_step(rate, x[k], u[k], u[k + 1], PERIOD)
        part: FloatArray = np.zeros((runs, n))
        if kind == "even":
            part = rng.uniform(-1.0, 1.0, (runs, n))
        elif kind == "signs":
            part = rng.choice([-1.0, 1.0], (runs, n))
        elif kind == "one sign":
            part = constant
        elif kind == "outward":
            part = np.sign(rate(x[k], u[k], farther) - rate(x[k], u[k]))[:, n:]
        x[k + 1, :, n:] += most * part
    return t, np.asarray(x.swapaxes(0, 1)), np.asarray(u.swapaxes(0, 1))


def learnt(
    belief: Belief, t: FloatArray, x: FloatArray, u: FloatArray, before: ParameterEstimate
) -> ParameterEstimate:
    """Return what two pieces teach."""
    half = SAMPLES // 2
    for piece in (slice(0, half + 1), slice(half, SAMPLES + 1)):
        before = belief.learn(before, t[piece], x[piece], u[piece])
    return before


def holds(estimate: ParameterEstimate, truth: FloatArray) -> bool:
    """Whether the truth is in the box."""
    return bool(((estimate.low <= truth) & (truth <= estimate.high)).all())


@pytest.mark.slow
@pytest.mark.parametrize("name", SPREAD)
def test_the_truth_is_in_the_box_in_every_run(name: str) -> None:
    """Of 5000 runs each, whatever noise within the bound does; and estimates stay in the box."""
    belief = bounded(name)
    size = len(belief.tolerances)
    print(f"\n{name}: of {RUNS} runs, those with the truth in the box; its volume, of the prior's,")
    print("in the median and the best tenth; its sides in the median")
    for seed, kind in enumerate(KINDS):
        rng = np.random.default_rng([seed, size])
        truth = rng.uniform(-1.0, 1.0, (RUNS, size))
        t, x, u = motions(belief, truth, kind, rng)
        sides, inside = np.empty((RUNS, size)), 0
        for run, offset in enumerate(truth):
            estimate = learnt(belief, t, x[run], u[run], belief.prior)
            assert estimate.contradictions == 0
            assert holds(estimate, estimate.offset)
            assert holds(belief.prior, estimate.low)
            assert holds(belief.prior, estimate.high)
            inside += holds(estimate, offset)
            sides[run] = 0.5 * (estimate.high - estimate.low)
        volume = np.quantile(sides.prod(axis=1), [0.5, 0.1])
        print(f"{kind:9s}{inside:6d}   {volume.round(3)}   {np.median(sides, axis=0).round(2)}")
        assert inside == RUNS
        assert volume[0] < 0.9


@pytest.mark.slow
@pytest.mark.parametrize("name", SPREAD)
def test_a_bound_that_is_too_small_is_noticed(name: str) -> None:
    """Of 200 runs with noise of several bounds, few lose the truth and say nothing."""
    belief = bounded(name)
    size = len(belief.tolerances)
    for factor in (2.0, 4.0, 16.0):
        rng = np.random.default_rng([int(factor), size])
        truth = rng.uniform(-1.0, 1.0, (200, size))
        t, x, u = motions(belief, truth, "signs", rng, factor)
        counts = {"noticed": 0, "in the box": 0, "dropped": 0}
        for run, offset in enumerate(truth):
            estimate = learnt(belief, t, x[run], u[run], belief.prior)
            noticed = estimate.contradictions > 0
            counts["noticed"] += noticed
            counts["in the box"] += not noticed and holds(estimate, offset)
            counts["dropped"] += not noticed and not holds(estimate, offset)
        print(f"\n{name}, noise of {factor:g} bounds: {counts}")
        assert counts["dropped"] < 100
        assert counts["noticed"] > 0


@pytest.mark.parametrize("name", SPREAD)
def test_the_box_has_that_of_linear_programming_in_it(name: str) -> None:
    """The same slabs, by SciPy: none of what they leave is lost."""
    belief = bounded(name, 0.3)
    size = len(belief.tolerances)
    rng = np.random.default_rng(7)
    t, x, u = motions(belief, rng.uniform(-1.0, 1.0, (4, size)), "even", rng)
    ratios = []
    for y, v in zip(x, u, strict=True):
        slope, rest, width = belief._slabs(belief.prior.low, belief.prior.high, t, y, v)
        box = _contracted(slope, rest, width)
        assert box is not None
        slope, rest = slope / width[:, None], rest / width
        A, b = np.vstack([slope, -slope]), np.concatenate([1.0 + rest, 1.0 - rest])
        exact = [linprog(s * e, A, b, bounds=(-1, 1)).fun for e in np.eye(size) for s in (1, -1)]
        low, high = np.array(exact[::2]), -np.array(exact[1::2])
        assert (box[0] <= low + 1e-7).all()
        assert (box[1] >= high - 1e-7).all()
        ratios.append(((box[1] - box[0]) / (high - low)).prod())
    print(f"\n{name}: volume of the box over that of linear programming {np.round(ratios, 2)}")


def test_slabs_that_leave_nothing() -> None:
    """Two that are apart are empty, and one without slope that excludes 0; wide ones do nothing."""
    slope, width = np.array([[1.0, 0.0], [1.0, 0.0]]), np.array([0.1, 0.1])
    assert _contracted(slope, np.array([-0.5, 0.5]), width) is None
    assert _contracted(0.0 * slope, np.array([0.0, 0.2]), width) is None
    box = _contracted(slope, np.array([0.0, 0.1]), width)
    assert box is not None
    np.testing.assert_allclose(box, [[0.0, -1.0], [0.1, 1.0]], atol=1e-12)
    box = _contracted(slope, np.zeros(2), 5.0 + width)
    assert box is not None
    np.testing.assert_array_equal(box, [[-1.0, -1.0], [1.0, 1.0]])


@pytest.mark.parametrize("name", SPREAD)
def test_what_is_not_linear_is_within_the_width(name: str) -> None:
    """Over random boxes, in the middle and at the corners: half of what is allowed, at most."""
    belief, rng = bounded(name, 1e-6), np.random.default_rng(3)
    n, size, worst = belief.mechanism.n, len(belief.tolerances), 0.0
    t, x, u = motions(belief, rng.uniform(-1.0, 1.0, (20, size)), "none", rng)
    for y, v in zip(x[:, 0], u[:, 0], strict=True):  # that do not move: nothing to integrate
        middle, half = rng.uniform(-0.5, 0.5, size), rng.uniform(0.0, 0.5, size)
        slope, rest, width = belief._slabs(
            middle - half, middle + half, t[:2], np.tile(y, (2, 1)), np.tile(v, (2, 1))
        )
        z = np.vstack([rng.uniform(-1, 1, (40, size)), rng.choice([-1.0, 1.0], (40, size))])
        values = belief.values(middle + half * z).T
        entries = belief.mechanism.function("mass")(0.0, *y, *values)
        mass = np.stack([np.broadcast_to(m, 80) for m in entries], axis=-1).reshape(80, n, n)
        rates = belief.mechanism.function("dynamics")(0.0, *y, *v, *values)
        error = -PERIOD * mass @ np.stack([np.broadcast_to(r, 80) for r in rates], -1)[..., None]
        worst = max(worst, (np.abs(error[..., 0] - (rest - z @ slope.T)) / width).max())
    print(f"\n{name}: {worst:.2f} of the width at most")
    assert worst < 1.0


@pytest.mark.parametrize("name", SPREAD)
def test_a_plant_that_changes_is_followed(name: str) -> None:
    """From one corner of the tolerances to the other: the box has the new truth in the end.

    Not at once in every run: for a while a wrong plant in the old box may explain the motion.
    """
    belief = bounded(name, 0.5)
    size, rng = len(belief.tolerances), np.random.default_rng(2)
    corner = 0.95 * np.ones((8, size))
    t, x, u = motions(belief, -corner, "even", rng)
    estimates = [learnt(belief, t, y, v, belief.prior) for y, v in zip(x, u, strict=True)]
    assert all(each.contradictions == 0 and holds(each, -corner[0]) for each in estimates)
    right = []
    for _ in range(6):
        t, x, u = motions(belief, corner, "even", rng)
        estimates = [
            learnt(belief, t, y, v, before) for y, v, before in zip(x, u, estimates, strict=True)
        ]
        right.append(sum(holds(each, corner[0]) for each in estimates))
        assert all(holds(each, each.offset) for each in estimates)
    print(f"\n{name}: of 8 runs with the truth in the box, after each tenth of a second: {right}")
    assert all(each.contradictions > 0 for each in estimates)
    assert right[-1] == 8


def test_a_plant_beyond_the_tolerances_is_found_all_the_same() -> None:
    """The box grows to the estimate, and says that the tolerances were contradicted."""
    belief = bounded("cart_pendulum", 0.2)
    rng = np.random.default_rng(0)
    t, x, u = motions(belief, np.array([[4.0, 0.0, 0.0]]), "none", rng)
    estimate = learnt(belief, t, x[0], u[0], belief.prior)
    assert estimate.contradictions > 0
    assert estimate.offset[0] == pytest.approx(4.0, abs=1.0)
    assert holds(estimate, estimate.offset)
    assert np.isfinite(belief.ensemble(estimate).values).all()


def test_the_ensemble_spans_the_box() -> None:
    """Each side is reached by half of the corners, and a fifth of a tolerance is the least."""
    belief = bounded("rotary_pendulum")
    offset = np.array([0.1, -0.2, 0.0, 0.95, 0.3])
    low, high = np.array([-1.0, -0.4, -0.05, 0.5, -0.7]), np.array([1.0, 0.0, 0.05, 1.0, 0.9])
    estimate = replace(belief.prior, offset=offset, low=low, high=high)
    values = belief.ensemble(estimate).values - belief.mechanism.parameter_values
    corners = values[1 + SLIPS :, belief.places] / belief._scale
    np.testing.assert_allclose(corners.max(axis=0), np.minimum(1, np.maximum(high, offset + LEAST)))
    np.testing.assert_allclose(corners.min(axis=0), np.minimum(low, offset - LEAST))
    assert ((corners > offset).sum(axis=0) == len(corners) // 2).all()
    with pytest.raises(InvalidInputError, match="without low and high"):
        belief.ensemble(replace(belief, bound=None).prior)


def test_of_many_parameters_those_that_matter_span_the_ensemble() -> None:
    """The others stay as estimated."""
    rig = ut.mechanisms.LIBRARY["triple_pendulum_on_a_cart"]()
    belief = replace(Belief.usual(rig), bound=0.01)
    assert len(belief.tolerances) > AXES
    corners = belief.ensemble(belief.prior).values[1 + SLIPS :]
    moved = (corners != rig.parameter_values).any(axis=0)
    assert moved.sum() == AXES


def test_without_a_bound_nothing_is_ruled_out() -> None:
    """And a bound that nothing exceeds leaves the estimate as it would be without, to the bit."""
    belief = bounded("rotary_pendulum")
    rng = np.random.default_rng(1)
    t, x, u = motions(belief, rng.uniform(-0.9, 0.9, (1, 5)), "even", rng)
    free = replace(belief, bound=None)
    plain = learnt(free, t, x[0], u[0], free.prior)
    assert plain.low.size == plain.high.size == plain.contradictions == 0
    wide = replace(belief, bound=10.0)
    same = learnt(wide, t, x[0], u[0], wide.prior)
    assert np.array_equal(same.offset, plain.offset)
    assert np.array_equal(same.information, plain.information)
    assert (same.low == -1.0).all()
    assert (same.high == 1.0).all()


def test_what_a_bound_cannot_be_and_where_it_is_refused() -> None:
    """Not positive, or of another shape; a Kalman filter says what to do; a log keeps the box."""
    belief = bounded("rotary_pendulum")
    for wrong in (0.0, -1.0, np.nan, np.inf, (0.1,), (0.1, 0.0)):
        with pytest.raises(InvalidInputError, match="bound of a belief"):
            replace(belief, bound=wrong)
    with pytest.raises(InvalidInputError, match="bound of Belief"):
        replace(belief, bound="small")  # type: ignore[arg-type]
    with pytest.raises(InvalidInputError, match="bound=None"):
        KalmanFilter(belief.mechanism, belief=belief)
    KalmanFilter(belief.mechanism, belief=replace(belief, bound=None))
    x = np.zeros((3, 4))
    with pytest.raises(InvalidInputError, match=r"Belief\.prior"):
        belief.learn(replace(belief, bound=None).prior, np.arange(3.0), x, x[:, :1])
    for prior in (replace(belief.prior, contradictions=2), replace(belief, bound=None).prior):
        again = _estimate_from(_plain(prior))
        assert np.array_equal(again.low, prior.low)
        assert np.array_equal(again.high, prior.high)
        assert again.contradictions == prior.contradictions
    x[1] = np.nan
    assert belief.learn(belief.prior, np.arange(3.0), x, x[:, :1]) is belief.prior
