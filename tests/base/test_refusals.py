"""What cannot be right is refused, or counted as broken, and never passes in silence."""

from __future__ import annotations

import copy
import math
import pickle
import types
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from support import interpreted
from undertow.base import InvalidInputError, UndertowError, UnstableSurfaceError
from undertow.cascade import Update
from undertow.closed_loop.gate import broken_by
from undertow.closed_loop.trajectory import Batch
from undertow.models import TIME
from undertow.optimiser.search import POLISH
from undertow.plants import Bench, Friction
from undertow.studies.motion import ended


@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_constraint_that_is_not_a_number_is_broken(rig: ut.Mechanism, compiled: bool) -> None:
    """w(x, u) = NaN, here 0 · ∞, stops the motion: NaN is no satisfied constraint."""
    odd = ut.Constraint("odd", lambda v: v.theta * (v.phi + 1e200) ** 2)
    loop = ut.ClosedLoop(rig, ut.MinimumTime(constraints=(odd,)))
    if not compiled:
        loop = interpreted(loop)
    with np.errstate(over="ignore", invalid="ignore"):
        run = loop.batch(rig.state(phi=0.2), [ut.first_surface(rig)], duration=0.02)
    assert run.event[0] == ut.Event.CONSTRAINT
    assert np.isnan(run.path[0, 0])


def test_the_step_must_follow_the_gains_of_the_disturbance_bounds(rig: ut.Mechanism) -> None:
    """k of (13), not η alone, sets the fastest rate k/ε; half the named step resolves it.

    Inside the layer s then falls to nothing without a change of sign.
    """
    bounded = rig.with_disturbance_bounds(0.5, 0.2)
    surface = ut.first_surface(bounded)
    x0 = bounded.state(theta=0.08 / surface.lambda_a.item())
    with pytest.raises(InvalidInputError, match=r"gains \(13\)") as refusal:
        ut.ClosedLoop(bounded, reaching=ut.ReachingLaw()).simulate(x0, surface)
    limit = float(str(refusal.value.limit).split("=")[1].split()[0])
    assert limit < 2 * 0.1 / 20  # what η alone would ask for
    loop = interpreted(ut.ClosedLoop(bounded, reaching=ut.ReachingLaw(), step=limit / 2))
    s = loop.simulate(x0, surface, duration=10 * limit).s[:-1, 0]
    assert s[0] == pytest.approx(0.08)
    assert (np.diff(s) < 0).all()
    assert 0 < s[-1] < 1e-3 * s[0]


def test_a_coordinate_may_be_called_x() -> None:
    """On a cart, v.x is the position of the cart and v.states is the whole state."""
    cart = ut.mechanisms.cart_pendulum()
    goal = ut.Objective(
        "own", lambda v: (v.states.T * v.states)[0], constraints=ut.state_box(x=0.5)
    )
    assert goal.stage_cost(cart) == sum(symbol**2 for symbol in cart.x)
    loop = interpreted(ut.ClosedLoop(cart, goal))
    run = loop.simulate(cart.state(x=0.49, x_dot=1.0), ut.first_surface(cart), duration=0.1)
    assert run.event == ut.Event.CONSTRAINT
    assert run["x"][-2] <= 0.5 < run["x"][-1]
    assert run.ending == "constraint |x| ≤ 0.5"


def test_a_motion_names_what_it_breaks_of_what_bounds_its_input(rig: ut.Mechanism) -> None:
    """Of two constraints the one on the input; where all hold it is the hard limit."""
    small = ut.Constraint("small voltage", lambda v: v.voltage**2 - 1)
    large = ut.Constraint("large voltage", lambda v: v.voltage**2 - 1e4)
    for bounds, ending in (
        ((small, large), "constraint small voltage"),
        ((large,), "constraint the hard input limit"),
    ):
        goal = ut.MinimumTime(constraints=bounds, hard_input=True)
        loop = interpreted(ut.ClosedLoop(rig, goal))
        run = loop.simulate(rig.state(phi=0.8), ut.first_surface(rig), duration=0.02)
        assert run.ending == ending
        assert f", {ending}, cost" in repr(run)
        assert ended(run, goal) == f"broke {ending.removeprefix('constraint ')}, at 0.000 s"


def test_a_gate_names_what_a_prediction_breaks(rig: ut.Mechanism) -> None:
    """The constraint with a margin that is not ≥ 0; the hard limit where all are; else nothing."""
    bounds = ut.state_box(theta=1.0, phi=0.5)
    loop = ut.ClosedLoop(rig, ut.MinimumTime(constraints=bounds))
    path = np.array([[0.1, -0.01], [0.1, np.nan], [0.1, 0.2], [-0.1, 0.2]])
    event = np.array([ut.Event.CONSTRAINT] * 3 + [ut.Event.REACHED])
    batch = cast(Batch, SimpleNamespace(event=event, path=path))
    found = [broken_by(loop, batch, k) for k in range(4)]
    assert found == ["|phi| ≤ 0.5", "|phi| ≤ 0.5", "the hard input limit", ""]


@pytest.mark.parametrize("evaluations", [300, 6000])
def test_a_budget_is_spent_and_not_exceeded(rig: ut.Mechanism, evaluations: int) -> None:
    """A global search uses the evaluations it is given, to one generation, or has converged."""
    optimiser = ut.Optimiser(ut.ClosedLoop(rig, ut.MinimumTime()))
    proposal = optimiser.propose(rig.state(phi=0.3), budget=ut.Budget(evaluations))
    assert proposal.evaluations <= evaluations
    spent = proposal.evaluations > evaluations - optimiser.population
    assert spent or (proposal.status == "converged" and evaluations - proposal.evaluations < POLISH)


