"""Single surfaces through the switching points of the earliest arrival."""

from __future__ import annotations

import numpy as np
import pytest

import undertow as ut
from undertow.law import SlidingModeLaw
from undertow.optimiser.arrival import ArrivalSearch
from undertow.optimiser.fitting import switching_fits
from undertow.optimiser.open_loop import OpenLoopMotion
from undertow.optimiser.schedules import earliest_arrival, earliest_motion
from undertow.optimiser.switching import DRAWN, GENERATIONS, MEMBERS, SwitchingSurfaces
from undertow.optimiser.task import Optimisation


def task_of(mechanism: ut.Mechanism, x0: np.ndarray) -> Optimisation:
    freedom = ut.DecisionVariables(reaching=True)
    cascade = ut.Cascade(mechanism, ut.MinimumTime(), belief="exact", freedom=freedom)
    task = cascade.optimiser._task(x0, 60.0, ut.Budget(100_000), 0.0, 0, False)
    task.cost(task.firsts)
    return task


@pytest.fixture(scope="module")
def earliest() -> tuple[Optimisation, OpenLoopMotion]:
    cart = ut.mechanisms.cart_pendulum()
    task = task_of(cart, cart.state(phi=ut.deg(20)))
    motion = earliest_motion(task, earliest_arrival(task, 0))
    assert motion is not None
    return task, motion


@pytest.mark.slow  # kernels of its own
def test_the_earliest_motion_has_three_switches(
    earliest: tuple[Optimisation, OpenLoopMotion],
) -> None:
    """2n − 1 for one input and 2n states; each state lies on the motion, beside a node of it."""
    task, motion = earliest
    x, qdd = earliest_arrival(task, 0).switches(motion)
    assert x.shape == (4, 3)
    assert qdd.shape == (2, 3)
    span = np.ptp(motion.x, axis=0)
    for state in x.T:
        assert (np.abs(motion.x - state) / span).max(axis=1).min() < 0.15


@pytest.mark.slow
def test_the_law_asks_for_no_input_where_the_motion_switches(
    earliest: tuple[Optimisation, OpenLoopMotion],
) -> None:
    """The law itself, at these states, for fits that nothing else draws: |u| ≪ its limit.

    Where the motion is at a limit, its sign is the motion's.
    """
    task, motion = earliest
    mechanism, limit = task.loop.mechanism, task.loop.input_limits[0]
    x, qdd = earliest_arrival(task, 0).switches(motion)
    fits = switching_fits(task.space, task.optimiser.anchor, x, qdd, motion.x.T)
    small = []
    for z in fits:
        plan = task.space.plan(z)
        (surface,), (law,) = plan.surfaces, plan.laws(task.loop.reaching)
        control = SlidingModeLaw(mechanism, surface, reaching=law)
        u = np.array([float(control(0.0, state).u[0]) for state in x.T])
        # Nodes of the motion but for the first, where its start is, and the end beside the target.
        along = np.array([float(control(0.0, state).u[0]) for state in motion.x[1:-3]])
        before, after = motion.u[:-3, 0] / limit, motion.u[1:-2, 0] / limit
        held = (before * after) > 0.99  # at one limit on either side of the node
        agrees = along[held] * before[held] > 0.0
        small.append(np.abs(u).max() < 0.05 * limit and agrees.all())
    assert sum(small) >= 3


@pytest.mark.slow
def test_a_search_around_the_fits_is_not_begun_that_cannot_be_ended(
    earliest: tuple[Optimisation, OpenLoopMotion],
) -> None:
    """Where what is left would do for the draws and the generations, and for no arrival."""
    task, motion = earliest
    left, spent = DRAWN + MEMBERS * GENERATIONS, task.evaluations
    arrivals = ArrivalSearch(task.states, lambda z: z[:, 0] > 0, 1e-3, lambda count: count > left)
    assert SwitchingSurfaces(task.firsts, motion.time).search(task, arrivals) == np.inf
    assert task.evaluations == spent


@pytest.mark.slow
def test_a_single_surface_arrives_next_to_the_earliest(
    earliest: tuple[Optimisation, OpenLoopMotion],
) -> None:
    """Of four seeds at least three come within 2 % of what no input beats."""
    task, motion = earliest
    costs = []
    for seed in range(4):
        optimiser = ut.Cascade(
            task.loop.mechanism, ut.MinimumTime(), belief="exact", seed=seed,
            freedom=ut.DecisionVariables(reaching=True),
        ).optimiser  # fmt: skip
        costs.append(optimiser.propose(task.x).cost)
    assert sum(cost < 1.02 * motion.time for cost in costs) >= 3
