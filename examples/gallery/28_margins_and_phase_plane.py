"""
The closed loop in python-control
=================================

The loop under our law as a nonlinear system: a cut through its vector field shows the surface, and
the loop at the target has gain, phase and delay margins like any other. Needs the extra
``interop``.
"""

import control
import matplotlib.pyplot as plt
import numpy as np

import undertow as ut
from undertow.export import loop_transfer, phase_plane

rig = ut.mechanisms.rotary_pendulum()
surface = ut.first_surface(rig)
system = ut.nlsys(ut.ClosedLoop(rig), surface)
figure, (left, right) = plt.subplots(1, 2, figsize=(8, 3.8), layout="constrained")
window = [-0.6, 0.6, -6, 6]
control.phase_plane_plot(
    phase_plane(system, "phi", "phi_dot"), window, plot_equilpoints=False, plot_separatrices=False,
    ax=left, color="0.7",
)  # fmt: skip
phi = np.linspace(-0.6, 0.6, 2)
(slope,) = surface.lambda_u.ravel() / surface.alpha_u.ravel()
left.plot(phi, -slope * phi, color="C1", linewidth=2, label="s = 0")
left.set(xlim=window[:2], ylim=window[2:], xlabel="φ (rad)", ylabel="φ̇ (rad/s)")
left.set_title("arm held at its target")
left.legend(loc="upper right", frameon=True)

# %%
# The loop cut at the motor: L(iω) stays far from −1, until it is as late as the delay margin says.
# That much a bench with sampling, filters and a slow line may use up.

(margins,) = ut.loop_margins(rig, surface)
print(margins)
L = loop_transfer(rig, surface)
omega = np.logspace(-1, 4, 4000)
response = L(1j * omega)
late = response * np.exp(-1j * omega * margins.delay)
right.plot(response.real, response.imag, label="L(iω)")
right.plot(late.real, late.imag, "--", label=f"{1000 * margins.delay:.1f} ms late")
circle = np.exp(1j * np.linspace(0, 2 * np.pi, 200))
right.plot(circle.real, circle.imag, color="0.7", linewidth=0.8)
right.plot(-1, 0, "k+")
right.set(xlim=(-3, 3), ylim=(-3, 3), aspect="equal", xlabel="Re L", ylabel="Im L")
right.legend(loc="upper right")
right.set_title("the loop at the target")
figure.suptitle("")
