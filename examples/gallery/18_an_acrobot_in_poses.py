"""
An acrobot, in poses
====================

A motion in one picture: faint poses first, the last in full, the path of the tip in orange.
``run.animate("film.gif")`` makes a film of it.
"""

from matplotlib.figure import Figure

import undertow as ut
from undertow.display.animation import Film, still

acrobot = ut.mechanisms.acrobot()
run = ut.Cascade(acrobot, ut.MinimumTime(), belief="exact").simulate()
figure = Figure(figsize=(4, 4.5))
still(figure.add_subplot(), Film.of(run.trajectory), ghosts=8)
motion = run.plot()
