"""Validated integration: tubes that contain every motion from a set of starts.

Many sets at once, the last axis counts them.  A set is z = m + C ξ + B r with ξ ∈ [−1, 1]^c
(starts and uncertain parameters, kept to first order through the whole motion) and a box r of
remainders (Lohner's doubleton); B is close to orthogonal, by a QR factorisation every step, so
that the remainders do not wrap.

One step h, for a right-hand side f that need only be Lipschitz:

1. A box Y with X + [0, h] f(Y) ⊂ Y holds every motion from X over the step (Picard).
2. Two motions differ by e with ė = A(t) e + A_p(t) δp, A(t) ∈ J the generalised slopes over Y.
   Products A(t₁)…A(t_k) lie in the interval matrix power J^k and the ordered integral has
   weight h^k/k!, so e(h) ∈ Φ e(0) + Ψ δp with Φ ∈ Σ h^k/k! J^k: no smoothness is needed, and
   a fast linear mode is resolved by the series, not by small steps.
3. Likewise m(h) ∈ m + Σ_{k≥1} h^k/k! J^{k−1} f(m).
4. The first R rows of f are smooth and dA/dt lies in G over Y.  There A(t) ∈ J₀ + t G with J₀
   the slopes over X alone, so the first term of Φ is h J₀ + h²/2 G.  In 3. the slopes between m
   and m(t) are in J(m) + t/2 G: they change at half the rate of those at m(t).  The second term
   up to time t is therefore in t²/2 J(m) f(m) + t³/6 G f(m), and what follows integrates each
   part by its own power of t:

       m(h) ∈ m + h f(m) + Σ_{k≥2} (h^k/k! J^{k−2} J(m) + h^{k+1}/(k+1)! J^{k−2} G) f(m).

   The two are added after the products with J, never before: J a + J b is more than J (a + b), and
   the slopes that multiply a are not those that multiply b.  This wins an order in h.

Everything is outward-rounded.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from undertow.models.mechanism import FloatArray
from undertow.proofs.closed_loop.pieces import put_boxes
from undertow.proofs.intervals.batch import Interval

Mask = NDArray[np.bool_]

#: Terms of the series; its tail is bounded.
TERMS = 6


class Rates(Protocol):
    """What a field says over boxes; the last axis counts boxes."""

    @property
    def rate(self) -> Interval:
        """ż, (N, L)."""

    @property
    def slope(self) -> Interval:
        """Generalised derivatives in z and in k parameters, (N, N + k, L)."""

    @property
    def kinked(self) -> Mask:
        """Boxes, (L,), for which it pays to say more of the points in them."""


class Paths(Protocol):
    """Points of boxes z and parameters, written around a middle."""

    @property
    def middle(self) -> FloatArray:
        """The middle, (N, L); parameters p̂."""

    def way(self, slope: Interval) -> Interval:
        """Enclose slope · (z − middle, p − p̂) over the points, (I, N + k, L) to (I, L)."""


@dataclass(frozen=True)
class _Motions:
    """Points of motions from m + C ξ + B r with ż in F, up to time h: a convex set."""

    tubes: Tubes
    rate: Interval
    span: Interval

    @property
    def middle(self) -> FloatArray:
        return self.tubes.middle

    def way(self, slope: Interval) -> Interval:
        first = slope[:, : len(self.tubes.middle)]
        return self.tubes.way(slope) + self.span * matmul(first, self.rate[:, None])[:, 0]


class Field(Protocol):
    """A right-hand side with slopes, and with k parameters p̂ + ρ ξ, ξ ∈ [−1, 1]."""

    @property
    def radii(self) -> FloatArray:
        """ρ, (k,)."""

    def over(
        self,
        z: Interval,
        *,
        middle: bool = False,
        paths: Paths | None = None,
        brief: bool = False,
    ) -> Rates:
        """Enclose rates and slopes over boxes.

        With ``middle`` for ξ = 0 alone; ``paths`` says more of the points in the boxes; with
        ``brief`` no slopes are asked for but those of the smooth rows.
        """

    def bend(self, z: Interval, rate: Interval) -> Interval:
        """Enclose d/dt of the slopes of the R smooth rows, (R, N + k, L), for ż in ``rate``."""


def matmul(a: Interval, b: Interval) -> Interval:
    """Product of interval matrices (I, K, L) and (K, J, L)."""
    total = a[:, 0, None] * b[None, 0]
    for k in range(1, a.lo.shape[1]):
        total = total + a[:, k, None] * b[None, k]
    return total


def bracket(low: FloatArray, high: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return floats (middle, radius) with middle ± radius ⊇ [low, high]."""
    middle = 0.5 * (low + high)
    radius = np.maximum(
        (Interval(high) - Interval(middle)).hi, (Interval(middle) - Interval(low)).hi
    )
    return middle, np.maximum(radius, 0.0)


def _row_sum(a: FloatArray) -> FloatArray:
    """Upper bound of the largest row sum of non-negative (I, K, L), as (L,)."""
    total = a[:, 0]
    for k in range(1, a.shape[1]):
        total = np.nextafter(total + a[:, k], np.inf)
    return np.asarray(total.max(axis=0))


