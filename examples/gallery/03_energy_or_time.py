"""
Least energy, or least time
===========================

The same pendulum from the same start. Least time uses the whole voltage; least energy takes as
long as its horizon allows to bring the arm home, and two thirds of a second for the pendulum.
"""

import undertow as ut
from undertow.closed_loop.figures import motion_figure

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
runs = {
    "least energy": ut.Cascade(pendulum, ut.MinimumEnergy(), belief="exact"),
    "least time": ut.Cascade(pendulum, ut.MinimumTime(), belief="exact"),
}
motions = {name: c.simulate(phi=ut.deg(35)).trajectory for name, c in runs.items()}
figure = motion_figure(motions, until=2.0, title="the first two seconds")
for name, motion in motions.items():
    effort = (motion.u[:-1, 0] ** 2 * (motion.t[1:] - motion.t[:-1])).sum()
    print(f"{name}: {motion.time:.2f} s, {effort:.1f} V² s")
