"""Sliding surfaces and reaching laws: where to slide, and how to get there, as numbers.

A surface is s = α_a q̇_a + λ_a q_a + α_u q̇_u + λ_u q_u, equation (10); the law that holds a
mechanism on it is :mod:`undertow.law.sliding`'s.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, NamedTuple, Protocol, Self, get_args

import numpy as np
import sympy as sp
from numpy.typing import ArrayLike, NDArray

from undertow.base import (
    BY_NAME,
    InvalidInputError,
    at_least,
    check_fields,
    checked,
    checked_names,
    floats,
    one_of,
    positive,
)
from undertow.models import FloatArray

Switching = Literal["saturation", "tanh", "sign"]


class SurfaceBlocks(NamedTuple):
    """The blocks of a surface: α_a and λ_a (…, m, m), α_u and λ_u (…, m, n−m)."""

    alpha_a: Any
    lambda_a: Any
    alpha_u: Any
    lambda_u: Any


class LawLayout(NamedTuple):
    """Where everything lies in the vectors of a surface and of a law.

    A surface vector is α_a, λ_a, α_u, λ_u, each row by row: 2mn numbers.  The law vector that
    kernels read goes on with η_1 … η_m, ε_1 … ε_m and, last, det Γ at the target.

    Examples
    --------
    >>> layout = LawLayout(n=2, m=1)
    >>> layout.blocks(np.array([-1.0, -0.5, 5.0, 10.0])).alpha_u
    array([[5.]])
    >>> layout.eta, layout.layer, layout.size
    (slice(4, 5, None), slice(5, 6, None), 7)
    """

    n: int
    m: int

    @property
    def starts(self) -> tuple[int, int, int, int, int, int]:
        """Where α_a, λ_a, α_u, λ_u, η and ε begin: what compiled code is given."""
        return _starts(self.n, self.m)

    @property
    def surface(self) -> slice:
        """The surface vector within a law vector."""
        return slice(0, 2 * self.m * self.n)

    @property
    def eta(self) -> slice:
        """The gains η_i."""
        return slice(*self.starts[4:])

    @property
    def layer(self) -> slice:
        """The half-widths ε_i of the layer."""
        return slice(self.starts[5], self.size - 1)

    @property
    def reaching(self) -> slice:
        """Both, as :meth:`ReachingLaw.vector` gives them."""
        return slice(self.starts[4], self.size - 1)

    @property
    def size(self) -> int:
        """Numbers of a law vector."""
        return 2 * self.m * self.n + 2 * self.m + 1

    def blocks(self, vectors: NDArray[Any]) -> SurfaceBlocks:
        """Return the blocks of surface or law vectors, (…, 2mn or more), as views."""
        a, b, c, d, end, _ = self.starts
        lead = vectors.shape[:-1]
        return SurfaceBlocks(
            vectors[..., a:b].reshape(*lead, self.m, self.m),
            vectors[..., b:c].reshape(*lead, self.m, self.m),
            vectors[..., c:d].reshape(*lead, self.m, self.n - self.m),
            vectors[..., d:end].reshape(*lead, self.m, self.n - self.m),
        )

    def matrices(self, entries: Sequence[sp.Expr]) -> SurfaceBlocks:
        """Return the blocks of the 2mn entries of a surface as SymPy's matrices."""
        return SurfaceBlocks(*(sp.Matrix(b) for b in self.blocks(np.array(entries, dtype=object))))


@cache
def _starts(n: int, m: int) -> tuple[int, int, int, int, int, int]:
    return 0, m * m, 2 * m * m, m * m + m * n, 2 * m * n, 2 * m * n + m


def _rows(what: str, values: ArrayLike, width: int, remedy: str = BY_NAME) -> FloatArray:
    """Return points, (…, width), or refuse them."""
    rows = floats(what, values, remedy)
    if rows.ndim == 0 or rows.shape[-1] != width:
        value, limit = f"shape {rows.shape}", f"(…, {width})"
        raise InvalidInputError(what, value=value, limit=limit, remedy=remedy)
    return rows


