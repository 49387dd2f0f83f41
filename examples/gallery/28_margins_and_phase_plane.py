"""
The closed loop in python-control
=================================

A cut through its vector field shows the surface. The loop at the target stays far from −1 until it
is as late as its delay margin says. Needs the extra ``interop``.
"""

import control
import matplotlib.pyplot as plt
import numpy as np

import undertow as ut
from undertow.export import loop_transfer, phase_plane

rig = ut.mechanisms.rotary_pendulum()
surface = ut.first_surface(rig)
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.8), layout="constrained")
plane = phase_plane(ut.nlsys(ut.ClosedLoop(rig), surface), "phi", "phi_dot")
control.phase_plane_plot(plane, [-0.6, 0.6, -6, 6], ax=left, color="0.7", plot_separatrices=False)
left.axline((0, 0), slope=-(surface.lambda_u / surface.alpha_u).item(), color="C1", label="s = 0")
left.set(xlabel="φ (rad)", ylabel="φ̇ (rad/s)", title="arm held at its target")
print(*ut.loop_margins(rig, surface))
omega, delay = np.logspace(-1, 4, 4000), ut.loop_margins(rig, surface)[0].delay
for late, line in ((0.0, "-"), (delay, "--")):
    L = loop_transfer(rig, surface)(1j * omega) * np.exp(-1j * omega * late)
    right.plot(L.real, L.imag, line, label=f"L(iω), {1000 * late:.1f} ms late")
right.plot(-1, 0, "k+")
right.set(xlim=(-3, 3), ylim=(-3, 3), xlabel="Re L", ylabel="Im L", title="the loop at the target")
figure.suptitle(""), left.legend(loc="lower left", frameon=True), right.legend(loc="upper right")
