"""
A crane with two inputs
=======================

Four coordinates, two motors: the same few lines. The surface has two rows, and each trolley its
own.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

gantry = ut.mechanisms.gantry_crane()
run = ut.Cascade(gantry, ut.MinimumTime(), belief="exact").simulate()
motion = run.trajectory
figure, (plan, swing) = plt.subplots(1, 2, figsize=(8, 3.5))
plan.plot(motion["x"], motion["y"])
plan.plot(0, 0, "o")
plan.set(xlabel="x (m)", ylabel="y (m)", title="the trolley from above")
for name in (c.name for c in gantry.coordinates if c.unit == "rad"):
    swing.plot(motion.t, np.degrees(motion[name]), label=name)
swing.set(xlabel="time (s)", ylabel="swing (°)")
swing.legend()
