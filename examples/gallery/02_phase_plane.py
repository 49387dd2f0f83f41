"""
The surface jumps
=================

The phase plane of the pendulum, and where s = 0 asks its velocity to be. Each re-optimisation
replaces the surface, the motion reaches the new one, and slides on.
"""

import matplotlib.pyplot as plt

import undertow as ut
from undertow.closed_loop.figures import COLOURS
from undertow.display.plot import phase, surface_trace

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
run = ut.Cascade(pendulum, ut.MinimumEnergy(horizon=3.0), belief="exact").simulate(phi=ut.deg(40))
figure, axes = plt.subplots(figsize=(6, 4))
phase(axes, run.trajectory, "phi", color=COLOURS["blue"], label="motion")
times = [update.t for update in run.updates]
trace = {"color": COLOURS["vermilion"], "linewidth": 1.0, "label": "s = 0"}
surface_trace(axes, run.trajectory, run.surfaces, times, "phi", **trace)
axes.set_ylim(-260, 60)
axes.legend()
print(f"{run.cost:.2f} V² s after {len(run.updates)} decisions")
