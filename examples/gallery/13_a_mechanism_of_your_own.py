"""
A mechanism of your own
=======================

Energies, parameters, and which coordinate is driven: a bar on a cart, with a torsion spring that is
too weak to hold it. Law, surface and optimum follow.
"""

import sympy as sp

import undertow as ut

x, tilt = ut.Coordinate("x", "m"), ut.Coordinate("tilt", "rad")
k = ut.Parameter("k", 0.2, "N m/rad", "torsion spring")
m, h, a, v, w = 0.3, 0.25, tilt.symbol, x.velocity, tilt.velocity
bar = ut.Mechanism.from_energies(
    "sprung_bar", [x, tilt], [ut.Input("force", "N", 10.0)],
    kinetic=(0.8 + m) * v**2 / 2 + m * h * sp.cos(a) * v * w + sp.Rational(2, 3) * m * h**2 * w**2,
    potential=m * 9.81 * h * sp.cos(a) + k.symbol * a**2 / 2,
    dissipation=0.05 * v**2, parameters=(k,), start={"tilt": ut.deg(12)},
)  # fmt: skip
print(ut.check_mechanism(bar, compiled=False))
run = ut.Cascade(bar, ut.MinimumTime()).simulate()
figure = run.plot()
