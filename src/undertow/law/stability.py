"""Stability on the surface: sliding dynamics, margins, a first surface.

On s = 0 the motion obeys ``E q̈_u = f_u + M_auᵀ α_a⁻¹ ṡ_r`` with
``E = M_uu − M_auᵀ α_a⁻¹ α_u``, and q̇_a from s = 0.  Linearised at the target it is a
system of order 2n − m in z = (q_a, q_u, q̇_u), whose eigenvalues decide local exponential
stability exactly, for any n and m.  For one actuated and one free coordinate without
damping the same condition reads (35)-(37) at the target.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import (
    InvalidInputError,
    SingularSurfaceError,
    UndertowError,
    UnstableSurfaceError,
    checked,
    floats,
    positive,
)
from undertow.law.sliding import (
    check_surface_shape,
    coupling,
    gains_at_target,
    gamma_determinant,
    singularity,
)
from undertow.law.surface import LawLayout, ReachingLaw, Surface
from undertow.models import (
    UNCONTROLLABLE,
    FloatArray,
    Mechanism,
    controllability,
    linearise,
    uncontrollable,
)
from undertow.symbolic import content_key, recall, remember

#: k/ε times the period of the law from which on it overshoots ever farther near the surface.
OVERSHOOTS = 2.0

#: How often a boundary layer is doubled at most.
DOUBLINGS = 20


def sliding_matrix(mechanism: Mechanism, surfaces: ArrayLike | Surface) -> FloatArray:
    """Return the matrix of the sliding dynamics at the target, (…, 2n−m, 2n−m).

    Surface vectors are (…, 2mn); ż = A_s z with z = (q_a, q_u, q̇_u).
    """
    lin = linearise(mechanism)
    n, m = mechanism.n, mechanism.m
    vectors = surfaces.vector if isinstance(surfaces, Surface) else np.asarray(surfaces, float)
    lead = vectors.shape[:-1]
    alpha_a, lambda_a, alpha_u, lambda_u = LawLayout(n, m).blocks(vectors)
    free = n - m
    M_ua, M_uu = lin.M[m:, :m], lin.M[m:, m:]
    # q̇_a = G z on the surface; then E q̈_u = [F_a F_u D_u] z + D_a G z + M_uaα_a⁻¹ ṡ_r.
    G = -np.linalg.solve(alpha_a, np.concatenate([lambda_a, lambda_u, alpha_u], axis=-1))
    E = M_uu - M_ua @ np.linalg.solve(alpha_a, alpha_u)
    pick_v = np.hstack([np.zeros((free, n)), np.eye(free)])
    surface_rate = lambda_a @ G + lambda_u @ pick_v
    right = (
        np.hstack([lin.F[m:], lin.D[m:, m:]])
        + lin.D[m:, :m] @ G
        + M_ua @ np.linalg.solve(alpha_a, surface_rate)
    )
    acceleration = np.linalg.solve(E, right)
    top = np.concatenate([G, np.broadcast_to(pick_v, (*lead, *pick_v.shape))], axis=-2)
    return np.concatenate([top, acceleration], axis=-2)


@lru_cache(maxsize=128)
def _coupling_at_target(mechanism: Mechanism) -> FloatArray:
    """Return X = M_uu⁻¹ M_auᵀ at the target, (n−m, m)."""
    return coupling(mechanism, np.zeros(mechanism.n))


def stability_margin(mechanism: Mechanism, surfaces: ArrayLike | Surface) -> FloatArray:
    """Return −max Re eig of the sliding dynamics, 1/s, (…,); positive means stable.

    Exact local exponential stability on the surface; −inf where the surface is singular
    at the target.
    """
    vectors = surfaces.vector if isinstance(surfaces, Surface) else np.asarray(surfaces, float)
    gamma = gamma_determinant(_coupling_at_target(mechanism), vectors)
    alpha_a = LawLayout(mechanism.n, mechanism.m).blocks(vectors).alpha_a
    sound = (np.abs(gamma) > 1e-9) & (np.abs(np.linalg.det(alpha_a)) > 1e-12)
    if vectors.ndim == 1:
        if not sound:
            return np.array(-np.inf)
        return np.asarray(-np.linalg.eigvals(sliding_matrix(mechanism, vectors)).real.max(-1))
    margins = np.full(vectors.shape[:-1], -np.inf)
    if sound.any():
        eigenvalues = np.linalg.eigvals(sliding_matrix(mechanism, vectors[sound]))
        margins[sound] = -eigenvalues.real.max(axis=-1)
    return margins


@dataclass(frozen=True)
class Margin:
    """A signed margin: ≥ 0 is satisfied."""

    name: str
    value: float
    unit: str
    remedy: str


@checked
def surface_margins(
    mechanism: Mechanism, surface: Surface, q: ArrayLike | None = None
) -> tuple[Margin, ...]:
    """Return the stability margins of a surface, (35)-(37) and their generalisation.

    Parameters
    ----------
    q
        Positions at which (37), the non-singularity of Γ, is asked for, (n,) or (N, n);
        the target by default.

    Returns
    -------
    tuple of Margin
        ``stability``: −max Re eig of the sliding dynamics, exact for any n and m;
        ``singularity``: min det Γ(q)/det Γ(0), the general form of (37); and, where the
        mechanism is of the paper's kind, the closed forms (35) and (36).
    """
    check_surface_shape(mechanism, surface)
    positions = np.zeros(mechanism.n) if q is None else np.asarray(q, float)
    gamma = singularity(mechanism, surface.vector, positions)
    target = float(singularity(mechanism, surface.vector, np.zeros(mechanism.n)))
    ratio = float(np.min(gamma / target)) if target != 0 else -np.inf
    return (
        *_paper_margins(mechanism, surface),
        Margin(
            "stability: −max Re eig of the sliding dynamics",
            float(stability_margin(mechanism, surface)),
            "1/s",
            "Start from undertow.first_surface(mechanism)",
        ),
        Margin(
            "(37) singularity: det Γ(q)/det Γ(0)",
            ratio,
            "",
            "Start closer to the target, or choose a larger |α_u|",
        ),
    )


def _paper_margins(mechanism: Mechanism, surface: Surface) -> tuple[Margin, ...]:
    """(35)-(36) where n = 2, m = 1, q_a is cyclic, and nothing damps the free joint."""
    if (mechanism.n, mechanism.m) != (2, 1):
        return ()
    lin = linearise(mechanism)
    if abs(lin.F[1, 0]) > 0 or np.abs(lin.D[1]).max() > 0 or not lin.F[1, 1] > 0:
        return ()
    unit = surface.normalised()
    side = -np.sign(lin.M[0, 1])  # the paper's b = −M_au is positive
    lambda_a, alpha_u, lambda_u = (
        float(unit.lambda_a[0, 0]),
        float(side * unit.alpha_u[0, 0]),
        float(side * unit.lambda_u[0, 0]),
    )
    sign = "" if side > 0 else "−"
    return (
        Margin("(35) λ_a < 0 at α_a = −1", -lambda_a, "1/s", "Take λ_a/α_a > 0"),
        Margin(f"(35) {sign}α_u > 0 at α_a = −1", alpha_u, "", "Change the sign of α_u"),
        Margin(f"(35) {sign}λ_u > 0 at α_a = −1", lambda_u, "1/s", "Change the sign of λ_u"),
        Margin(
            "(36) λ_a/α_a < λ_u/α_u",
            lambda_u / alpha_u + lambda_a if alpha_u != 0 else -np.inf,
            "1/s",
            "Lower |λ_a| or raise |λ_u|",
        ),
    )


@checked
def check_surface(mechanism: Mechanism, surface: Surface, x0: ArrayLike | None = None) -> None:
    """Refuse a surface that is unstable, or singular at the target or at ``x0``.

    Raises
    ------
    UnstableSurfaceError
        The exact stability condition fails; the message names which of (35)-(36) is to
        blame where the mechanism is of the paper's kind.
    SingularSurfaceError
        (37) fails at the target or at the initial state.
    """
    margins = surface_margins(mechanism, surface)
    target = float(singularity(mechanism, surface.vector, np.zeros(mechanism.n)))
    if abs(target) < 1e-9:
        raise SingularSurfaceError(
            f"{surface} at the target",
            value=f"det Γ = {target:.3g}",
            limit="not zero",
            remedy="Change α_u: the law does not exist there (37)",
        )
    stability = next(m for m in margins if m.name.startswith("stability"))
    if not stability.value > 0:
        broken = next((m for m in margins if not m.value > 0), stability)
        detail = f"{broken.name}: margin"
        if broken is not stability:
            detail = f"exact stability margin {stability.value:.4g} 1/s, and {detail}"
        raise UnstableSurfaceError(
            f"{surface} for '{mechanism.name}', {detail}",
            value=f"{broken.value:.4g} {broken.unit}".strip(),
            limit="> 0",
            remedy=broken.remedy,
        )
    if x0 is not None:
        state = mechanism.check_state(x0)
        margin = surface_margins(mechanism, surface, state[..., : mechanism.n])[-1]
        if not margin.value > 0:
            raise SingularSurfaceError(
                f"{surface} at the initial state, {margin.name}",
                value=f"{margin.value:.4g}",
                limit="> 0",
                remedy=margin.remedy,
            )


@checked
def first_surface(
    mechanism: Mechanism, weights: Sequence[float] | None = None, rate: float = 0.0
) -> Surface:
    """Design a stabilising surface by the quadratic method of Utkin and Young (1978).

    In regular form (a QR factorisation of B) the sliding motion is a linear system whose
    input is the remaining m states; one Riccati equation of order 2n − m minimises
    ∫ xᵀQx dt on it and gives C = [λ, α] directly.

    Parameters
    ----------
    weights
        Diagonal of Q, (2n,), positive; by default 1 on q_a, 10 on q_u and 0.1 on the
        velocities, in SI units: for what is of the size of a bench.  Of a long crane they ask for
        the trolley's place and hardly for the swing: give ``rate``, or weights 1/x_max² of what is
        large there.
    rate
        Convergence rate asked for, 1/s: all eigenvalues left of −rate.

    Raises
    ------
    ModelError
        When (A, B) is not controllable, with the Hautus distance.
    InvalidInputError
        For weights or a rate that cannot be used.

    Notes
    -----
    The default design is kept on disk beside the kernels: a second start need not repeat it.
    """
    n, m = mechanism.n, mechanism.m
    if weights is None:
        weights = [1.0] * m + [10.0] * (n - m) + [0.1] * n
        if rate == 0:
            return _kept(mechanism, np.array([weights]), strict=True)[0]
    diagonal = np.asarray(weights, dtype=float)
    if diagonal.shape != (2 * n,) or not (np.isfinite(diagonal).all() and (diagonal > 0).all()):
        raise InvalidInputError(
            "weights of the quadratic design", value=list(weights), limit=f"{2 * n} numbers > 0"
        )
    positive("convergence rate, 1/s", rate, zero=True)
    return _quadratic(mechanism, diagonal, rate)


#: Stands for :func:`usual_reaching` where nobody gives a law, until mechanism and step are known.
SUITED = cast(ReachingLaw, None)


@checked
def usual_reaching(
    mechanism: Mechanism, surface: Surface | None = None, *, period: float = 0.002
) -> ReachingLaw:
    """Return the paper's reaching law, its boundary layer as thick as disturbances ask for.

    The gains (13) of the mechanism's disturbance bounds, among them dry friction in a model file,
    may be too fast for a law that is renewed once a ``period``, s: ε is doubled until k/ε is below
    2 per period near the target, on the ``surface``, by default the first one.  Without bounds it
    is the paper's law as it is.

    Raises
    ------
    InvalidInputError
        For a period that is not positive, or a surface of another size.
    ModelError
        When the first surface cannot be designed.
    """
    positive("period of the law, s", period)
    law = ReachingLaw()
    if not any(mechanism.disturbance_bounds):
        return law
    used = first_surface(mechanism) if surface is None else surface
    check_surface_shape(mechanism, used)
    eta, layer = law.per_surface(mechanism.m)
    rate = gains_at_target(mechanism, used.vector[None], eta[None])[0] / layer * period
    fastest = float(np.abs(rate).max())
    doubled = next((k for k in range(DOUBLINGS) if fastest / 2**k < OVERSHOOTS), 0)
    return ReachingLaw(layer=float(layer.max()) * 2**doubled)


@checked
def quadratic_designs(mechanism: Mechanism, weights: ArrayLike) -> tuple[Surface, ...]:
    """Return :func:`first_surface` for rows of weights, (N, 2n), but for those that have none.

    They are kept on disk together.

    Raises
    ------
    InvalidInputError
        For weights of another shape, or that are not positive.
    """
    rows = floats("weights of quadratic designs", weights)
    good = rows.ndim == 2 and rows.shape[1] == 2 * mechanism.n
    if not (good and np.isfinite(rows).all() and (rows > 0).all()):
        raise InvalidInputError(
            "weights of quadratic designs",
            value=f"shape {rows.shape}, least {rows.min(initial=np.inf):g}",
            limit=f"(N, {2 * mechanism.n}) numbers > 0",
        )
    return _kept(mechanism, rows, strict=False)


def _kept(mechanism: Mechanism, weights: FloatArray, *, strict: bool) -> tuple[Surface, ...]:
    """Return quadratic designs from the disk, or design and keep them."""
    numbers = repr((mechanism.parameter_values.tolist(), weights.tolist()))
    key = content_key(mechanism.structure, numbers)
    known = recall("surfaces", key)
    if known is not None:
        rows = json.loads(known)
        return tuple(Surface.from_vector(np.array(r), mechanism.n, mechanism.m) for r in rows)
    made = []
    for row in weights:
        try:
            made.append(_quadratic(mechanism, row, 0.0))
        except UndertowError:
            if strict:
                raise
    remember("surfaces", key, json.dumps([surface.vector.tolist() for surface in made]))
    return tuple(made)


def _quadratic(mechanism: Mechanism, diagonal: FloatArray, rate: float) -> Surface:
    import scipy.linalg  # slow to import: a known design does without

    n, m = mechanism.n, mechanism.m
    A, T = _regular_form(mechanism)
    free = 2 * n - m
    Q = T @ np.diag(diagonal) @ T.T
    with _designing(mechanism, "weights of the quadratic design", diagonal.tolist()):
        P = scipy.linalg.solve_continuous_are(
            A[:free, :free] + rate * np.eye(free),
            A[:free, free:],
            Q[:free, :free],
            Q[free:, free:],
            s=Q[:free, free:],
        )
        K = np.linalg.solve(Q[free:, free:], A[:free, free:].T @ P + Q[:free, free:].T)
        surface = _surface_of(mechanism, np.hstack([K, np.eye(m)]) @ T)
    return surface


@contextmanager
def _designing(mechanism: Mechanism, what: str, given: Sequence[object]) -> Iterator[None]:
    """Say why there is no design: no linear feedback can do it, or what was asked for cannot be."""
    try:
        with np.errstate(all="ignore"):
            yield
    except (ValueError, SingularSurfaceError, UnstableSurfaceError) as error:
        if controllability(mechanism) < UNCONTROLLABLE:
            raise uncontrollable(mechanism) from error
        if isinstance(error, UndertowError):
            raise
        limit = f"such that there is a design: {str(error).rstrip('.')}"
        raise InvalidInputError(what, value=list(given), limit=limit) from error


@checked
def placed_surface(mechanism: Mechanism, poles: Sequence[complex]) -> Surface:
    """Design a surface whose sliding dynamics have the given 2n − m eigenvalues, 1/s.

    Complex ones come with their conjugates, and none more than m times.

    Raises
    ------
    InvalidInputError
        For other poles, a wrong number of them, and poles not left of the imaginary axis.
    ModelError
        When (A, B) is not controllable.
    """
    n, m = mechanism.n, mechanism.m
    free = 2 * n - m
    wanted = np.asarray(poles, dtype=complex)
    if wanted.shape != (free,) or not ((wanted.real < 0) & np.isfinite(wanted)).all():
        raise InvalidInputError(
            "poles of the sliding dynamics",
            value=list(poles),
            limit=f"{free} finite numbers with negative real part",
        )
    if np.unique_counts(wanted).counts.max() > m:
        raise InvalidInputError(
            "poles of the sliding dynamics",
            value=list(poles),
            limit=f"each at most {m} times, as many as there are inputs",
            remedy="Move equal ones a little apart: -3, -3.1, -3.2",
        )
    import scipy.signal  # slow to import, and needed here alone

    A, T = _regular_form(mechanism)
    with _designing(mechanism, "poles of the sliding dynamics", poles):
        with warnings.catch_warnings():
            # The poles are placed; only the conditioning may not be the best there is.
            warnings.filterwarnings("ignore", "Convergence was not reached", UserWarning)
            placed = scipy.signal.place_poles(A[:free, :free], A[:free, free:], wanted)
        surface = _surface_of(mechanism, np.hstack([placed.gain_matrix, np.eye(m)]) @ T)
    return surface


def _regular_form(mechanism: Mechanism) -> tuple[FloatArray, FloatArray]:
    """Return T A Tᵀ and T, orthogonal, with T B = (0, R): the input acts last."""
    lin = linearise(mechanism)
    basis, _ = np.linalg.qr(lin.input, mode="complete")
    m = mechanism.m
    T = np.vstack([basis[:, m:].T, basis[:, :m].T])
    return T @ lin.A @ T.T, T


def _surface_of(mechanism: Mechanism, C: FloatArray) -> Surface:
    n, m = mechanism.n, mechanism.m
    if abs(np.linalg.det(C[:, n : n + m])) < 1e-9 * np.linalg.norm(C) ** m:
        raise SingularSurfaceError(
            f"designed surface for '{mechanism.name}'",
            value="α_a singular",
            limit="an invertible α_a",
            remedy="Change the weights, or the poles",
        )
    surface = Surface(C[:, n : n + m], C[:, :m], C[:, n + m :], C[:, m:n]).normalised()
    check_surface(mechanism, surface)
    return surface
