"""What holds a target: how long a motion on a surface strays, and where it does not come home."""

from __future__ import annotations

import numpy as np
import pytest

import undertow as ut
from undertow.cascade.holding import regulation
from undertow.law import Plan


def test_the_form_is_how_far_the_loop_strays_and_for_how_long(
    rig: ut.Mechanism, quick: ut.Surface
) -> None:
    """xᵀPx = ∫ xᵀx dt of the closed loop itself, from any small error."""
    loop = ut.ClosedLoop(rig)
    P = regulation(rig, quick, loop.reaching)
    for x in 1e-4 * np.random.default_rng(0).standard_normal((4, 4)):
        motion = loop.simulate(x, Plan.of(quick), duration=20.0, terminal=0.0)
        size = np.einsum("ti,ti->t", motion.x, motion.x)
        assert np.trapezoid(size, motion.t) == pytest.approx(float(x @ P @ x), rel=1e-3)


def test_on_a_surface_that_is_unstable_there_is_none(rig: ut.Mechanism, quick: ut.Surface) -> None:
    """The integral is infinite there, and a form of either sign would solve Lyapunov's equation."""
    away = ut.Surface(quick.alpha_a, -quick.lambda_a, quick.alpha_u, quick.lambda_u)
    assert ut.law.stability_margin(rig, away) < 0
    assert np.isnan(regulation(rig, away, ut.ClosedLoop(rig).reaching)).all()
