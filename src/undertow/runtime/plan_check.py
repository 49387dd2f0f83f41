"""The fast loop's own look at a plan: what it runs is packed from the plan, and is stable.

An answer of the slow loop carries a plan, which was judged, and the numbers of the law, which
run.  Nothing but the sender ties the one to the other: here the numbers are packed anew from the
plan, and the linear sliding dynamics at the target are tested by Routh and Hurwitz's criterion on
their characteristic polynomial, both of them apart from the code that made and judged the plan.
"""

from __future__ import annotations

import numpy as np

from undertow.law import LawLayout, Plan, ReachingLaw
from undertow.models import FloatArray, Mechanism, linear_numbers
from undertow.symbolic import Workspace, brief

#: What the test knows and works on: M, F and D of the unactuated rows at the target, X = M_uu⁻¹
#: M_auᵀ there, a surface, the matrix of its sliding dynamics, and room for the eliminations.
_LAYOUT = {
    "M": "free, n", "F": "free, n", "D": "free, n", "X": "free, m", "surface": "2 * m * n",
    "A": "size, size", "left": "width, width", "right": "width, 2 * n",
    "polynomials": "size + 1, size + 1", "routh": "2, size + 1",
}  # fmt: skip


class PlanCheck:
    """Packs the plans of a mechanism for the fast loop, and tests their stability.

    ``reaching`` is the law of plans that have none of their own.
    """

    def __init__(self, mechanism: Mechanism, reaching: ReachingLaw) -> None:
        n, m = mechanism.n, mechanism.m
        self._m, self._layout = m, LawLayout(n, m)
        self._reaching, self._usual = reaching, reaching.vector(m)
        self._mechanism, free = mechanism, n - m
        self._parts = Workspace(
            _LAYOUT, n=n, m=m, free=free, size=n + free, width=max(m, free)
        )  # fmt: skip
        self.believe(mechanism.parameter_values)
        self._arrays = tuple(self._parts[name] for name in _LAYOUT)
        self._gamma(), self._judge()  # compiled by now

    def believe(self, values: FloatArray) -> None:
        """Test from now on with other values of the mechanism's parameters, (P,), SI units."""
        (mass,), (slopes,), _ = linear_numbers(self._mechanism, values[None])
        m, n = self._m, len(mass)
        for name, whole in (("M", mass), ("F", slopes[:, :n]), ("D", slopes[:, n:])):
            self._parts[name][:] = whole[m:]
        self._parts["X"][:] = np.linalg.solve(mass[m:, m:], mass[m:, :m])

    def pack(self, plan: Plan) -> FloatArray:
        """Return the numbers of the law for each surface of a plan, (S, 2mn + 2m + 1).

        The same as :func:`undertow.runtime.slow_loop.law_vectors_of`, in a tenth of its time.
        Raises ValueError for a plan of another mechanism.
        """
        layout, m = self._layout, self._m
        law_vectors = np.empty((len(plan.surfaces), layout.size))
        for k, (law_vector, surface) in enumerate(zip(law_vectors, plan.surfaces, strict=True)):
            law_vector[layout.surface] = surface.vector
            law = None if plan.reaching is None else plan.reaching[k]
            if law is not None and law.switching != self._reaching.switching:
                raise ValueError(f"a plan that switches by '{law.switching}'")
            law_vector[layout.reaching] = self._usual if law is None else law.vector(m)
            self._parts["surface"][:] = law_vector[layout.surface]
            law_vector[-1] = self._gamma()
        return law_vectors

    def fault(self, law_vectors: FloatArray) -> str:
        """Return what forbids the use of packed numbers, (S, …); empty where nothing does.

        The surface that the plan ends on must be stable, as for the gate: earlier ones are
        left again.
        """
        gains = law_vectors[:, self._layout.reaching]
        if not ((gains > 0.0).all() and (gains < np.inf).all()):
            return "a gain or a boundary layer that is not positive"
        if not (np.abs(law_vectors[:, -1]) > 1e-12).all():
            return "det Γ is zero at the target"
        self._parts["surface"][:] = law_vectors[-1, self._layout.surface]
        if not self._judge():
            return "its sliding dynamics are not stable, by Routh's criterion"
        return ""

    def stable(self, surface: FloatArray) -> bool:
        """Whether the sliding dynamics of a surface vector, (2mn,), are stable at the target."""
        self._parts["surface"][:] = surface
        return self._judge()

    def _gamma(self) -> float:
        return float(_gamma(self._m, self._layout.starts, *self._arrays))

    def _judge(self) -> bool:
        return bool(_judge(self._m, self._layout.starts, *self._arrays))


