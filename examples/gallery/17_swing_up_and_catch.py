"""
Swing up, and catch
===================

From hanging: an energy law pumps the pendulum up, and as soon as the sliding-mode law is predicted
to bring it home it takes over.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut
from undertow.cascade.swing_up import CatchRegion, SwingUpAndCatch, designed, hanging
from undertow.estimators import Measured, run_recorded
from undertow.plants import IdealRig

pendulum = ut.mechanisms.rotary_pendulum()
controller = SwingUpAndCatch(designed(pendulum), CatchRegion(pendulum))
rig = IdealRig(pendulum, hanging(pendulum) + pendulum.state(phi=0.01), period=0.001)
record = run_recorded(rig, Measured(pendulum), controller, seconds=8.0)
figure, axes = plt.subplots(figsize=(6, 3.5))
axes.plot(record.t, np.degrees(record.x[:, 1]), label="pendulum φ")
axes.plot(record.t, np.degrees(record.x[:, 0]), label="arm θ")
for when, _ in controller.events:
    axes.axvline(when, linestyle=":", color="0.3")
axes.set(xlabel="time (s); dotted: caught", ylabel="angle (°)")
axes.legend()
