"""Experiments: pure tasks on any executor, kept one by one, gone on with where they ended."""

from __future__ import annotations

import errno
import json
import math
import multiprocessing
import os
from collections.abc import Callable
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

import undertow as ut
from undertow.base import ArtefactError, InvalidInputError, parse_json
from undertow.models import FloatArray
from undertow.studies.experiment import Experiment, Serial, ended, grouped
from undertow.studies.ledger import Key, built, plain
from undertow.studies.paper import CONDITIONS
from undertow.studies.paper.experiment import Motion
from undertow.studies.trials.balance import Balance
from undertow.studies.trials.trial import Result


@dataclass(frozen=True)
class Part:
    """A result with everything in it that one may have."""

    name: str
    counts: tuple[int, ...]
    cost: float
    limit: float | None
    good: bool
    by_name: dict[str, tuple[float, ...]]


@dataclass(frozen=True, eq=False)
class Whole:
    """Nested."""

    parts: tuple[Part, ...]
    values: FloatArray


NUMBERS = st.floats(allow_nan=False)
PARTS = st.builds(
    Part,
    name=st.text(max_size=5),
    counts=st.lists(st.integers(), max_size=3).map(tuple),
    cost=NUMBERS,
    limit=st.none() | NUMBERS,
    good=st.booleans(),
    by_name=st.dictionaries(st.text(max_size=3), st.lists(NUMBERS, max_size=2).map(tuple)),
)


@settings(max_examples=25)
@given(
    st.lists(PARTS, max_size=3),
    st.lists(st.lists(NUMBERS, min_size=2, max_size=2), min_size=1, max_size=3),
)
def test_a_result_is_read_as_it_was_kept(parts: list[Part], values: list[list[float]]) -> None:
    """To the last bit, through JSON that any other reader takes, too."""
    whole = Whole(tuple(parts), np.array(values))
    text = json.dumps(plain(whole), allow_nan=False)
    again = built(Whole, parse_json(text))
    assert again.parts == whole.parts
    assert_array_equal(again.values, whole.values)


def test_a_nan_is_kept_and_what_is_no_number_is_refused() -> None:
    assert math.isnan(built(float, plain(math.nan)))
    assert built(float, plain(-math.inf)) == -math.inf
    for kind, said in (
        (float, "1.0"), (float, None), (float, True), (int, 1.0), (int, True), (bool, 1), (str, 3),
        (float | None, "x"), (tuple[int, ...], 3), (tuple[int, str], [1]), (dict[str, int], []),
        (Part, {"name": "x"}),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r"no |zip"):
            built(kind, said)


def test_surfaces_of_the_paper_are_kept_to_the_last_bit() -> None:
    """And the motion that is simulated of what was read is the same."""
    surfaces = [ut.Surface(-1, -0.5, 5, 10), ut.Surface(-1, -1 / 3, 2, 11)]
    motion = Motion.of(CONDITIONS["matched"], "energy", surfaces, (0.0, 0.1))
    again = built(Motion, parse_json(json.dumps(plain(motion))))
    assert again.surfaces == motion.surfaces
    assert again.total == motion.total is not None
    assert motion.trajectory is not None
    assert_array_equal(again.trajectory.x, motion.trajectory.x)
    with pytest.raises(InvalidInputError, match="invertible"):
        built(ut.Surface, plain(surfaces[0]) | {"alpha_a": [[0.0]]})


def square(k: int, made: list[int], stop: int = -1) -> float:
    made.append(k)
    if k == stop:
        raise KeyboardInterrupt
    if k == 7:
        raise InvalidInputError("number", value=7, limit="another")
    return math.inf if k == 2 else float(k * k)


def squares(count: int, made: list[int], stop: int = -1) -> Experiment[float, Any]:
    tasks: dict[Key, Callable[[], float]] = {
        ("square", k): partial(square, k, made, stop) for k in range(count)
    }
    return Experiment("squares", tuple[str, int, float], tasks, {"a": 1}, lambda _: [],
                      gather=grouped)  # fmt: skip


