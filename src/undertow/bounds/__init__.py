"""The optimal-control bound: the least cost of any input, by direct collocation.

The sliding-mode law is one way to move; this module asks how cheap *any* admissible input
u(t) could be from the same state, so that a result has something to be measured by.

    min over u(·), t_f:  ∫ Φ(x, u) dt   with  ẋ = (q̇, M⁻¹(f + B u)),  x(0) = x₀,
    |u| ≤ u_max (38),  w(x, u) ≤ 0 (25),  ‖x(t_f)‖₂ ≤ ν (31),  t_f ≤ horizon

It is transcribed by the separated Hermite-Simpson scheme (Betts, *Practical Methods for
Optimal Control*, 2010, ch. 4; Kelly, *SIAM Review* 59, 2017): states at the nodes and
midpoints of a mesh, inputs at the nodes and linear between them, so that u(t) keeps its
limits everywhere.  IPOPT solves the sparse programme with exact derivatives by CasADi.

**What the number means.**  It is a *local* optimum of a *discretised* problem, not a
rigorous lower bound: another basin may hold a cheaper motion, and the true infimum may be
lower by about the discretisation error.  Both can be looked at on the result: where the
guess came from, what the last mesh refinement changed, how far the motion is from the
equations of motion between the nodes, and how stationary it is.  See :func:`bound`.
"""

from undertow.bounds.optimum import Bound, bound

__all__ = ["Bound", "bound"]
