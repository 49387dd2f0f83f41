"""
From where it comes home
========================

1353 starts in one call: caught, fallen, or singular. Sampled, so no proof; the map of
:doc:`/certificates` is proved.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum()
loop = ut.ClosedLoop(pendulum, ut.MinimumTime(horizon=20.0))
phi, rate = np.meshgrid(np.radians(np.linspace(-60, 60, 41)), np.linspace(-8, 8, 33))
starts = np.zeros((phi.size, 4))
starts[:, 1], starts[:, 3] = phi.ravel(), rate.ravel()
batch = loop.batch(starts, ut.first_surface(pendulum))
time = np.where(batch.reached, batch.time, np.nan).reshape(phi.shape)
figure, axes = plt.subplots(figsize=(6, 4))
mesh = axes.pcolormesh(np.degrees(phi), rate, time, shading="nearest")
figure.colorbar(mesh, label="time to the target (s)")
axes.set(xlabel="φ(0) (°)", ylabel="φ̇(0) (rad/s)", title="white: does not come home")
print(f"{batch.reached.sum()} of {phi.size} starts come home")
