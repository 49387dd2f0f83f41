"""
What is proved
==============

Claims about a surface, each decided with intervals or exact numbers, or said to be undecided. A
longer search also proves a region of attraction.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut
from undertow.law import surface_margins

rig = ut.mechanisms.rotary_pendulum()
surface = ut.first_surface(rig)
print(ut.certify(rig, surface, phi=ut.deg(10), seconds=0))
angles = np.linspace(-80, 80, 161)
margins = [surface_margins(rig, surface, [0, a])[-1] for a in np.radians(angles)]
figure, axes = plt.subplots(figsize=(6, 3.5))
axes.plot(angles, [margin.value for margin in margins])
axes.axhline(0, color="0.5")
axes.set(
    xlabel="φ (°)", ylabel="det Γ(q) / det Γ(0)", title="the law exists where this is positive"
)
