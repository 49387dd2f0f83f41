"""From hanging at rest to balanced on realistic rigs; and MuJoCo as the truth, no retuning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from undertow.cascade import Cascade
from undertow.cascade.swing_up import CatchRegion, SwingUp, SwingUpAndCatch, hanging
from undertow.cascade.swing_up.search import RatedGains, designs_for
from undertow.estimators import Estimator
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray, Mechanism
from undertow.objective import objective_for
from undertow.optimiser import Budget
from undertow.plants import Bench, MuJoCoRig
from undertow.plants.bench import bench_for
from undertow.runtime import default_gate, estimator_for
from undertow.studies.trials.steering import CascadeSteering
from undertow.studies.trials.trial import Outcome, Result, judge, run_trial, trial

#: Length of a swing-up run, s.
SWING_SECONDS = 30.0
#: Mechanisms of the library that a swing-up is shown for, and that MuJoCo stands in for.
SWINGING = ("rotary_pendulum", "cart_pendulum", "pendubot")
ENGINES = ("rotary_pendulum", "cart_pendulum", "double_pendulum_on_a_cart")


@dataclass(frozen=True)
class SwingResult:
    """Swing-ups of one mechanism of the library, by its ``name``.

    ``gains``: those of the energy law. ``catches``: times of the last catch, s, of the runs that
    had one. ``thrown``: how often a run was thrown out, in all. ``stops``: runs that hit an end
    stop. Angles of the outcomes are counted from the upright that they ended in.
    """

    name: str
    gains: tuple[RatedGains, ...]
    outcomes: tuple[Result, ...]
    catches: tuple[float, ...]
    thrown: int
    stops: int


@dataclass(frozen=True, eq=False)
class SwingRun:
    """One swing-up.

    ``outcome``: angles are counted from the upright that it ended in. ``catch``: time of the last
    catch, s; NaN for a run that did not end in one. ``thrown``: how often it was thrown out.
    ``stop``: whether it hit an end stop.
    """

    outcome: Outcome
    catch: float
    thrown: int
    stop: bool


def swing_trial(
    bench: Bench,
    swing: SwingUp,
    region: CatchRegion,
    *,
    seed: int = 0,
    seconds: float = SWING_SECONDS,
    estimator: Estimator | None = None,
) -> SwingRun:
    """Swing a mechanism up on a realistic rig, once, from hanging at rest.

    Energy law and catch region have the controller's belief, the bench is the truth; the run takes
    ``seconds``, s; the estimator is as for :func:`undertow.studies.trials.trial.trial`.
    """
    mechanism = region.mechanism
    controller = SwingUpAndCatch(swing, region)
    run = trial(
        mechanism,
        bench,
        lambda _: controller,
        hanging(mechanism),
        seconds,
        seed,
        estimator=estimator,
        compensates=lambda: controller.balancing,
    )
    truth = run.record.truth - controller.offset
    edges = np.array([[c.low, c.high] for c in mechanism.coordinates])
    positions = run.record.truth[:, : mechanism.n]
    return SwingRun(
        judge(mechanism, replace(run.record, truth=truth), seed),
        controller.events[-1][0] if controller.balancing else math.nan,
        sum(what == "lost" for _, what in controller.events),
        bool(((positions <= edges[:, 0]) | (positions >= edges[:, 1])).any()),
    )


def swing_trials(
    mechanism: Mechanism,
    gains: Sequence[RatedGains],
    *,
    seeds: int = 20,
    seconds: float = SWING_SECONDS,
) -> SwingResult:
    """Swing a mechanism up on realistic rigs, from hanging at rest, one for each seed.

    The energy law has the ``gains``; a run takes ``seconds``, s.
    """
    bench, region = bench_for(mechanism), CatchRegion(mechanism)
    swing = SwingUp(mechanism, tuple(one.gains for one in gains))
    runs = [swing_trial(bench, swing, region, seed=seed, seconds=seconds) for seed in range(seeds)]
    return SwingResult(
        mechanism.name,
        tuple(gains),
        tuple(run.outcome.numbers for run in runs),
        tuple(run.catch for run in runs if math.isfinite(run.catch)),
        sum(run.thrown for run in runs),
        sum(run.stop for run in runs),
    )


def searched(name: str, *, seeds: int, fresh: int | None = None) -> SwingResult:
    """Do the same for a mechanism of the library with its gains, kept or searched for.

    The kept ones are taken where ``fresh``, the seed of a new search, is ``None``.
    """
    mechanism = LIBRARY[name]()
    gains = designs_for(mechanism, seed=fresh or 0, fresh=fresh is not None)
    return swing_trials(mechanism, gains, seeds=seeds)


@dataclass(frozen=True, eq=False)
class EngineResult:
    """A run of the cascade in MuJoCo; ``final``, (n,), are the positions at its end."""

    name: str
    outcome: Result
    final: FloatArray
    admitted: int


def engine_trial(name: str, *, seconds: float = 10.0, budget: int = 256) -> EngineResult:
    """Balance a mechanism of the library in MuJoCo, from its usual start, positions only.

    The same settings for all of them; the engine gets the belief's parameters, and none of its
    equations. The run takes ``seconds``, s, a re-optimisation ``budget`` rollouts at most.
    """
    mechanism = LIBRARY[name]()
    x0 = mechanism.state(**mechanism.start)
    rig = MuJoCoRig(mechanism, x0)
    objective = objective_for(mechanism, "effort")
    kalman = estimator_for(mechanism, Bench(mechanism))
    cascade = Cascade(
        mechanism, objective, gate=default_gate(kalman), warm=Budget(budget), belief="exact"
    )
    steering = CascadeSteering(cascade, cascade.start(x0))
    record = run_trial(mechanism, rig, kalman, lambda _: steering, seconds)
    outcome = judge(mechanism, record, 0, objective)
    final = record.truth[-1, : mechanism.n]
    return EngineResult(mechanism.name, outcome.numbers, final, steering.admitted)
