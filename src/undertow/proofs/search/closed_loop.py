"""The search behind a proof of the closed loop: a terminal set, and how to cut the starts.

Nothing here proves anything: what is found is decided by
:meth:`undertow.proofs.LoopClaim.decide`, from its numbers alone.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property, partial

import numpy as np
from scipy.linalg import solve_discrete_lyapunov

from undertow.base.arguments import require
from undertow.base.errors import InfeasibleError
from undertow.base.verdict import Verdict
from undertow.law import ReachingLaw, SlidingModeLaw, Surface
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.proofs.claims.closed_loop import LoopClaim
from undertow.proofs.claims.model_data import law_of, model_of
from undertow.proofs.claims.terminal_ellipsoid import TerminalEllipsoid
from undertow.proofs.kernel import claims as kernel
from undertow.proofs.kernel.claims import STEP
from undertow.proofs.kernel.compiled import between
from undertow.proofs.kernel.loop import MOST_OF_ONE, ContinuousLoop, HeldLoop, Loop, halves
from undertow.proofs.kernel.model import Law, Model, scale_of, system
from undertow.proofs.search.terminal_ellipsoid import EllipsoidSearch, search_for

#: Motions that are simulated for the terminal set; the thinnest box of starts, of the reach.
MOTIONS, THINNEST = 24, 2.0**-16

#: Time that a tube may take beyond twice that of the longest before it, s: then it is too wide.
PATIENCE = 0.5

#: How a box of starts grows after one whose tube arrived, and shrinks after one that was lost.
WIDER, THINNER = 1.25, 0.5

#: Parts that a box of plants is cut into before a start is given up; the part of a box of starts
#: that is tried first, and the pieces that it may be cut into.
MOST_PARTS, FIRST_BOX, MOST_PIECES = 64, 2.0**-5, 10_000

#: By how many times the pieces of a box may become more for one that is larger; its least growth.
MORE_PIECES, LEAST_WIDER = 8, 1.02


@dataclass(frozen=True)
class ProvedLoop:
    """Starts from which the loop converges.

    ``claim``: what was found. ``verdict``: its verdict, by the kernel. ``seconds``: process time of
    search and proof together.
    """

    claim: LoopClaim
    verdict: Verdict
    seconds: float


def runge_kutta(
    rate: Callable[[FloatArray], FloatArray],
    x: FloatArray,
    duration: float,
    step: float,
    every: int,
) -> tuple[FloatArray, FloatArray]:
    """Return float64 RK4 motions from states (L, N), (K + 1, L, N) every so many steps, and times.

    ``rate`` is of the states; ``duration`` and ``step`` are in s.
    """
    path, times = [x], [0.0]
    with np.errstate(all="ignore"):
        for k in range(1, max(1, round(duration / step)) + 1):
            a = rate(x)
            b = rate(x + 0.5 * step * a)
            c = rate(x + 0.5 * step * b)
            x = x + step / 6 * (a + 2 * b + 2 * c + rate(x + step * c))
            if k % every == 0:
                path.append(x)
                times.append(k * step)
    return np.array(path), np.array(times)


def follow(
    law: SlidingModeLaw, x: FloatArray, duration: float, every: int = 4, period: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Return float64 RK4 motions of the clipped loop from states (L, 2n), and their times.

    Steps are of ε/η, the time in which s decays in the layer, and of 5 ms at most; with the input
    held for a period, they are periods. Returns states (K + 1, L, 2n), every so many steps, and
    times (K + 1,), s.
    """
    n = law.mechanism.n
    eta, layer = law.reaching.per_surface(law.mechanism.m)
    step = period or float(min(0.005, np.min(layer / eta)))

    def under(u: FloatArray, x: FloatArray) -> FloatArray:
        return np.concatenate([x[..., n:], law.mechanism.accelerations(0.0, x, u)], axis=-1)

    if not period:
        return runge_kutta(lambda x: under(law(0.0, x).u, x), x, duration, step, every)
    path, count = [x], max(1, round(duration / period))
    with np.errstate(all="ignore"):
        for k in range(1, count + 1):
            u = law(0.0, x).u
            x = runge_kutta(partial(under, u), x, period, period, 1)[0][1]
            if k % every == 0:
                path.append(x)
    return np.array(path), np.linspace(0.0, period * every * (len(path) - 1), len(path))


