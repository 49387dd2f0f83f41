"""MuJoCo as a rig: the same motion as the model's, from another engine."""

from __future__ import annotations

import math

import numpy as np
import pytest

import undertow as ut
from undertow.errors import InvalidInputError
from undertow.mechanisms.scenes import Scene, mujoco_scene
from undertow.rig import IdealRig, MuJoCoRig

pytest.importorskip("mujoco")


@pytest.mark.parametrize("name", ["rotary_pendulum", "double_pendulum_on_a_cart"])
def test_both_engines_move_alike(name: str) -> None:
    mechanism = ut.mechanisms.LIBRARY[name]()
    x0 = mechanism.state(**mechanism.start)
    rigs = MuJoCoRig(mechanism, x0), IdealRig(mechanism, x0)
    for k in range(300):
        for rig in rigs:
            rig.write(np.array([0.3 * mechanism.inputs[0].limit * math.sin(0.05 * k)]))
    np.testing.assert_allclose(rigs[0].truth, rigs[1].truth, rtol=1e-6, atol=1e-6)
    assert rigs[0].read().t == pytest.approx(0.3)
    assert rigs[0].read().v is None


def test_inputs_are_clipped_by_the_rig() -> None:
    arm = ut.mechanisms.rotary_pendulum()
    strong, limit = (MuJoCoRig(arm, [0, math.pi, 0, 0]) for _ in range(2))
    for _ in range(50):
        strong.write(np.array([100.0]))
        limit.write(np.array([15.0]))
    np.testing.assert_array_equal(strong.truth, limit.truth)


def test_a_scene_of_another_mechanism_is_refused() -> None:
    arm = ut.mechanisms.rotary_pendulum()
    scene = mujoco_scene(ut.mechanisms.double_pendulum_on_a_cart())
    with pytest.raises(InvalidInputError, match="3 joints"):
        MuJoCoRig(arm, scene=scene)
    with pytest.raises(InvalidInputError, match="period"):
        MuJoCoRig(arm, period=0.0)
    assert isinstance(scene, Scene)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["rotary_pendulum", "cart_pendulum", "double_pendulum_on_a_cart", "acrobot"]
)
def test_the_cascade_balances_in_mujoco_without_retuning(name: str) -> None:
    from undertow.trials.upright import engine_trial

    assert engine_trial(ut.mechanisms.LIBRARY[name](), seconds=6.0, budget=128).outcome.balanced
