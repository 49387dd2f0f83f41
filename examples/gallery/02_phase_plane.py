"""
The surface jumps
=================

The phase plane of the pendulum, and where s = 0 asks its velocity to be. Each re-optimisation
replaces the surface, the motion reaches the new one, and slides on: all of it, and its end.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut
from undertow.closed_loop.figures import COLOURS
from undertow.display.plot import phase, surface_trace

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
run = ut.Cascade(pendulum, ut.MinimumEnergy(horizon=3.0), belief="exact").simulate(phi=ut.deg(40))
motion, times = run.trajectory, [update.t for update in run.updates]
figure, planes = plt.subplots(1, 2, figsize=(8, 4), layout="constrained")
for axes, since in zip(planes, (0.0, 0.3), strict=True):
    phase(axes, motion, "phi", color=COLOURS["blue"], label="motion")
    trace = {"color": COLOURS["vermilion"], "linewidth": 1.0, "label": "s = 0"}
    surface_trace(axes, motion, run.surfaces, times, "phi", **trace)
    angle, rate = (np.degrees(motion[name][motion.t >= since]) for name in ("phi", "phi_dot"))
    axes.set_xlim(*(1.1 * np.array([angle.min(), angle.max()])))
    axes.set_ylim(*(1.1 * np.array([rate.min(), rate.max()])))
    axes.set_title(f"from {since:g} s on")
planes[0].legend()
print(f"{run.cost:.2f} V² s after {len(run.updates)} decisions")
