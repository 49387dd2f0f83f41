"""What regions on the surface are made of: Lyapunov functions as data, the motion in float64.

The claim itself is :mod:`undertow.proofs.claims.region`; it is searched for in
:mod:`undertow.proofs.search.region` and decided in :mod:`undertow.proofs.kernel.region`.
"""
