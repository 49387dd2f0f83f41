"""
How much delay a surface bears
==============================

Sampled at 1 kHz, with the input late by whole periods. A steeper reaching law (η/ε) is quicker and
bears less; this is what the gate of a run on hardware weighs.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut
from undertow.cascade.robustness import delay_margin

pendulum = ut.mechanisms.rotary_pendulum()
figure, axes = plt.subplots(figsize=(6, 3.5))
ratios = np.array([25, 50, 75, 100, 150, 200, 300, 400])
for rate in (0.0, 1.0, 2.0):
    surface = ut.first_surface(pendulum, rate=rate)
    margins = [delay_margin(pendulum, surface, ut.ReachingLaw(0.1 * r, 0.1)) for r in ratios]
    axes.plot(
        ratios, 1000 * np.array(margins), "o-", label=f"surface designed with rate {rate:g} 1/s"
    )
axes.set(xlabel="η/ε (1/s)", ylabel="largest delay (ms)", ylim=(0, None))
axes.legend()
