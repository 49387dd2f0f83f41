"""
A cost of your own
==================

Any stage cost Φ(x, u) in the names of states and inputs. Here the arm is kept near its place: the
more a radian of it costs, the less it swings out.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
figure, axes = plt.subplots(figsize=(6, 3.5))
for weight in (0.0, 50.0):
    cost = ut.Objective(
        "arm", lambda v, w=weight: v.voltage**2 + w * v.theta**2 + 0.05 * v.phi**2, horizon=4.0
    )
    run = ut.Cascade(pendulum, cost, belief="exact").simulate(phi=ut.deg(25))
    axes.plot(run.trajectory.t, np.degrees(run.trajectory["theta"]), label=f"{weight:g} V²/rad²")
axes.set(xlim=(0, 4), xlabel="time (s)", ylabel="arm θ (°)", title="weight of the arm's angle")
axes.legend()
