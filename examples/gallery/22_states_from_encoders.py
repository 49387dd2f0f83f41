"""
States from encoders
====================

A bench measures positions in counts. The filter gives velocities; here beside the truth, which a
simulated bench knows.
"""

import matplotlib.pyplot as plt

import undertow as ut
from undertow.estimators import KalmanFilter, run_recorded
from undertow.law import InnerLoop
from undertow.plants import RealisticRig, srv02_rig

bench = srv02_rig()
belief = bench.mechanism
law = InnerLoop(belief, ut.first_surface(belief))
rig = RealisticRig(bench, belief.state(phi=ut.deg(10)), seed=1)
estimator = KalmanFilter(belief, rig.period)
estimator.reset(belief.state(phi=ut.deg(10)))
record = run_recorded(rig, estimator, lambda t, x: law(x), seconds=2.0)
figure, (above, below) = plt.subplots(2, sharex=True, figsize=(6, 4.5))
above.plot(record.t, record.x[:, 3], label="estimated")
above.plot(record.t, record.truth[:, 3], "--", label="true")
above.set(ylabel="φ̇ (rad/s)")
above.legend()
below.plot(record.t, record.x[:, 3] - record.truth[:, 3])
below.set(xlabel="time (s)", ylabel="error (rad/s)")
