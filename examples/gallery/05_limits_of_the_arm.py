"""
Limits of the arm
=================

A box on states is a constraint of the objective. The optimiser looks for the least time that keeps
within it, and the gate refuses what does not.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
figure, axes = plt.subplots(figsize=(6, 3.5))
for limit in (None, 30):
    box = ut.state_box(theta=ut.deg(limit)) if limit else ()
    cascade = ut.Cascade(pendulum, ut.MinimumTime(constraints=box), belief="exact")
    run = cascade.simulate(phi=ut.deg(15))
    name = f"|θ| ≤ {limit}°" if limit else "no limit"
    axes.plot(run.trajectory.t, np.degrees(run.trajectory["theta"]), label=name)
    print(f"{name}: {run.time:.2f} s")
axes.set(xlabel="time (s)", ylabel="arm θ (°)", title="least time, with the arm confined")
axes.legend()
