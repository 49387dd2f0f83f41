"""Environment steps a second on one core: ours in lanes, and Gymnasium's vectors of single ones.

Each entrant steps its environments with the same kind of random actions, episodes that end begin
anew, and what comes back is what an agent would get: observations, rewards, ends.  Gymnasium's own
CartPole in its NumPy vector is there for scale: another plant, one Euler step each 20 ms, where
ours takes two Runge-Kutta steps of 2.5 ms.
"""

# ruff: noqa: E402  the extra is asked for first

from __future__ import annotations

import sys

from harness import clock, command_line, need, race, table

gymnasium = need("gymnasium", "gym")

from typing import Any

import numpy as np

import undertow.export.gym  # noqa: F401 - registers the library

#: Wanted for the rotary pendulum, steps/s.
WANTED = 1e6


class Entrant:
    """Environments that are stepped so many times a round."""

    def __init__(self, env: Any, steps: int) -> None:
        self.env, self.steps = env, steps
        env.reset(seed=0)
        env.action_space.seed(0)
        self.actions = [env.action_space.sample() for _ in range(8)]
        for actions in self.actions:  # compiles what is compiled
            env.step(actions)

    def __call__(self) -> None:
        """Step them for a round."""
        for k in range(self.steps):
            self.env.step(self.actions[k % len(self.actions)])

    @property
    def count(self) -> int:
        """Environment steps of a round."""
        return int(self.steps * self.env.num_envs)


def main() -> int:
    """Race them and print steps a second."""
    options = command_line(__doc__).parse_args()
    now, quick = clock(options.clock), options.quick
    rounds, part = (3, 8) if quick else (11, 1)
    one = gymnasium.VectorizeMode.VECTOR_ENTRY_POINT
    entrants: dict[str, Any] = {}
    for name in ("rotary_pendulum", "cart_pendulum", "triple_pendulum_on_a_cart"):
        for count in (1024,) if name != "rotary_pendulum" else (16, 256, 1024, 8192):
            env = gymnasium.make_vec(f"undertow/{name}-v0", num_envs=count, vectorization_mode=one)
            entrants[f"{name}, {count} in lanes"] = Entrant(env, 2**19 // count // part)
    made = {"num_envs": 64, "vectorization_mode": "sync"}
    for kind in ("", "_realistic"):
        env = gymnasium.make_vec(f"undertow/rotary_pendulum{kind}-v0", **made)
        entrants[f"rotary_pendulum{kind}, 64 in SyncVectorEnv"] = Entrant(env, 32 // part)
    cart = gymnasium.make_vec("CartPole-v1", num_envs=1024, vectorization_mode=one)
    entrants["CartPole-v1 of Gymnasium, 1024 in NumPy"] = Entrant(cart, 256 // part)
    seconds = race(entrants, rounds, now, "round")
    rows, best = [], {}
    for name, entrant in entrants.items():
        best[name] = entrant.count / float(np.median(seconds[name]))
        rows.append([name, f"{best[name]:,.0f}", f"{1e9 / best[name]:,.0f}"])
    table(
        f"Steps of environments on one core, {options.clock} clock",
        ["environments", "steps/s", "ns a step"],
        rows,
    )
    ours = best["rotary_pendulum, 1024 in lanes"]
    sync = best["rotary_pendulum, 64 in SyncVectorEnv"]
    print(f"\n{ours:,.0f} environment steps/s, 1024 rotary pendulums (wanted: {WANTED:,.0f})")
    print(f"{ours / sync:,.0f} times Gymnasium's SyncVectorEnv of the same environment")
    return 0 if ours >= WANTED or quick else 1


if __name__ == "__main__":
    sys.exit(main())
