"""Target equilibria: found from a guess, and made the origin of error coordinates."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
import sympy as sp

from undertow.base import InvalidInputError, ModelError, checked, floats, one_of, require
from undertow.models.importers.equations import check_balanced, shifted
from undertow.models.importers.tree import LARGEST
from undertow.models.importers.xml_files import without_rounding
from undertow.models.linearisation import AT_REST, controllability, force_scale, linearise
from undertow.models.mechanism import FloatArray, Mechanism
from undertow.models.quantities import in_degrees, number_of
from undertow.models.validity import by_names


@checked
def holding_input(mechanism: Mechanism, q: FloatArray | None = None) -> FloatArray:
    """Return the input that holds the mechanism at rest at q, −B⁻¹ f_a(q, 0), (m,).

    Parameters
    ----------
    q
        Positions, (n,); the target x = 0 by default.
    """
    n, m = mechanism.n, mechanism.m
    x = np.zeros(2 * n)
    if q is not None:
        x = mechanism.check_state(np.append(floats("positions", q), np.zeros(n)))
    return np.asarray(-np.linalg.solve(mechanism.B, mechanism.f(x)[:m]))


@checked
def find_equilibrium(mechanism: Mechanism, /, **guess: float) -> dict[str, float]:
    """Find an equilibrium near a guess: f_u(q, 0) = 0 with the actuated coordinates as given.

    Parameters
    ----------
    mechanism
        The model.
    **guess
        Coordinate values, rad or m; zero where left out.  The m actuated ones are kept, the
        n − m free ones are solved for.

    Returns
    -------
    dict
        All n coordinates, by name.

    Raises
    ------
    ModelError
        When no equilibrium is found near the guess, with the force that is left.
    InvalidInputError
        For an unknown coordinate.

    Warns
    -----
    UserWarning
        Of a guess that puts a free angle more than a turn off zero: degrees, probably.

    Examples
    --------
    >>> import undertow as ut
    >>> rig = ut.mechanisms.rotary_pendulum()
    >>> round(find_equilibrium(rig, phi=3.0)["phi"], 6)
    3.141593
    """
    near = _positions(mechanism, guess)
    if turned := in_degrees(mechanism.coordinates, mechanism.m, near):
        warnings.warn(f"guess of an equilibrium: {turned}", stacklevel=3)  # who called this
    q, relative = _solved(mechanism, near, mechanism.m)
    if not relative <= AT_REST:
        scale = force_scale(mechanism)
        raise ModelError(
            f"equilibrium of '{mechanism.name}' near {dict(guess)}",
            value=f"|f_u| = {scale * relative:.3g} left",
            limit=f"below {AT_REST * scale:.3g}",
            remedy="Start from another guess, or hold the actuated coordinates elsewhere",
        )
    names = [c.name for c in mechanism.coordinates]
    return dict(zip(names, (float(v) for v in q), strict=True))


#: Words for equilibria.
WORDS = ("upright", "hanging", "nearest")

#: Largest Hautus distance from a pair of no use, relative: below, no input reaches a joint.
_UNREACHED = 1e-9

#: Hinges of which both 0 and 180° are tried.
_TRIED = 5

#: A usual start, error of the first free coordinate from the target: rad, m.
_OFF = {"rad": math.radians(5.0), "m": 0.05}


@checked
def at_equilibrium(mechanism: Mechanism, target: str | Mapping[str, float] = "") -> Mechanism:
    """Return the mechanism in error coordinates from an equilibrium that is found and named.

    Searched are the equilibria near poses with every hinge at 0 or 180° (the first one at ±90°
    too), that lie inside the travel of all joints and that the inputs can hold within their
    limits.  Actuated joints stay there, or in the middle of their travel; where the inputs cannot
    hold that, they go to where the inputs are zero, as a servo with a load does.

    Parameters
    ----------
    mechanism
        The model, its coordinates as a file has them.
    target
        ``"upright"``: the one with the highest potential energy that gravity and springs would
        leave.  ``"hanging"``: the one with the lowest, to which they return.  ``"nearest"``: the
        one nearest to zero.  A guess, coordinate name to rad or m: the one near it, actuated
        coordinates kept.  By default the nearest that inputs can stabilise, zero itself where it
        is one.

    Returns
    -------
    Mechanism
        Its coordinates read zero at the target; its description says where that was.  Where it
        has no usual start, one 5° or 5 cm off in the first free coordinate.

    Raises
    ------
    ModelError
        Where there is no such equilibrium, or no input reaches some joint there.
    InvalidInputError
        For another word, and unknown coordinates.
    """
    return _placed(mechanism, *where(mechanism, target))


def where(mechanism: Mechanism, target: str | Mapping[str, float]) -> tuple[dict[str, float], str]:
    """Return the equilibrium that :func:`at_equilibrium` takes, by coordinates, and its words.

    Raises ModelError or InvalidInputError as for that.
    """
    if isinstance(target, Mapping):
        guess = _positions(mechanism, target)
        words = "the equilibrium near " + _position(mechanism, guess)
        found = find_equilibrium(mechanism, **target)
        return _unwound(mechanism, found, guess), words
    if target:
        one_of("target equilibrium", target, WORDS, "Or say where: joint=ANGLE")
    if target in ("upright", "hanging"):
        return _named(mechanism, _standing(mechanism, target)), target
    q = None
    for q in _nearest_first(mechanism):
        at = _named(mechanism, q)
        moved = move_target(mechanism, **at) if np.any(q) else mechanism
        if target or controllability(moved) > _UNREACHED:
            return at, "the nearest equilibrium"
    if q is None:
        raise _none_found(mechanism)
    raise ModelError(
        f"linear models of '{mechanism.name}' at its equilibria",
        value="motions that no input reaches",
        limit="controllable",
        remedy=_adrift(mechanism) or "Actuate another joint: FILE:JOINT,JOINT",
    )


def _unwound(mechanism: Mechanism, found: dict[str, float], guess: FloatArray) -> dict[str, float]:
    """Return an equilibrium less the whole turns of hinges between it and the guess, (n,)."""
    q = np.array(list(found.values()))
    hinges = np.array([c.unit == "rad" for c in mechanism.coordinates])
    turns = np.where(hinges, np.round((q - guess) / (2 * math.pi)), 0.0)
    near = q - 2 * math.pi * turns
    return (
        _named(mechanism, near) if turns.any() and _residual(mechanism, near) <= AT_REST else found
    )


def _nearest_first(mechanism: Mechanism) -> Iterator[FloatArray]:
    """Zero where it is one of those that are looked for, then the others, which takes longer."""
    zero = np.zeros(mechanism.n)
    rests = _rests(mechanism) and not _obstacle(mechanism, zero)[0]
    if rests:
        yield zero
    yield from (e.q for e in _equilibria(mechanism) if np.any(e.q) or not rests)


def _none_found(mechanism: Mechanism) -> ModelError:
    """The refusal of a mechanism without an equilibrium."""
    poses = ((*_obstacle(mechanism, q), _position(mechanism, q)) for q in _poses(mechanism))
    _, obstacle, pose = min(poses, default=(0.0, "that was found", ""))
    return ModelError(
        f"equilibria of '{mechanism.name}'",
        value=f"none: {pose} {obstacle}" if pose else f"none {obstacle}",
        limit="a pose inside the travel of the joints, which the inputs hold within limits",
        remedy=_adrift(mechanism) or "Say where one is: JOINT=ANGLE for every joint",
    )


def _standing(mechanism: Mechanism, target: str) -> FloatArray:
    """Return the upright or hanging equilibrium, (n,)."""
    high, found = target == "upright", list(_equilibria(mechanism))
    if not found:
        raise _none_found(mechanism)
    stands = [e for e in found if e.stable is (not high)]
    if not stands:
        raise ModelError(
            f"{target} equilibrium of '{mechanism.name}'",
            value="none that was found",
            limit="one of " + "; ".join(_position(mechanism, e.q) for e in found),
            remedy="Take the nearest, or say where: JOINT=ANGLE",
        )
    chosen = (max if high else min)(stands, key=lambda e: e.energy)
    return chosen.q


def _named(mechanism: Mechanism, q: FloatArray) -> dict[str, float]:
    return dict(zip((c.name for c in mechanism.coordinates), q.tolist(), strict=True))


@dataclass(frozen=True, eq=False)
class _Equilibrium:
    """Positions, (n,); potential energy, J; whether gravity and springs return to it, if known."""

    q: FloatArray
    energy: float
    stable: bool | None


def _rests(mechanism: Mechanism) -> bool:
    """Whether zero is an equilibrium of the free coordinates."""
    residual = np.abs(mechanism.f(np.zeros(2 * mechanism.n))[mechanism.m :]).max()
    return bool(residual <= AT_REST * force_scale(mechanism))


def _equilibria(mechanism: Mechanism) -> Iterator[_Equilibrium]:
    """Find equilibria inside the travel that the inputs hold, the nearest to zero first."""
    n, m = mechanism.n, mechanism.m
    found: list[FloatArray] = []
    for q in _poses(mechanism):
        known = any(np.abs(q - other).max() < 1e-6 for other in found)
        if not (known or _obstacle(mechanism, q)[0]):
            found.append(q)
    scale = force_scale(mechanism)
    for q in sorted(found, key=lambda q: float(np.linalg.norm(q))):
        x = np.append(q, np.zeros(n))
        steps = 1e-5 * np.eye(2 * n)[m:n]
        slopes = (mechanism.f(x + steps) - mechanism.f(x - steps))[:, m:].T / 2e-5
        pull = np.linalg.eigvals(slopes).real / scale
        stable = False if (pull > 1e-7).any() else True if (pull < -1e-7).all() else None
        energy = 0.0 if mechanism.potential is None else float(mechanism.energy(x))
        yield _Equilibrium(q, energy, stable)


def _obstacle(mechanism: Mechanism, q: FloatArray) -> tuple[float, str]:
    """What forbids to rest at q, as a size and in words; the size is 0 where nothing does."""
    outside = [
        c.name
        for c, v in zip(mechanism.coordinates, q.tolist(), strict=True)
        if not c.low < v < c.high
    ]
    if outside:
        return math.inf, f"is outside the travel of {', '.join(outside)}"
    held = holding_input(mechanism, q)
    shares = np.abs(held) / mechanism.input_limits
    i = int(shares.argmax())
    channel = mechanism.inputs[i]
    if shares[i] <= 1:
        return 0.0, ""
    return shares[i], f"takes {channel.name} = {held[i]:.3g}, limited to {channel.limit:g}"


def _poses(mechanism: Mechanism) -> Iterator[FloatArray]:
    """Find poses of rest, beyond travel and limits too.

    The actuated coordinates stay where the search begins; where the inputs could not hold that, the
    pose in which they are zero comes next: that of a servo and of what hangs on a spring.
    """
    n, m = mechanism.n, mechanism.m
    hinges = [i for i, c in enumerate(mechanism.coordinates) if c.unit == "rad"]
    low = np.array([c.low for c in mechanism.coordinates])
    high = np.array([c.high for c in mechanism.coordinates])
    middle = np.clip(np.zeros(n), low, high)
    bounded = np.isfinite(high - low)
    middle[bounded] = (low[bounded] + high[bounded]) / 2
    sample = np.random.default_rng(0).uniform(-2, 2, (64, n))
    forces = mechanism.f(np.hstack([sample, np.zeros_like(sample)]))[:, m:]
    falls = np.ptp(forces, axis=0) < 1e-9 * np.abs(forces).max(axis=0)
    if falls.any():  # a force that is the same everywhere, and not zero
        return
    tries: list[tuple[float, ...]] = [(0.0, math.pi)] * min(len(hinges), _TRIED) + [(0.0,)] * (
        len(hinges) - _TRIED
    )
    if tries:
        tries[0] = (0.0, math.pi, math.pi / 2, -math.pi / 2)
    for angles in itertools.product(*tries):
        guess = np.zeros(n)
        guess[hinges] = angles
        guess = np.where(guess > high, guess - 2 * math.pi, guess)
        guess = np.where((guess > low) & (guess < high), guess, middle)
        for kept in (m, 0):
            q, left = _solved(mechanism, guess, kept)
            if left > AT_REST:
                break
            q = _unturned(mechanism, q)
            yield q
            if _obstacle(mechanism, q)[0] in (0.0, math.inf):
                break
            guess = q


def _unturned(mechanism: Mechanism, q: FloatArray) -> FloatArray:
    """Return a pose of rest with hinges that turn round and round within half a turn."""
    turned = np.where(
        [c.unit == "rad" and math.isinf(c.high) for c in mechanism.coordinates],
        np.remainder(q + math.pi - 1e-9, 2 * math.pi) - math.pi + 1e-9,
        q,
    )
    turned[np.abs(turned) < 1e-12] = 0.0
    return turned if _residual(mechanism, turned) <= AT_REST else q


def _residual(mechanism: Mechanism, q: FloatArray) -> float:
    """|f_u| at rest at q, relative."""
    force = mechanism.f(np.append(q, np.zeros(mechanism.n)))[mechanism.m :]
    return float(np.abs(force).max()) / force_scale(mechanism)


def _placed(mechanism: Mechanism, equilibrium: Mapping[str, float], words: str) -> Mechanism:
    """Return the mechanism about an equilibrium, with a usual start, and words about it."""
    q = _positions(mechanism, equilibrium)
    moved = move_target(mechanism, **equilibrium) if np.any(q) else mechanism
    held = without_rounding(holding_input(moved), force_scale(moved))
    force = ", ".join(f"{i.name} = {u:.3g}" for i, u in zip(moved.inputs, held, strict=True) if u)
    words = words if np.any(q) else "zero" + f", {words}" * (words in WORDS)
    text = f"target {words}: {_position(mechanism, q)} of the file"
    text += f", held by {force}" * bool(force)
    if not (mechanism.start and not np.any(q)):
        start, needed = _usual_start(moved)
        moved = replace(moved, start=start)
        text += f"; 5° or 5 cm off needs {needed:.3g} times its inputs' limits" * (needed > 1)
    lines = [line for line in (mechanism.description, text) if line]
    return replace(moved, description="\n".join(lines))


def _usual_start(mechanism: Mechanism) -> tuple[dict[str, float], float]:
    """Return a start that the inputs can bring home: 5° or 5 cm off in the first free coordinate.

    Where the linear model needs more than the limits for that, so much closer that it needs half.
    Returns the start, and what 5° or 5 cm need of the limits.
    """
    free = mechanism.coordinates[mechanism.m]
    off = min(_OFF.get(free.unit, 0.05), 0.5 * free.high, -0.5 * free.low)
    needed = least_peak(mechanism, mechanism.state(**{free.name: off}))
    return {free.name: off if needed <= 1 else 0.5 * off / needed}, needed


@checked
def least_peak(mechanism: Mechanism, x: FloatArray) -> float:
    """Return the least peak of inputs, in parts of their limits, that stops all growing motions.

    Of the linear model at the target, a motion z = wᵀx that grows as e^{λt} comes to rest under
    u(t) where ∫ e^{−λt} wᵀB u dt = −z(0): a linear programme in u on 300 steps, until its slowest
    has grown e⁶ times.

    Parameters
    ----------
    mechanism
        The model, with the limits of its inputs.
    x
        State, (2n,).

    Returns
    -------
    float
        More than 1: the linear model cannot be brought to rest from there.  0 where nothing grows.
    """
    from scipy.optimize import linprog  # slow to import

    try:
        lin = linearise(mechanism)
    except ModelError:
        return 0.0
    x = mechanism.check_state(x)
    rates, modes = np.linalg.eig(lin.A.T)
    grows = rates.real > 1e-6
    limits = np.minimum(mechanism.input_limits, LARGEST)
    if not grows.any():
        return 0.0
    rates, modes = rates[grows], modes[:, grows]
    t = np.linspace(0.0, 6.0 / float(rates.real.min()), 301)
    decay = np.exp(-np.outer(rates, t))
    part = (decay[:, :-1] - decay[:, 1:]) / rates[:, None]
    pushes = np.einsum("rk,ri->rki", part, modes.T @ lin.input * limits).reshape(len(rates), -1)
    size, scale = pushes.shape[1], np.abs(pushes).max() or 1.0
    pushes /= scale  # limits of any size are solved for alike
    equal = np.hstack([np.vstack([pushes.real, pushes.imag]), np.zeros((2 * len(rates), 1))])
    wanted = -np.hstack([(modes.T @ x).real, (modes.T @ x).imag])
    peak = np.vstack([np.hstack([sign * np.eye(size), -np.ones((size, 1))]) for sign in (1, -1)])
    found = linprog(
        np.append(np.zeros(size), 1.0),
        A_ub=peak,
        b_ub=np.zeros(2 * size),
        A_eq=equal,
        b_eq=wanted,
        bounds=[(None, None)] * size + [(0, None)],
    )
    return float(found.fun or 0.0) / float(scale) if found.status == 0 else 0.0


def _position(mechanism: Mechanism, q: FloatArray) -> str:
    """Positions in words, hinges in degrees."""
    return ", ".join(
        f"{c.name} = {math.degrees(v):.4g}°" if c.unit == "rad" else f"{c.name} = {v:.4g} m"
        for c, v in zip(mechanism.coordinates, q.tolist(), strict=True)
    )


def _adrift(mechanism: Mechanism) -> str:
    """Say which coordinates nothing ties to those that inputs act on."""
    n, m = mechanism.n, mechanism.m
    tied = set(range(m))
    rates = [c.velocity for c in mechanism.coordinates]
    for _ in range(n):
        for i in range(n):
            for j in range(n):
                force = mechanism.force[i].free_symbols | mechanism.mass_matrix[i, j].free_symbols
                acts = {mechanism.q[j], rates[j]} & force or mechanism.mass_matrix[i, j] != 0
                if i != j and acts and {i, j} & tied:
                    tied |= {i, j}
    loose = [c.name for i, c in enumerate(mechanism.coordinates) if i not in tied]
    if not loose:
        return ""
    names = ",".join(f"-{name}" for name in loose)
    return (
        f"Nothing ties {', '.join(loose)} to what the inputs move: if they do not belong to the "
        f"mechanism, freeze them, FILE:{names}"
    )


def _solved(mechanism: Mechanism, q: FloatArray, kept: int) -> tuple[FloatArray, float]:
    """Solve f(q, 0) = 0 for the coordinates behind the first ``kept``, from q on.

    As many equations as coordinates are kept are left out: those of the inputs, where the m
    actuated ones are. Returns positions, (n,), and the force that is left, relative to
    :func:`force_scale`.
    """
    from scipy.optimize import root  # slow to import

    n, scale = mechanism.n, force_scale(mechanism)

    def force(moved: FloatArray) -> FloatArray:
        x = np.concatenate([q[:kept], moved, np.zeros(n)])
        return np.asarray(mechanism.f(x)[kept:] / scale)

    try:
        found = _polished(force, root(force, q[kept:], tol=1e-14).x)
        return np.concatenate([q[:kept], found]), float(np.abs(force(found)).max())
    except InvalidInputError:  # the search left what can be computed
        return q, math.inf


def _polished(force: Callable[[FloatArray], FloatArray], q: FloatArray) -> FloatArray:
    """Newton's method to the last digits, where the slopes are regular."""
    h, best = 1e-6, q
    for _ in range(4):
        left = force(best)
        slopes = np.array(
            [(force(best + d) - force(best - d)) / (2 * h) for d in h * np.eye(len(q))]
        )
        try:
            better = best - np.linalg.solve(slopes.T, left)
        except np.linalg.LinAlgError:
            return best
        if not np.abs(force(better)).max() < np.abs(left).max():
            return best
        best = better
    return best


