"""
Motions as tables
=================

A motion is a data frame whose columns are named and carry units. Needs the extra ``interop``.
"""

import undertow as ut

crane = ut.mechanisms.overhead_crane()
run = ut.Cascade(crane, ut.MinimumTime(), belief="exact").simulate(x=-0.5)
frame = run.trajectory.to_pandas()
print(frame.iloc[:: len(frame) // 5].round(3).to_string())
print(frame.attrs["units"])
axes = frame[["x", "theta", "force"]].plot(subplots=True, figsize=(6, 5))
figure = axes[0].figure