def test_an_interrupted_experiment_goes_on_where_it_ended(tmp_path: Path) -> None:
    """Nothing finished is lost, and nothing is done twice; the result is that of one go."""
    made: list[int] = []
    told: list[tuple[str, float]] = []
    first = squares(6, made, stop=3)
    with pytest.raises(KeyboardInterrupt):
        first.run(first.ledger(tmp_path))
    assert made == [0, 1, 2, 3]
    made.clear()
    second = squares(6, made)
    result = second.run(second.ledger(tmp_path), progress=lambda *words: told.append(words))
    assert made == [3, 4, 5]
    assert told == [(f"square ({k + 1} of 6)", k / 6) for k in (3, 4, 5)]
    assert result == squares(6, []).run() == {"square": [0.0, 1.0, math.inf, 9.0, 16.0, 25.0]}
    other = Experiment("squares", second.line, second.tasks, {"a": 2}, second.report)
    with pytest.raises(ArtefactError, match="other versions or settings"):
        other.ledger(tmp_path)


def test_progress_of_tasks_that_have_only_numbers_names_the_experiment() -> None:
    """The noise of a coverage is a number, once 0: its progress read "… , 119 s left"."""
    tasks: dict[Key, Callable[[], float]] = {(noise, 0): lambda: 1.0 for noise in (0.001, 0.0)}
    told: list[tuple[str, float]] = []
    work: Experiment[float, Any] = Experiment(
        "coverage", tuple[float, int, float], tasks, {}, lambda _: []
    )
    work.run(progress=lambda *words: told.append(words))
    assert told == [("coverage (1 of 2)", 0.0), ("coverage (2 of 2)", 0.5)]


def test_what_was_finished_before_a_task_failed_is_kept(tmp_path: Path) -> None:
    work = squares(9, [])
    ledger = work.ledger(tmp_path)
    with pytest.raises(InvalidInputError, match="number"):
        work.run(ledger)
    assert list(work.finished(ledger)) == [("square", k) for k in range(7)]
    assert work.ledger(tmp_path).known == ledger.known


def test_a_disk_that_is_full_is_told_with_the_ledger(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    work = squares(3, [])
    ledger = work.ledger(tmp_path)

    def full(*_: Any, **__: Any) -> Any:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # of a write: without a name

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(ArtefactError, match=r"squares\.jsonl': got No space left.*same command"):
        work.run(ledger)


def test_few_tasks_are_under_way_and_what_waits_is_cancelled() -> None:
    pulled: list[int] = []

    def tasks() -> Any:
        for k in range(50):
            pulled.append(k)
            yield k, (pow, k, 2)

    with ThreadPoolExecutor(2) as pool:
        found = ended(pool, tasks(), 2)
        key, future = next(found)
        assert future.result() == key**2
        assert len(pulled) <= 4
        found.close()  # type: ignore[attr-defined]
    assert [(k, f.result()) for k, f in ended(Serial(), tasks())] == [(k, k * k) for k in range(50)]


@pytest.mark.slow  # processes that compile nothing, but import all
@pytest.mark.parametrize(
    "executor",
    [
        lambda: ThreadPoolExecutor(1),
        lambda: ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn")),
    ],
    ids=["thread", "processes"],
)
def test_trials_have_the_same_bits_on_any_executor(executor: Callable[[], Executor]) -> None:
    """Tasks are pure: they give the same in other processes, in whatever order."""
    tasks = Balance(seeds=2, seconds=2.0, budget=32, limits=False).tasks()
    few = {key: task for key, task in tasks.items() if key[0] == "bench-energy"}
    work: Experiment[Any, dict[Any, list[Result]]] = Experiment(
        "balance", tuple[str, str, int, Result], few, {}, lambda _: [], gather=grouped
    )
    with executor() as pool:
        found = work.run(executor=pool, width=2)
    assert repr(found) == repr(work.run())
