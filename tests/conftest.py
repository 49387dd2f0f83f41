"""Settings of the whole suite, and the closed loops that several files share."""

from __future__ import annotations

import functools
import gc
import os
import random
import time
from dataclasses import fields
from typing import TYPE_CHECKING

import pytest
import typer.main
import typer.testing
from hypothesis import settings

import compiled_lines
import undertow as ut
from undertow.cascade import CascadeState
from undertow.law import Plan
from undertow.optimiser import Optimiser
from undertow.runtime import Recipe
from undertow.symbolic.compiler import UNSUITED

if TYPE_CHECKING:
    from collections.abc import Iterator

    from undertow.runtime import Controller

# The same examples on every run: a failure on one machine is a failure on all.
settings.register_profile("undertow", deadline=None, derandomize=True, database=None)
settings.load_profile("undertow")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let a run have so many minutes, for a part of the tests that a word draws; count lines."""
    group = parser.getgroup("undertow")
    count = "also run what is compiled in Python, where coverage sees its lines"
    group.addoption("--count-compiled", action="store_true", help=count)
    group.addoption("--minutes", type=float, help="start no test later; its files in a drawn order")
    group.addoption("--draw", default="", help="a word that draws the order")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Put files in the drawn order where not all of them may have their turn."""
    if config.getoption("minutes") is not None:
        files = sorted({str(item.path) for item in items})
        random.Random(config.getoption("draw")).shuffle(files)
        place = {name: k for k, name in enumerate(files)}
        items.sort(key=lambda item: place[str(item.path)])


def pytest_collection_finish() -> None:
    """Leave what was imported and collected out of the search for garbage, and search less often.

    It is there to the end, and to go through it again and again took a twentieth of the time.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000)


BEGUN = time.monotonic()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out what comes too late, and say so."""
    minutes = item.config.getoption("minutes")
    if minutes is not None and time.monotonic() - BEGUN > 60 * minutes:
        pytest.skip(f"left out after {minutes:g} minutes; make slow runs all")


# Typer builds the whole command line anew each time that a test runs a command of it.
typer.testing._get_command = functools.cache(typer.main.get_command)  # type: ignore[attr-defined]


def pytest_configure(config: pytest.Config) -> None:
    """Keep generated kernels in the checkout: workers share them, the user's cache stays clean."""
    if config.getoption("count_compiled"):
        compiled_lines.count_compiled()
    cache = getattr(config, "cache", None)  # absent with -p no:cacheprovider
    if cache is not None:
        os.environ.setdefault("UNDERTOW_CACHE", str(cache.mkdir("kernels")))


@pytest.fixture(scope="session", autouse=True)
def plain_lines_are_plain() -> Iterator[None]:
    """What is taken for plain in a compiled function never turns out to need numba."""
    yield
    assert UNSUITED == []


@pytest.fixture(scope="session", autouse=True)
def first_once() -> Iterator[None]:
    """What a recipe of the library's names starts with depends on it alone: tests share it.

    And on how long is searched: ``short_searches`` of runs.py.
    """
    found: dict[tuple[str, object], CascadeState] = {}
    searched = Recipe.first

    @functools.wraps(searched)
    def first(recipe: Recipe) -> CascadeState:
        parts = {part.name: getattr(recipe, part.name) for part in fields(recipe)}
        named = isinstance(recipe.mechanism, str) and isinstance(recipe.objective, str)
        own = recipe.design or recipe.estimator or isinstance(recipe.target, ut.Reference)
        if own or not named or recipe.mechanism not in ut.mechanisms.LIBRARY:
            return searched(recipe)
        key = repr(parts), vars(Optimiser)["usual_cold"]
        if key not in found:
            found[key] = searched(recipe)
        return found[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Recipe, "first", first)
        yield


@pytest.fixture(scope="session")
def rig() -> ut.Mechanism:
    """The paper's rotary pendulum with the damping that its printed totals imply."""
    return ut.mechanisms.rotary_pendulum(d_e=0.025)


@pytest.fixture(scope="session")
def base() -> ut.Surface:
    """The base case of Tables 1 and 2."""
    return ut.Surface(alpha_a=-1, lambda_a=-0.5, alpha_u=5, lambda_u=10)


@pytest.fixture(scope="session")
def quick() -> ut.Surface:
    """A surface that brings the rotary pendulum home within a few seconds."""
    return ut.Surface(alpha_a=-1, lambda_a=-1.59, alpha_u=1.96, lambda_u=12.1)


@pytest.fixture
def memory(quick: ut.Surface) -> CascadeState:
    """What a cascade on that surface remembers."""
    return CascadeState(Plan.of(quick))


@pytest.fixture
def controller(memory: CascadeState) -> Controller:
    """The controller of :data:`runs.RECIPE`, idle."""
    from runs import RECIPE

    return RECIPE.make_controller(memory)