@dataclass(frozen=True, eq=False)
class Surface:
    """A linear sliding surface, equation (10).

    Parameters
    ----------
    alpha_a, lambda_a
        (m, m), both invertible; weights of q̇_a and q_a.
    alpha_u, lambda_u
        (m, n−m); weights of q̇_u and q_u.  Numbers are accepted for m = n−m = 1.

    Raises
    ------
    InvalidInputError
        When shapes disagree, an entry is not finite, or α_a is singular.

    Examples
    --------
    >>> base = Surface(alpha_a=-1, lambda_a=-0.5, alpha_u=5, lambda_u=10)
    >>> round(float(base.s([0.1, 0.2, 0.0, 0.0])[0]), 12)
    1.95
    """

    alpha_a: FloatArray
    lambda_a: FloatArray
    alpha_u: FloatArray
    lambda_u: FloatArray

    @checked
    def __init__(
        self, alpha_a: ArrayLike, lambda_a: ArrayLike, alpha_u: ArrayLike, lambda_u: ArrayLike
    ) -> None:
        given = zip(SurfaceBlocks._fields, (alpha_a, lambda_a, alpha_u, lambda_u), strict=True)
        blocks = {name: np.array(value, dtype=float, ndmin=2) for name, value in given}
        m, free = blocks["alpha_a"].shape[0], blocks["alpha_u"].shape[1]
        for name, block in blocks.items():
            shape = (m, m) if name.endswith("_a") else (m, free)
            if block.shape != shape:
                raise InvalidInputError(
                    f"surface block {name}",
                    value=f"shape {block.shape}",
                    limit=f"{shape}",
                    remedy="Blocks with _a are (m, m), those with _u are (m, n−m)",
                )
            if not np.isfinite(block).all():
                raise InvalidInputError(
                    f"surface block {name}",
                    value=block.tolist(),
                    limit="finite numbers",
                    remedy="Keep the surface that was in use before",
                )
            block.flags.writeable = False
            object.__setattr__(self, name, block)
        alpha = blocks["alpha_a"]
        if abs(alpha[0, 0] if m == 1 else np.linalg.det(alpha)) < 1e-12:
            raise InvalidInputError(
                "surface block alpha_a",
                value=blocks["alpha_a"].tolist(),
                limit="invertible",
                remedy="Use −1 (or −I), the paper's normalisation",
            )

    def _repr_latex_(self) -> str:
        """Show its equation in a notebook: numbers for one surface, else matrices."""
        terms = zip(self._blocks, (r"\dot{q}_a", "q_a", r"\dot{q}_u", "q_u"), strict=True)

        def shown(block: FloatArray) -> str:
            if block.size == 1:
                return f"{block.item():+.4g}"
            rows = r" \\ ".join(" & ".join(f"{v + 0.0:.4g}" for v in row) for row in block)
            return rf"+ \begin{{pmatrix}} {rows} \end{{pmatrix}}"

        text = " ".join(rf"{shown(block)}\,{name}" for block, name in terms)
        return rf"$\displaystyle s = {text.lstrip('+ ')}$"

    @property
    def _blocks(self) -> SurfaceBlocks:
        return SurfaceBlocks(self.alpha_a, self.lambda_a, self.alpha_u, self.lambda_u)

    @property
    def m(self) -> int:
        """Number of surfaces, one per input."""
        return int(self.alpha_a.shape[0])

    @property
    def n(self) -> int:
        """Number of coordinates."""
        return self.m + int(self.alpha_u.shape[1])

    @property
    def vector(self) -> FloatArray:
        """All 2mn entries: α_a, λ_a, α_u, λ_u, each row by row."""
        return np.concatenate([block.ravel() for block in self._blocks])

    @classmethod
    @checked
    def from_vector(cls, vector: ArrayLike, n: int, m: int) -> Self:
        """Rebuild a surface from its 2mn entries, the inverse of :attr:`vector`."""
        at_least("number of inputs", m, 1, "One surface goes with each input")
        at_least("number of coordinates", n, m + 1, "Fewer inputs than coordinates")
        entries = floats("surface vector", vector)
        if entries.shape != (2 * m * n,):
            raise InvalidInputError(
                "surface vector",
                value=f"shape {entries.shape}",
                limit=f"({2 * m * n},), 2mn numbers",
                remedy="Give α_a, λ_a, α_u, λ_u, each row by row",
            )
        return cls(*LawLayout(n, m).blocks(entries))

    @property
    def position_row(self) -> FloatArray:
        """[λ_a, λ_u], (m, n)."""
        return np.hstack([self.lambda_a, self.lambda_u])

    @property
    def velocity_row(self) -> FloatArray:
        """[α_a, α_u], (m, n)."""
        return np.hstack([self.alpha_a, self.alpha_u])

    @property
    def matrix(self) -> FloatArray:
        """C with s = C x, (m, 2n)."""
        return np.hstack([self.position_row, self.velocity_row])

    def normalised(self) -> Self:
        """Return the same surface scaled to α_a = −I, the paper's normalisation."""
        m = self.m
        if np.array_equal(self.alpha_a, -np.eye(m)):
            return self
        scale = -np.linalg.inv(self.alpha_a)
        return type(self)(
            -np.eye(m), scale @ self.lambda_a, scale @ self.alpha_u, scale @ self.lambda_u
        )

    @checked
    def s(self, x: ArrayLike) -> FloatArray:
        """Return s at the states x: (…, 2n) to (…, m)."""
        return np.asarray(_rows("states of a surface", x, 2 * self.n) @ self.matrix.T)

    @checked
    def sliding_coordinates(self, x: ArrayLike) -> FloatArray:
        """Return y = (q_u, q̇_u, w) of the states x, (…, 2n) to (…, 2n − m): what moves on s = 0.

        w = q_a + λ_a⁻¹ λ_u q_u is the slow coordinate: on the surface ẇ follows from q̇_u and w.

        Raises
        ------
        InvalidInputError
            For another shape, and where λ_a is singular.
        """
        states, n, m = _rows("states of a surface", x, 2 * self.n), self.n, self.m
        w = states[..., :m] + states[..., m:n] @ self._lean.T
        return np.concatenate([states[..., m:n], states[..., n + m :], w], axis=-1)

    @checked
    def on_surface(self, y: ArrayLike) -> FloatArray:
        """Return the states with s = 0 at y = (q_u, q̇_u, w), (…, 2n − m) to (…, 2n).

        The inverse of :meth:`sliding_coordinates` on the surface, with its errors.
        """
        free = self.n - self.m
        points = _rows("sliding coordinates", y, self.n + free, "Give q_u, q̇_u and w")
        q_u, v_u, w = np.split(points, [free, 2 * free], axis=-1)
        pull = w @ self.lambda_a.T + v_u @ self.alpha_u.T
        v_a = -np.linalg.solve(self.alpha_a, pull[..., None])[..., 0]
        return np.concatenate([w - q_u @ self._lean.T, q_u, v_a, v_u], axis=-1)

    @property
    def _lean(self) -> FloatArray:
        """λ_a⁻¹ λ_u, (m, n − m)."""
        try:
            return np.asarray(np.linalg.solve(self.lambda_a, self.lambda_u))
        except np.linalg.LinAlgError:
            raise InvalidInputError(
                "lambda_a of a surface", value="a singular one", limit="one that can be inverted"
            ) from None

    def __eq__(self, other: object) -> bool:
        """Compare entry by entry."""
        return isinstance(other, Surface) and np.array_equal(self.vector, other.vector)

    def __hash__(self) -> int:
        """Hash of the entries."""
        return hash(self.vector.tobytes())

    def __repr__(self) -> str:
        """Show the blocks to four digits."""

        def show(block: FloatArray) -> str:
            if block.size == 1:
                return f"{block.item():.4g}"
            return str([[float(f"{v:.4g}") + 0.0 for v in row] for row in block])  # no -0.0

        return f"Surface({', '.join(f'{k}={show(b)}' for k, b in self._blocks._asdict().items())})"


