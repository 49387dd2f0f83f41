"""
Hand over to python-control
===========================

The linear model at the target, with names, for whatever that package does: here the Bode plot from
voltage to the pendulum's angle. Needs the extra ``interop``.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

plant = ut.mechanisms.rotary_pendulum().linearise().ss()
omega = np.logspace(-1, 2.5, 300)
response = plant(1j * omega)[plant.output_labels.index("phi"), 0]
figure, (gain, phase) = plt.subplots(2, sharex=True, figsize=(6, 4.5))
gain.loglog(omega, abs(response))
gain.set(ylabel="|φ/u| (rad/V)")
phase.semilogx(omega, np.degrees(np.unwrap(np.angle(response))))
phase.set(xlabel="frequency (rad/s)", ylabel="phase (°)")
print(plant.poles())
