"""The kernel as CUDA C++, compiled by the host, rolls out what the processor's kernel does."""

from __future__ import annotations

import shutil
from importlib.util import find_spec
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import undertow as ut
from undertow.closed_loop import ClosedLoop, Ensemble, on_gpu
from undertow.symbolic.cuda import Translation

pytestmark = pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler")

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
FIELDS = "cost", "time", "x", "radius", "singular", "path", "closest", "steps"
SURFACE = ut.Surface(-1, -1.59, 1.96, 12.1)


def agree(
    loop: ClosedLoop, surface: ut.Surface | ut.Plan, count: int = 200, **settings: Any
) -> None:
    """Compare batches from random states: same events, numbers up to rounding.

    What rounding may become in a motion is seen from one that starts 1e-13 of its state beside.
    """
    rng = np.random.default_rng(1)
    mechanism = loop.mechanism
    usual = np.abs(mechanism.state(**mechanism.start)) + 0.05
    states = rng.uniform(-2, 2, (count, 2 * mechanism.n)) * usual
    beside = loop.batch(states * (1 + 1e-13), surface, **settings)
    others = {field: getattr(beside, field).copy() for field in FIELDS}
    expected = loop.batch(states, surface, **settings)
    got = on_gpu(loop, "host").batch(states, surface, **settings)
    assert_array_equal(got.event, expected.event)
    for field, other in others.items():
        mine, theirs = getattr(got, field), getattr(expected, field)
        room = 1e-9 * np.maximum(1, np.abs(theirs)) + np.nan_to_num(10 * np.abs(other - theirs))
        assert not (np.abs(mine - theirs) > room).any(), field
    assert np.median(np.nan_to_num(np.abs(others["x"] - expected.x))) < 1e-9


@pytest.mark.parametrize(
    "loop",
    [
        pytest.param(ClosedLoop(RIG, ut.MinimumTime(horizon=2.0)), marks=pytest.mark.slow),
        pytest.param(
            ClosedLoop(RIG, ut.MinimumEnergy(horizon=2.0), zoh_steps=2), marks=pytest.mark.slow
        ),
        pytest.param(
            ClosedLoop(
                RIG,
                ut.MinimumTime(horizon=2.0, constraints=ut.state_box(phi=0.7)),
                plant=ut.mechanisms.rotary_pendulum(m=0.2),
            ),
            marks=pytest.mark.slow,
        ),
    ],
    ids=["time", "sampled", "another plant in a box"],
)
def test_same_motions(loop: ClosedLoop) -> None:
    """From a hundred states, some of which come home and some not, events and numbers are alike."""
    agree(loop, SURFACE)


def test_plan_with_closest_approach() -> None:
    """Surfaces take over in turn, and the closest approach is found."""
    plan = ut.Plan((SURFACE, ut.Surface(-1, -1.59, 1.96, 9.0)), (0.0, 0.3))
    agree(ClosedLoop(RIG, ut.MinimumEnergy(horizon=1.0)), plan, seek=True)


@pytest.mark.slow
def test_ensemble() -> None:
    """Every lane with a plant of its own."""
    values = RIG.parameter_values * np.array([[1.0], [1.02]])
    loop = ClosedLoop(RIG, ut.MinimumEnergy(horizon=2.0), ensemble=Ensemble(RIG, values))
    agree(loop, SURFACE, count=40)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(ut.mechanisms.LIBRARY))
def test_every_mechanism(name: str) -> None:
    """Motions of all mechanisms of the library, three coordinates or two motors included."""
    mechanism = getattr(ut.mechanisms, name)()
    loop = ClosedLoop(mechanism, ut.MinimumEnergy(horizon=0.5))
    agree(loop, ut.first_surface(mechanism), count=64)


def test_unknown_text_is_refused() -> None:
    """What such a kernel never does is refused by name, not translated wrongly."""
    source = "def f(a, b, x):\n    while x:\n        x = x - 1.0\n"
    kinds = {"a": "long long", "b": "long long", "x": "double"}
    with pytest.raises(ut.base.ModelError, match="while x"):
        Translation(source, "f", kinds, 1)


@pytest.mark.skipif(find_spec("cuda") is not None, reason="the extra is installed")
def test_without_the_extra_the_remedy_is_named() -> None:
    """No GPU is looked for in vain."""
    with pytest.raises(ut.base.MissingExtraError, match=r"undertow\[gpu\]"):
        on_gpu(ClosedLoop(RIG, ut.MinimumEnergy(horizon=1.0)))
