"""
What is proved
==============

Claims about a surface, each decided with intervals or exact numbers, or said to be undecided. Needs
the extra ``certify``; a longer search also proves a region of attraction.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

rig = ut.mechanisms.rotary_pendulum()
surface = ut.first_surface(rig)
print(ut.certify(rig, surface, phi=ut.deg(10), seconds=0))
angles = np.linspace(-80, 80, 161)
margin = [
    {m.name: m.value for m in ut.surface_margins(rig, surface, [0, np.radians(a)])} for a in angles
]
figure, axes = plt.subplots(figsize=(6, 3.5))
name = next(n for n in margin[0] if n != "stability")
axes.plot(angles, [row[name] for row in margin])
axes.axhline(0, color="0.5")
axes.set(xlabel="φ (°)", ylabel=name, title="the law exists while this is positive")
