"""The run that the tests of the runtime share."""

from __future__ import annotations

from undertow.runtime import Recipe

RECIPE = Recipe(parameters={"d_e": 0.025}, evaluations=64, start=(0.0, 0.3, 0.0, 0.0))
