"""
What the motor can do
=====================

The furthest start that is caught, by the voltage that the amplifier gives: starts from rest, half a
degree apart, rolled out together.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum()
surface, angles = ut.first_surface(pendulum), np.arange(1, 60, 0.5)
starts = np.zeros((len(angles), 4))
starts[:, 1] = np.radians(angles)
limits, caught = np.arange(3, 25, 2.0), []
for limit in limits:
    loop = ut.ClosedLoop(pendulum.with_input_limit(limit), ut.MinimumTime(horizon=20.0))
    lost = ~loop.batch(starts, surface).reached
    caught.append(angles[np.argmax(lost)] if lost.any() else angles[-1])
figure, axes = plt.subplots(figsize=(6, 3.5))
axes.plot(limits, caught, "o-")
axes.set(xlabel="largest voltage (V)", ylabel="first start that is lost (°)", ylim=(0, None))
