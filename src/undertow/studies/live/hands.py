"""Hands that pull at a mechanism: springs between places of its figure and the mice of viewers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from undertow.base import InvalidInputError
from undertow.display.live import Grip, Scene
from undertow.models import FloatArray, Mechanism

#: Natural frequency of the spring, rad/s, with the mass that it moves; its damping; and the largest
#: acceleration that it gives to that, m/s².
FREQUENCY, DAMPING, PULL = 18.0, 0.7, 120.0

#: What is farther from the mouse than this part of the picture is not taken hold of.
REACH = 0.2


@dataclass(frozen=True)
class Hand:
    """What it holds, where it is in the picture, (2,), m, and the mass that it feels there, kg."""

    grip: Grip
    at: FloatArray
    mass: float


class Hands:
    """The hands of all viewers, by their numbers.

    Parameters
    ----------
    scene
        The figure that they take hold of.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self._hands = scene, dict[int, Hand]()

    def __bool__(self) -> bool:
        """Whether anything is held."""
        return bool(self._hands)

    def grab(self, viewer: int, plant: Mechanism, q: FloatArray, at: FloatArray) -> None:
        """Take hold of the nearest part that moves.

        Parameters
        ----------
        viewer
            Whose hand.
        plant
            For the mass that is felt.
        q
            Where the mechanism is, (n,).
        at
            Where the hand is in the picture, (2,), m.

        Raises
        ------
        InvalidInputError
            Where nothing is near.
        """
        left, right, bottom, top = self.scene.window
        reach, values = REACH * max(right - left, top - bottom), plant.parameter_values
        grip = self.scene.nearest(q, values, at, reach)
        if grip is None:
            raise InvalidInputError(
                "what is taken hold of", value="nothing near there", limit="a part that moves"
            )
        J = self.scene.slopes(q, values, grip)
        mobility = J @ np.linalg.solve(plant.M(q), J.T)
        self._hands[viewer] = Hand(grip, at, 2.0 / max(float(np.trace(mobility)), 1e-9))

    def move(self, viewer: int, at: FloatArray) -> None:
        """Move a hand, if it holds anything."""
        if viewer in self._hands:
            self._hands[viewer] = replace(self._hands[viewer], at=at)

    def let_go(self, viewer: int) -> bool:
        """Open a hand; whether it held anything."""
        return self._hands.pop(viewer, None) is not None

    def clear(self) -> None:
        """Open all hands."""
        self._hands.clear()

    def force(self, x: FloatArray, parameters: FloatArray) -> FloatArray:
        """Return the generalised force of all hands at a state x, (2n,): Σ (∂p/∂q)ᵀ F, (n,)."""
        n = len(x) // 2
        total = np.zeros(n)
        for hand in self._hands.values():
            J = self.scene.slopes(x[:n], parameters, hand.grip)
            stretch = hand.at - self.scene.held(x[:n], parameters, hand.grip)
            pull = FREQUENCY**2 * stretch - 2.0 * DAMPING * FREQUENCY * (J @ x[n:])
            size = float(np.linalg.norm(pull))
            total += J.T @ (hand.mass * min(1.0, PULL / max(size, PULL)) * pull)
        return total

    def shown(self, q: FloatArray, parameters: FloatArray) -> list[list[float]]:
        """Return what is held and where the hand is, x and y each, for every hand, m."""
        return [
            [*self.scene.held(q, parameters, hand.grip).tolist(), *hand.at.tolist()]
            for hand in self._hands.values()
        ]
