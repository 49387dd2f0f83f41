"""What a simulated run of the cascade is made of: legs and pieces; and the record of it.

A run goes along legs.  A run to x = 0 has one, without a target, and ends where it arrives.  A
set-point is a task of its own, as if started afresh from where the last one was left: its first
plan is found by the global search.  Cost counts while the error is outside the terminal set about
the set-point; once it was reached the mechanism is held there, see :mod:`.holding`, until the
target jumps.  A reference is one task: cost counts while the error is outside the terminal set
about it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from undertow.base import (
    InvalidInputError,
    Verdict,
    at_least,
    check_place,
    checked,
    positive,
    write_file,
)
from undertow.cascade.targets import legs_of
from undertow.closed_loop import ROUNDING, ClosedLoop, Event, Trajectory, simulate_along
from undertow.closed_loop.gate import Admission
from undertow.estimators import ParameterEstimate
from undertow.law import Plan, ReferenceMotion, SetPoints, Surface, Target, target_of
from undertow.models import FloatArray, Mechanism, number_of
from undertow.optimiser import Proposal

if TYPE_CHECKING:
    from undertow.cascade.cascade import Cascade
    from undertow.cascade.state import CascadeState
    from undertow.closed_loop.figures import MotionFigure
    from undertow.display.sketches import Sketch

#: How far an estimate moves, in tolerances, before what was planned with it is planned anew.
NEWS = 0.1

#: How often what a motion shows is learnt, about, s.
LEARNING = 0.02


@dataclass(frozen=True, eq=False)
class Update:
    """One decision of the outer loop, as recorded.

    ``t`` and ``x`` are when and where; ``plan`` the one in use afterwards; ``predicted``
    its J̃_k; ``spent`` the cost spent since the decision before; ``task`` counts the
    tasks before: a target that jumps begins one, and so does leaving a set-point once reached.
    """

    t: float
    x: FloatArray
    proposal: Proposal
    admission: Admission
    plan: Plan
    predicted: float
    spent: float
    task: int = 0

    @property
    def surface(self) -> Surface:
        """The surface in use after the decision."""
        return self.plan.surfaces[0]

    def __repr__(self) -> str:
        """Show when, what was decided and why."""
        decided = "admitted" if self.admission.accepted else "kept"
        return f"Update(t={self.t:g} s, {decided}: {self.admission.reason})"


@dataclass(frozen=True, eq=False)
class Run:
    """A simulated run of the cascade.

    Attributes
    ----------
    trajectory
        The motion of the plant.
    updates
        The decisions of the outer loop, in order.
    """

    trajectory: Trajectory
    updates: tuple[Update, ...]

    def __repr__(self) -> str:
        """Show how it ended."""
        admitted = sum(update.admission.accepted for update in self.updates)
        return (
            f"Run({self.trajectory.mechanism.name}, {self._end}, cost {self.cost:.6g}, "
            f"{len(self.updates)} decisions, {admitted} admitted)"
        )

    @property
    def _end(self) -> str:
        """How and when it ended, in words: a target where it stayed was reached before the end."""
        motion = self.trajectory
        stayed = (np.diff(motion.t[-2:]) > 0) & (np.diff(motion.accumulated_cost[-2:]) == 0)
        when = "by" if self.reached and stayed.any() else "at"
        return f"{motion.ending} {when} {self.time:.4g} s"

    @property
    def cost(self) -> float:
        """Cost of the whole motion."""
        return self.trajectory.cost

    @property
    def time(self) -> float:
        """Time at the end, s: of a run that stays at its target, later than when it arrived.

        A run stays that follows a reference, or goes to set-points for a ``duration``; any other
        ends where it reaches the terminal set.
        """
        return self.trajectory.time

    @property
    def reached(self) -> bool:
        """Whether it ended in the terminal set."""
        return self.trajectory.event == Event.REACHED

    def plot(self) -> MotionFigure:
        """Return a figure of the motion; dotted lines mark where another surface took over.

        A Matplotlib figure: save it with ``.savefig("motion.png")``; a notebook shows it.
        """
        motion = self.trajectory
        cost = f"{self.cost:.4g} {motion.cost_unit}".strip()
        figure = motion.plot(f"{motion.mechanism.name}: {self._end}, cost {cost}")
        figure.axes[-1].set_xlabel("time (s); dotted: another surface takes over")
        for before, update in itertools.pairwise(self.updates):
            if update.surface != before.surface:
                for axes in figure.axes:
                    axes.axvline(update.t, color="black", linewidth=0.7, linestyle=":")
        return figure

    @checked
    def animate(
        self,
        path: str | Path,
        *,
        fps: float = 25.0,
        longest: float = 8.0,
        speed: float = 1.0,
        figure: Sketch | None = None,
    ) -> Path:
        """Write a film of the motion, a GIF, and return where it is.

        Parameters
        ----------
        path
            The file, for instance ``"film.gif"``.
        fps, longest, speed
            Frames in a second, the longest film, s, and seconds of motion in a second of film.
        figure
            What to draw; by default the mechanism's own stick figure, or dials.

        Raises
        ------
        ArtefactError
            When the file cannot be written.
        InvalidInputError
            For a frame rate, length or speed that is not positive.
        """
        from undertow.display.animation import Film, gif
        from undertow.display.sketches import Sketch

        if not (figure is None or isinstance(figure, Sketch)):
            raise InvalidInputError(
                "figure of an animation", value=repr(figure), limit="an undertow.display Sketch"
            )

        check_place(Path(path), b"GIF8")
        film = Film.of(self.trajectory, fps=fps, longest=longest, speed=speed, figure=figure)
        return write_file(Path(path), gif(film))

    def _repr_html_(self) -> str:
        """Show its end and its motion in a notebook."""
        return f"<p>{escape(repr(self))}</p>{self.trajectory._repr_html_()}"

    @property
    def surfaces(self) -> tuple[Surface, ...]:
        """The surface in use after each decision; how it is reached is in :attr:`plans`."""
        return tuple(update.surface for update in self.updates)

    @property
    def plans(self) -> tuple[Plan, ...]:
        """The plan in use after each decision: surfaces, and where it says so how they are reached.

        Simulate it alone by ``cascade.loop.simulate(x0, run.plans[0])``, or export it to C.
        """
        return tuple(update.plan for update in self.updates)

    @property
    def verdicts(self) -> tuple[Verdict | None, ...]:
        """What is known of the plan in use, at each decision."""
        return tuple(update.admission.verdict for update in self.updates)

    @property
    def lemma3_slack(self) -> FloatArray:
        """Slack of Lemma 3 at each decision, J̃_k − spent − J̃_{k+1}, in units of cost.

        Never negative, to integration tolerance, where belief and truth agree; for
        minimum time it is t_{f,k} − Δt − t_{f,k+1}.  NaN where one of the predictions is
        infinite: a disturbed plant may leave what the belief can bring home; and where another task
        begins, for instance because the target jumped.  While a reference moves, predictions
        count to a horizon that moves along, and slack may be negative.
        """
        predicted = np.array([update.predicted for update in self.updates])
        spent = np.array([update.spent for update in self.updates])
        finite = np.isfinite(predicted)
        task = np.array([update.task for update in self.updates])
        known = finite[1:] & finite[:-1] & (task[1:] == task[:-1])
        predicted = np.where(finite, predicted, 0.0)
        return np.where(known, predicted[:-1] - spent[1:] - predicted[1:], np.nan)


@dataclass(frozen=True, eq=False)
class Leg:
    """A part of a run from ``begin`` to ``end``, s, with one target, or none: x = 0.

    Predictions look at most ``longest`` ahead, s.  ``stays``: once the target is reached the
    mechanism is held there, until the end.
    """

    begin: float
    end: float
    longest: float
    target: ReferenceMotion | None = None
    stays: bool = False


def legs_to(
    cascade: Cascade, target: Target | Mapping[str, float] | None, duration: float | None
) -> list[Leg]:
    """Return the legs of a run; without a duration it ends where the last set-point is reached."""
    goal = None if target is None else target_of(target)
    last = goal.times[-1] if isinstance(goal, SetPoints) else 0.0
    total = last + cascade.objective.horizon if duration is None else duration
    positive("duration of a run, s", total, "Leave it out for the objective's horizon")
    at_least(
        "duration of a run, s", total, 2 * cascade.step, "Searches look two steps ahead or more"
    )
    if goal is None:
        return [Leg(0.0, total, total)]
    if isinstance(goal, SetPoints):
        goal.check_within(total)
    motions = legs_of(cascade.mechanism, cascade.objective, goal, total)
    # The inner loop meets a jump at its next sample.
    begins = [math.ceil(t / cascade.stride - 1e-6) * cascade.stride for t, _ in motions]
    return [
        Leg(
            begin,
            min(end, total),
            min(cascade.objective.horizon, total - begin),
            motion,
            stays=duration is not None or motion.moves or end < total,
        )
        for begin, end, (_, motion) in zip(begins, [*begins[1:], total], motions, strict=True)
        if begin < total
    ]


def moving_loops(
    cascade: Cascade, plant: Mechanism | Mapping[float, Mechanism] | None
) -> dict[int, ClosedLoop]:
    """Return the loop of each plant that moves, by the stride of the run from which it does."""
    usual = None if cascade.known is None else cascade.mechanism
    given = plant if isinstance(plant, Mapping) else {0.0: plant}
    plants = {number_of("time of a plant, s", t): moving for t, moving in given.items()}
    for t in plants:
        positive("time of a plant, s", t, "Plants change after the start, at 0", zero=True)
    return {
        round(t / cascade.stride): replace(
            cascade.loop,
            objective=cascade.objective,
            plant=moving or usual,
            ensemble=None,
            returning=False,
        )
        for t, moving in sorted({0.0: None, **plants}.items())
    }


def moments(
    cascade: Cascade, legs: Iterable[Leg], marks: Iterable[int]
) -> Iterator[tuple[Leg, float, float, bool]]:
    """Yield leg, time and length of each piece of a run, s, and whether a decision is due.

    Decisions come each period of a leg, learning some times within it; pieces also begin at
    ``marks``, in strides of the run.
    """
    stride, period = cascade.stride, cascade.period
    strides = round(period / stride)
    parts = 1 if cascade.known is None else min(strides, max(1, round(period / LEARNING)))
    learning = {round(strides * part / parts) for part in range(parts)}
    for leg in legs:
        for k in range(math.ceil((leg.end - leg.begin) / period - 1e-9)):
            first = round(leg.begin / stride) + k * strides
            within = (learning | {mark - first for mark in marks}) & {*range(strides)}
            for part, after in itertools.pairwise([*sorted(within), strides]):
                t = leg.begin + k * period + part * stride
                span = period if after - part == strides else (after - part) * stride
                if leg.end - t > ROUNDING * cascade.step:
                    yield leg, t, min(span, leg.end - t), part == 0


def is_news(before: ParameterEstimate | None, now: ParameterEstimate | None) -> bool:
    """Whether so much was learnt since a decision that it is worth another one."""
    if before is None or now is None:
        return False
    return bool(np.abs(now.offset - before.offset).max() > NEWS)


def simulate_piece(
    cascade: Cascade, truth: ClosedLoop, memory: CascadeState, x: FloatArray, t: float, span: float,
    stays: bool,
) -> Trajectory:  # fmt: skip
    """Simulate a plan for a while, absolute; once it has arrived, staying costs nothing."""
    target, plan = memory.target, memory.at(t)
    if memory.estimate is not None:
        truth = truth.believing(cascade.believed(memory))
    if target is not None and target.moves:
        return simulate_along(truth, x, plan, target, duration=span, start=t)
    loop, error = cascade.about(truth, target, t), memory.error(t, x)
    motion = loop.simulate(error, plan, duration=span, start=t)
    if stays and motion.event == Event.REACHED:
        held = loop.simulate(error, plan, duration=span, start=t, terminal=0.0)
        cost = np.minimum(held.accumulated_cost, motion.cost)
        event = held.event if held.event != Event.HORIZON else motion.event
        motion = replace(held, accumulated_cost=cost, event=event)
    return replace(motion, mechanism=truth.truth, x=memory.absolute(t, motion.x))
