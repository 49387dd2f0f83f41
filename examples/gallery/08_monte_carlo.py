"""
Monte Carlo over plants
=======================

The controller believes the data sheet, the plants differ. Each line is another plant: mass, length,
motor and damping drawn within ±15 %.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum()
loop = ut.ClosedLoop(pendulum, ut.MinimumTime(horizon=20.0))
surface = ut.first_surface(pendulum)
rng = np.random.default_rng(0)
figure, axes = plt.subplots(figsize=(6, 3.5))
times = []
for _ in range(60):
    wrong = {p.name: p.value * rng.uniform(0.85, 1.15)
             for p in pendulum.parameters if p.name in ("m", "l", "a_e", "d_e")}  # fmt: skip
    plant = pendulum.with_parameters(**wrong)
    motion = ut.ClosedLoop(pendulum, loop.objective, plant=plant).simulate(
        pendulum.state(phi=ut.deg(25)), surface
    )
    times.append(motion.time)
    axes.plot(motion.t, np.degrees(motion["phi"]), color="C0", alpha=0.25, linewidth=0.8)
axes.set(xlim=(0, 2), xlabel="time (s)", ylabel="pendulum φ (°)", title="60 plants, one surface")
print(f"arrival: {min(times):.1f} to {max(times):.1f} s")
