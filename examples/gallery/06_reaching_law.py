"""
Reaching the surface
====================

ṡ = −k sat(s/ε): outside the layer s falls at a constant rate k, inside it decays with ε/k. A larger
gain reaches sooner, and asks for more voltage until the amplifier clips it.
"""

import matplotlib.pyplot as plt

import undertow as ut

pendulum = ut.mechanisms.rotary_pendulum()
surface = ut.first_surface(pendulum)
figure, (above, below) = plt.subplots(2, sharex=True, figsize=(6, 5))
for eta in (5.0, 10.0, 20.0):
    loop = ut.ClosedLoop(pendulum, ut.MinimumTime(), ut.ReachingLaw(eta=eta, layer=0.1))
    motion = loop.simulate(pendulum.state(phi=ut.deg(15)), surface, duration=1.0)
    above.plot(motion.t, motion.s[:, 0], label=f"η = {eta:g} rad/s²")
    below.plot(motion.t, motion.u[:, 0])
above.axhspan(-0.1, 0.1, color="0.9")
above.set(ylabel="s (rad/s)", title="surface value; grey: the boundary layer")
below.set(xlabel="time (s)", ylabel="voltage (V)", xlim=(0, 0.8))
above.legend()