def prove_loop(
    mechanism: Mechanism,
    surface: Surface,
    reaching: ReachingLaw | None = None,
    *,
    starts: Mapping[str, float],
    period: float = 0.0,
    plant: Mapping[str, tuple[float, float]] | None = None,
    duration: float = 15.0,
    seconds: float = 300.0,
    progress: Callable[[str], None] | None = None,
) -> ProvedLoop:
    """Prove that the loop converges from as far off the target as it can.

    Parameters
    ----------
    starts
        States that are off the target, and by how much at most, SI units; the others are 0. With
        one, a line of starts grows piece by piece; with several, a box of this shape, all of them
        at once, grows as a whole.
    period
        The law's input is held for so long, s, as the decimal that it is written as; 0: renewed at
        every instant.
    plant
        Parameters of the plant that lie in [low, high], around those that the law knows; for a held
        input.
    duration
        Longest motion, s.
    seconds
        Process time of the search; the proof takes about as much again.

    Returns
    -------
    ProvedLoop
        Its verdict is the kernel's on the final claim.

    Raises
    ------
    InvalidInputError
        For a state that the mechanism does not have, a size that is not positive, or a plant in a
        box whose input is not held.
    InfeasibleError
        When not even the first box could be proved.
    """
    started = time.process_time()
    names = mechanism.state_names
    require(bool(starts), "starts of the loop", "none", "one state or more")
    for name, value in starts.items():
        require(name in names, "state of the starts", name, ", ".join(names))
        good = bool(np.isfinite(value) and value > 0)
        require(good, f"size of the starts in {name}", value, "finite, > 0")
    good = bool(np.isfinite(duration) and duration > 0)
    require(good, "duration", duration, "finite, > 0")
    good = np.isfinite(period) and 0 <= period <= 0.1
    require(good, "period of a held input", period, "0 to 0.1 s")
    remedy = "Take the period of the sampler, such as 0.001 s"
    require(
        period or not plant, "plant in a box", "an input renewed at every instant", "held", remedy
    )
    law = ReachingLaw() if reaching is None else reaching
    task = _Task(
        mechanism, surface, law, dict(starts), Fraction(repr(float(period))), dict(plant or {})
    )
    loop, known = task.aimed(duration)
    grow = _longest_line if len(starts) == 1 else _largest_box
    part, cuts = grow(task, loop, started + seconds, progress or (lambda _: None))
    if not part:
        raise InfeasibleError(
            f"proved starts of the loop with {surface}",
            value="no tube ended in the terminal set",
            limit=f"boxes down to {THINNEST:.2g} of what was asked for",
            remedy="Give smaller starts, or more time",
        )
    found = LoopClaim.of(task.claim(known, part, cuts))
    verdict = found.decide(mechanism, surface, law)
    return ProvedLoop(found, verdict, time.process_time() - started)


#: How much of the starts a search has, and where they and the plants are cut.
_Grown = tuple[float, dict[str, list[float]]]


def _longest_line(task: _Task, loop: Loop, until: float, progress: Callable[[str], None]) -> _Grown:
    """Put one piece after another along one state, as wide as its tube bears, until a time."""
    ((name, reach),) = task.starts.items()
    index = task.model.states.index(name)
    # Around the edge of the layer a box is a small part of it, or its tube crosses for long.
    weight = np.abs(task.surface.matrix[:, index]).max()
    width = min(reach / 32, 0.15 * float(np.min(task.law.layer)) / max(weight, 1e-12))
    edges, box = [0.0], np.zeros((len(task.model.states), 2))
    parts, latest, patience = _sliced(task.box, 0), 0, int(PATIENCE / loop.step.imag)
    while edges[-1] < reach and width > reach * THINNEST and time.process_time() < until:
        box[index] = edges[-1], min(edges[-1] + width, reach)
        there, most = True, 2 * latest + patience if len(edges) > 1 else MOST_OF_ONE
        for part in parts:
            taken, there = loop.follow(np.vstack([box, part]), most)
            if not there:
                break
            latest = max(latest, taken)
        if task.plant and not there and len(parts) < MOST_PARTS and width < reach / 128:
            parts, width = _sliced(task.box, len(parts)), 2 * width
        if there:
            edges.append(float(box[index, 1]))
            if len(edges) % 20 == 0:
                progress(f"proved up to {name} = {edges[-1]:.4g}")
        width *= WIDER if there else THINNER
    cuts = {name: edges[1:-1]}
    for j, varied in enumerate(task.varied):
        cuts[varied] = sorted({float(v) for part in parts for v in part[j]})[1:-1]
    return edges[-1] / reach, cuts