def stack(upper: Interval, lower: Interval) -> Interval:
    """Stack two blocks of rows."""
    return Interval.concatenate([upper, lower])


def _with_zero(a: Interval) -> Interval:
    return Interval(np.minimum(a.lo, 0.0), np.maximum(a.hi, 0.0))


@dataclass
class Tubes:
    """L sets on their way.

    Parameters
    ----------
    field
        The right-hand side.
    middle
        m, (N, L).
    spread
        C, (N, c, L); the last k columns belong to the field's parameters.
    basis
        B, (N, N, L), each close to orthogonal.
    rest
        r, (N, L), contains 0.
    """

    field: Field
    middle: FloatArray
    spread: FloatArray
    basis: FloatArray
    rest: Interval

    @classmethod
    def of(cls, field: Field, middle: FloatArray, spread: FloatArray, rest: Interval) -> Tubes:
        """Start from m + C ξ + r; columns for the field's parameters are added."""
        size, lanes = middle.shape
        parameters = np.zeros((size, len(field.radii), lanes))
        basis = np.repeat(np.eye(size)[:, :, None], lanes, axis=2)
        spread = np.concatenate([spread, parameters], axis=1)
        return cls(field, middle, spread, basis, _with_zero(rest))

    def take(self, lanes: Mask | NDArray[np.intp]) -> Tubes:
        """Return some of the sets."""
        return Tubes(
            self.field,
            self.middle[:, lanes],
            self.spread[..., lanes],
            self.basis[..., lanes],
            self.rest[:, lanes],
        )

    def image(self, rows: Interval) -> Interval:
        """Enclose R z over the sets for a matrix R, (I, N), as (I, L)."""
        R = rows[:, :, None]
        return (
            matmul(R, Interval(self.middle)[:, None])[:, 0]
            + _spread(matmul(R, Interval(self.spread)))
            + self._rest_by(R)
        )

    def way(self, slope: Interval) -> Interval:
        """Enclose slope · (z − m, p − p̂) over the sets, (I, N + k, L) to (I, L)."""
        size = len(self.middle)
        first = slope[:, :size]
        return _spread(self._spread_by(first, slope[:, size:])) + self._rest_by(first)

    def _spread_by(self, first: Interval, second: Interval) -> Interval:
        """Enclose the columns of the spread under slopes in z and in the field's parameters."""
        k, spread = len(self.field.radii), matmul(first, Interval(self.spread))
        if not k:
            return spread
        own = spread[:, -k:] + second * Interval(self.field.radii[None, :, None])
        return Interval.concatenate([spread[:, :-k], own], axis=1)

    def _rest_by(self, rows: Interval) -> Interval:
        return matmul(matmul(rows, Interval(self.basis)), self.rest[:, None])[:, 0]

    def mapped(self, value: Interval, slope: Interval) -> Tubes:
        """Apply a Lipschitz map g: ``value`` holds g(m, p̂), ``slope`` (N, N + k, L) its slopes."""
        size = len(self.middle)
        return self._assemble(slope[:, :size], slope[:, size:], value - Interval(self.middle))

    @property
    def hull(self) -> Interval:
        """Boxes that hold the sets, (N, L)."""
        return (
            Interval(self.middle)
            + _spread(Interval(self.spread))
            + matmul(Interval(self.basis), self.rest[:, None])[:, 0]
        )

    def advance(self, h: float) -> tuple[Tubes, Interval, Rates, Mask]:
        """Move all sets on by h.

        Returns
        -------
        Tubes
            The sets at the end of the step.
        Interval
            Boxes that hold them over the whole step, (N, L).
        Rates
            The field over these boxes.
        numpy.ndarray
            Which sets moved; the others found no such box, and their numbers mean nothing.
        """
        step = Interval(h)
        begin, outer, rates, good = self._enclose(h)
        size = len(self.middle)
        here = self.field.over(Interval(self.middle), middle=True, brief=True)
        G = self.field.bend(outer, rates.rate)
        smooth = len(G.lo)
        kinked = rates.slope[smooth:]
        drawn = begin.slope[:smooth] + Interval(0.0, h) * G
        J = stack(rates.slope[:smooth].intersect(drawn), kinked)
        J_z = J[:, :size]
        mean = stack(begin.slope[:smooth] + 0.5 * step * G, kinked)
        # Ordered integrals of A…A for [Φ Ψ], and of A…A f(m) for the middle: there the second
        # factor from the right is J(m) in ``move``, of order h^k, and G in ``turn``, h^(k+1).
        flow, term = mean * step, J * step
        f = here.rate[:, None]
        half, sixth = step * step * 0.5, step * step * step * (1 / Interval(6.0))
        move = matmul(stack(here.slope[:smooth], kinked)[:, :size], f) * half
        curved = stack(G[:, :size], Interval.zeros(size - smooth, size, f.shape[-1]))
        turn = matmul(curved, f) * sixth
        drift = f * step + move + turn
        for k in range(2, TERMS + 1):
            term = matmul(J_z, term) * (step * (1 / Interval(float(k))))
            flow = flow + term
        for k in range(3, TERMS + 1):
            move = matmul(J_z, move) * (step * (1 / Interval(float(k))))
            turn = matmul(J_z, turn) * (step * (1 / Interval(float(k + 1))))
            drift = drift + move + turn
        # The tail of both series in the maximum norm, Σ_{k≥1} (h‖J‖)^k ≤ h‖J‖/(1 − h‖J‖).
        ratio = step * Interval(_row_sum(J_z.magnitude)) * (1 / Interval(float(TERMS + 1)))
        good &= ratio.hi < 0.9
        factor = ratio * (1 / (1 - ratio))
        tail = _ball(factor * Interval(_row_sum(term.magnitude)))
        flow = flow + tail[None, None]
        # The next of ``turn`` is over the last by less than ``ratio`` too.
        last = Interval(move.magnitude.max(axis=(0, 1))) + Interval(turn.magnitude.max(axis=(0, 1)))
        drift = drift + _ball(factor * last)[None, None]
        Phi = flow[:, :size] + Interval(np.eye(size)[:, :, None])
        return self._assemble(Phi, flow[:, size:], drift[:, 0]), outer, rates, good

    def _enclose(self, h: float) -> tuple[Rates, Interval, Rates, Mask]:
        """Find boxes that hold the motions over a step; the field at its begin and over it."""
        start, span = self.hull, Interval(0.0, h)
        begin = self.field.over(start, brief=True)
        guess = start + span * begin.rate
        lanes = start.lo.shape[1]
        outer = Interval(np.empty_like(start.lo), np.empty_like(start.hi))
        rates, good, todo = begin, np.zeros(lanes, dtype=bool), np.arange(lanes)
        # A set's boxes are its own: what becomes of it does not depend on the others.
        for _ in range(12):
            room = 0.05 * (guess.hi - guess.lo) + 1e-9
            tried = Interval(guess.lo - room, guess.hi + room)
            found = self.field.over(tried)
            guess = start[:, todo] + span * found.rate
            outer[:, todo] = tried
            rates = put_boxes(rates, todo, found)
            with np.errstate(invalid="ignore"):
                inside = np.all((guess.lo >= tried.lo) & (guess.hi <= tried.hi), axis=0)
            good[todo] = inside
            if inside.all():
                break
            todo, guess = todo[~inside], guess[:, ~inside]
        kinked = np.flatnonzero(rates.kinked)
        if len(kinked):
            paths = _Motions(self.take(kinked), rates.rate[:, kinked], span)
            rates = put_boxes(rates, kinked, self.field.over(outer[:, kinked], paths=paths))
        return begin, outer, rates, good

    def _assemble(self, Phi: Interval, Psi: Interval, drift: Interval) -> Tubes:
        target, carried = Interval(self.middle) + drift, self._spread_by(Phi, Psi)
        middle, spread = target.middle, carried.middle
        lost = (target - Interval(middle)) + _spread(carried - Interval(spread))
        turned = matmul(Phi, Interval(self.basis))
        basis = _orthogonal(turned.middle, self.rest.magnitude)
        transposed = Interval(np.swapaxes(basis, 0, 1))
        rest = matmul(matmul(transposed, turned), self.rest[:, None])[:, 0]
        rest = rest + matmul(transposed, lost[:, None])[:, 0]
        # Bᵀ is the inverse but for δ = ‖BᵀB − I‖: (I + G)⁻¹ w ∈ w ± δ/(1 − δ) ‖w‖.
        size = len(self.middle)
        gram = matmul(transposed, Interval(basis)) - Interval(np.eye(size)[:, :, None])
        off = Interval(_row_sum(gram.magnitude))
        error = off * (1 / (1 - off)) * Interval(rest.magnitude.max(axis=0))
        rest = rest + _ball(error)[None]
        return Tubes(self.field, middle, spread, basis, _with_zero(rest))