@checked
def move_target(mechanism: Mechanism, /, **equilibrium: float) -> Mechanism:
    """Return the mechanism in error coordinates from another equilibrium.

    Parameters
    ----------
    mechanism
        The model.
    **equilibrium
        The new target in the coordinates of ``mechanism``, rad or m; zero where left out.

    Returns
    -------
    Mechanism
        Its coordinates keep their names and read zero at the new target, which its description
        says.  The start state is dropped: it belonged to the old one.

    Raises
    ------
    ModelError
        When it is no equilibrium of the free coordinates, f_u ≠ 0.
    """
    place = f"target {_position(mechanism, _positions(mechanism, equilibrium))} of the old one"
    coordinates, (mass, force, potential) = shifted(
        mechanism.name,
        mechanism.coordinates,
        equilibrium,
        sp.Matrix(mechanism.mass_matrix),
        sp.Matrix(mechanism.force),
        mechanism.potential,
    )
    moved = replace(
        mechanism,
        coordinates=coordinates,
        mass_matrix=mass,
        force=force,
        potential=potential,
        start={},
        description="\n".join(filter(None, (mechanism.description, place))),
    )
    check_balanced(moved, equilibrium)
    return moved


def _positions(mechanism: Mechanism, values: Mapping[str, float]) -> FloatArray:
    names = [c.name for c in mechanism.coordinates]
    values = by_names(f"coordinates of '{mechanism.name}'", values)
    for name in values:
        whose = f"coordinate of '{mechanism.name}'"
        one_of(whose, name, names, "Name the coordinates of the mechanism")
    q = np.array([number_of(f"coordinate '{name}'", values.get(name, 0.0)) for name in names])
    good = np.isfinite(q).all()
    require(good, f"coordinates of '{mechanism.name}'", dict(values), "finite numbers")
    return q
