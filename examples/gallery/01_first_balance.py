"""
A pendulum balances
===================

The cascade re-optimises its sliding surface every 0.1 s; keeping the first surface takes longer.
"""

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
cascade = ut.Cascade(pendulum, ut.MinimumTime())
run = cascade.simulate(phi=ut.deg(40))
figure = run.plot()

# %%
# The same start, with the first surface kept to the end:

fixed = cascade.loop.simulate(pendulum.state(phi=ut.deg(40)), run.plans[0])
kept = fixed.plot("the first surface, kept")
print(f"re-optimised {run.time:.2f} s, kept {fixed.time:.2f} s")
