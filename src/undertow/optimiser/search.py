"""The searches for a plan: global from nothing, local from a plan in use.

A global search first improves the best of some quadratic designs, which is an answer already, and
then looks elsewhere: for a smooth cost by descents from the best of many draws, for the time of
arrival by :mod:`undertow.optimiser.arrival`.  Of a smooth cost the best single surface comes first,
where there may be several one after another: its copies are what they are improved from.  Where
a plan has to suit many plausible plants, a smooth cost is searched far and wide for one of them, at
a fraction of the time, and its minima are improved for all; where these then disagree, for all from
the start.

What independent random starts of a global search lead to is kept: it tells how likely its answer
is the best one, see :mod:`undertow.optimiser.confidence`.  For a smooth cost these are descents of
their own in the end, unfinished ones told from other minima by a hill-valley test [1]_; for the
time of arrival the searches far and wide and from switching points.

References
----------
.. [1] Ursem, "Multinational evolutionary algorithms", Proc. CEC 1999, 1633-1640.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache
from itertools import chain
from typing import Any

import numpy as np

from undertow.closed_loop import INADMISSIBLE, LANES, UNSTABLE
from undertow.law import Plan, stability_margin
from undertow.models import FloatArray
from undertow.optimiser.arrival import SHORTER, ArrivalSearch
from undertow.optimiser.cma_es import CMAES, minimise
from undertow.optimiser.confidence import confidence
from undertow.optimiser.proposal import Budget
from undertow.optimiser.schedules import WIDE, WORTHWHILE, follow_earliest, lead_back
from undertow.optimiser.switching import SwitchingSurfaces
from undertow.optimiser.task import Optimisation
from undertow.optimiser.trust_region import TrustRegion

#: Largest number of coordinates for a model search: its model has 55 terms then.
MODEL_SIZE = 9

#: Draws that are rolled out between two looks at the clock, where the time is limited.
TOGETHER = 512

#: Fruitless looks around that end a re-optimisation.
LOOKS = 2

#: Generations that end a search along a ridge, where gains come in jumps, unless together they
#: gain this part of the time.
PATIENCE, GAIN = 8, 3e-3

#: Searches with a model from the best of so many draws each, after a global search of a smooth
#: cost, to see where they end; and their evaluations, in terms of the model.
RESTARTS, TRIED, TERMS = 11, 64, 24

#: Where a rollout is one on each of many plants: so many generations that together gain less than
#: this part of the cost end a descent.
LONG_PAUSE, SLOW = 40, 1e-4

#: Confidence from which minima for one plant lead to the best one for all, where it is hardly
#: improved without a model.
AGREED = 0.5

#: Widest spread of a first population along a ridge.
FAR = 0.25

#: Evaluations at most that improve a plan along its ridge: of a first answer, and where searches
#: for an earlier arrival lead nowhere; and what searches with a model found, without one.
POLISH = 512

#: A search for arrivals far and wide: its members, draws for each of them, and between which parts
#: of the best time it begins: what arrives a little later may lead to what arrives earlier.
CROWD, DRAWS, BEGINS = 48, 64, (0.95, 1.3)

#: Searches from the switches of the earliest arrival that follow each one far and wide, and how
#: many around the best plan may lead nowhere then.
SWITCHING, LESS_FRUITLESS = 2, 2

#: The same around the best plan: the spread is between two powers of ten; and how many of these
#: searches in turn may lead nowhere before the next one far and wide.  With few parameters arrivals
#: are isolated, and one is enough.
FEW, AROUND, NEAR_AND_FAR, FRUITLESS = 24, 8, (-1.5, 0.3), 6

#: A single surface is divided into so many, the first but one of which takes over after this part
#: of the time in which nearly all of the cost, this part, is spent, each later one after twice the
#: time; and the evaluations that improving them may take, per coordinate of a single one.
DIVIDED, SOON, NEARLY_ALL, FINE = 5, 1 / 8, 0.95, 10240

#: Evaluations, and the spread of the first population, where a plan all but does.
CLOSE_BY, HAIR = 512, 1e-3

#: Evaluations for a single surface where no schedule arrives; twice as many without any plan.
ALONE = 1024

#: Of few parameters, a plan that costs so many times what it promised, however it is improved, is
#: one of many: the evaluations that another one is looked for with.
BROKEN, ANEW = 1.05, 16384

#: Time constants of the first surface after which, without any plan, an arrival is looked for.
LONG = 10.0


def _descend(
    task: Optimisation, z: FloatArray, sigma: float, evaluations: int, tolerance: float
) -> bool:
    search = CMAES(z, sigma, task.optimiser.population, task.rng)
    # Times of arrival improve in jumps: a pause is no sign that the search is done.
    smooth = not task.optimiser.counts_time
    resolution = task.resolution if smooth else 0.0
    pause: dict[str, Any] = {}
    if smooth and task.plants > 1 and not (task.warm or resolution):
        pause = {"relative": SLOW, "patience": LONG_PAUSE, "below": INADMISSIBLE}
    minimise(
        search,
        task.cost,
        evaluations=min(evaluations, task.left),
        tolerance=tolerance,
        resolution=resolution,
        stop=lambda: task.left < search.population or task.late(),
        **pause,
    )
    return search.converged


def descend_close_by(task: Optimisation, plan: Plan) -> bool:
    """Descend from a plan that all but does, whether or not it is admissible."""
    here = task.begin(plan)
    task.score_incumbent(here)
    return _descend(task, here, HAIR, task.left, 1e-3)


def global_search(task: Optimisation) -> Iterator[bool]:
    """Search, then take over what a plainer set of decision variables allows, where that is better.

    What it allows this one allows, too: no answer is worse than that of a plainer set.  Yields
    for each answer whether it has converged.
    """
    plainer = task.plainer()
    return chain(_own_search(task), _take_over(task, plainer))


def _take_over(task: Optimisation, plainer: Optimisation | None) -> Iterator[bool]:
    if plainer is None or task.late():
        return
    before = task.best_cost
    *_, converged = global_search(plainer)
    task.budget = Budget(task.budget.evaluations + plainer.budget.evaluations, task.budget.seconds)
    task.evaluations += plainer.evaluations
    task.minima.append(plainer.best_cost)
    if plainer.best is not None:
        task.consider(plainer.best)
    if task.best_cost < before:
        yield converged
        if task.optimiser.counts_time and task.optimiser.freedom.schedule:
            yield from follow_earliest(task)


def _own_search(task: Optimisation) -> Iterator[bool]:
    """Search with the task's own decision variables; yields whether it has converged."""
    return _earliest(task) if task.optimiser.counts_time else _least(task)


