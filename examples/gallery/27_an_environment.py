"""
An environment, and our controller as its policy
================================================

A Gymnasium environment is a mechanism to be balanced: here on a bench with friction, encoders and
delay, another one each episode. A controller of ours is a policy with stable-baselines3's
``predict``. Where friction holds the arm just outside the terminal set an episode goes on to its
horizon. Needs the extra ``gym``.
"""

import matplotlib.pyplot as plt
import numpy as np

import undertow as ut

rig = ut.mechanisms.rotary_pendulum()
env = ut.environment(rig, realistic=True, render_mode="rgb_array")
ours = ut.policy(ut.ClosedLoop(rig), ut.first_surface(rig))


def episode(predict, seed):
    """Times, rewards so far, and pictures of the first half second."""
    observation, _ = env.reset(seed=seed)
    state, rewards, pictures = None, [], []
    while True:
        if len(rewards) % 20 == 0 and len(pictures) < 5:
            pictures.append(env.render())
        action, state = predict(observation, state)
        observation, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        if terminated or truncated:
            return env.task.period * np.arange(1, len(rewards) + 1), np.cumsum(rewards), pictures


rng = np.random.default_rng(0)
policies = {
    "ours": ours.predict,
    "nothing": lambda observation, state: (np.zeros(1), state),
    "random": lambda observation, state: (rng.uniform(-1, 1, 1), state),
}
figure, axes = plt.subplot_mosaic(
    [["0", "1", "2", "3", "4"], ["r"] * 5], figsize=(7.5, 4.8), layout="constrained",
    height_ratios=(0.8, 1),
)  # fmt: skip
for k, picture in enumerate(episode(ours.predict, seed=3)[2]):
    axes[str(k)].imshow(picture[5:290, 70:290])
    axes[str(k)].set_title(f"{0.1 * k:.1f} s")
    axes[str(k)].axis("off")
for (name, predict), colour in zip(policies.items(), ("C0", "0.5", "C1"), strict=True):
    for seed in range(5):
        t, total, _ = episode(predict, seed)
        axes["r"].plot(t, -total, color=colour, label=name if seed == 0 else None)
        axes["r"].plot(t[-1:], -total[-1:], "o", color=colour, markersize=3)
axes["r"].set(xlabel="time (s); a dot: the end of an episode", ylabel="cost = −rewards (s)")
axes["r"].set(yscale="log", ylim=(1e-3, 20))
axes["r"].legend(loc="lower right")
print(f"{len(env.observation_space.low)} observations, {env.task.mechanism.m} action")