def test_descent_is_undefined_where_a_prediction_is() -> None:
    """A plant that leaves what the belief can bring home gives NaN slack, no −∞."""
    nothing: Any = None
    updates = tuple(
        Update(0.1 * k, nothing, nothing, nothing, nothing, predicted, 1.0)
        for k, predicted in enumerate((9.0, 7.5, np.inf, np.inf, 5.0, 4.0))
    )
    slack = ut.Run(nothing, updates).lemma3_slack
    np.testing.assert_array_equal(slack, [0.5, np.nan, np.nan, np.nan, 0.0])


SURFACE = ut.Surface(-1, -1.49, 1.72, 11.9)
REFUSED: dict[str, Callable[[ut.Mechanism], object]] = {
    "time-dependent belief": lambda rig: ut.Cascade(rig.disturbed({"theta": sp.sin(TIME)})),
    "time-dependent law": lambda rig: ut.SlidingModeLaw(
        rig.disturbed({"theta": sp.sin(TIME)}), SURFACE
    ),
    "NaN surface": lambda rig: ut.ClosedLoop(rig).batch(rig.state(), [[-1, np.nan, 1.7, 12]]),
    "negative gains": lambda rig: ut.ClosedLoop(rig).batch(
        rig.state(), SURFACE.vector, reaching=np.array([-20.0, 0.1])
    ),
    "state and names": lambda rig: ut.Cascade(rig).simulate(rig.state(phi=0.1), theta=0.1),
    "duration": lambda rig: ut.Cascade(rig).simulate(phi=0.1, duration=-1.0),
    "many starts": lambda rig: ut.Cascade(rig).simulate(np.zeros((2, 4))),
    "step": lambda rig: ut.Cascade(rig, step=0.0),
    "seed": lambda rig: ut.Cascade(rig, seed=-1),
    "budget": lambda rig: ut.Budget(10.5),  # type: ignore[arg-type]
    "zoh_steps": lambda rig: ut.ClosedLoop(rig, zoh_steps=1.5),  # type: ignore[arg-type]
    "horizon": lambda rig: ut.ClosedLoop(rig, ut.MinimumTime(horizon=1e12)).batch(
        rig.state(phi=0.1), SURFACE
    ),
    "plan with times": lambda rig: ut.ClosedLoop(rig).simulate(
        rig.state(phi=0.1), ut.Plan((SURFACE,)), switch_times=(0.0, 0.5)
    ),
    "unit": lambda rig: ut.Coordinate("a", unit="deg"),
    "name": lambda rig: ut.Coordinate("a b"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_bad_input_is_refused(rig: ut.Mechanism, what: str) -> None:
    """Each with a condition of ours that carries a value, a limit and a remedy."""
    with pytest.raises(UndertowError) as refusal:
        REFUSED[what](rig)
    assert refusal.value.value is not None
    assert refusal.value.limit is not None


def test_an_unstable_first_surface_is_refused(rig: ut.Mechanism) -> None:
    """(35) fails for λ_a > 0 at α_a = −1, and the message says so."""
    with pytest.raises(UnstableSurfaceError, match=r"\(35\)"):
        ut.Optimiser(ut.ClosedLoop(rig), first=ut.Surface(-1, 0.5, 5, 10))


@pytest.mark.parametrize("kind", ["m8[s]", "M8[s]", "U8"])
def test_times_and_texts_are_no_states(rig: ut.Mechanism, kind: str) -> None:
    """NumPy makes floats of seconds since 1970, and of digits in quotes; SI units they are not."""
    with pytest.raises(InvalidInputError, match="must be numbers"):
        rig.check_state(np.zeros(4).astype("i8").astype(kind))


def test_who_gives_or_takes_something_may_change_it_afterwards(rig: ut.Mechanism) -> None:
    """What was checked is kept as a copy; what is handed out is the caller's own."""
    tolerances, paths = {"m": 0.02}, dict(ut.Reference.sine(1.0, theta=0.1).paths)
    friction = {"phi": Friction(coulomb=0.1)}
    belief, reference = ut.Belief(rig, tolerances), ut.Reference(paths)
    bench = Bench(rig, friction=friction)
    tolerances["m"] = math.inf
    paths["phi"] = friction["x"] = cast(Any, None)
    assert belief.tolerances == {"m": 0.02}
    assert list(reference.paths) == ["theta"]
    assert list(bench.friction) == ["phi"]
    for kept in (belief.tolerances, reference.paths, bench.friction, rig.start):
        with pytest.raises(TypeError, match="does not support item assignment"):
            cast(Any, kept)["m"] = 1.0
    assert pickle.loads(pickle.dumps(belief)).tolerances == belief.tolerances
    assert cast(Any, rig.start) | {"phi": 0.1} == {"phi": 0.1}
    with pytest.raises(TypeError, match="mappingproxy"):  # another library's are its own
        pickle.dumps(types.MappingProxyType({"m": 0.02}))
    assert copy.deepcopy(bench).friction == bench.friction
    M = rig.linearise().M
    M[:] = math.nan
    assert np.isfinite(rig.linearise().M).all()
