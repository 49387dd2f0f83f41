"""
The predicted cost only falls
=============================

Lemma 3: at each re-optimisation what was spent plus what is predicted is no more than before. The
gate enforces it; the run records it.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
run = ut.Cascade(pendulum, ut.MinimumTime(), belief="exact").simulate(phi=ut.deg(40))
spent = np.cumsum([update.spent for update in run.updates])
total = spent + [update.predicted for update in run.updates]
figure, axes = plt.subplots(figsize=(6, 3.5))
axes.step([update.t for update in run.updates], total, "o-", where="post")
axes.axhline(run.time, linestyle=":", color="0.4", label="when it arrived")
axes.set(xlabel="time of the decision (s)", ylabel="spent + predicted (s)", ylim=(0, None))
axes.legend()
print(f"smallest slack: {np.nanmin(run.lemma3_slack):.2g} s")
