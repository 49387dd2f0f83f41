"""
An environment, and our controller as its policy
================================================

A Gymnasium environment: a mechanism to be balanced, here on a bench with friction, encoders and
delay, and our controller as a policy. Pictures are 0.1 s apart; a dot is an end. Needs ``gym``.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

rig = ut.mechanisms.rotary_pendulum()
env = ut.environment(rig, realistic=True, render_mode="rgb_array")
ours = ut.policy(ut.ClosedLoop(rig), ut.first_surface(rig))
figure, axes = plt.subplot_mosaic("01234;rrrrr", figsize=(7.5, 4.8), layout="constrained")
for k in range(10):  # in turn under our law, and left alone
    (observation, _), state, cost, over = env.reset(seed=k // 2), None, [0.0], False
    while not over:
        if k == 6 and len(cost) % 20 == 1 and len(cost) < 100:
            axes[str(len(cost) // 20)].imshow(env.render()[5:290, 70:290])
            axes[str(len(cost) // 20)].set_axis_off()
        action, state = (np.zeros(1), None) if k % 2 else ours.predict(observation, state)
        observation, reward, terminated, truncated, info = env.step(action)
        cost, over = [*cost, cost[-1] - reward], terminated or truncated
    t, label = env.task.period * np.arange(len(cost)), ("ours", "no input", *[None] * 8)[k]
    axes["r"].semilogy(t, cost, f"C{k % 2}o-", markersize=4, markevery=[-1], label=label)
axes["r"].set(xlabel="time (s)", ylabel="cost = −rewards (s)", ylim=(1e-3, 9))
axes["r"].legend()
