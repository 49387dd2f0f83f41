"""
An arm that follows a sine
==========================

The pendulum stays upright while its arm follows a reference. The reference's acceleration is fed
forward, and the pendulum is asked for the bounded motion that goes with it.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum()
cascade = ut.Cascade(
    pendulum, ut.objective_for(pendulum, "bench-time", horizon=4.0), belief="exact"
)
run = cascade.simulate(pendulum.state(), target=ut.Reference.sine(0.5, theta=ut.deg(45)))
motion = run.trajectory
figure, (above, below) = plt.subplots(2, sharex=True, figsize=(6, 4.5))
above.plot(motion.t, np.degrees(motion["theta"]), label="arm")
above.plot(motion.t, 45 * np.sin(np.pi * motion.t), "--", label="45° at 0.5 Hz")
above.set(ylabel="θ (°)")
above.legend()
below.plot(motion.t, np.degrees(motion["phi"]))
below.set(xlabel="time (s)", ylabel="pendulum φ (°)")
