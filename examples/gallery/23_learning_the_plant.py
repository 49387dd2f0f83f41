"""
Learning the plant
==================

The pendulum is a quarter heavier than believed, the motor a tenth weaker. The cascade plans for an
ensemble of plants, which the motion narrows; beside it the one that takes its model for the truth.
"""

import undertow as ut

rig = ut.mechanisms.rotary_pendulum()
belief = ut.Belief.relative(rig, m=0.3, a_e=0.2)
cascade = ut.Cascade(rig, ut.MinimumTime(), belief=belief)
truth = rig.with_parameters(m=1.25 * 0.125, a_e=0.9 * 0.1285)
run = cascade.simulate(phi=ut.deg(25), plant=truth)
figure = run.plot()
exact = ut.Cascade(rig, ut.MinimumTime(), belief="exact").simulate(phi=ut.deg(25), plant=truth)
print(f"learning: {run.time:.2f} s, {run.reached}; exact: {exact.time:.2f} s, {exact.reached}")
