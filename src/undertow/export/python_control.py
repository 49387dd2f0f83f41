"""Hand-over to python-control: the plant and the closed loop as its systems, margins, planes.

Linear models are :meth:`undertow.Mechanism.linearise`'s ``ss()``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from undertow.base import InvalidInputError, check_fields, checked, one_of, require, require_extra
from undertow.closed_loop import ClosedLoop
from undertow.law import InnerLoop, Plan, ReachingLaw, Surface, check_surface, feedback_at_target
from undertow.models import FloatArray, Mechanism, linearise

#: Frequencies at which disk margins are looked for: this many, and so far about the eigenvalues.
FREQUENCIES, DECADES = 2000, 2.0


def _control(need: str) -> Any:
    return require_extra("control", "interop", f"{need} need python-control")


@checked
def nlsys(what: Mechanism | ClosedLoop, surfaces: Surface | Plan | None = None) -> Any:
    """Return a plant, or a closed loop under our law, as python-control's ``NonlinearIOSystem``.

    Parameters
    ----------
    what
        A mechanism: inputs are its own, not clipped, outputs its states.  A closed loop with its
        surface or plan: inputs are disturbances behind the actuator, ``voltage_disturbance`` and
        so on, in the units of the inputs; outputs are states and inputs.  Its plant is the truth.
    surfaces
        What a loop slides on; a plan's later surfaces take over at their times t, s.

    Returns
    -------
    control.NonlinearIOSystem
        In continuous time, with the names of states and inputs.

    Raises
    ------
    MissingExtraError
        Without python-control.
    InvalidInputError
        For a loop without a surface, a mechanism with one, and a sampled loop.
    """
    loop = what if isinstance(what, ClosedLoop) else None
    if (loop is None) != (surfaces is None):
        raise InvalidInputError(
            "surfaces of a system",
            value="none, for a closed loop" if surfaces is None else "some, beside a mechanism",
            limit="what a closed loop slides on; none for a mechanism",
            remedy="ut.nlsys(mechanism), or ut.nlsys(loop, surface)",
        )
    control = _control("its systems")
    if loop is None:
        assert isinstance(what, Mechanism)  # no loop
        flow = _flow(what)
        return control.nlsys(
            lambda t, x, u, _params: flow(t, x, u),
            None,
            states=what.state_names,
            inputs=[i.name for i in what.inputs],
            outputs=what.state_names,
            name=what.name.replace(".", "_"),  # python-control takes no dots
        )
    if loop.zoh_steps:
        raise InvalidInputError(
            "closed loop as a system in continuous time",
            value="sampled",
            limit="the continuous law, zoh_steps=0",
            remedy="Leave zoh_steps out",
        )
    assert surfaces is not None  # as for every loop
    plan, names = Plan.of(surfaces), [i.name for i in loop.mechanism.inputs]
    laws = [
        InnerLoop(loop.mechanism, surface, law)
        for surface, law in zip(plan.surfaces, plan.laws(loop.reaching), strict=True)
    ]
    times, flow, limits = np.array(plan.times), _flow(loop.truth), loop.input_limits

    def decided(t: float, x: FloatArray) -> FloatArray:
        law = laws[int(np.searchsorted(times, t, side="right")) - 1] if t > 0 else laws[0]
        return np.clip(law(np.ascontiguousarray(x)), -limits, limits)

    return control.nlsys(
        lambda t, x, d, _params: flow(t, x, decided(t, x) + d),
        lambda t, x, _d, _params: np.concatenate([x, decided(t, x)]),
        states=loop.mechanism.state_names,
        inputs=[f"{name}_disturbance" for name in names],
        outputs=[*loop.mechanism.state_names, *names],
        name=f"{loop.truth.name}_loop".replace(".", "_"),
    )


def _flow(mechanism: Mechanism) -> Any:
    """Return ẋ as a function of t, x, (2n,), and u, (m,)."""
    accelerations, values = mechanism.function("dynamics"), mechanism.parameter_values
    n = mechanism.n

    def flow(t: float, x: FloatArray, u: FloatArray) -> FloatArray:
        return np.concatenate([x[n:], accelerations(t, *x, *u, *values)])

    return flow


@dataclass(frozen=True)
class LoopMargins:
    """What the loop at the target bears where one input's path is cut, all others closed.

    Attributes
    ----------
    input
        Name of the input.
    gain
        Factors that the loop gain may be multiplied with, from below 1 to above 1: a plant that
        falls by itself also bears no gain that is too small.
    phase
        Phase that may be lost, rad.
    delay
        Delay that it bears, s; of several crossovers the least.
    disk
        Factor g and phase, rad, that it bears at once: the gain anywhere in [1/g, g] and the phase
        anywhere within ±, from the balanced disk margin.
    crossover
        Frequency at which the delay counts, rad/s.
    """

    input: str
    gain: tuple[float, float]
    phase: float
    delay: float
    disk: tuple[float, float]
    crossover: float

    def __post_init__(self) -> None:
        """Refuse fields of another type."""
        check_fields(self)

    def __str__(self) -> str:
        """Show all of them in one line."""
        low, high = self.gain
        g, angle = self.disk
        return (
            f"{self.input}: gain × {low:.3g} to {high:.3g}, phase {math.degrees(self.phase):.3g}°, "
            f"delay {1000 * self.delay:.3g} ms at {self.crossover:.3g} rad/s, disk × {g:.3g} and "
            f"{math.degrees(angle):.3g}°"
        )


@checked
def loop_transfer(
    mechanism: Mechanism,
    surface: Surface,
    reaching: ReachingLaw | None = None,
    *,
    cut: str | None = None,
) -> Any:
    """Return the loop at the target, cut at one input, as ``control.StateSpace``: L(s).

    Inside the boundary layer, and within its limits, the law is u = k x; L = −k (sI − A)⁻¹ B, with
    the loops of the other inputs closed.  1 + L = 0 are the poles.

    Parameters
    ----------
    mechanism
        The model.
    surface, reaching
        The law; the paper's gains by default.
    cut
        Name of the input; the first by default.

    Raises
    ------
    MissingExtraError
        Without python-control.
    UnstableSurfaceError, SingularSurfaceError
        For a surface that cannot be used.
    """
    names = [i.name for i in mechanism.inputs]
    name = names[0] if cut is None else cut
    one_of("input to cut at", name, names)
    place = names.index(name)
    check_surface(mechanism, surface)
    control = _control("loops")
    lin = linearise(mechanism)
    k = feedback_at_target(mechanism, surface, reaching)
    others = [i for i in range(mechanism.m) if i != place]
    A = lin.A + lin.input[:, others] @ k[others]
    return control.ss(
        A, lin.input[:, [place]], -k[[place]], 0, states=lin.states, inputs=name, outputs=name
    )


@checked
def loop_margins(
    mechanism: Mechanism, surface: Surface, reaching: ReachingLaw | None = None
) -> tuple[LoopMargins, ...]:
    """Return gain, phase, delay and disk margins of the loop at the target, one for each input.

    They are python-control's, of :func:`undertow.export.loop_transfer`.

    Parameters
    ----------
    mechanism
        The model.
    surface, reaching
        The law; the paper's gains by default.

    Raises
    ------
    MissingExtraError
        Without python-control.
    UnstableSurfaceError, SingularSurfaceError
        For a surface that cannot be used.
    """
    control = _control("margins")
    found = []
    for given in mechanism.inputs:
        L = loop_transfer(mechanism, surface, reaching, cut=given.name)
        gains, phases, _, _, crossovers, _ = control.stability_margins(L, returnall=True)
        gains, phases = np.asarray(gains), np.radians(phases) % (2 * math.pi)
        delays = phases / crossovers
        first = int(np.argmin(delays)) if len(delays) else -1
        rates = np.abs(np.concatenate([L.poles(), np.linalg.eigvals(L.A - L.B @ L.C)]))
        slow, fast = np.log10([rates[rates > 1e-6].min(), rates.max()])
        omega = np.logspace(slow - DECADES, fast + DECADES, FREQUENCIES)
        _, disk, angle = control.disk_margins(L, omega)
        found.append(
            LoopMargins(
                given.name,
                (
                    float(gains[gains < 1].max(initial=0.0)),
                    float(gains[gains > 1].min(initial=math.inf)),
                ),
                float(np.minimum(phases, 2 * math.pi - phases).min(initial=math.inf)),
                float(delays[first]) if len(delays) else math.inf,
                (float(control.db2mag(disk)), math.radians(angle)),
                float(crossovers[first]) if len(delays) else math.nan,
            )
        )
    return tuple(found)


@checked
def phase_plane(system: Any, across: str, along: str, **others: float) -> Any:
    """Return a cut through a system's vector field: two of its states, the others held.

    For ``control.phase_plane_plot``.  Of a closed loop in (φ, φ̇) it shows how the surface attracts:
    with the others held, s = 0 is a line.

    Parameters
    ----------
    system
        What :func:`undertow.nlsys` returns.
    across, along
        Names of the states of the plane.
    **others
        Where the other states are held, SI units; 0 by default.

    Returns
    -------
    control.NonlinearIOSystem
        Two states, no inputs.

    Raises
    ------
    MissingExtraError
        Without python-control.
    InvalidInputError
        For unknown names, or the same one twice.
    """
    control = _control("phase planes")
    if not isinstance(system, control.NonlinearIOSystem) or not system.nstates:
        raise InvalidInputError(
            "system of a phase plane",
            value=repr(system),
            limit="what ut.nlsys returns",
            remedy="Write phase_plane(ut.nlsys(loop, surface), 'phi', 'phi_dot')",
        )
    names = list(system.state_labels)
    for name in (across, along, *others):
        one_of("state of a phase plane", name, names)
    require(across != along, "states of a phase plane", (across, along), "two different ones")
    places = [names.index(across), names.index(along)]
    held = np.array([others.get(name, 0.0) for name in names])
    nothing = np.zeros(system.ninputs)

    def flow(t: float, x: FloatArray, _u: FloatArray, _params: object) -> FloatArray:
        whole = held.copy()
        whole[places] = x
        return np.asarray(system.dynamics(t, whole, nothing)[places])

    return control.nlsys(flow, None, states=[across, along], inputs=0, outputs=[across, along])
