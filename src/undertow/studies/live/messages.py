"""What a page is told of a mechanism, of an instant of its motion, and of a decision."""

from __future__ import annotations

from typing import Any

import numpy as np

from undertow.base import InvalidInputError
from undertow.closed_loop.figures import display
from undertow.display.live import Message, Scene
from undertow.estimators import Belief, ParameterEstimate
from undertow.law import Plan, ReachingLaw
from undertow.models import FloatArray, Mechanism


def described(mechanism: Mechanism, scene: Scene) -> Message:
    """Return what a page must know of a mechanism."""

    def shown(unit: str) -> dict[str, Any]:
        factor, word = display(unit)
        return {"unit": word, "factor": factor}

    return {
        "kind": "hello",
        "mechanism": mechanism.name.replace("_", " "),
        "about": "; ".join(mechanism.description.splitlines()),
        "coordinates": [
            {"name": c.name, "about": c.description, **shown(c.unit)} for c in mechanism.coordinates
        ],
        "inputs": [{"name": i.name, "unit": i.unit, "limit": i.limit} for i in mechanism.inputs],
        "parts": scene.parts,
        "count": scene.count,
        "window": [*map(float, scene.window)],
    }


def frame_message(
    scene: Scene, parameters: FloatArray, t: float, x: FloatArray, u: FloatArray,
    demand: FloatArray, s: FloatArray, predicted: float,
) -> Message:  # fmt: skip
    """Return a picture: time, state, input, what the law asked for, s, and what is left to pay.

    And where the points of the figure are, of a plant with these parameters.
    """
    return {
        "kind": "frame", "t": float(t), "x": x.tolist(), "u": u.tolist(),
        "demand": np.asarray(demand).tolist(), "s": s.tolist(), "left": float(predicted),
        "points": scene.places(x[: len(x) // 2], parameters).tolist(),
    }  # fmt: skip


class ReadOnlyShow:
    """A show that is only looked at: whatever its viewers ask for is refused."""

    what, remedy = "recording", ""

    def hear(self, said: Message, viewer: int) -> None:
        """Refuse whatever is asked for.

        Raises
        ------
        InvalidInputError
            Always.
        """
        asked = repr(said.get("do"))[:40]
        raise InvalidInputError(self.what, value=asked, limit="looked at", remedy=self.remedy)

    def gone(self, viewer: int) -> None:
        """Nothing was held."""


def plan_message(
    t: float, accepted: bool, why: str, plan: Plan, predicted: float, otherwise: ReachingLaw
) -> Message:
    """Return a decision of the slow loop: the plan in use after it, and why it is that.

    ``otherwise`` is the reaching law of a plan that has none.
    """
    surface, reaching = plan.surfaces[0], plan.laws(otherwise)[0]
    return {
        "kind": "plan", "t": float(t), "accepted": accepted, "why": why,
        "predicted": float(predicted), "rows": surface.matrix.tolist(),
        "layer": reaching.vector(surface.m)[surface.m :].tolist(),
    }  # fmt: skip


def plausible(belief: Belief | None, estimate: ParameterEstimate | None) -> list[dict[str, Any]]:
    """Return what the controller takes for possible of each uncertain parameter, SI units.

    ``low`` to ``high`` is its tolerance; ``members`` are its values on the corners of the ensemble,
    which close in as it learns; ``estimate`` is the most plausible one.
    """
    if belief is None or not belief.tolerances:
        return []
    estimate = estimate or belief.prior
    best = belief.values(estimate.offset)
    values = belief.ensemble(estimate).values
    corners = values[(values != best).any(axis=1)]
    nominal = belief.mechanism.parameter_values
    return [
        {
            "name": name, "estimate": float(best[place]),
            "low": float(nominal[place] - off), "high": float(nominal[place] + off),
            "members": corners[:, place].tolist(),
        }
        for place, (name, off) in zip(belief.places, belief.tolerances.items(), strict=True)
    ]  # fmt: skip
