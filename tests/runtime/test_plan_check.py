"""The fast loop packs and tests plans itself: Routh's criterion against eigenvalues, forgeries."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import undertow as ut
from runs import RECIPE
from support import rest_slow
from undertow.cascade import Admission, CascadeState
from undertow.law import Plan, ReachingLaw, first_surface, sliding_matrix
from undertow.runtime import (
    Columns,
    Controller,
    Log,
    Runtime,
    SimulatedClock,
    about,
    replay,
)
from undertow.runtime.plan_check import PlanCheck, is_hurwitz
from undertow.runtime.slow_loop import Answer, law_vectors_of
from undertow.studies.fault_injection.cases import FaultyWorker

MECHANISMS = (
    "rotary_pendulum", "cart_pendulum", "overhead_crane", "pendubot", "acrobot",
    "reaction_wheel_pendulum", "tora", "ball_and_beam", "wheeled_inverted_pendulum",
    "double_pendulum_on_a_cart", "two_motor_three_link", "gantry_crane",
    "triple_pendulum_on_a_cart",
)  # fmt: skip


@pytest.mark.parametrize("name", MECHANISMS)
def test_routh_agrees_with_the_eigenvalues(name: str) -> None:
    """10⁴ random surfaces of every mechanism of the library, near and far from a stable one."""
    mechanism = getattr(ut.mechanisms, name)()
    test, rng = PlanCheck(mechanism, ReachingLaw()), np.random.default_rng(0)
    stable = first_surface(mechanism).vector
    spread = [stable * (1 + s * rng.normal(size=(2500, stable.size))) for s in (0.05, 0.3, 1.0)]
    wild = np.abs(stable).max() * rng.normal(size=(2500, stable.size))
    surfaces = np.concatenate([*spread, wild])
    eigenvalues = np.linalg.eigvals(sliding_matrix(mechanism, surfaces))
    worst, size = eigenvalues.real.max(axis=1), np.abs(eigenvalues).max(axis=1)
    found = np.array([test.stable(surface) for surface in surfaces])
    clear = np.abs(worst) > 1e-9 * size  # on the border rounding decides
    assert clear.mean() > 0.999
    np.testing.assert_array_equal(found[clear], worst[clear] < 0)
    assert 0.05 < found.mean() < 0.95


def test_routh_of_matrices_whose_eigenvalues_are_known() -> None:
    """Similar to diagonals from 1e-4 to 1e4, one of them moved across the axis."""
    rng = np.random.default_rng(1)
    for size in range(1, 9):
        work = np.zeros((size + 1, size + 1)), np.zeros((2, size + 1))
        for _ in range(50):
            roots = -(10.0 ** rng.uniform(-2, 2, size))
            basis = np.linalg.qr(rng.normal(size=(size, size)))[0]
            A = basis @ np.diag(roots) @ basis.T
            assert is_hurwitz(A.copy(), *work)
            roots[0] *= -1
            assert not is_hurwitz(basis @ np.diag(roots) @ basis.T, *work)
    for bad in (np.nan, np.inf, 0.0):
        assert not is_hurwitz(np.array([[bad]]), np.zeros((2, 2)), np.zeros((2, 2)))


@pytest.mark.parametrize("name", ["rotary_pendulum", "two_motor_three_link", "gantry_crane"])
def test_a_plan_is_packed_as_the_slow_loop_packs_it(name: str) -> None:
    """Bit for bit; det Γ(0), which both compute by themselves, to rounding."""
    mechanism = getattr(ut.mechanisms, name)()
    law = ReachingLaw(30.0, 0.2)
    cascade = ut.Cascade(mechanism, ut.MinimumTime(), law, belief="exact")
    surface = first_surface(mechanism)
    other = ut.Surface.from_vector(1.01 * surface.vector, mechanism.n, mechanism.m)
    test = PlanCheck(mechanism, law)
    plans = (
        Plan.of(surface),
        Plan((surface, other), (0.0, 0.1)),
        Plan((surface, other), (0.0, 0.1), (ReachingLaw(), ReachingLaw(5.0, 0.5))),
    )
    for plan in plans:
        law_vectors, expected = test.pack(plan), law_vectors_of(cascade, CascadeState(plan))
        np.testing.assert_array_equal(law_vectors[:, :-1], expected[:, :-1])
        np.testing.assert_allclose(law_vectors[:, -1], expected[:, -1], rtol=1e-12)
        assert test.fault(law_vectors) == ""
    for column, number in ((-2, 0.0), (-3, -1.0), (-1, 0.0), (-2, np.inf), (-3, np.nan)):
        law_vectors = test.pack(plans[0])
        law_vectors[0, column] = number
        assert test.fault(law_vectors)
    with pytest.raises(ValueError, match="switches by 'sign'"):
        test.pack(Plan((surface,), (0.0,), (ReachingLaw(switching="sign"),)))


@pytest.mark.parametrize("name", ["rotary_pendulum", "gantry_crane", "two_motor_three_link"])
def test_what_is_learnt_is_tested_with(name: str) -> None:
    """With other parameters det Γ(0) and stability are those of the mechanism that has them."""
    mechanism = getattr(ut.mechanisms, name)()
    cascade = ut.Cascade(mechanism, ut.MinimumTime())
    known = cascade.known
    assert known is not None
    rng = np.random.default_rng(3)
    estimate = replace(known.prior, offset=rng.uniform(-1, 1, len(known.tolerances)))
    other = known.believed(estimate)
    test = PlanCheck(mechanism, ReachingLaw())
    test.believe(known.values(estimate.offset))
    stable = first_surface(other)
    memory = CascadeState(Plan.of(stable), estimate=estimate)
    np.testing.assert_allclose(
        test.pack(memory.plan), law_vectors_of(cascade, memory), rtol=1e-12, atol=1e-12
    )
    surfaces = stable.vector * (1 + 0.3 * rng.normal(size=(500, stable.vector.size)))
    worst = np.linalg.eigvals(sliding_matrix(other, surfaces)).real.max(axis=1)
    found = np.array([test.stable(surface) for surface in surfaces])
    clear = np.abs(worst) > 1e-9
    np.testing.assert_array_equal(found[clear], worst[clear] < 0)
    nominal = PlanCheck(mechanism, ReachingLaw()).pack(memory.plan)[0, -1]
    assert abs(test.pack(memory.plan)[0, -1] - nominal) > 1e-3 * abs(nominal)  # they matter


# -- forged answers ------------------------------------------------------------------------------


def _admitted(answer: Answer, **changes: object) -> Answer:
    return replace(answer, admission=Admission(True, "forged", 0.0), **changes)  # type: ignore[arg-type]


def _law_vectors(factor: object) -> Callable[[Answer], Answer]:
    def change(answer: Answer) -> Answer:
        memory = replace(answer.memory, since=answer.use)
        return _admitted(answer, law_vectors=answer.law_vectors * np.asarray(factor), memory=memory)

    return change


def _flipped(answer: Answer) -> Answer:
    """Plan and numbers agree, and are not stable."""
    s = answer.memory.plan.surfaces[0]
    plan = Plan.of(ut.Surface(s.alpha_a, -s.lambda_a, s.alpha_u, -s.lambda_u))
    memory = replace(answer.memory, plan=plan, since=answer.use)
    return _admitted(answer, law_vectors=law_vectors_of(RECIPE.cascade, memory), memory=memory)


FORGERIES = {
    "all flipped": (_law_vectors([-1.0] * 4 + [1.0] * 3), "not those of its plan"),
    "λ flipped": (_law_vectors([1.0, -1.0, 1.0, -1.0, 1.0, 1.0, 1.0]), "not those of its plan"),
    "scaled": (_law_vectors(50.0), "not those of its plan"),
    "zero": (_law_vectors(0.0), "not those of its plan"),
    "one bit": (
        _law_vectors([1.0, 1.0 + 2.0**-52, 1.0, 1.0, 1.0, 1.0, 1.0]),
        "not those of its plan",
    ),
    "gain": (_law_vectors([1.0] * 4 + [2.0, 1.0, 1.0]), "not those of its plan"),
    "plan flipped": (_flipped, "not stable, by Routh's criterion"),
}


@pytest.mark.parametrize("name", rest_slow(FORGERIES, "one bit", "plan flipped"))
def test_a_forged_answer_is_refused_with_its_reason_and_counted(
    name: str, controller: Controller, tmp_path: Path
) -> None:
    """Admitted, or so it says: the plan in use stays, the run is degraded, its replay the same."""
    change, reason = FORGERIES[name]
    worker = FaultyWorker(RECIPE.respond, lambda answer: [(0.0, change(answer))], 0.25)
    meta = about(controller, RECIPE)
    with Log(tmp_path / "run.db", Columns.of(RECIPE.belief), meta, threaded=False) as book:
        runtime = Runtime(controller, RECIPE.make_rig(), worker, clock=SimulatedClock(), log=book)
        report = runtime.run(0.45)
    said = [text for _, kind, text in report.events if kind == "answer"]
    forged = [text for text in said if reason in text]
    assert all("refused, unsound" in text for text in forged)
    assert report.invalid_answers == len(forged) > 5
    assert sum("applied" in text for text in said) == len(said) - len(forged)
    assert all(reason in text for text in said[3:])
    assert report.verdict.ending == "degraded"
    assert report.verdict.exit_code == 6
    assert not replay(tmp_path / "run.db", decisions=False).differing


def test_an_old_answer_is_refused_under_a_new_number(controller: Controller) -> None:
    kept: list[Answer] = []

    def again(answer: Answer) -> list[tuple[float, Answer]]:
        kept.append(answer)
        first = kept[0]
        memory = replace(first.memory, sequence=answer.sequence)
        old = replace(first, sequence=answer.sequence, use=answer.use, x=answer.x, memory=memory)
        return [(0.0, _admitted(old))]

    worker = FaultyWorker(RECIPE.respond, again, 0.0)
    runtime = Runtime(controller, RECIPE.make_rig(), worker, clock=SimulatedClock())
    report = runtime.run(0.3)
    said = [text for _, kind, text in report.events if kind == "answer"]
    assert "applied" in said[0]
    assert all("its plan is of another time" in text for text in said[1:])
    assert len(said) > 2


def test_the_test_of_a_plan_takes_microseconds() -> None:
    """It comes after the output; of processor time, ten times what it takes."""
    for name in ("rotary_pendulum", "two_motor_three_link", "triple_pendulum_on_a_cart"):
        mechanism = getattr(ut.mechanisms, name)()
        test, plan = PlanCheck(mechanism, ReachingLaw()), Plan.of(first_surface(mechanism))
        times = []
        for _ in range(300):
            began = time.thread_time()
            assert test.fault(test.pack(plan)) == ""
            times.append(time.thread_time() - began)
        assert np.median(times) < 300e-6