def _ball(radius: Interval) -> Interval:
    return Interval(-radius.hi, radius.hi)


def _spread(C: Interval) -> Interval:
    """Enclose C ξ, ξ ∈ [−1, 1]^c, for C (N, c, L)."""
    total = np.zeros(C.lo[:, 0].shape) if C.lo.shape[1] else np.zeros((len(C.lo), C.lo.shape[2]))
    size = C.magnitude
    for k in range(size.shape[1]):
        total = np.nextafter(total + size[:, k], np.inf)
    return Interval(-total, total)


def _orthogonal(a: FloatArray, weight: FloatArray) -> FloatArray:
    """Orthogonal factors of (N, N, L), longest columns first so that they keep their direction."""
    size = len(a)
    matrices = np.moveaxis(np.nan_to_num(a, posinf=0.0, neginf=0.0), -1, 0)
    length = np.linalg.norm(matrices, axis=1) * weight.T
    order = np.argsort(-np.nan_to_num(length), axis=1)
    sorted_ = np.take_along_axis(matrices, order[:, None, :], axis=2)
    # Keep it regular: a column that vanished is replaced by what QR makes of a small identity.
    q, _ = np.linalg.qr(sorted_ + 1e-300 * np.eye(size))
    return np.ascontiguousarray(np.moveaxis(q, 0, -1))
