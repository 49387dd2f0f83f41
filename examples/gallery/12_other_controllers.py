"""
Beside LQR and predictive control
=================================

One call runs each controller on each plant, here the model and a bench with friction, encoders and
delay, with the same estimator. Needs the extra ``bounds`` for predictive control.
"""

import undertow as ut
from undertow.plants import srv02_rig

rig = ut.mechanisms.rotary_pendulum()
goal = ut.objective_for(rig, "bench-energy", horizon=5.0)
table = ut.compare(
    rig,
    {"cascade": ut.Cascade(rig, goal), "LQR": ut.lqr(rig), "NMPC": ut.nmpc(rig, goal)},
    plants={"the model": rig, "the bench": srv02_rig()},
    phi=ut.deg(15), seconds=5,
)  # fmt: skip
print(table)

# %%
# The same as bars:

frame = table.to_pandas().pivot(index="controller", columns="plant", values="cost")
axes = frame.plot.bar(rot=0, ylabel=f"cost ({table.cost_unit})", xlabel="", figsize=(6, 3.5))
figure = axes.figure
