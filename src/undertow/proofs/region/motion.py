"""The motion on a surface in float64, for searches and pictures; the kernel makes its own."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike

from undertow.base.arguments import require
from undertow.law import Surface, check_surface_shape
from undertow.models.mechanism import FloatArray, Mechanism, Parameter
from undertow.proofs.exact_model import exact_matrix, exact_mechanism, is_odd, require_autonomous
from undertow.symbolic import Tape, compile_numpy


def unused(names: Iterable[str], taken: Collection[str]) -> list[str]:
    """Return made-up names, each with underscores after it until nothing else has it.

    >>> unused(["w_x"], ["x", "w_x"])
    ['w_x_']
    """
    found: list[str] = []
    for name in names:
        while name in taken or name in found:
            name += "_"  # noqa: PLW2901
        found.append(name)
    return found


@dataclass(frozen=True, eq=False)
class SurfaceMotion:
    """The sliding dynamics of a mechanism in y = (q_u, q̇_u, w), of order N = 2n − m.

    ``mechanism``, ``surface``: whose motion, on which surface; w = q_a + λ_a⁻¹ λ_u q_u. Raises
    InvalidInputError for a surface of another size, with a singular λ_a, or a force that depends on
    time; ModelError for a model that is not smooth.
    """

    mechanism: Mechanism
    surface: Surface

    def __post_init__(self) -> None:
        """Check sizes and that w exists; make the model exact."""
        check_surface_shape(self.mechanism, self.surface)
        object.__setattr__(self, "mechanism", exact_mechanism(self.mechanism))
        require_autonomous(self.mechanism, "region")
        require(
            not abs(np.linalg.det(self.surface.lambda_a)) < 1e-12,
            "surface for a region of attraction",
            "λ_a singular",
            "λ_a invertible",
            "With λ_a singular the actuated coordinates do not converge",
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of y."""
        c = self.mechanism.coordinates
        free = c[self.mechanism.m :]
        return (
            *(k.name for k in free),
            *(f"{k.name}_dot" for k in free),
            *unused((f"w_{k.name}" for k in c[: self.mechanism.m]), self.mechanism.state_names),
        )

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The mechanism's."""
        return self.mechanism.parameters

    def build_graph(self, tape: Tape, y: Sequence[sp.Expr]) -> tuple[list[sp.Expr], sp.Expr]:
        """Lay ẏ and det E on a tape, for y given as atoms."""
        mechanism, surface = self.mechanism, self.surface
        m, free = mechanism.m, mechanism.n - mechanism.m
        q_u, v_u, w = (
            sp.Matrix(y[:free]), sp.Matrix(y[free : 2 * free]), sp.Matrix(y[2 * free :])
        )  # fmt: skip
        lambda_a, alpha_u = exact_matrix(surface.lambda_a), exact_matrix(surface.alpha_u)
        inverse = exact_matrix(surface.alpha_a).inv()
        ratio = lambda_a.inv() * exact_matrix(surface.lambda_u)
        q_a = tape.matrix(w - ratio * q_u)
        v_a = tape.matrix(-inverse * (lambda_a * w + alpha_u * v_u))
        w_dot = tape.matrix(v_a + ratio * v_u)
        rename = dict(zip(mechanism.x, [*q_a, *q_u, *v_a, *v_u], strict=True))
        rows = [*mechanism.mass_matrix[m:, :], *mechanism.force[m:, :]]
        atoms = tape.let_all([e.xreplace(rename) for e in rows])
        M = sp.Matrix(free, mechanism.n, atoms[: free * mechanism.n])
        f_u = sp.Matrix(atoms[free * mechanism.n :])
        pull = tape.matrix(M[:, :m] * inverse)
        E = tape.matrix(M[:, m:] - pull * alpha_u)
        right = tape.matrix(f_u + pull * (lambda_a * w_dot))
        adjugate, determinant = tape.adjugate(E)
        reciprocal = tape.let(1 / determinant)
        acceleration = tape.matrix(tape.product(adjugate, right) * reciprocal)
        return [*v_u, *acceleration, *w_dot], determinant

    @cached_property
    def odd(self) -> bool:
        """Whether ẏ(−y) = −ẏ(y), decided on the mechanism's expressions."""
        return is_odd(self.mechanism.force, self.mechanism.x, self.mechanism.mass_matrix)

    @cached_property
    def slow(self) -> FloatArray:
        """κ, (m, n−m), in η = q_a + α_a⁻¹α_u q_u = w − κ q_u.

        η̇ = −α_a⁻¹λ_a w holds no q̇_u: where λ_a is small, η is slow while w is not.
        """
        s = self.surface
        return np.asarray(
            np.linalg.solve(s.lambda_a, s.lambda_u) - np.linalg.solve(s.alpha_a, s.alpha_u)
        )

    @property
    def size(self) -> int:
        """N."""
        return len(self.names)

    @cached_property
    def symbols(self) -> tuple[sp.Symbol, ...]:
        """Symbols of the N coordinates."""
        return tuple(sp.Symbol(f"_y{i}", real=True) for i in range(self.size))

    @cached_property
    def _field(self) -> Any:
        tape = Tape()
        rates, determinant = self.build_graph(tape, self.symbols)
        inputs = [*self.symbols, *(p.symbol for p in self.parameters)]
        return compile_numpy(tape, inputs, [*rates, determinant])

    def _evaluate(self, y: ArrayLike) -> list[FloatArray]:
        columns = np.moveaxis(np.asarray(y, dtype=float), -1, 0)
        with np.errstate(all="ignore"):
            values = self._field(*columns, *(p.value for p in self.parameters))
        return [np.broadcast_to(v, columns.shape[1:]) for v in values]

    def __call__(self, y: ArrayLike) -> FloatArray:
        """Return ẏ at the points y: (…, N) to (…, N)."""
        return np.stack(self._evaluate(y)[:-1], axis=-1)

    @cached_property
    def _at_target(self) -> float:
        return float(self._evaluate(np.zeros(self.size))[-1])

    def margin(self, y: ArrayLike) -> FloatArray:
        """Return what is left of det E at the points y, (…,), as a part of that at the target."""
        return np.asarray(self._evaluate(y)[-1] / self._at_target)

    @cached_property
    def jacobian(self) -> FloatArray:
        """∂ẏ/∂y at 0, (N, N), by central differences."""
        h = 1e-6 * np.eye(self.size)
        return np.asarray((self(h) - self(-h)).T / 2e-6)
