"""
How much better could any control be?
=====================================

The optimal-control bound is the least cost of any input, found by direct collocation (a local
optimum; extra ``bounds``). The cascade for least energy comes within some per cent of it.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
goal = ut.MinimumEnergy(horizon=17.0)
starts = (15, 25, 35)
cascade = ut.Cascade(pendulum, goal, belief="exact")
ours = [cascade.simulate(phi=ut.deg(a)).cost for a in starts]
least = [ut.bound(pendulum, goal, phi=ut.deg(a)).cost for a in starts]
figure, axes = plt.subplots(figsize=(6, 3.5))
at = np.arange(len(starts))
axes.bar(at - 0.2, ours, 0.4, label="cascade")
axes.bar(at + 0.2, least, 0.4, label="bound")
axes.set_xticks(at, [f"{a}°" for a in starts])
axes.set(xlabel="φ(0)", ylabel="∫u² dt (V² s)")
axes.legend()
print([f"{100 * (a / b - 1):.1f} %" for a, b in zip(ours, least, strict=True)])