def _earliest(task: Optimisation) -> Iterator[bool]:
    """Improve the design that arrives first, then look elsewhere for an earlier arrival."""
    task.cost(task.firsts[: max(1, task.left)])
    done = _along_ridge(task, min(POLISH, task.left))
    if not task.best_cost < INADMISSIBLE:
        if task.plants == 1:
            _descend_from_draws(task, ALONE, 3 * ALONE)
        else:
            _near_one_plant(task)
        done = _along_ridge(task, min(POLISH, task.left))
    yield done
    schedule, done = task.optimiser.freedom.schedule > 0, False
    if schedule:
        for done in follow_earliest(task, task.left // 2):
            yield done
    if done:
        return
    _arrive_earlier(task, wide=True, keep=POLISH + schedule * (task.left // 2))
    yield _along_ridge(task, POLISH if schedule else task.left)
    if schedule:
        yield from follow_earliest(task)


def _least(task: Optimisation) -> Iterator[bool]:
    """Improve the best of the designs by a smooth cost, then look elsewhere."""
    several = len(task.space.freedom.times) > 1 or task.optimiser.freedom.schedule > 0
    if several:
        task.switch_at((0.0,))
        task.kept = min(FINE * task.space.size, 3 * task.left // 4)
    again = 0 if several else restart_budget(task.space.size)
    if again and task.left >= single_budget(task.space.size) + again:
        task.kept = again
    z = task.firsts[: max(1, task.left)]
    scores = task.cost(z)
    one = None
    if task.centre.size <= MODEL_SIZE:
        _model_search(task, task.centre)
        if not task.best_cost < INADMISSIBLE:
            one = _near_one_plant(task)
        yield False
    one = one or _near_one_plant(task)
    converged = None
    if one is not None and 0 < one.best_cost < INADMISSIBLE and task.best_cost < INADMISSIBLE:
        converged = _go_on_from(task, one)
    if converged is None:
        converged = _search_everywhere(task, z, scores)
        if not several and task.kept:
            task.kept = 0
            _restart(task)
    yield converged
    if several:
        task.kept, task.minima = 0, []  # minima of single surfaces
        task.switch_at(_division(task))
        yield _descend(task, task.centre, 0.1, task.left, 1e-4)


def _search_everywhere(task: Optimisation, z: FloatArray, scores: FloatArray) -> bool:
    """Descend from the best of many draws, and of what was scored before."""
    optimiser, rng, total = task.optimiser, task.rng, task.evaluations + task.left
    draws = max(optimiser.population, total // 6)
    drawn, costs = zip(*_draws(task, draws), strict=True)
    z, scores = np.vstack([z, *drawn]), np.concatenate([scores, *costs])
    if not scores.min() < UNSTABLE:  # not one that may be rolled out: nothing to go by
        return False
    starts = z[np.argsort(scores, kind="stable")[:3]]
    share = (total - len(z)) // 4
    for start in starts:
        _descend(task, start, 0.3, share, 3e-3)
    converged = _descend(task, task.centre, 0.03, share, 1e-4)
    while task.left >= optimiser.population and not task.late():
        start = task.centre + task.space.steps(rng, np.ones(1))[0]
        _descend(task, start, 0.3, task.left, 3e-3)
    return converged


def _go_on_from(task: Optimisation, one: Optimisation) -> bool | None:
    """Improve for all plausible plants each minimum that a search for one plant found.

    Returns whether that has converged, and ``None`` where most do not lead to the same: what is
    best for one plant may be late on the others, and what is best for all somewhere else.  Where
    each leads to counts as often as the minimum was found.  A bound that some plants meet misleads
    models: the best is improved without one, too.
    """
    if task.centre.size > MODEL_SIZE:
        return _descend(task, task.centre, 0.03, task.left, 1e-4)
    assert one.best is not None  # an admissible one
    converged = True
    for found, times in one.found or [(one.best, 1)]:
        search = _model_search(task, task.space.encode(found))
        converged &= search.converged
        if search.best_f < INADMISSIBLE:
            task.minima += times * [search.best_f]
    if (confidence(task.minima) or 0.0) < AGREED:
        task.minima = []
        return None
    return _descend(task, task.centre, 0.03, POLISH, 1e-4) or converged


def _draws(task: Optimisation, count: int) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Yield draws about the first design, (N, d), and their costs: as many as there is time for."""
    together = count if math.isinf(task.budget.seconds) else TOGETHER
    for first in range(0, count, together):
        if first and (task.left <= 0 or task.late()):
            return
        z = task.firsts[0] + task.space.steps(task.rng, np.ones(min(together, count - first)))
        z = z[: max(1, task.left)]
        yield z, task.cost(z)


def _near_one_plant(task: Optimisation) -> Optimisation | None:
    """Look near what is best for one plant, the estimate, for what suits every plausible one.

    That takes a fraction of the time, and what suits all may be near it: a motion that goes up to
    the singularity (37) on one plant is past it on the next.  Returns the search for one plant.
    """
    one = task.for_one_plant()
    if one is None or task.late():
        return None
    for _ in _own_search(one):
        pass
    task.take_time_of(one)
    if one.best is not None and one.best_cost < INADMISSIBLE:
        here = task.space.encode(one.best)
        task.cost(here[None])
        for spread in (0.1, 0.3, 0.03):
            if not task.best_cost < INADMISSIBLE:
                _descend(task, here, spread, min(ALONE, task.left), 1e-3)
    return one


def _descend_from_draws(task: Optimisation, draws: int, share: int) -> None:
    """Descend from the best three of many draws, until a plan is admissible."""
    z = task.firsts[0] + task.space.steps(task.rng, np.ones(max(1, min(draws, task.left))))
    for start in z[np.argsort(task.cost(z), kind="stable")[:3]]:
        if not task.best_cost < INADMISSIBLE:
            _descend(task, start, 0.3, share, 3e-3)


def single_budget(size: int) -> int:
    """Return the evaluations of a search for a single surface of a smooth cost.

    6144 for the three parameters of n = 2; a covariance takes as long to learn as it has entries.
    """
    return 2048 * size**2 // 3


def restart_budget(size: int) -> int:
    """Return the evaluations of all restarts with so many coordinates; none where they are many."""
    terms = (size + 1) * (size + 2) // 2
    return RESTARTS * (TRIED + TERMS * terms + LANES) if size <= MODEL_SIZE else 0


def _restart(task: Optimisation) -> None:
    """Search from independent random starts, and keep the minima to which that leads.

    An end from which the way straight to the best plan leads over no higher cost lies in the
    valley of that: descents that are not finished are not other minima.
    """
    each, ends = task.left // RESTARTS - LANES, []
    for _ in range(RESTARTS):
        if task.left < each + LANES or task.late():
            break
        drawn = task.firsts[0] + task.space.steps(task.rng, np.ones(TRIED))
        here, cost = drawn[task.cost(drawn).argmin()], np.inf
        most, gained = each - TRIED, True
        while gained and most >= LANES and not task.late():
            before = task.evaluations
            search = _model_search(task, here, most)
            gained = search.best_f < (1.0 - WORTHWHILE) * cost
            here, cost = search.best_x, min(cost, search.best_f)
            most -= max(task.evaluations - before, 1)
        if cost < INADMISSIBLE:
            ends.append((here, cost))
    parts = np.linspace(0.0, 1.0, LANES + 2)[1:-1, None]
    others, here = [], task.centre
    for there, cost in ends:
        between = task.cost(here + parts * (there - here))
        if between.max() > (1.0 + WORTHWHILE) * cost:
            others.append((there, cost))
    same = 1 + len(ends) - len(others)
    task.minima += same * [task.best_cost] + [cost for _, cost in others]
    task.found = [(task.space.plan(z), 1) for z, _ in others]
    task.found.insert(0, (task.space.plan(here), same))


def _division(task: Optimisation) -> tuple[float, ...]:
    """When each of several surfaces is to take over from the best single one, s."""
    period, best = task.optimiser.freedom.schedule, task.best
    if not period:
        return task.optimiser.freedom.times
    assert best is not None  # cost() has run before
    motion = task.loop.simulate(task.x, best, duration=task.horizon)
    spent = np.searchsorted(motion.accumulated_cost, NEARLY_ALL * motion.cost)
    first = period * max(1, round(SOON * float(motion.t[spent]) / period))
    times = (round(first * 2**k, 9) for k in range(DIVIDED - 1))
    return (0.0, *(t for t in times if t < task.horizon))


def local_search(task: Optimisation, incumbent: Plan) -> bool:
    """Start from the incumbent; look further away where that gains nothing."""
    if task.optimiser.freedom.schedule:
        task.switch_at(incumbent.times)
    here = task.begin(incumbent)
    if task.left < 2 * LANES or task.late():
        task.score_incumbent(here)
    if here.size > MODEL_SIZE:
        task.score_incumbent(here)
        _look_around(task, here)
        return _descend(task, task.centre, 0.1, task.left, 1e-3)
    search = _model_search(task, here)
    if not task.best_cost < INADMISSIBLE:
        _look_around(task, here)
        return _descend(task, task.centre, 0.3, task.left, 1e-3)
    # Look further away, and go where that leads, until it leads nowhere any more.
    fruitless = 0
    while fruitless < LOOKS and task.left >= LANES and not task.late():
        before = task.best_cost
        _look_around(task, task.centre)
        fruitless += 1
        if task.best_cost < (1.0 - WORTHWHILE) * before - task.resolution:
            search = _model_search(task, task.centre)
            fruitless = 0
    return fruitless == LOOKS or search.converged


def _model_search(task: Optimisation, here: FloatArray, most: int | None = None) -> TrustRegion:
    """Follow a quadratic model of the cost from some coordinates on, to so many evaluations."""
    search = TrustRegion(here, 0.1, LANES, task.rng)
    minimise(
        search,
        task.cost,
        evaluations=task.left if most is None else most,
        tolerance=1e-4,
        resolution=task.resolution,
        relative=WORTHWHILE,
        patience=2,
        stop=lambda: task.left <= 0 or task.late(),
    )
    task.score_incumbent(here)  # where there was no time for a single generation
    return search


def search_earlier(task: Optimisation, incumbent: Plan) -> bool:
    """Search for an earlier arrival along the thin set of plans that arrive directly.

    Across that set the closest approach moves away from 0 at once, along it hardly: the
    first population is shaped by ∂(closest state)/∂z.
    """
    here = task.begin(incumbent)
    task.score_incumbent(here)
    if task.optimiser.freedom.schedule:
        if lead_back(task, incumbent):
            return True
        alone = ALONE if task.best_cost < INADMISSIBLE else 2 * ALONE
        _arrive_earlier(task, keep=max(0, task.left - alone))
        found = task.best
        return found is not None and found is not incumbent and lead_back(task, found)
    if not task.best_cost < INADMISSIBLE:
        _look_around(task, here)
    if task.optimiser.aims:
        _along_ridge(task, min(POLISH, task.left))
        return _arrive_earlier(task)
    converged = _along_ridge(task, task.left)
    if task.best_cost > BROKEN * task.promised + 2 * task.loop.step:
        if task.usual:
            task.budget = Budget(task.evaluations + ANEW)
        _arrive_earlier(task, wide=True, keep=POLISH)
        converged = _along_ridge(task, task.left)
    return converged


def _along_ridge(task: Optimisation, most: int) -> bool:
    """Search from the best plan along its ridge, with so many evaluations at most."""
    here = task.centre
    if not task.best_cost < INADMISSIBLE:
        return _descend(task, here, 0.1, most, 1e-3)
    d, loop = here.size, task.loop
    if task.best_cost <= loop.step:  # all but there
        return True
    if most < 2 * d + LANES or task.late():
        return False
    probes = here + 1e-4 * np.vstack([np.eye(d), -np.eye(d)])
    task.evaluations += len(probes)
    vectors, gains = task.space.decode(probes)
    near = loop.batch(
        task.x, vectors, reaching=gains, switch_times=task.space.freedom.times,
        duration=1.05 * task.best_cost, terminal=0.0, seek=True,
    ).closest_x  # fmt: skip
    slope = (near[:d] - near[d:]) / 2e-4
    if not np.isfinite(slope).all():
        return _descend(task, here, 0.1, most, 1e-3)
    across, steepness, _ = np.linalg.svd(slope)
    spread = np.full(d, FAR)
    tight = loop.objective.terminal_radius / np.maximum(steepness, 1e-12)
    spread[: len(tight)] = np.minimum(tight, FAR)
    search = CMAES(here, 1.0, LANES, task.rng, (across * spread**2) @ across.T)
    minimise(
        search,
        task.cost,
        evaluations=min(most, task.left),
        tolerance=1e-4,
        relative=GAIN,
        patience=PATIENCE,
        stop=lambda: task.left < search.population or task.late(),
    )
    return search.converged


@cache
def _reaches(count: int) -> FloatArray:
    return np.geomspace(0.1, 1.0, count)


def _look_around(task: Optimisation, here: FloatArray) -> None:
    wide = min(task.left, LANES)
    if wide > 0:
        around = here + task.space.steps(task.rng, _reaches(wide))
        task.cost(around, hopeless=1.0)


def _arrive_earlier(task: Optimisation, wide: bool = False, keep: int = 0) -> bool:
    """Search for earlier arrivals around the best plan, or first far and wide.

    And far and wide again when that leads nowhere any more; so many evaluations are left over.
    A first plan with a reaching law of its own is looked for around the switches of the earliest
    motion, too: without one, a few surfaces switch there, and more local searches serve better.
    """
    rng, space, spent = task.rng, task.space, -1
    search = ArrivalSearch(
        task.states,
        lambda z: task.cost(z) < INADMISSIBLE,  # those that arrive did so on the first plant
        0.9 * task.loop.objective.terminal_radius,
        lambda evaluations: task.left < evaluations + keep or task.late(),
    )
    freedom = task.optimiser.freedom
    single = wide and freedom.reaching and not freedom.schedule and task.plants == 1
    most = 1
    if task.optimiser.aims:
        most = LESS_FRUITLESS if single else FRUITLESS
    fruitless = most if wide else 0
    switching: SwitchingSurfaces | None = None
    while task.left > keep and not task.late() and task.evaluations > spent:
        before, spent = task.best_cost, task.evaluations
        if before <= task.loop.step:  # all but there
            return True
        if not before < INADMISSIBLE or fruitless == most:
            z = task.firsts[0] + space.steps(rng, np.full(CROWD * DRAWS, WIDE))
            known = before < INADMISSIBLE
            T = rng.uniform(*BEGINS) * before if known else _long(task)
            task.minima.append(search.run(z, T, CROWD))
            fruitless = 0
            if single and not search.without(len(z)):
                single, switching = False, SwitchingSurfaces.of(task, keep)
            if switching is not None:
                ends = (switching.search(task, search) for _ in range(SWITCHING))
                task.minima.extend(ends)
            continue
        spread = 10.0 ** rng.uniform(*NEAR_AND_FAR, FEW * AROUND)
        search.run(task.centre + space.steps(rng, spread), SHORTER * before, FEW)
        fruitless += 1
        if task.best_cost < (1.0 - WORTHWHILE) * before:
            fruitless = 0
        elif fruitless == 1:
            _along_ridge(task, min(POLISH, task.left - keep))
    return False


def _long(task: Optimisation) -> float:
    """A time, s, in which something should have arrived."""
    anchor = task.optimiser.anchor
    rate = float(stability_margin(task.loop.mechanism, anchor.vector[None])[0])
    return min(task.horizon, LONG / max(rate, LONG / task.horizon))