def _largest_box(task: _Task, loop: Loop, until: float, progress: Callable[[str], None]) -> _Grown:
    """Grow a box of states, cut into a grid of pieces, until a time.

    Where one of them is lost, all are cut more finely: across the state, or the parameter, whose
    halves of that piece get farthest.  Where that is not enough a few times, the box is to grow by
    less.
    """
    names, size = (*task.model.states, *task.varied), len(task.model.states)
    ends = [task.starts.get(name, 0.0) for name in task.model.states]
    whole = np.vstack([np.column_stack([np.negative(ends), ends]), task.box])
    wide = np.flatnonzero(np.ptp(whole, axis=1)).tolist()
    odd = system(task.model, task.numbers).odd
    if odd:  # one side of one state will do (Lemma 9)
        whole[wide[0], 0] = 0.0
    count, part, near = np.ones(len(whole), dtype=int), FIRST_BOX, whole[:, 1]
    done, most = (0.0, dict[str, list[float]]()), MOST_OF_ONE
    wider, proved = WIDER, count
    while count.prod() <= MOST_PIECES and wider > LEAST_WIDER:
        box = np.vstack([part * whole[:size], task.box])
        edges = [np.linspace(a, b, n + 1) for (a, b), n in zip(box, count, strict=True)]
        pieces = np.array([*itertools.product(*map(itertools.pairwise, edges))])
        # The next one that is lost is most likely to be where the last one was.
        away = np.abs(pieces.mean(axis=-1) - near)[:, wide] / np.ptp(box, axis=1)[wide]
        pieces = pieces[np.argsort(away.max(axis=1), kind="stable")]
        bad, latest = _first_lost(loop, pieces, most, until)
        if time.process_time() > until:
            break
        if bad is None:
            if odd:
                edges[wide[0]] = np.concatenate([-edges[wide[0]][:0:-1], edges[wide[0]]])
            cuts = {names[j]: edges[j][1:-1].tolist() for j in wide if len(edges[j]) > 2}
            done, most = (part, cuts), 2 * latest + int(PATIENCE / loop.step.imag)
            progress(f"proved {part:.3g} of the box, by {len(pieces)} tubes")
            if part == 1.0:
                break
            part, proved = min(1.0, wider * part), count.copy()
        elif done[0] and count.prod() >= MORE_PIECES * proved.prod():
            wider, count = wider**0.5, proved.copy()
            part = min(1.0, wider * done[0])
        else:
            halved = [_first_lost(loop, halves(bad, j), most, until) for j in wide]
            far = [np.inf if lost is None else steps for lost, steps in halved]
            finer = wide[int(np.argmax(far))]
            count[finer] = math.ceil(1.5 * count[finer])
            near = bad.mean(axis=-1)
    return done


def _first_lost(
    loop: Loop, boxes: Iterable[FloatArray], most: int, until: float
) -> tuple[FloatArray | None, int]:
    """The first box whose tube is lost, and after how many steps; else the most that one takes."""
    latest = 0
    for box in boxes:
        taken, there = loop.follow(box, most)
        if not there:
            return box, taken
        latest = max(latest, taken)
        if time.process_time() > until:
            break
    return None, latest


