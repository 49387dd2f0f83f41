"""
Poles on the surface
====================

On s = 0 what is left is a linear system of order 2n − m near the target. Its eigenvalues move as
λ_u grows; the motor's damping and strength have no part in them.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut
from undertow.law import sliding_matrix

pendulum = ut.mechanisms.rotary_pendulum()
values = np.linspace(4, 30, 200)
poles = np.array([np.linalg.eigvals(sliding_matrix(pendulum, ut.Surface(-1, -1.59, 1.96, value)))
                  for value in values])  # fmt: skip
figure, axes = plt.subplots(figsize=(6, 4))
for column in poles.T:
    dots = axes.scatter(column.real, column.imag, c=values, s=6)
figure.colorbar(dots, label="λ_u (1/s)")
axes.axvline(0, color="0.5", linewidth=0.8)
axes.set(xlabel="real part (1/s)", ylabel="imaginary part (1/s)", title="stable left of the line")
