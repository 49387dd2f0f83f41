"""What an installation has, what an extra would add, and whether all of it works here.

Each test compares two things that were made in different ways: compiled code with the formulas, a
simulated motion with SciPy's integrator, C with Python; or looks at what really happened, as the
run against the clock does, which also tells how punctual this machine is.
"""

from __future__ import annotations

import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np

from undertow.base import Progress, each, error_text, no_progress, versions
from undertow.cascade import Cascade
from undertow.checks import check_mechanism
from undertow.closed_loop import ClosedLoop, Event
from undertow.export import Build, EmbeddedController
from undertow.law import ReachingLaw, SlidingModeLaw, Surface, first_surface
from undertow.mechanisms import rotary_pendulum
from undertow.models import Mechanism
from undertow.objective import MinimumEnergy, objective_for
from undertow.plants import IdealRig
from undertow.proofs import search_for
from undertow.runtime import run
from undertow.symbolic.private import cache_folder, private_folder

#: What each extra adds, in the order in which people come to want them.
ADDS = {
    "show": "the live page",
    "bounds": "optimal-control bounds",
    "appendix": "the paper's appendix: a Lyapunov matrix for each case",
    "mujoco": "an independent engine, and its reader of MJCF",
    "interop": "pandas, xarray, python-control",
    "gym": "environments for Gymnasium",
    "logs": "logs as MCAP and Parquet",
    "campaign": "Monte Carlo campaigns: dask, zarr",
    "gpu": "rollouts on a GPU",
    "compare": "what the benchmarks compare with",
}

#: Where this package is.
PLACE = Path(__file__).parents[1]

#: Those for who changes this package.
OWN = ("docs", "dev")

#: Length of the run against the clock, s, and how much of it may be late in a test that passes.
RUN, LATE = 2.0, 0.5

#: What is said where more than a thousandth of it is late.
TOO_LATE = (
    "this machine misses too many periods for hardware: end other programs, or ask for real-time "
    "priority"
)

#: Largest relative difference from SciPy's integrator, and from C, that rounding explains.
AGREES = 1e-6

#: Where the tests' pendulum starts, rad; and how long it is compared with SciPy's, s.
START, SHORT = 0.3, 0.5


@dataclass(frozen=True)
class Extra:
    """An extra: what it is called, what it adds, and its packages with their versions here."""

    name: str
    adds: str
    packages: tuple[tuple[str, str | None], ...]

    @property
    def missing(self) -> tuple[str, ...]:
        """Packages that are not installed."""
        return tuple(name for name, version in self.packages if version is None)


def extras() -> list[Extra]:
    """Return the extras that the installed package names, or none where it is not installed."""
    try:
        lines = metadata.requires("undertow") or []
    except metadata.PackageNotFoundError:
        return []
    needed: dict[str, list[tuple[str, str | None]]] = {}
    for line in lines:
        found = re.match(r"([\w.-]+).*;.*\bextra\s*==\s*['\"]([\w-]+)['\"]", line)
        if found:
            needed.setdefault(found[2], []).append((found[1], _version(found[1])))
    order = [*ADDS, *sorted({*needed} - {*ADDS, *OWN})]
    return [
        Extra(name, ADDS.get(name, ""), tuple(needed[name])) for name in order if name in needed
    ]


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None


def facts_of_machine() -> dict[str, str]:
    """Return what this machine and this installation are, by what each thing is called."""
    found = versions()
    ours = [f"{name} {found[name]}" for name in ("numpy", "scipy", "sympy", "numba", "matplotlib")]
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    lines = {
        "undertow": f"{found['undertow'] or 'from source, not installed'}, {PLACE}",
        "Python": f"{platform.python_version()}, {sys.executable}",
        "packages": ", ".join(ours),
        "machine": f"{found['machine']}, {usable} processors",
    }
    if hasattr(os, "getloadavg"):
        lines["machine"] += f", load {os.getloadavg()[0]:.1f}"
    lines["compiled code"] = _cache()
    compilers = [name for name in ("gcc", "clang", "g++") if shutil.which(name)]
    lines["compilers"] = (
        ", ".join(compilers) or "none: exported C can be written, not tried; no FMI units"
    )
    return lines


def _cache() -> str:
    folder = private_folder()
    files = [one.stat().st_size for one in folder.rglob("*") if one.is_file()]
    words = f"{folder}, {len(files):,} files, {sum(files) / 1e6:.0f} MB"
    try:
        kept = folder == cache_folder().resolve()
    except RuntimeError:  # the user has no home
        kept = False
    return (
        words if kept else f"{words}; temporary: set UNDERTOW_CACHE to a folder that only you write"
    )


@dataclass(frozen=True)
class Result:
    """What came of one test: in words, and the time that it took, s.

    ``warning``: what works here, but not well enough for everything; nothing where all is well.
    """

    name: str
    passed: bool
    words: str
    seconds: float
    warning: str = ""


