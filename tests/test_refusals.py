"""What cannot be right is refused, or counted as broken, and never passes in silence."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.errors import InvalidInputError, UndertowError, UnstableSurfaceError
from undertow.mechanism import TIME


def test_a_constraint_that_is_not_a_number_is_broken(rig: ut.Mechanism) -> None:
    """w(x, u) = NaN stops the motion: NaN is no satisfied constraint."""
    odd = ut.Constraint("odd", lambda v: sp.sqrt(v.theta - 50))
    loop = ut.ClosedLoop(rig, ut.MinimumTime(constraints=(odd,)))
    run = loop.batch(rig.state(phi=0.2), [ut.first_surface(rig)])
    assert run.event[0] == ut.Event.CONSTRAINT
    assert np.isnan(run.path[0, 0])


def test_the_step_must_follow_the_gains_of_the_disturbance_bounds(rig: ut.Mechanism) -> None:
    """k of (13), not η alone, sets the fastest rate k/ε that the step has to resolve."""
    bounded = rig.with_disturbance_bounds(0.5, 0.2)
    surface = ut.first_surface(bounded)
    with pytest.raises(InvalidInputError, match=r"gains \(13\)") as refusal:
        ut.ClosedLoop(bounded).simulate(bounded.state(phi=0.2), surface)
    limit = float(str(refusal.value.limit).split("=")[1].split()[0])
    run = ut.ClosedLoop(bounded, step=limit / 2).simulate(bounded.state(phi=0.2), surface)
    assert run.event == ut.Event.REACHED


def test_a_coordinate_may_be_called_x() -> None:
    """On a cart, v.x is the position of the cart and v.states is the whole state."""
    cart = ut.mechanisms.cart_pendulum()
    limits = ut.MinimumEnergy(constraints=ut.state_box(x=0.5))
    run = ut.Cascade(cart, limits).simulate(phi=0.1, duration=20.0)
    assert run.reached
    assert np.abs(run.trajectory["x"]).max() <= 0.5


@pytest.mark.parametrize("evaluations", [300, 6000])
def test_a_budget_is_spent_and_not_exceeded(rig: ut.Mechanism, evaluations: int) -> None:
    """A global search uses the evaluations that it is given, to within one generation."""
    optimiser = ut.Optimiser(ut.ClosedLoop(rig, ut.MinimumTime()))
    proposal = optimiser.propose(rig.state(phi=0.3), budget=ut.Budget(evaluations))
    assert evaluations - optimiser.population < proposal.evaluations <= evaluations


def test_descent_is_undefined_where_a_prediction_is(rig: ut.Mechanism) -> None:
    """A plant that leaves what the belief can bring home gives NaN slack, no −∞."""
    cascade = ut.Cascade(rig, ut.MinimumTime(), cold=ut.Budget(600), warm=ut.Budget(64))
    run = cascade.simulate(phi=0.5, plant=rig.with_parameters(m=0.16), duration=1.0)
    assert not np.isinf(run.descent).any()


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
    "hold": lambda rig: ut.ClosedLoop(rig, hold=1.5),  # type: ignore[arg-type]
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