@brief()
def _solve(A: FloatArray, B: FloatArray, size: int, width: int) -> float:
    """Solve A X = B in place, (size, size) and (size, width); return det A, 0 where singular."""
    determinant = 1.0
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(A[i, k]) > abs(A[pivot, k]):
                pivot = i
        if not abs(A[pivot, k]) > 0.0:
            return 0.0
        if pivot != k:
            determinant = -determinant
            for j in range(size):
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
            for j in range(width):
                B[k, j], B[pivot, j] = B[pivot, j], B[k, j]
        determinant *= A[k, k]
        for i in range(size):
            if i != k and A[i, k] != 0.0:
                factor = A[i, k] / A[k, k]
                for j in range(k, size):
                    A[i, j] -= factor * A[k, j]
                for j in range(width):
                    B[i, j] -= factor * B[k, j]
    for k in range(size):
        for j in range(width):
            B[k, j] /= A[k, k]
    return determinant


@brief()
def _gamma(
    m: int, starts: tuple[int, ...], M: FloatArray, F: FloatArray, D: FloatArray, X: FloatArray,
    surface: FloatArray,
    A: FloatArray, left: FloatArray, right: FloatArray, polynomials: FloatArray, routh: FloatArray,
) -> float:  # fmt: skip
    """Return det Γ = det(α_a − α_u X) at the target."""
    free, alpha_u = X.shape[0], starts[2]
    for i in range(m):
        for j in range(m):
            left[i, j] = surface[i * m + j]
            for k in range(free):
                left[i, j] -= surface[alpha_u + i * free + k] * X[k, j]
    return _solve(left, right, m, 0)


@brief()
def _judge(
    m: int, starts: tuple[int, ...], M: FloatArray, F: FloatArray, D: FloatArray, X: FloatArray,
    surface: FloatArray,
    A: FloatArray, left: FloatArray, right: FloatArray, polynomials: FloatArray, routh: FloatArray,
) -> bool:  # fmt: skip
    """Whether the sliding dynamics of a surface are stable; nothing is allocated.

    z = (q_a, q_u, q̇_u):  q̇_a = G z with G = −α_a⁻¹ [λ_a, λ_u, α_u], and
    E q̈_u = [F_a, F_u, D_u] z + D_a G z + M_auᵀ α_a⁻¹ (λ_a G z + λ_u q̇_u).
    """
    free, n = X.shape[0], M.shape[1]
    size, (_, lambda_a, alpha_u, lambda_u, _, _) = n + free, starts
    # −G without its sign: the rows of α_a⁻¹ [λ_a, λ_u, α_u].
    for i in range(m):
        for j in range(m):
            left[i, j] = surface[i * m + j]
            right[i, j] = surface[lambda_a + i * m + j]
        for j in range(free):
            right[i, m + j] = surface[lambda_u + i * free + j]
            right[i, n + j] = surface[alpha_u + i * free + j]
    if _solve(left, right, m, size) == 0.0:
        return False
    A[:] = 0.0
    for i in range(m):
        for j in range(size):
            A[i, j] = -right[i, j]
    for i in range(free):
        A[m + i, n + i] = 1.0
    # The acceleration's rows: [F_a, F_u, D_u] + D_a G + M_auᵀ (α_a⁻¹λ_a G + α_a⁻¹λ_u), E below.
    for i in range(free):
        row = n + i
        for j in range(n):
            A[row, j] = F[i, j]
        for j in range(free):
            A[row, n + j] = D[i, m + j]
        for k in range(m):
            for j in range(size):
                A[row, j] += D[i, k] * A[k, j]
                for p in range(m):
                    A[row, j] += M[i, k] * right[k, p] * A[p, j]
            for j in range(free):
                A[row, n + j] += M[i, k] * right[k, m + j]
    for i in range(free):
        for j in range(free):
            left[i, j] = M[i, m + j]
            for k in range(m):
                left[i, j] -= M[i, k] * right[k, n + j]
    for i in range(free):
        for j in range(size):
            right[i, j] = A[n + i, j]
    if _solve(left, right, free, size) == 0.0:
        return False
    for i in range(free):
        for j in range(size):
            A[n + i, j] = right[i, j]
    return is_hurwitz(A, polynomials, routh)