def _sliced(box: FloatArray, before: int) -> list[FloatArray]:
    """Cut a box of parameters (P, 2) into more parts than before, each side alike."""
    if not len(box):
        return [box]
    count = 1
    while count ** len(box) <= before:
        count *= 2
    sides = [itertools.pairwise(np.linspace(a, b, count + 1).tolist()) for a, b in box]
    return [np.array(part) for part in itertools.product(*sides)]


@dataclass(frozen=True)
class _Task:
    """What is to be proved, as the kernel has it."""

    mechanism: Mechanism
    surface: Surface
    law: ReachingLaw
    starts: Mapping[str, float]
    period: Fraction
    plant: Mapping[str, tuple[float, float]]

    @cached_property
    def model(self) -> Model:
        return model_of(self.mechanism)

    @cached_property
    def numbers(self) -> Law:
        return law_of(self.mechanism, self.surface, self.law)

    @property
    def varied(self) -> list[str]:
        """Names of the parameters that vary, in the model's order."""
        return [p.name for p in self.model.parameters if p.name in self.plant]

    @property
    def box(self) -> FloatArray:
        """Their ranges, (P, 2)."""
        return np.array([self.plant[k] for k in self.varied], dtype=float).reshape(-1, 2)

    @property
    def exact_box(self) -> dict[str, tuple[Fraction, Fraction]]:
        return {k: (Fraction(float(a)), Fraction(float(b))) for k, (a, b) in self.plant.items()}

    def claim(
        self, end: kernel.TerminalEllipsoid, part: float, cuts: Mapping[str, Sequence[float]]
    ) -> kernel.ClosedLoop:
        """Return the claim about a part of the starts."""
        zero, most = Fraction(0), {k: Fraction(part * v) for k, v in self.starts.items()}
        starts, still = {k: (-v, v) for k, v in most.items()}, (zero,) * self.mechanism.n
        where = {k: tuple(map(Fraction, v)) for k, v in cuts.items()}
        return kernel.ClosedLoop(starts, self.period, self.exact_box, still, zero, end, where)

    def aimed(self, duration: float) -> tuple[Loop, kernel.TerminalEllipsoid]:
        """Return the loop with a proved terminal set that simulated motions enter early.

        Raises InfeasibleError where none is found.
        """
        n, period = self.mechanism.n, float(self.period)
        steered = SlidingModeLaw(self.mechanism, self.surface, self.law)
        x = np.zeros((MOTIONS, 2 * n))
        for j, (name, size) in enumerate(self.starts.items()):
            signs = 1 - 2 * (np.arange(MOTIONS) >> j & 1)  # of corners, in turn
            ends = np.linspace(size / MOTIONS, size, MOTIONS)
            x[:, self.model.states.index(name)] = signs * ends
        every = max(1, round(0.005 / period)) if period else 4
        path = follow(steered, x, duration, every, period)[0]
        if not period:
            search = search_for(self.mechanism, self.surface, self.law)
            terminal = None if search is None else _terminal(search, path)
            if terminal is not None:
                own = terminal.stated(self.mechanism, None)
                return ContinuousLoop(self.model, self.numbers, own.W, own.radius, STEP), own
        else:
            held, loop = (
                HeldLoop(self.model, self.numbers, self.period, plant)
                for plant in ({}, self.exact_box)
            )
            search = _held_search(held)
            terminal = None if search is None else _terminal(search, self._coordinates(path))
            if terminal is not None and self.plant:
                terminal = replace(terminal, W=_for_all_plants(loop, terminal.W))
            for shrink in 0.8 ** np.arange(12):
                if terminal is None:
                    break
                own = replace(terminal, radius=shrink * terminal.radius).stated(
                    self.mechanism, None
                )
                loop.take(own.W, own.radius)
                if not loop.terminal()[0]:
                    return loop, own
        raise InfeasibleError(
            f"terminal set of {self.surface}",
            value="no motion enters a proved ellipsoid",
            limit=f"starts up to {self.starts}, within {duration:g} s",
            remedy="Take a longer duration, smaller starts, a shorter period or a smaller box",
        )

    def _coordinates(self, x: FloatArray) -> FloatArray:
        """Return (q, M_ua v_a + M_uu v_u, s) of states (…, 2n)."""
        n, m = self.mechanism.n, self.mechanism.m
        q, v = x[..., :n], x[..., n:]
        with np.errstate(all="ignore"):
            p = np.einsum("...ij,...j->...i", self.mechanism.M(q)[..., m:, :], v)
        return np.concatenate([q, p, x @ self.surface.matrix.T], axis=-1)


