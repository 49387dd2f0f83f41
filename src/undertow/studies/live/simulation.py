"""A cascade on its simulated plant, against the clock, with a hand that pokes and changes it.

The fast loop, 1 kHz, and the plant are stepped together by whoever shows them; the slow loop is in
another process, see :mod:`undertow.studies.live.planner`.  Its answers are for the state predicted
for the time of their use, as in a run on a rig: one that comes late, or for a state that a hand has
meanwhile changed, is refused, and says so.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, UndertowError, one_of, require
from undertow.cascade import CascadeState
from undertow.closed_loop.figures import display
from undertow.display.live import Message, Scene
from undertow.display.sketches import Sketch
from undertow.display.tree_sketch import sketch_named
from undertow.estimators import Belief
from undertow.law import Plan, ReferenceMotion, first_surface
from undertow.law.inner_loop import InnerLoop
from undertow.models import FloatArray, Mechanism, number_of
from undertow.objective import USUAL, Objective
from undertow.plants import RealisticRig
from undertow.runtime import Answer, Request, Settings, Worker, background_worker
from undertow.runtime.processes import Background
from undertow.runtime.slow_loop import LeadTime
from undertow.studies.live.beside import Beside, BoundAsked, MapAsked, beside
from undertow.studies.live.controls import PUSH, Control, controls_of
from undertow.studies.live.hands import Hands
from undertow.studies.live.messages import described, frame_message, plan_message, plausible
from undertow.studies.live.planner import Job, Task, cascade_for, planner

#: Period of the fast loop, s.
STEP = 0.001

#: Δt between re-optimisations at the start, s.
DELTA = 0.1

#: Seconds of motion in a second that can be chosen.
SPEEDS = (1.0, 0.5, 0.2, 0.05)

#: Pictures that a new viewer is shown of what was before, and decisions.
PAST, DECISIONS = 600, 60

#: What a push of strength 1 changes the velocity of the last coordinate by, rad/s or m/s, at most;
#: and as a part of what would carry it, at the rate of its fastest mode, as far as the start is.
PUSHED, PUSHED_PART = {"rad": 0.7, "m": 0.2}, 0.5

#: An answer is looked for once a picture: so much later than its time it is not late, s.
PICTURE = 1.0 / 60.0

#: A mechanism that has fallen is caught when its free angles are so near again, rad, with where
#: their velocities carry them in the time of the fastest mode.
CATCH = 0.35

#: Least time from asking for a plan to its use, s.
LEAST_LEAD = 0.01

#: An answer that has not come after so long is given up, s: what is new has to be compiled first.
GIVE_UP = 300.0

#: The state of the show, in words.
WAITING, RUNNING, FALLEN = "waiting", "running", "fallen"


class Simulation:
    """A mechanism under its cascade, shown live.

    Parameters
    ----------
    mechanism
        What the controller believes in; the plant is that too, until it is changed.
    figure
        What is drawn of it.
    x0
        Where it starts, (2n,); by default the mechanism's usual start.
    objective
        A word of :func:`undertow.objective_for`.
    period
        Δt between re-optimisations, s.
    seed
        Of the optimiser.
    worker
        Who plans; by default a process of its own.
    beside
        Who finds bounds and maps of what comes home; ``None``: nobody does.

    Attributes
    ----------
    t
        Time of the motion, s.
    mode
        ``waiting`` for a first surface, ``running``, or ``fallen``.
    rig
        The plant.
    law
        The fast loop.
    memory
        That of the cascade; ``None`` before there is a plan.
    hands
        What viewers hold.
    ready
        Done once all that steps it is compiled; before, nothing moves.
    """

    t: float
    mode: str
    rig: RealisticRig
    memory: CascadeState | None
    _why: str  # it has fallen
    _u: FloatArray
    _task: Task  # in force, and its target, (n,)
    _goal: FloatArray
    _spent: float  # since the decision in force
    _debt: float  # time of the motion that the clock is ahead of it, s
    _due: float  # when the next plan is asked for, s
    _asked: tuple[int, Job, float] | None  # number, what, and when by the clock, s
    _waiting: Answer | None  # for its time of use
    _anew: bool  # a new task is to be begun: what was planned is for another state
    _touched: bool  # by a hand, in the step before
    _seen: list[tuple[float, FloatArray, FloatArray]]  # of the plant, since it was last asked
    _said: Message

    def __init__(
        self,
        mechanism: Mechanism,
        figure: Sketch,
        x0: ArrayLike | None = None,
        *,
        objective: str = USUAL,
        period: float = DELTA,
        seed: int = 0,
        worker: Worker[Request, Answer] | None = None,
        beside: Beside | None = None,
    ) -> None:
        self.mechanism, self.scene = mechanism, Scene(mechanism, figure)
        self._x0 = mechanism.initial_state(x0, {})
        self.controls = controls_of(mechanism, objective, period)
        # What cannot be is refused here, not in another process.
        self._cascade = lru_cache(maxsize=4)(lambda task: cascade_for(mechanism, task, seed))
        self._cascade(self.controls.task).objective.check_start(mechanism, self._x0)
        self._belief = Belief.usual(mechanism)
        far = float(np.abs(self._x0[: mechanism.n]).max())
        self._fastest = mechanism.linearise().fastest
        self._turning = [
            i for i, one in enumerate(mechanism.coordinates)
            if one.unit == "rad" and (i >= mechanism.m or math.isinf(one.high - one.low))
        ]  # fmt: skip
        carried = PUSHED_PART * self._fastest * far
        self._usual_push = min(PUSHED[mechanism.coordinates[-1].unit], carried or math.inf)
        self._settings = Settings()
        surface = first_surface(mechanism)
        self.law = InnerLoop(mechanism, surface)
        self._idle = CascadeState(Plan.of(surface))
        self._costs: dict[str, tuple[Objective, Callable[..., Any]]] = {}
        self._worker = worker or background_worker(planner(mechanism, seed), processes=2)
        self._beside = beside or Beside(None, None)
        self._look: tuple[int, tuple[float, float]] | None = None  # whose plane is shown, how far
        self._bound: Message = {}
        self._region: Message = {}
        self.paused, self.speed, self.mode = False, 1.0, WAITING
        lead, most = self._settings.lead_time, self._settings.max_lead_time
        self._lead = LeadTime(lead, most, STEP, least=LEAST_LEAD)
        self._sequence, self._clock = 0, 0.0
        self._firsts: dict[Task, Answer] = {}
        self.hands = Hands(self.scene)
        self._fresh: list[Message] = []
        self._history: deque[Message] = deque(maxlen=PAST)
        self._decisions: deque[Message] = deque(maxlen=DECISIONS)
        self._seen, self._said = [], {}
        self.ready: Future[None] = Future()
        self.reset()
        self._ask()
        Background(self._warm_up, "undertow warm-up")

    # -- what it is ---------------------------------------------------------------------------

    def _rig(self, x: FloatArray) -> RealisticRig:
        """Return the plant at a state, as the controls stand.

        Raises
        ------
        InvalidInputError
            Where no such plant can be: M is not positive.
        """
        bench = self.controls.bench
        plant = bench.mechanism
        if not np.linalg.eigvalsh(plant.M(x[: plant.n])).min() > 0:
            raise InvalidInputError(
                f"plant of '{plant.name}'", value="a mass matrix that is not positive",
                limit="masses and inertias that a body can have",
                remedy="Move the slider back",
            )  # fmt: skip
        rig = RealisticRig(bench.with_timing(period=STEP), x)
        self._parameters = plant.parameter_values
        return rig

    def hello(self) -> Message:
        """Return all that a new viewer must know."""
        return {
            **described(self.mechanism, self.scene),
            "live": True,
            "speeds": SPEEDS,
            "controls": [control.shown() for control in self.controls.values()],
            "state": self._state(),
            "frames": [*self._history],
            "plans": [*self._decisions],
            "beside": [one for one in (self._bound, self._region) if one],
        }

    def _state(self) -> Message:
        waits = "" if self._asked is None else ("surface" if self.memory is None else "plan")
        return {
            "kind": "state", "mode": self.mode, "paused": self.paused, "speed": self.speed,
            "waits": waits, "why": self._why, "there": self.mode == RUNNING and self._at_target,
        }  # fmt: skip

    # -- time ---------------------------------------------------------------------------------

    def advance(self, seconds: float) -> list[Message]:
        """Go on by so much time on the clock, s; return what is new."""
        self._clock += seconds
        if self.ready.done():
            self.ready.result()  # what went wrong is raised
            self._take()
            self._ask()
        if not self.paused and self.mode != WAITING:
            self._debt += seconds * self.speed
            shown = self.t
            while self._debt >= STEP:
                self._debt -= STEP
                self._step()
                if self.t - shown > 1.5 * PICTURE * self.speed and self._debt >= STEP:
                    shown = self.t  # it was held up: what moved meanwhile is shown, too
                    self._say_frame()
        self._say_frame()
        self._look_beside()
        now = self._state()
        if now != self._said:
            self._said = now
            self._fresh.append(now)
        fresh, self._fresh = self._fresh, []
        return fresh

    def _step(self) -> None:
        """One period of the fast loop and of the plant."""
        x = self.rig.truth
        error = self._error(x)
        if self.mode == RUNNING:
            u = self.law(error).copy()
            if self._has_fallen(error):
                self.mode = FALLEN
        if self.mode == FALLEN:
            u = np.zeros(self.mechanism.m)
            self.law(error)
            if self._is_near(error):
                self._unwind()
                self.mode, self._anew, self._why = RUNNING, True, ""
        held = bool(self.hands)
        if held:
            self._end_bound()
            self.rig.knock(STEP * self.hands.force(x, self._parameters))
        if held or self._touched:
            self._seen.clear()  # what a hand does is nothing to learn from
            self._touched = False
        else:
            self._seen.append((self.t, x, u))
        self.rig.write(u)
        self._spend(error, u)
        self.t += STEP
        self._u = u
        if not np.isfinite(self.rig.truth).all():
            self.mode, self._why = FALLEN, "the motion ran away"
            self.rig = self._rig(x)
        elif self.mode == FALLEN:
            self._unwind()
        answer = self._waiting
        if answer is not None and self.t >= answer.use - 0.5 * STEP:
            self._waiting = None
            self._apply(answer)

    def _error(self, x: FloatArray) -> FloatArray:
        """Return how far states, (…, 2n), are off the target in force."""
        error = x.copy()
        error[..., : self.mechanism.n] -= self._goal
        return error

    def _free_angles(self) -> list[int]:
        m, coordinates = self.mechanism.m, self.mechanism.coordinates
        return [i for i in range(m, len(coordinates)) if coordinates[i].unit == "rad"]

    def _has_fallen(self, error: FloatArray) -> bool:
        for i in self._free_angles():
            if abs(error[i]) > self._settings.fall_angle:
                self._why = f"{self.mechanism.coordinates[i].name} is beyond 90°"
                return True
        if not self.law.margin[0] > self._settings.min_margin:
            self._why = "the law does not exist there: det Γ has come to 0, (37)"
            return True
        return False

    def _is_near(self, error: FloatArray) -> bool:
        n = self.mechanism.n
        q, v = (np.abs(error[half][self._free_angles()]) for half in (slice(n), slice(n, None)))
        return (
            bool((q + v / max(self._fastest, 1e-9) < CATCH).all())
            and bool(self.law.margin[0] > 0.2)
            and bool(np.isfinite(error).all())
        )

    def _unwind(self) -> None:
        """Count angles that have turned over from the nearest upright, or from the target.

        A driven angle is left alone where a turn of it is something else, as that of a wheel on
        the ground or of a joint with a spring.
        """
        x = self.rig.truth
        for i in self._turning:
            turned = x.copy()
            turned[i] -= 2 * math.pi * round((x[i] - self._goal[i]) / (2 * math.pi))
            if turned[i] == x[i] or (i < self.mechanism.m and not self._same(x, turned)):
                continue
            x = turned
            self.rig = self._rig(x)

    def _same(self, x: FloatArray, other: FloatArray) -> bool:
        """Whether two states look alike, and move alike."""
        force, n = self.mechanism.f, self.mechanism.n
        a, b = (
            np.concatenate([self.scene.points(y[:n], self._parameters).ravel(), force(y)])
            for y in (x, other)
        )
        return bool(np.allclose(a, b, rtol=1e-6, atol=1e-9))

    def _spend(self, error: FloatArray, u: FloatArray) -> None:
        word = self._task.objective
        if word not in self._costs:
            objective = self._cascade(self._task).objective
            self._costs[word] = objective, objective.stage_function(self.mechanism)
        objective, stage_of = self._costs[word]
        if np.linalg.norm(error) > objective.terminal_radius:
            self._spent += STEP * float(stage_of(*error, *u)[0])

    # -- beside it ----------------------------------------------------------------------------

    def _look_beside(self) -> None:
        """Tell what has been found of bound and region, and ask for the next map."""
        for found in self._beside.take(self._clock):
            if found["kind"] == "bound":
                self._bound = found
            else:
                self._region = found
            self._fresh.append(found)
        if self._look is not None and self.memory is not None and self.mode == RUNNING:
            self._beside.draw(self._clock, self._map)

    def _map(self) -> MapAsked:
        """Return the question of what comes home in the plane that is looked at."""
        assert self._look is not None  # else nothing is asked
        assert self.memory is not None
        axis, reach = self._look
        return MapAsked(
            self.t, self._task, self.law.parameters.copy(), self.memory.surface,
            self.law.reaching, self._error(self.rig.truth), self._goal.copy(), axis, reach,
        )  # fmt: skip

    def _begin_bound(self) -> None:
        """Ask what the best input would pay from here, for the plant as it is."""
        self._end_bound()
        free = all(
            math.isinf(c.low) and math.isinf(c.high)
            for c, moved in zip(self.mechanism.coordinates, self._goal, strict=True)
            if moved
        )  # a travel would be another one, counted from the target
        if free and not self.hands and self.mode == RUNNING:
            x = self._error(self.rig.truth)
            self._beside.begin(BoundAsked(self.t, self._task, self._parameters.copy(), x))

    def _end_bound(self) -> None:
        """Forget the bound: it is of an undisturbed motion of another plant, or from elsewhere."""
        self._beside.begin(None)
        if self._bound.get("cost") is not None:
            self._bound = {"kind": "bound", "t": self.t, "cost": None, "why": ""}
            self._fresh.append(self._bound)

    def _set_look(self, axis: object, reach: object) -> None:
        number = number_of("axis of the phase plane", axis)
        one_of("axis of the phase plane", f"{number:g}", [str(i) for i in range(self.mechanism.n)])
        if not isinstance(reach, list) or len(reach) != 2:
            raise InvalidInputError("reach", value=repr(reach)[:80], limit="[far, fast], SI units")
        far, fast = (number_of("reach of the phase plane", one) for one in reach)
        near = 0 < far < 1e6 and 0 < fast < 1e6
        require(near, "reach", f"{far:g}, {fast:g}", "above 0, below 1e6")
        self._look = int(number), (far, fast)

    # -- the slow loop ------------------------------------------------------------------------

    @property
    def _at_target(self) -> bool:
        objective, _ = self._costs.get(self._task.objective, (None, None))
        error = self._error(self.rig.truth)
        return objective is not None and bool(np.linalg.norm(error) <= objective.terminal_radius)

    def _ask(self) -> None:
        """Ask for the next plan, where one is due and nothing is on its way."""
        if self._asked is not None:
            if self._clock - self._asked[2] > GIVE_UP:
                self._asked = None
                alive = self._worker.replace()
                words = "another one takes over" if alive else "its last plan stays in use"
                note = f"the optimiser has not answered for {GIVE_UP:g} s: {words}"
                self._fresh.append({"kind": "note", "text": note})
            return
        if self._waiting is not None or self.mode == FALLEN:
            return
        task, goal = self.controls.task, self.controls.target
        first = self.memory is None
        if first and task in self._firsts and not goal.any():
            self._task = task
            self._apply(self._firsts[task])
            return
        new = first or self._anew or task != self._task or not np.array_equal(goal, self._goal)
        if not new and (self.paused or self.t < self._due or self._at_target):
            return
        x = self.rig.truth
        # Before there is a first plan nothing moves, so that is for this very state.
        lead = 0.0 if first else max(STEP, math.ceil(self._lead.seconds * self.speed / STEP) * STEP)
        use = round((self.t + lead) / STEP) * STEP
        memory = self._idle if first else self.memory
        assert memory is not None  # idle is one
        self._sequence += 1
        seen = None
        if len(self._seen) > 1 and not first:
            t, states, inputs = zip(*self._seen, strict=True)
            seen = np.array(t), self._error(np.array(states)), np.array(inputs)
        self._seen.clear()
        job = Job(
            self.t, self._error(x), use, replace(memory, sequence=self._sequence - 1),
            target=ReferenceMotion.at_rest(goal) if new else None, task=task, seen=seen,
        )  # fmt: skip
        self._due = max(self._due + task.period, self.t) if not new else self.t + task.period
        self._asked, self._anew = (self._sequence, job, self._clock), False
        self._worker.ask(job)

    def _take(self) -> None:
        answer = self._worker.take(self.t)
        if answer is None or self._asked is None or answer.sequence != self._asked[0]:
            return  # of before a reset
        job, self._asked = self._asked[1], None
        if self.memory is None:
            if answer.proposal.plan is None or answer.memory.plan is None or not answer.jump:
                self._why = answer.proposal.message or answer.proposal.status
                # The designed surface is better than none, or than one of before a reset.
                self.law.use(self._idle.surface, self._cascade(job.task).reaching)
                self._decide(answer, False, f"no surface from here: {self._why}")
                self._anew = False
                self.memory = self._idle
                self.mode = RUNNING
                return
            if not job.target or not any(job.target.position(0.0)):
                self._firsts[job.task] = answer
        elif self.t <= answer.use + 1.5 * PICTURE * self.speed:
            if answer.seconds < 0.5 * self._lead.seconds:
                self._lead.early()
            self._task, self._waiting = job.task, answer
            return
        elif not answer.jump:  # what is for another task may be late: the state is looked at
            self._lead.late()
            self._decide(answer, False, f"late by {1e3 * (self.t - answer.use):.0f} ms")
            return
        self._task = job.task
        self._apply(answer)

    def _apply(self, answer: Answer) -> None:
        """Use an answer, now that its time has come, unless it is for another state."""
        memory = answer.memory
        goal = np.zeros(self.mechanism.n)
        if memory.target is not None:
            goal[:] = memory.target.position(0.0)
        off = np.abs(self.rig.truth - np.concatenate([goal, 0 * goal]) - answer.x)
        bound = self._settings.max_prediction_error * (1.0 + np.abs(answer.x))
        if not (off <= bound).all() and self.memory is not None:
            i = int(np.argmax(off / bound))
            name = self.mechanism.state_names[i]
            factor, unit = display(self.mechanism.coordinates[i % self.mechanism.n].unit)
            rate = "/s" if i >= self.mechanism.n else ""
            words = f"{name} is {factor * off[i]:.3g} {unit}{rate} off what was predicted"
            self._decide(answer, False, words)
            self._anew = answer.jump or not math.isfinite(memory.predicted)
            return
        self._goal, self.memory = goal, memory
        limits = self._task.limits
        if tuple(self.law.mechanism.input_limits) != limits:
            self._limit(limits)
        self.law.lane = answer.law_vectors[0]
        self.law.surface, reaching = memory.plan.at(0.0)
        self.law.reaching = reaching or self._cascade(self._task).reaching
        if memory.estimate is not None:
            self.law.believe(
                self._belief.values(memory.estimate.offset), self._error(self.rig.truth)
            )
        self._spent = 0.0
        if self.mode == WAITING:
            self.mode = RUNNING
        if answer.jump:
            self._begin_bound()
        first = "first optimum of a task" if answer.jump else ""
        # After a jump the search near the plan in use is followed by one everywhere.
        why, jumped, _ = answer.admission.reason.partition("; the state is")
        self._anew = self._anew or bool(jumped)
        self._decide(answer, answer.admission.accepted, first or why)

    def _take_reserve(self) -> None:
        """Go on with the plan in reserve, as on a rig whose velocities have jumped.

        The plan in use was chosen for where it was, at rest for hardly any cost, and may lose what
        is pushed before the next one comes.
        """
        if self.memory is None or self.mode != RUNNING:
            return
        cascade, error = self._cascade(self._task), self._error(self.rig.truth)
        plan = cascade.after_jump(self.memory, error)
        before, lane = self.law.reaching, self.law.lane
        surface, reaching = plan.at(0.0)
        self.law.use(surface, reaching or cascade.reaching)
        self.law(error)
        if self.law.margin[0] > self._settings.min_margin:
            self.memory = replace(self.memory, plan=plan, since=self.t)
            self._tell(True, "a plan in reserve: the velocities have jumped", math.nan)
        else:
            self.law.lane, self.law.reaching = lane, before
            self.law.surface = self.memory.surface

    def _decide(self, answer: Answer, accepted: bool, why: str) -> None:
        """Say what has become of an answer."""
        memory = self.memory or self._idle
        predicted = memory.predicted if answer.memory is memory else math.nan  # of another state
        self._tell(accepted, why, predicted, ms=1e3 * answer.seconds, first=answer.jump)

    def _tell(
        self,
        accepted: bool,
        why: str,
        predicted: float,
        ms: float | None = None,
        first: bool = False,
    ) -> None:
        """Tell viewers what plan is in use now, why, and what the answer took that it is from."""
        memory, learnt = self.memory or self._idle, {}
        if memory.estimate is not None:
            values = self._belief.values(memory.estimate.offset)
            places = zip(self._belief.places, self._belief.tolerances, strict=True)
            for place, name in places:
                learnt[name] = float(values[place])
        reaching = self.law.reaching
        message = plan_message(self.t, accepted, why, memory.plan, predicted, reaching)
        message |= {
            "ms": ms, "first": first, "learnt": learnt,
            "ghost": self.scene.places(self._goal, self._parameters).tolist(),
            "goal": self._goal.tolist(), "objective": self._task.objective,
            "plausible": plausible(self._belief, memory.estimate),
        }  # fmt: skip
        self._decisions.append(message)
        self._fresh.append(message)

    def _limit(self, limits: tuple[float, ...]) -> None:
        """Let law and plant have other limits of the inputs."""
        before = self.law
        limited = self.mechanism.with_input_limit(*limits)
        self.law = InnerLoop(limited, before.surface, before.reaching)
        self.law.lane = before.lane
        self.law.parameters[:] = before.parameters

    # -- what is told to viewers --------------------------------------------------------------

    def _say_frame(self) -> None:
        x = self.rig.truth
        error = self._error(x)
        s, demand = (self.law.surface.s(error), self.law.demand)
        predicted = math.nan if self.memory is None else self.memory.predicted - self._spent
        frame = frame_message(
            self.scene, self._parameters, self.t, x, self._u, demand, s, predicted
        )
        if self.hands:
            frame["held"] = self.hands.shown(x[: self.mechanism.n], self._parameters)
        if not self._history or self._history[-1]["t"] < self.t:
            self._history.append(frame)
        self._fresh.append(frame)

    # -- what viewers do ----------------------------------------------------------------------

    def hear(self, said: Message, viewer: int) -> None:
        """Do what a viewer asks for.

        Raises
        ------
        InvalidInputError
            For what cannot be done.
        """
        what, here = said.get("do"), self.rig.truth[: self.mechanism.n]
        acts: dict[str, Callable[[], None]] = {
            "pause": lambda: self._pause(bool(said.get("on", not self.paused))),
            "step": self._single,
            "speed": lambda: self._go(number_of("speed", said.get("to"))),
            "reset": self.reset,
            "push": lambda: self._push(-1.0 if said.get("side") == -1 else 1.0),
            "grab": lambda: self.hands.grab(
                viewer, self.controls.plant, here, _place(said.get("at"))
            ),
            "drag": lambda: self.hands.move(viewer, _place(said.get("at"))),
            "release": lambda: self.gone(viewer),
            "look": lambda: self._set_look(said.get("axis"), said.get("reach")),
            "set": lambda: self._set(str(said.get("name")), said.get("value")),
            "defaults": self._defaults,
        }
        one_of("what a viewer asks for", str(what), acts)
        acts[str(what)]()

    def gone(self, viewer: int) -> None:
        """Let go of what a viewer holds."""
        if self.hands.let_go(viewer) and not self.hands:
            self._touched, self._due = True, self.t

    def reset(self) -> None:
        """Begin again at the start, with the controls as they stand."""
        self.rig = self._rig(self._x0)
        self.mode, self._why, self.memory = WAITING, "", None
        self.t = self._debt = self._due = self._spent = 0.0
        self._asked = self._waiting = None  # what is still computed is for what is over
        self._anew = self._touched = False
        self._task, self._goal = self.controls.task, np.zeros(self.mechanism.n)
        self._u = np.zeros(self.mechanism.m)
        self._limit(self._task.limits)
        self.law.parameters[:] = self.mechanism.parameter_values
        for kept in (self._seen, self.hands, self._history, self._decisions, self._said):
            kept.clear()
        self._beside.forget()
        self._bound, self._region = {}, {}
        self._fresh.append({"kind": "reset"})

    def _pause(self, on: bool) -> None:
        self.paused, self._debt = on, 0.0

    def _single(self) -> None:
        """One picture on: a sixtieth of a second, slower in slow motion."""
        self.paused = True
        if self.mode != WAITING:
            for _ in range(max(1, round(self.speed * PICTURE / STEP))):
                self._step()

    def _go(self, speed: float) -> None:
        one_of("speed", str(speed), map(str, SPEEDS))
        self.speed = speed

    def _push(self, side: float) -> None:
        n = self.mechanism.n
        inverse = np.linalg.inv(self.controls.plant.M(self.rig.truth[:n]))
        change = self._usual_push * self.controls[PUSH].si
        impulse = np.zeros(n)
        impulse[-1] = side * change / inverse[-1, -1]
        self.rig.knock(impulse)
        self._take_reserve()
        self._touched, self._due = True, self.t
        self._end_bound()

    def _set(self, name: str, value: object) -> None:
        one_of("control", name, self.controls)
        self._put([self.controls[name].put(value)])

    def _defaults(self) -> None:
        self._put([replace(c, value=c.usual) for c in self.controls.values()])

    def _put(self, changed: Sequence[Control]) -> None:
        """Change controls; where no such plant or task can be, all stay as they were."""
        before = self.controls
        self.controls = before.changed(changed)
        try:
            if any(c.group == "plant" or c.name.startswith("limit") for c in changed):
                self.rig = self._rig(self.rig.truth)
                self._limit(self.controls.task.limits)
                self._end_bound()
        except UndertowError as error:
            self.controls = before
            raise InvalidInputError(
                "control", value=str(error), limit="values that go together"
            ) from error
        finally:
            shown = [self.controls[c.name].shown() for c in changed]
            self._fresh.append({"kind": "controls", "controls": shown})

    def _warm_up(self) -> None:
        """Have the fast loop compiled, while the first plan is sought and viewers come."""
        try:
            rig, x = self._rig(self._x0), self._error(self._x0)
            rig.knock(np.zeros(self.mechanism.n))
            rig.write(InnerLoop(self.mechanism, self._idle.surface)(x))
        except BaseException as error:
            self.ready.set_exception(error)
        else:
            self.ready.set_result(None)

    def close(self) -> None:
        """End the slow loop."""
        self._worker.close()
        self._beside.close()


def simulation(
    name: str, mechanism: Mechanism, x0: FloatArray, objective: str, period: float, seed: int = 0
) -> Simulation:
    """Return a simulation of a mechanism that was asked for by name, with the figure for that."""
    figure = sketch_named(name, mechanism)
    looks_on = beside(mechanism)
    try:
        return Simulation(
            mechanism, figure, x0, objective=objective, period=period, seed=seed, beside=looks_on
        )  # fmt: skip
    except BaseException:
        looks_on.close()
        raise


def _place(value: object) -> FloatArray:
    """Return a place in the picture, (2,), m."""
    if not isinstance(value, list) or len(value) != 2:
        raise InvalidInputError("place in the picture", value=repr(value)[:80], limit="[x, y], m")
    place = np.array([number_of("place in the picture", v) for v in value])
    require((np.abs(place) < 1e6).all(), "place in the picture", place.tolist(), "near it")
    return place