#: Returns whether it is as it should be, what was found, and perhaps a warning.
Test = Callable[[Mechanism], tuple[bool, str] | tuple[bool, str, str]]


def self_test(progress: Progress = no_progress) -> Iterator[Result]:
    """Try one thing of each kind; ten seconds, or a minute where all has to be compiled first.

    Yields one test after another; a test that breaks off has failed, with the error's words.
    """
    mechanism = rotary_pendulum(d_e=0.025)
    tests: dict[str, Test] = {
        "compiled code against its formulas": _formulas,
        "a motion against SciPy's integrator": _motion,
        "a cascade brings the pendulum upright": _balance,
        "a terminal set is proved": _proof,
        "the exported C against Python": _c,
        f"{RUN:g} s against the clock, 1 kHz": _clock,
    }
    for name in each(tests, progress, str):
        began = time.perf_counter()
        try:
            passed, words, *warning = tests[name](mechanism)
        except Exception as error:  # whatever is wrong here is what is asked for
            passed, words, warning = False, error_text(error), []
        yield Result(name, passed, words, time.perf_counter() - began, *warning)


def _formulas(mechanism: Mechanism) -> tuple[bool, str]:
    report = check_mechanism(mechanism, samples=16)
    held = len(report.checks) - len(report.failures)
    failed = "".join(f"; {check}" for check in report.failures)
    return report.passed, f"{held} of {len(report.checks)} conditions hold{failed}"


def _motion(mechanism: Mechanism) -> tuple[bool, str]:
    from scipy.integrate import solve_ivp

    surface, reaching, x0 = first_surface(mechanism), ReachingLaw(), mechanism.state(phi=START)
    ours = ClosedLoop(mechanism, MinimumEnergy(horizon=SHORT), reaching).simulate(x0, surface)
    law, n = SlidingModeLaw(mechanism, surface, reaching), mechanism.n

    def rate(t: float, x: np.ndarray) -> np.ndarray:
        return np.concatenate([x[n:], mechanism.accelerations(t, x, law(t, x).u)])

    theirs = solve_ivp(rate, (0.0, ours.t[-1]), x0, "LSODA", rtol=1e-8, atol=1e-10)
    off = float(np.abs(ours.x[-1] - theirs.y[:, -1]).max() / np.abs(ours.x).max())
    return off < AGREES, f"after {ours.t[-1]:.1f} s {off:.0e} apart, relative"


def _balance(mechanism: Mechanism) -> tuple[bool, str]:
    cascade = Cascade(mechanism, objective_for(mechanism, "bench-energy"))
    began = time.perf_counter()
    motion = cascade.simulate(phi=START)
    took = time.perf_counter() - began
    within = (np.abs(motion.trajectory.u) <= mechanism.input_limits * (1 + 1e-12)).all()
    good = motion.trajectory.event == Event.REACHED and bool(within)
    return good, (
        f"{len(motion.updates)} re-optimisations, upright after {motion.time:.2f} s of motion, "
        f"{took:.1f} s of work"
    )


def _proof(mechanism: Mechanism) -> tuple[bool, str]:
    surface = Surface(-1, -1.59, 1.96, 12.1)
    search = search_for(mechanism, surface, ReachingLaw())
    found = None if search is None else search.largest()
    if found is None:
        return False, "none was found"
    return found.ball > 0, f"a ball of {found.ball:.1e} inside, by interval arithmetic"


def _c(mechanism: Mechanism) -> tuple[bool, str]:
    if shutil.which("gcc") is None:
        return True, "left out: no gcc"
    controller = EmbeddedController(mechanism, first_surface(mechanism))
    with tempfile.TemporaryDirectory() as folder:
        found = Build(controller, Path(folder)).agreement(1000)
    off = max(found.output, found.s)
    return off < AGREES, f"{off:.0e} apart at {found.states - found.left_out} states, relative"


def _clock(mechanism: Mechanism) -> tuple[bool, str, str]:
    cascade = Cascade(mechanism, objective_for(mechanism, "bench-energy"))
    x0 = mechanism.state(phi=START)
    done = run(cascade, IdealRig(mechanism, x0), seconds=RUN, x0=x0)
    late, steps = done.missed_deadlines + done.skipped_periods, max(1, done.steps)
    response, woken = done.response_times, done.wakeup_delays
    words = (
        f"woken {1e6 * woken.quantile(0.5):.0f} µs late in the median, "
        f"{1e6 * woken.quantile(0.99):.0f} µs at the 99th percentile; "
        f"output after {1e6 * response.quantile(0.99):.0f} µs (p99); "
        f"{late} of {steps} periods missed"
    )
    return late <= LATE * steps, words, TOO_LATE if late > 0.001 * steps else ""