def _map_at_target(loop: HeldLoop, plant: Sequence[float] = ()) -> FloatArray | None:
    """The derivative of one plant's map from sample to sample at the target, in (q, D p, s)."""
    scale = np.ones(loop.size)
    scale[loop.model.n : loop.size - loop.model.m] = [float(v) for v in scale_of(loop.model)]
    x = np.append(np.zeros(loop.size), plant)
    X = between(x, x)
    found = loop.held.derivative(X, *loop.slopes(X), loop.step)
    if loop.no_equilibrium or found is None:
        return None
    own = found[0][: loop.size, : loop.size]
    J = 0.5 * (own.real + own.imag)
    return np.asarray(scale[:, None] * J / scale)


def _for_all_plants(loop: HeldLoop, W: FloatArray) -> FloatArray:
    """W of an ellipsoid that the maps of all plants of a box may shrink; of one plant, as it was.

    It is of the mean Lyapunov function of the middle and of the corners, for what the first one's
    falls with the plant in the middle; W is turned so that its own fall is nearly diagonal.
    """
    ends = [(float(a), float(b)) for a, b in loop.plant]
    plants = [[0.5 * (a + b) for a, b in ends], *itertools.product(*ends)]
    maps = [J for p in plants if (J := _map_at_target(loop, p)) is not None]
    if len(maps) < len(plants):
        return W
    P = W.T @ W
    lost = P - maps[0].T @ P @ maps[0]
    mean = np.mean([solve_discrete_lyapunov(J.T, lost) for J in maps], axis=0)
    try:
        root = np.linalg.cholesky(mean).T
    except np.linalg.LinAlgError:  # a corner is not stable
        return W
    turned = [root @ J @ np.linalg.inv(root) for J in maps]
    return np.asarray(np.linalg.eigh(sum(J.T @ J for J in turned))[1].T @ root)


def _held_search(loop: HeldLoop) -> EllipsoidSearch | None:
    """Prepare the search for the loop with a held input, in (q, D p, s)."""
    n, m, A = loop.model.n, loop.model.m, _map_at_target(loop)
    if A is None:
        return None
    C, layer = np.eye(m, 2 * n, 2 * n - m), np.array([float(v) for v in loop.law.layer])

    def margin(candidate: TerminalEllipsoid) -> float:
        W = tuple(tuple(Fraction(float(v)) for v in row) for row in candidate.W)
        loop.take(W, Fraction(float(candidate.radius)))
        why, found = loop.terminal()
        return min(found, 0.0) if why else found

    return EllipsoidSearch.of(margin, A, C, layer, float(loop.step.imag))


def _terminal(search: EllipsoidSearch, path: FloatArray) -> TerminalEllipsoid | None:
    """A proved ellipsoid that the motions (K, L, 2n) of as many starts as may be enter early.

    Each of some motions, the farthest first, proposes the one around its first state that has one.
    """
    best: tuple[int, int] | None = None
    chosen, count = None, path.shape[1]
    for j in dict.fromkeys(round(part * (count - 1)) for part in (1.0, 0.93, 0.86, 0.75, 0.6, 0.4)):
        for state in path[:, j]:
            if not np.isfinite(state).all() or (found := search.around(state)) is None:
                continue
            with np.errstate(all="ignore"):
                inside = np.linalg.norm(path @ found.W.T, axis=-1) < 0.98 * found.radius
            enters = inside.any(axis=0)
            far = count if enters.all() else int(enters.argmin())
            score = far, -int(inside[:, :far].argmax(axis=0).max(initial=0))
            if far and (best is None or score > best):
                best, chosen = score, found
            break
    return chosen
