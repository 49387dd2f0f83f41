"""What a run has learnt of its plant, and the surface in use: they go together, or it waits."""

from __future__ import annotations

import undertow as ut
from undertow.cascade import CascadeState
from undertow.estimators import KalmanFilter
from undertow.law import InnerLoop, Plan
from undertow.models import FloatArray
from undertow.plants import Measurement
from undertow.runtime import Command, Controller, Inputs, Mode, Settings

RIG = ut.mechanisms.rotary_pendulum()
BELIEF = ut.Belief.relative(RIG, m=0.2, l=0.05, I_e=0.2, a_e=0.1, d_e=0.5)

#: Where φ = 36.8° the surface is near its singularity: for the model it may be used, for these not.
LEARNT = BELIEF.values([0.4, 0.14, 0.32, -0.34, 0.02])
SURFACE = ut.Surface(-1, -4.039, 1.306, 8.926)


class Sure(KalmanFilter):
    """A filter that is sure of its parameters from the first sample on."""

    def estimate(self, measurement: Measurement, u: FloatArray) -> FloatArray:
        """The usual estimate of the state, and the learnt parameters."""
        x = super().estimate(measurement, u)
        self.parameters[:] = LEARNT
        return x


def held(phi: float, surface: ut.Surface = SURFACE) -> Controller:
    """A controller after fifty steps with a pendulum that is held at rest at an angle."""
    cascade = ut.Cascade(RIG, belief=BELIEF)
    memory = CascadeState(Plan.of(surface))
    seen = Measurement(0.0, RIG.state(phi=phi)[:2])
    controller = Controller(
        cascade, memory, Sure(RIG, 0.001, belief=BELIEF), period=0.001, settings=Settings()
    )
    for k in range(50):
        controller.step(Inputs(k * 0.001, Measurement(k * 0.001, seen.q), command=Command.START))
    return controller


def test_a_surface_that_does_not_bear_what_is_learnt_goes_on_without_it() -> None:
    """With the parameters that are learnt the run would have stopped: det Γ is too small."""
    controller = held(ut.deg(36.8))
    assert controller.mode is Mode.CATCH
    assert controller.margin[0] > controller.settings.min_margin
    law = InnerLoop(RIG, SURFACE)
    law.parameters[:] = LEARNT
    law(controller.wrapped)
    assert law.margin[0] < controller.settings.min_margin


def test_a_surface_that_bears_it_goes_on_with_it() -> None:
    near = held(ut.deg(10))
    law = InnerLoop(RIG, SURFACE)
    law.parameters[:] = LEARNT
    law(near.wrapped)
    assert near.margin[0] == law.margin[0]