@checked_names
@dataclass(frozen=True)
class ReachingLaw:
    """How the surface is reached: gain, boundary layer and switching function.

    Parameters
    ----------
    eta
        Reaching gains η_i > 0 of (13), one per surface or one for all.
    layer
        Half-widths ε_i > 0 of the boundary layer (39), in the units of s.  Not used by
        ``"sign"``.
    switching
        ``"saturation"`` (39), ``"tanh"`` or ``"sign"`` (12).  The last is discontinuous: sampled
        every h s it chatters, s by about h η, and no terminal set that is smaller can be held.  A
        closed loop in continuous time slides on s = 0.
    """

    eta: float | tuple[float, ...] = 20.0
    layer: float | tuple[float, ...] = 0.1
    switching: Switching = "saturation"

    def __post_init__(self) -> None:
        """Refuse gains and layers that are not positive and finite."""
        known, remedy = get_args(Switching), "Choose 'saturation' for the paper's law (39)"
        one_of("switching function", self.switching, known, remedy)
        check_fields(self)
        for name in ("eta", "layer"):
            remedy = "The paper uses η = 20 and a layer of 0.1"
            positive(f"reaching law {name}", getattr(self, name), remedy)

    @property
    def has_layer(self) -> bool:
        """Whether the law is continuous, with a boundary layer: all but ``"sign"``."""
        return self.switching != "sign"

    @checked
    def vector(self, m: int) -> FloatArray:
        """Return (η_1 … η_m, ε_1 … ε_m)."""
        at_least("number of inputs", m, 1, "One surface goes with each input")
        values = [np.atleast_1d(np.asarray(v, dtype=float)) for v in (self.eta, self.layer)]
        for name, value in zip(("eta", "layer"), values, strict=True):
            if value.size not in (1, m):
                raise InvalidInputError(
                    f"reaching law {name}",
                    value=f"{value.size} numbers",
                    limit="1" if m == 1 else f"1 or {m}",
                    remedy="Give one number for all surfaces, or one per input",
                )
        return np.concatenate([np.broadcast_to(v, (m,)) for v in values])

    def per_surface(self, m: int) -> tuple[FloatArray, FloatArray]:
        """Return η and ε of each of m surfaces, (m,) each."""
        eta, layer = np.split(self.vector(m), 2)
        return eta, layer

    @checked
    def check_period(self, name: str, period: float, m: int) -> None:
        """Refuse a time between two inputs, s, in which s would cross its layer.

        Raises
        ------
        InvalidInputError
            Unless it is below 2 ε/η; of ``"sign"``, which has no layer, any will do.
        """
        eta, layer = self.per_surface(m)
        longest = float(np.min(2 * layer / eta))
        if self.has_layer and not period < longest:
            raise InvalidInputError(
                name,
                value=f"{period:g} s",
                limit=f"below 2 ε/η = {longest:g} s",
                remedy="Use a shorter one, a thicker boundary layer or a smaller η",
            )


class Region(Protocol):
    """A set of states."""

    def contains(self, x: FloatArray) -> bool:
        """Whether the state is inside for certain."""


@dataclass(frozen=True)
class ProvedSet:
    """A proved region of attraction of a full closed loop, for one surface and reaching law.

    ``model`` is the mechanism's fingerprint; empty where nobody said it.
    """

    surface: Surface
    reaching: ReachingLaw
    region: Region
    model: str = ""

    def contains(self, x: FloatArray) -> bool:
        """Whether the state is inside for certain."""
        return self.region.contains(x)
