"""
Targets that jump
=================

A crane is sent to one place, and two seconds later to another. Each jump is optimised as a fresh
start.
"""

import undertow as ut

crane = ut.mechanisms.overhead_crane()
cascade = ut.Cascade(crane, ut.objective_for(crane, "bench-time", horizon=10.0), belief="exact")
run = cascade.simulate(target=ut.SetPoints([(0, {"x": 0.5}), (3, {"x": -0.5})]), duration=6.0)
figure = run.plot()