@brief()
def is_hurwitz(A: FloatArray, polynomials: FloatArray, routh: FloatArray) -> bool:
    """Whether all eigenvalues of A, (N, N), have negative real parts, by Routh and Hurwitz.

    A is overwritten: balanced, scaled, and brought to Hessenberg form by eliminations (Wilkinson,
    *The Algebraic Eigenvalue Problem*, ch. 6), which gives the characteristic polynomial by a
    recurrence over its leading minors. ``polynomials`` and ``routh`` are room, (N + 1, N + 1) and
    (2, N + 1). The answer is also no where a number is not finite, or an entry of Routh's first
    column is zero.
    """
    size = A.shape[0]
    total = 0.0
    for i in range(size):
        for j in range(size):
            total += abs(A[i, j])
    if not total < np.inf:
        return False
    _balance(A)
    scale = 0.0  # a polynomial in s/ω, ω about the size of the largest eigenvalue
    for i in range(size):
        for j in range(size):
            scale = max(scale, abs(A[i, j]))
    if not scale > 0.0:
        return False
    for i in range(size):
        for j in range(size):
            A[i, j] /= scale
    for k in range(1, size - 1):
        pivot = k
        for i in range(k + 1, size):
            if abs(A[i, k - 1]) > abs(A[pivot, k - 1]):
                pivot = i
        if A[pivot, k - 1] == 0.0:
            continue
        if pivot != k:
            for j in range(size):
                A[k, j], A[pivot, j] = A[pivot, j], A[k, j]
            for i in range(size):
                A[i, k], A[i, pivot] = A[i, pivot], A[i, k]
        for i in range(k + 1, size):
            factor = A[i, k - 1] / A[k, k - 1]
            if factor != 0.0:
                for j in range(size):
                    A[i, j] -= factor * A[k, j]
                for j in range(size):
                    A[j, k] += factor * A[j, i]
    # p_k(s) = (s − h_kk) p_{k−1} − Σ_i h_{k−i,k} (Π subdiagonal) p_{k−i−1}; ascending powers.
    polynomials[:] = 0.0
    polynomials[0, 0] = 1.0
    for k in range(1, size + 1):
        for j in range(k):
            polynomials[k, j + 1] += polynomials[k - 1, j]
            polynomials[k, j] -= A[k - 1, k - 1] * polynomials[k - 1, j]
        product = 1.0
        for i in range(1, k):
            product *= A[k - i, k - i - 1]
            for j in range(k - i):
                polynomials[k, j] -= product * A[k - i - 1, k - 1] * polynomials[k - i - 1, j]
    return _routh(polynomials[size], routh)


@brief()
def _balance(A: FloatArray) -> None:
    """Scale rows and columns by powers of two until they are of a size (Parlett, Reinsch)."""
    size = A.shape[0]
    for _ in range(20):
        changed = False
        for i in range(size):
            column = row = 0.0
            for j in range(size):
                if j != i:
                    column += abs(A[j, i])
                    row += abs(A[i, j])
            if column == 0.0 or row == 0.0:
                continue
            factor, together = 1.0, column + row
            while column < 0.5 * row and factor < 1e100:
                factor *= 2.0
                column *= 2.0
                row *= 0.5
            while column >= 2.0 * row and factor > 1e-100:
                factor *= 0.5
                column *= 0.5
                row *= 2.0
            if column + row < 0.95 * together:
                changed = True
                for j in range(size):
                    A[i, j] /= factor
                    A[j, i] *= factor
        if not changed:
            return


@brief()
def _routh(polynomial: FloatArray, rows: FloatArray) -> bool:
    """Whether the first column of Routh's array is positive; ascending powers, the last is 1."""
    order = polynomial.shape[0] - 1
    for j in range(order + 1):
        if not polynomial[j] > 0.0:  # necessary, and cheap
            return False
        rows[0, j] = rows[1, j] = 0.0
    for j in range(order + 1):
        rows[j % 2, j // 2] = polynomial[order - j]
    above, below = 0, 1
    for _ in range(order - 1):
        if not rows[below, 0] > 0.0:
            return False
        ratio = rows[above, 0] / rows[below, 0]
        for j in range(order // 2 + 1):
            following = rows[below, j + 1] if j + 1 <= order else 0.0
            ahead = rows[above, j + 1] if j + 1 <= order else 0.0
            rows[above, j] = ahead - ratio * following
        above, below = below, above
    return bool(rows[below, 0] > 0.0)
