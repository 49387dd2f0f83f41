"""Batches shared by threads: the same bits, no thread left behind, errors reach the caller."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import undertow as ut
from undertow.base import InvalidInputError
from undertow.closed_loop import threads as sharing
from undertow.models import FloatArray


def fleet(rig: ut.Mechanism, count: int) -> tuple[FloatArray, FloatArray]:
    """Return states and surfaces some of which arrive, break off, diverge and cost too much."""
    rng = np.random.default_rng(7)
    states = rig.state(phi=0.5) * rng.uniform(0.2, 3.0, (count, 1))
    return states, np.array([-1.0, -1.59, 1.96, 12.1]) * rng.uniform(0.7, 1.4, (count, 4))


@pytest.mark.parametrize("tail_rtol", [0.0, 1e-4])
@pytest.mark.parametrize("count", [1, 33, 95, 257])
def test_results_are_the_same_bits_whatever_the_number_of_threads(
    count: int, tail_rtol: float, rig: ut.Mechanism, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each lane, in whichever thread and beside whichever others, has the bits it has alone."""
    monkeypatch.setattr(sharing, "WORTH", 1)
    loop = ut.ClosedLoop(rig, tail_rtol=tail_rtol)
    states, surfaces = fleet(rig, count)
    one, *others = (
        replace(loop, threads=threads).batch(
            states, surfaces, duration=2.0, cap=60.0, stable_only=True, seek=not tail_rtol
        )
        for threads in (1, 2, 3)
    )
    if count > 90:
        assert len(set(one.event.tolist())) >= 3
    for other in others:
        for name, values in vars(one).items():
            np.testing.assert_array_equal(getattr(other, name), values, err_msg=name)
    if not tail_rtol:
        for k in (0, count // 2, count - 1):
            alone = loop.batch(states[k], surfaces[k], duration=2.0, cap=60.0, stable_only=True)
            assert alone.cost[0] == one.cost[k]
            assert alone.time[0] == one.time[k]
            np.testing.assert_array_equal(alone.x[0], one.x[k])


def test_sampled_loops_and_ensembles_are_shared_by_threads(
    rig: ut.Mechanism, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sharing, "WORTH", 1)
    states, surfaces = fleet(rig, 70)
    held = ut.ClosedLoop(rig, zoh_steps=2)
    belief = ut.Belief.usual(rig)
    about = ut.ClosedLoop(rig, ensemble=belief.ensemble(belief.prior))
    for loop in (held, about):
        one, two = (
            replace(loop, threads=threads).batch(states, surfaces, duration=0.5)
            for threads in (1, 2)
        )
        np.testing.assert_array_equal(one.x, two.x)
        np.testing.assert_array_equal(one.cost, two.cost)


def test_threads_are_begun_where_they_pay_and_none_is_left(
    rig: ut.Mechanism, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A batch of some milliseconds is shared; a single motion and a short batch are not."""
    begun = []

    class Watched(ThreadPoolExecutor):
        def __init__(self, workers: int) -> None:
            begun.append(workers)
            super().__init__(workers)

    monkeypatch.setattr(sharing, "ThreadPoolExecutor", Watched)
    states, surfaces = fleet(rig, 256)
    loop, before = ut.ClosedLoop(rig, threads=2), threading.active_count()
    loop.batch(states[:1], surfaces[:1], duration=10.0)
    loop.batch(states, surfaces, duration=0.2)
    assert not begun
    loop.batch(states, surfaces, duration=2.0)
    assert begun == [2]
    assert threading.active_count() == before
    ut.ClosedLoop(rig).batch(states, surfaces, duration=2.0)
    assert begun == [2]


def test_what_goes_wrong_in_a_thread_reaches_the_caller(rig: ut.Mechanism) -> None:
    loop, before = ut.ClosedLoop(rig, threads=2), threading.active_count()
    kernels = loop._kernels

    def failing(first: int, last: int, *arguments: Any) -> None:
        if first:
            raise MemoryError("no room")
        kernels.rollout(first, last, *arguments)

    object.__setattr__(loop, "_kernels", SimpleNamespace(rollout=failing))
    with pytest.raises(MemoryError, match="no room"):
        loop.batch(*fleet(rig, 256), duration=2.0)
    assert threading.active_count() == before


def test_no_thread_is_refused(rig: ut.Mechanism) -> None:
    with pytest.raises(InvalidInputError, match=r"threads of a closed loop.*0.*≥ 1"):
        ut.ClosedLoop(rig, threads=0)
