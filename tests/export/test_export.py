"""The exported C: compiles without a warning, equals the Python, never leaves its limits."""

from __future__ import annotations

import csv
import math
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
import pytest
import sympy as sp
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

import undertow as ut
from support import bar, rest_slow, unoptimised
from undertow.base import (
    ArtefactError,
    InvalidInputError,
    MissingExtraError,
    ModelError,
    UnstableSurfaceError,
    as_text,
)
from undertow.cli import app
from undertow.export import (
    Agreement,
    Build,
    DerivativeStep,
    EmbeddedController,
    Footprint,
    KalmanStep,
    PlanAnswer,
    Status,
    SuperTwistingStep,
    Twin,
    files,
    host,
)
from undertow.export.controller import checksums, plan_numbers
from undertow.export.host import FLAGS, NEAREST, run_on_rig, tool
from undertow.export.routh import characteristic_polynomial
from undertow.export.twin import run_positions
from undertow.law import Plan, sliding_matrix, stability_margin
from undertow.mechanisms import LIBRARY
from undertow.plants import RealisticRig, plausible_rig, srv02_rig
from undertow.studies.rigs.export import (
    ExportRow,
    Upsets,
    notes,
    tables,
    upset_every_bit,
    upsets_table,
)
from undertow.studies.rigs.export import csv as export_csv
from undertow.symbolic import C99Emitter, Tape, literal

pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")

#: Beyond the export's own flags: what embedded projects ask for.
STRICT = (
    "-Wconversion",
    "-Wshadow",
    "-Wdouble-promotion",
    "-Wstrict-prototypes",
    "-Wmissing-prototypes",
    "-Wcast-qual",
    "-Wvla",
)
M = "two_motor_three_link"

#: Mechanisms whose offers are tried by default: one of each shape.
QUICK = {("rotary_pendulum", "float"), (M, "double")}


#: What is written of a controller depends on it alone: tests of the same one share it.
written = lru_cache(maxsize=64)(files)


@pytest.fixture(scope="module", autouse=True)
def quickly_built() -> Iterator[None]:
    """C is written once, and compiled without optimising but where a test says so."""
    with unoptimised(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "files", written)
        yield


#: A mechanism of the library: what is generated for its law is shared by its controllers.
mechanism_named = cache(lambda name: LIBRARY[name]())


@lru_cache(maxsize=64)
def exported(name: str = "rotary_pendulum", **options: object) -> EmbeddedController:
    mechanism = mechanism_named(name)
    surface = ut.first_surface(mechanism)
    return EmbeddedController(mechanism, surface, **options)  # type: ignore[arg-type]


def three_rows(mechanism: ut.Mechanism, scale: float = 1.0) -> Plan:
    s = ut.first_surface(mechanism)
    surfaces = [
        ut.Surface(s.alpha_a, k * scale * s.lambda_a, s.alpha_u, k * scale * s.lambda_u)
        for k in (1.0, 1.1, 1.2)
    ]
    return Plan(tuple(surfaces), (0.0, 0.05, 0.12))


def gcc(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["gcc", *words], cwd=folder, capture_output=True, text=True, check=False, timeout=60
    )


# -- it compiles, and is what Python computes ----------------------------------------------------


@pytest.mark.parametrize(
    ("name", "real", "differentiator"),
    [
        pytest.param("rotary_pendulum", "double", DerivativeStep(), marks=pytest.mark.slow),
        pytest.param("rotary_pendulum", "float", SuperTwistingStep(), marks=pytest.mark.slow),
        pytest.param(M, "double", SuperTwistingStep((300.0, 200.0, 100.0)), marks=pytest.mark.slow),
        pytest.param(M, "float", DerivativeStep(0.004), marks=pytest.mark.slow),
        ("rotary_pendulum", "double", KalmanStep()),
    ],
)
def test_strict_c99_without_a_warning_and_its_own_test_passes(
    name: str, real: str, differentiator: object, tmp_path: Path
) -> None:
    """Law, limits, estimator, table, lost sensors: the vectors of Python's law and estimator.

    Run under the compiler's sanitisers, so nothing undefined happens on the way.
    """
    controller = exported(name, real=real, differentiator=differentiator, slew=500.0)
    build = Build(controller, tmp_path)
    build.compile([f"{name}.c"], "unit.o", *STRICT, "-O2", "-c")
    build.compile(
        [f"{name}.c", f"{name}_test.c"], "strict", *STRICT, "-O0", "-fsanitize=undefined,address"
    )
    done = subprocess.run([tmp_path / "strict"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert not done.stderr
    assert " 0 failed" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("differentiator", [DerivativeStep(), SuperTwistingStep()])
@pytest.mark.parametrize("name", ["rotary_pendulum", "double_pendulum_on_a_cart", M])
def test_estimator_limits_slew_and_plans_agree_over_a_long_run(
    name: str, differentiator: object, tmp_path: Path
) -> None:
    """Positions that jump and are lost, whole states between, plans offered: equal to 1e-12."""
    controller = exported(name, differentiator=differentiator, slew=3000.0)
    limit, n = controller.mechanism.input_limits, controller.mechanism.n
    rng, twin, number = np.random.default_rng(0), Twin(controller), 1
    x = np.zeros(2 * n)
    with Build(controller, tmp_path).start() as process:
        for k in range(4000):
            x[n:] = 0.98 * x[n:] + 0.05 * rng.standard_normal(n)
            x[:n] += 1e-3 * x[n:] + (rng.random() < 0.01) * rng.uniform(-1, 1, n)
            seen = np.where(rng.random(2 * n) < 0.02, rng.choice([np.nan, np.inf, 1e12]), x)
            if k % 97 == 0:
                number += 1
                plan = Plan.of(three_rows(controller.mechanism, rng.uniform(0.8, 1.2)).surfaces[0])
                assert process.offer(plan, number) == twin.offer(plan, number)
            if k // 50 % 3 == 0:
                (u, said), (u_twin, said_twin) = process.step_state(seen), twin.step_state(seen)
            else:
                (u, said), (u_twin, said_twin) = process.step(seen[:n]), twin.step(seen[:n])
            assert said == said_twin
            assert (np.abs(u - u_twin) <= 1e-12 * limit).all()


def test_the_test_can_fail(tmp_path: Path) -> None:
    """A parameter that is 1 % off is found by the vectors."""
    controller = exported()
    for name, content in written(controller).items():
        text = re.sub(r"(UT_PARAMETER_\d+_m) 0\.125\b", r"\1 0.12625", content.decode())
        (tmp_path / name).write_text(text)
    passed, said = Build(controller, tmp_path).self_test()
    assert not passed
    assert " 0 failed" not in said


@pytest.mark.parametrize("states", rest_slow([10_000, 100_000], 10_000))
def test_agrees_with_python_at_1e5_random_states(
    states: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Show 6: relative difference ≤ 1e-12 in double precision, of C that is optimised."""
    monkeypatch.setattr(host, "FLAGS", FLAGS)
    agreement = Build(exported(), tmp_path).agreement(states)
    assert agreement.states == states
    assert max(agreement.output, agreement.demand, agreement.s, agreement.margin) <= 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("real", ["double", "float"])
@pytest.mark.parametrize("name", list(LIBRARY))
def test_every_mechanism_of_the_library(name: str, real: str, tmp_path: Path) -> None:
    """Show 6 for all: own test, agreement over 1e5 states, nothing asked of the library but maths.

    Single precision: a thousandth, but where the sign of det Γ is rounding.
    """
    controller = exported(name, real=real)
    build = Build(controller, tmp_path)
    assert build.self_test()[0]
    near = build.agreement(100_000)
    worst = max(near.output, near.demand, near.s, near.margin)
    assert worst <= (1e-12 if real == "double" else 1e-3)
    assert near.left_out <= 5
    positions = run_positions(controller)
    footprint = build.footprint(positions[np.isfinite(positions).all(axis=1)])
    assert set(footprint.calls) <= {"sincos", "sincosf", "sin", "cos", "sinf", "cosf", "memcpy"}
    assert 100 < footprint.instructions < 5000


@pytest.mark.slow
def test_disturbance_bounds_and_other_switching_functions_are_exported(tmp_path: Path) -> None:
    """The gains (13) from bounds, and the other switching functions."""
    rig = LIBRARY[M]().with_disturbance_bounds(0.3, 0.2, 0.1)
    for switching in ("tanh", "sign"):
        folder = tmp_path / switching
        folder.mkdir()
        law = ut.ReachingLaw((15.0, 20.0), (0.4, 0.5), switching)
        controller = EmbeddedController(rig, ut.first_surface(rig), law)
        build = Build(controller, folder)
        assert build.self_test()[0]
        assert build.agreement(2000).demand <= 1e-12


# -- no heap, no unbounded loop, no recursion ----------------------------------------------------

LOOP = re.compile(r"for \(int (\w) = 0; \1 < (\w+); \1\+\+\) \{")


def unbounded(source: str) -> list[str]:
    """Return what could keep C from ending: loops without a constant bound, calls upwards."""
    text = re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL)
    found = re.findall(r"\b(while|do|goto|longjmp|setjmp|switch)\b", text)
    heads = re.findall(r"\bfor \(.*", text)
    constants = {"UT_N", "UT_M", "UT_X", "UT_SURFACE", "UT_ROWS"}
    for head in heads:
        match = LOOP.match(head)
        if match is None or match[2] not in constants:
            found.append(head)
    counters = re.findall(
        r"\b([ik]) (?:=|\+=|-=) |(?:--|\+\+)([ik])\b", text.replace("int ", "int")
    )
    found += [a or b for a, b in counters]
    defined: list[str] = []
    for head, body in re.findall(
        r"^(?:static )?[a-z_]+ (?:\*)?(ut_\w+)\([^;{]*\)\n\{(.*?)^\}",
        text,
        re.DOTALL | re.MULTILINE,
    ):
        found += [
            f"{head} calls {f}" for f in re.findall(r"\b(ut_\w+)\(", body) if f not in defined
        ]
        defined.append(head)
    return found


@pytest.mark.parametrize(
    ("name", "step"), [("rotary_pendulum", KalmanStep()), (M, DerivativeStep())]
)
def test_no_unbounded_loop_and_no_recursion(name: str, step: object) -> None:
    """Every loop counts to a constant; every function calls only those defined above it."""
    source = written(exported(name, differentiator=step))[f"{name}.c"].decode()
    assert len(LOOP.findall(source)) >= 10
    assert unbounded(source) == []


@pytest.mark.parametrize(
    "planted",
    [
        "    while (1) {\n    }\n",
        "    for (int i = 0; i < c->row; i++) {\n    }\n",
        "    i = 0;\n",
        "    (void)ut_step_state(c, q, u);\n",
    ],
)
def test_the_search_for_unbounded_loops_finds_them(planted: str) -> None:
    """The check above fails where it should."""
    source = written(exported())["rotary_pendulum.c"].decode()
    head = "int ut_step(ut_controller *c, const ut_real q[UT_N], ut_real u[UT_M])\n{\n"
    assert head in source
    assert unbounded(source.replace(head, head + planted)) != []


def test_no_heap_and_a_bounded_stack(tmp_path: Path) -> None:
    """The object file asks for nothing but maths, and its frames are static."""
    build = Build(exported(M), tmp_path)
    build.compile([f"{M}.c"], "unit.o", "-O2", "-c", "-fstack-usage")
    undefined = subprocess.run(
        ["nm", "-u", "unit.o"], cwd=tmp_path, capture_output=True, text=True, check=True
    ).stdout.split()
    assert set(undefined) - {"U", "_GLOBAL_OFFSET_TABLE_"} <= {"sincos", "sin", "cos", "memcpy"}
    usage = (tmp_path / "unit.su").read_text().split("\n")[:-1]
    assert usage
    assert all(line.endswith("\tstatic") for line in usage)


def test_fast_math_is_refused(tmp_path: Path) -> None:
    """-ffast-math would take the checks for NaN away."""
    Build(exported(), tmp_path)
    done = gcc(tmp_path, "-std=c99", "-ffast-math", "-c", "rotary_pendulum.c")
    assert done.returncode != 0
    assert "without -ffast-math" in done.stderr


# -- never NaN, never past a limit ---------------------------------------------------------------


def test_whatever_comes_in_the_output_is_a_number_within_limit_and_slew(tmp_path: Path) -> None:
    """NaN, infinity, absurd numbers, in any order: |u| ≤ limit and |Δu| ≤ slew · T."""
    controller = exported(M, slew=(3000.0, 5000.0))
    limit = controller.mechanism.input_limits
    step = controller.slew_rates * controller.period
    value = st.one_of(
        st.floats(allow_nan=True, allow_infinity=True), st.floats(-3, 3), st.just(math.nan)
    )
    measurement = st.tuples(st.booleans(), st.lists(value, min_size=6, max_size=6))
    last = np.zeros(2)
    with Build(controller, tmp_path).start() as process:

        @settings(max_examples=30, deadline=None, database=None)
        @given(st.lists(measurement, min_size=1, max_size=20))
        def check(sequence: list[tuple[bool, list[float]]]) -> None:
            nonlocal last
            for positions_alone, x in sequence:
                u, _ = process.step(x[:3]) if positions_alone else process.step_state(x)
                assert (np.abs(u) <= limit).all()
                assert (np.abs(u - last) <= step * (1 + 1e-12)).all()
                last = u

        check()


def test_a_lost_sensor_is_bridged_then_latched_at_zero_until_it_is_armed_again(
    tmp_path: Path,
) -> None:
    """The estimate is carried on for ``missed`` periods; after that the input is switched off.

    It stays off when readings return, until it is let on again.
    """
    controller = exported(missed=4)
    q = np.array([0.02, 0.1])
    with Build(controller, tmp_path).start() as process:
        before = [process.step(q) for _ in range(50)][-1]
        lost = [process.step([0.02, math.nan]) for _ in range(8)]
        returned = [process.step(q) for _ in range(20)]
        process.arm()
        after = process.step(q)
    assert before[1] in (Status.OK, Status.CLIPPED)
    assert all(s & Status.BRIDGED and u == before[0] for u, s in lost[:4])
    assert all(s & Status.LOST and u == 0.0 for u, s in lost[4:])
    assert all(s & Status.LOST and u == 0.0 for u, s in returned)
    assert not after[1] & (Status.LOST | Status.BRIDGED)
    assert after[0] != 0.0


def test_limits_are_rounded_towards_zero_in_single_precision() -> None:
    """The literal of a limit is never above the limit."""
    controller = exported(real="float")
    for value in (0.1, 15.0, 0.3, 1 / 3, 7.7):
        shown = np.float32(controller.limit(value).rstrip("f"))
        assert float(shown) <= value
        assert float(shown) > value * (1 - 1e-6)


# -- memory that is upset ------------------------------------------------------------------------

#: Steps from nonsense and sense, plans offered, whole and damaged; between steps the memory is
#: overwritten anywhere: with numbers of every kind, small integers, single bits.
FUZZ = r"""
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include "NAME_vectors.h"

static uint64_t seed = 88172645463325252ULL;

static uint64_t any(void)
{
    seed ^= seed << 13;
    seed ^= seed >> 7;
    seed ^= seed << 17;
    return seed;
}

static ut_real number(void)
{
    const ut_real kinds[] = {(ut_real)NAN, (ut_real)INFINITY, -(ut_real)INFINITY, (ut_real)1e30,
                             (ut_real)-1e9, (ut_real)9.99e8, (ut_real)1e-38, 0, -0.0f};
    const uint64_t kind = any() % 24;
    ut_real value;
    if (kind < sizeof kinds / sizeof kinds[0]) {
        return kinds[kind];
    }
    if (kind == 23) {
        const ut_word word = (ut_word)any();
        memcpy(&value, &word, sizeof value);
        return value;
    }
    return (ut_real)((double)(any() % 2000001) / 1e6 - 1.0);
}

static void upset(ut_controller *c)
{
    unsigned char *bytes = (unsigned char *)c;
    const size_t at = any() % (sizeof *c - sizeof(uint64_t) + 1);
    const uint64_t word = any() % 3 ? any() : any() % 9 - 4;
    const ut_real value = number();
    switch (any() % 4) {
    case 0:
        bytes[at] = (unsigned char)(bytes[at] ^ (1u << any() % 8));
        break;
    case 1:
        memcpy(bytes + at, &word, 1 + any() % sizeof word);
        break;
    case 2:
        memcpy(bytes + at / sizeof value * sizeof value, &value, sizeof value);
        break;
    default:
        memcpy(bytes + at / 4 * 4, &word, 4);
        break;
    }
}

static ut_plan made(const ut_controller *c)
{
    ut_plan p = ut_next_plan;
    p.number = any() % 3 ? c->newest + 1 : (unsigned long)any();
    p.count = any() % 8 ? 1 + (int)(any() % UT_ROWS) : (int)(any() % 9) - 4;
    for (int k = 0; k < UT_ROWS; k++) {
        p.row[k] = ut_next_plan.row[0];
        p.start[k] = any() % 8 ? 20UL * (unsigned long)k : any() % 100;
    }
    if (any() % 4 == 0) {
        p.row[0].surface[any() % UT_SURFACE] = number();
        p.row[0].eta[any() % UT_M] = number();
    }
    if (any() % 8) {
        ut_plan_seal(&p);
    }
    return p;
}

int main(int argc, char **argv)
{
    const long steps = argc > 1 ? atol(argv[1]) : 1;
    static ut_controller c;
    long bad = 0, accepted = 0, faults = 0, fallbacks = 0, given = 0;
    ut_init(&c);
    for (long k = 0; k < steps; k++) {
        ut_real q[UT_X], u[UT_M];
        for (int i = 0; i < UT_X; i++) {
            q[i] = any() % 16 ? (ut_real)((double)(any() % 2001) / 1e5 - 0.01) : number();
        }
        const int status = any() % 2 ? ut_step(&c, q, u) : ut_step_state(&c, q, u);
        for (int i = 0; i < UT_M; i++) {
            bad += !(fabs((double)u[i]) <= (double)ut_scale[i]);
            given += u[i] < 0 || u[i] > 0;
        }
        faults += (status & UT_FAULT) != 0;
        fallbacks += (status & UT_FALLBACK) != 0;
        if (any() % 7 == 0) {
            const ut_plan p = made(&c);
            accepted += ut_offer(&c, &p) == UT_ACCEPTED;
        }
        if (any() % 5 == 0) {
            for (uint64_t n = any() % 3 ? 1 : any() % 9; n > 0; n--) {
                upset(&c);
            }
        }
        if (any() % 1009 == 0) {
            memset(&c, any() % 2 ? 0xff : 0, sizeof c);
        }
        if (any() % 16 == 0) {
            ut_arm(&c);
        }
    }
    printf("%ld %ld %ld %ld %ld\n", bad, accepted, faults, fallbacks, given);
    return bad != 0;
}
"""


def fuzzed(controller: EmbeddedController, folder: Path, steps: int) -> list[int]:
    """Return outputs beyond a limit, plans accepted, faults, fallbacks, outputs other than 0."""
    build = Build(controller, folder)
    (folder / "fuzz.c").write_text(FUZZ.replace("NAME", controller.stem))
    sanitised = ("-O0", "-fsanitize=undefined,address", "-fno-sanitize-recover=all")
    program = build.compile([f"{controller.stem}.c", "fuzz.c"], "fuzz", *sanitised)
    done = subprocess.run(
        [program, str(steps)], capture_output=True, text=True, check=False, timeout=600
    )
    assert not done.stderr, done.stderr
    return [int(word) for word in done.stdout.split()]


@pytest.mark.parametrize(
    ("name", "real", "step", "steps"),
    [
        pytest.param("rotary_pendulum", "double", DerivativeStep(), 20_000, marks=pytest.mark.slow),
        pytest.param(M, "float", DerivativeStep(), 60_000, marks=pytest.mark.slow),
        ("rotary_pendulum", "float", KalmanStep(), 20_000),
        *(
            pytest.param(name, real, step, 3_000_000, marks=pytest.mark.slow)
            for name, real, step in (
                ("rotary_pendulum", "double", DerivativeStep()),
                ("rotary_pendulum", "float", SuperTwistingStep()),
                (M, "double", KalmanStep()),
            )
        ),
    ],
)
def test_no_output_is_beyond_a_limit_whatever_words_of_the_memory_are_upset(
    name: str, real: str, step: object, steps: int, tmp_path: Path
) -> None:
    """Under the sanitisers: nothing read or written out of bounds, nothing undefined."""
    controller = exported(name, real=real, differentiator=step, rows=3, slew=4000.0)
    bad, accepted, faults, fallbacks, given = fuzzed(controller, tmp_path, steps)
    assert bad == 0
    # It is no test of a controller that is always off.
    assert min(accepted, faults, fallbacks, given) > steps / 1000


#: What becomes of the controller when words of its memory are overwritten, a line for each case:
#: the first output, the outputs beyond the limit in 200 steps, the statuses or-ed, the last status.
WORDS = r"""
#include <math.h>
#include <stdio.h>
#include <string.h>
#include "rotary_pendulum_vectors.h"

static ut_controller c;

static void report(const char *name)
{
    const ut_real q[UT_N] = {0.01, 0.02};
    ut_real u[UT_M], first = 0;
    int beyond = 0, status = 0, all = 0;
    for (int k = 0; k < 200; k++) {
        status = ut_step(&c, q, u);
        all |= status;
        first = k ? first : u[0];
        beyond += !(fabs((double)u[0]) <= 15.0);
    }
    printf("%s %.17g %d %d %d\n", name, (double)first, beyond, all, status);
}

static void start(void)
{
    const ut_real q[UT_N] = {0.01, 0.02};
    ut_real u[UT_M];
    ut_init(&c);
    for (int k = 0; k < 20; k++) {
        (void)ut_step(&c, q, u);
    }
}

int main(void)
{
    const double values[] = {100, 1e30, (double)INFINITY, (double)NAN, -1e30, 3};
    const int indices[] = {1, -1, 7, 64, -2147483647, 2147483647};
    for (int k = 0; k < 6; k++) {
        start();
        c.u[0] = (ut_real)values[k];
        report("output");
        ut_arm(&c);
        report("armed");
    }
    for (int k = 0; k < 6; k++) {
        start();
        c.row = indices[k];
        report("row");
        start();
        c.taken = (sig_atomic_t)indices[k];
        report("taken");
        start();
        c.offered = (sig_atomic_t)indices[k];
        report("offered");
        start();
        c.missed = indices[k];
        report("missed");
    }
    for (int k = 0; k < UT_SURFACE; k++) {
        start();
        c.slot[c.taken].row[0].surface[k] *= -1;
        report("plan");
    }
    start();
    for (int k = 0; k < UT_SURFACE; k++) {
        c.slot[c.taken].row[0].surface[k] *= k & 1 ? -1 : 1;
    }
    report("plan");
    start();
    c.slot[c.taken].count = 1 << 20;
    report("plan");
    start();
    c.guard ^= 1u;
    report("latch");
    for (int k = 0; k < 6; k++) {
        start();
        c.filter[1][1] = (ut_real)values[k];
        report("estimate");
    }
    memset(&c, 0, sizeof c);
    report("blank");
    memset(&c, 0xff, sizeof c);
    report("ones");
    ut_arm(&c);
    report("begun");
    return 0;
}
"""


@pytest.mark.parametrize("real", rest_slow(["double", "float"], "float"))
def test_each_word_of_the_memory_is_checked_where_it_is_used(real: str, tmp_path: Path) -> None:
    """The output, its mirror, indices, counters, plan, latch, estimate, memory never begun.

    A damaged output is off at once and stays off until it is let on again; a damaged plan is
    replaced by the built-in one, here the same, bit for bit; damaged indices and counters change
    nothing.
    """
    build = Build(exported(real=real, slew=4000.0), tmp_path)
    (tmp_path / "words.c").write_text(WORDS)
    program = build.compile(
        ["rotary_pendulum.c", "words.c"], "words", "-O0", "-fsanitize=undefined,address"
    )
    done = subprocess.run([program], capture_output=True, text=True, check=True)
    assert not done.stderr
    rows = [line.split() for line in done.stdout.splitlines()]
    assert len(rows) == 6 * 2 + 6 * 4 + 5 + 1 + 1 + 6 + 3
    healthy = Twin(exported(slew=4000.0))
    expected = [healthy.step([0.01, 0.02])[0][0] for _ in range(21)][-1]
    assert expected != 0
    for name, first, beyond, seen, last in rows:
        assert beyond == "0"
        statuses, end, u = Status(int(seen)), Status(int(last)), float(first)
        off = name in ("output", "latch", "blank", "ones")
        assert bool(statuses & Status.FAULT) == bool(end & Status.FAULT) == off
        assert not statuses & Status.LOST
        assert bool(statuses & Status.FALLBACK) == (name in ("plan", "blank", "ones", "begun"))
        if off:
            assert u == 0.0
        elif name not in ("estimate", "armed", "begun"):
            assert u == pytest.approx(expected, rel=1e-12 if real == "double" else 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("real", "every"), [("double", 37), pytest.param("float", 7, marks=pytest.mark.slow)]
)
def test_bits_of_the_memory_upset_on_the_rig_leave_the_output_within_its_limits(
    real: str, every: int, tmp_path: Path
) -> None:
    """A sample of ``--bit-flips``: all but the output, its mirror and the latch are ridden out."""
    controller = exported(real=real)
    start = controller.mechanism.state(phi=math.radians(35))
    rig = RealisticRig(srv02_rig(), start, seed=0)
    upsets = upset_every_bit(Build(controller, tmp_path), rig, moments=(0.05,), every=every)
    assert upsets.undisturbed
    assert sum(upsets.runs.values()) == -(-upsets.bits // every) >= 70
    assert sum(upsets.beyond.values()) == 0
    off = {"u", "mirror", "guard"}
    assert all(upsets.held[k] == upsets.runs[k] for k in upsets.runs if k not in off)
    assert all(upsets.held[k] == 0 for k in off)
    assert sum(upsets.runs[k] for k in off) > 0


@pytest.mark.slow
def test_bits_upset_under_two_motors_and_a_plan_of_three_surfaces(tmp_path: Path) -> None:
    """Limits hold for both inputs while surfaces take over one after another."""
    rig = LIBRARY["gantry_crane"]()
    controller = EmbeddedController(rig, three_rows(rig), slew=4000.0)
    bench = RealisticRig(plausible_rig(rig), seed=0)
    upsets = upset_every_bit(Build(controller, tmp_path), bench, moments=(0.03, 1.0), every=19)
    assert sum(upsets.beyond.values()) == 0
    assert sum(upsets.held.values()) > 0.8 * sum(upsets.runs.values())


@pytest.mark.slow
def test_an_output_beyond_its_limit_is_counted(tmp_path: Path) -> None:
    """The search for them finds one: a controller that clips too late."""
    controller = exported(prefix="other")
    build = Build(controller, tmp_path)
    source = tmp_path / "rotary_pendulum.c"
    text = source.read_text()
    text = text.replace("next = other_within(next, other_limit[i]);", "")
    text = text.replace("if (c->mirror[i] != (other_word)~other_bits(c->u[i])) {", "if (0) {")
    source.write_text(text)
    rig = RealisticRig(srv02_rig(), controller.mechanism.state(phi=0.3), seed=0)
    upsets = upset_every_bit(build, rig, moments=(0.05,), after=0.05, every=3)
    assert upsets.beyond["u"] > 0


def test_what_became_of_the_upsets_is_told_by_member_and_in_all() -> None:
    """A member without a run has no line; a run that falls without an upset is not held against."""
    runs, beyond, held = (
        {"u": 4, "spare": 0, "q": 16},
        {"u": 3, "spare": 0, "q": 0},
        {"u": 1, "q": 9},
    )
    upsets = Upsets("a rig", "float", 96, (0.05, 2.0), True, runs, beyond, held | {"spare": 0})
    said = str(upsets)
    assert "20 runs" in said
    assert "at 0.05, 2 s: output beyond its limit in 3; still balanced 10 (50.0%)." in said
    assert str(replace(upsets, undisturbed=False)).endswith(
        "but so is not the run without an upset."
    )
    lines = [line.split() for line in as_text(upsets_table(upsets)).decode().splitlines()]
    assert ["u", "4", "3", "25.0%"] in lines
    assert ["q", "16", "0", "56.2%"] in lines
    assert not any(line[:1] == ["spare"] for line in lines)


def test_the_report_of_an_export_has_a_line_for_each_controller() -> None:
    """Its own test that fails is said as such; all numbers are in the file."""
    near, cost = Agreement(9, 1, 1e-15, 2e-15, 3e-15, 4e-15), Footprint(99.6, 1, 2, 3, 4, ("sin",))
    rows = [ExportRow(exported(name), name != M, "", near, cost) for name in ("rotary_pendulum", M)]
    agrees, costs = (as_text(one).decode().splitlines() for one in tables(rows))
    assert any(line.split()[:5] == [M, "3", "2", "FAILED", "1.0e-15"] for line in agrees)
    assert any(
        line.split() == ["rotary_pendulum", "100", "1", "2", "3", "4", "sin"] for line in costs
    )
    first, second = csv.DictReader(export_csv(rows).decode().splitlines())
    assert (first["own test"], second["own test"]) == ("passed", "FAILED")
    assert (first["margin"], second["calls"]) == ("4.0e-15", "sin")
    assert ["left out" in " ".join(notes(real, 9, "gcc")) for real in ("float", "double")] == [
        NEAREST[real] > 0 for real in ("float", "double")
    ]


# -- plans ---------------------------------------------------------------------------------------


def test_a_plan_takes_over_row_by_row_as_in_python(tmp_path: Path) -> None:
    """A table of three surfaces built in, then another offered: equal outputs, equal switches."""
    rig = mechanism_named(M)
    controller = EmbeddedController(rig, three_rows(rig))
    later = three_rows(rig, 0.9)
    rng = np.random.default_rng(0)
    q = 0.05 * rng.standard_normal(3)
    switched = []
    with Build(controller, tmp_path).start() as process:
        twin = Twin(controller)
        for k in range(400):
            if k == 200:
                for side in (process, twin):
                    assert side.offer(later, 2) is PlanAnswer.ACCEPTED
            q = q + 1e-4 * rng.standard_normal(3)
            (u, said), (u_twin, said_twin) = process.step(q), twin.step(q)
            assert said == said_twin
            assert np.abs(u - u_twin).max() <= 1e-12 * rig.input_limits.max()
            if said & Status.SWITCHED:
                switched.append(k)
    assert switched == [50, 120, 200, 250, 320]


def test_offers_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    """Stale, busy, singular, not finite, too fast for the period, too long, not rising."""
    rig = LIBRARY["rotary_pendulum"]()
    s = ut.first_surface(rig)
    controller = replace(exported(), rows=2)
    with Build(controller, tmp_path).start() as process:

        def offer(*rows: str, number: int = 5, count: int | None = None) -> PlanAnswer:
            text = f"p {number} {len(rows) if count is None else count} {' '.join(rows)}"
            return PlanAnswer(int(process._ask(text)[0]))

        def row(start: int = 0, eta: float = 20.0, layer: float = 0.1, **entries: float) -> str:
            a_a, l_a, a_u, l_u = s.vector.tolist()
            a_u, l_a = entries.get("alpha_u", a_u), entries.get("lambda_a", l_a)
            return f"{start} {a_a!r} {l_a!r} {a_u!r} {l_u!r} {eta!r} {layer!r}"

        singular = -1.0 / float(ut.law.sliding.coupling(rig, np.zeros(2))[0, 0])
        assert offer(row(alpha_u=singular)) is PlanAnswer.INVALID
        assert offer(row(lambda_a=math.nan)) is PlanAnswer.INVALID
        assert offer(row(eta=0.0)) is PlanAnswer.INVALID
        assert offer(row(layer=-1.0)) is PlanAnswer.INVALID
        assert offer(row(eta=300.0)) is PlanAnswer.INVALID  # 0.001 s ≥ 2 · 0.1 / 300
        assert offer(row(start=1)) is PlanAnswer.INVALID
        assert offer(row(), row(start=0)) is PlanAnswer.INVALID
        assert offer(row(), row(start=9), count=3) is PlanAnswer.INVALID
        assert offer(count=0) is PlanAnswer.INVALID
        assert offer(row(), number=1) is PlanAnswer.STALE
        assert offer(row(), row(start=9), number=7) is PlanAnswer.ACCEPTED
        assert offer(row(), number=8) is PlanAnswer.BUSY
        process.step([0.0, 0.0])
        assert offer(row(), number=7) is PlanAnswer.STALE
        assert offer(row(eta=199.0), number=8) is PlanAnswer.ACCEPTED


def test_a_plan_is_sealed_by_its_sender_and_damage_on_the_way_is_noticed(tmp_path: Path) -> None:
    """One bit of any word of a row, or of its check word: refused; whole: taken."""
    rig = mechanism_named("rotary_pendulum")
    controller = EmbeddedController(rig, three_rows(rig))
    starts, rows = controller.starts(controller.plan), plan_numbers(controller, controller.plan)
    checks = checksums(2, starts, rows, "double")
    flat = [np.concatenate(row) for row in rows]
    rng = np.random.default_rng(0)
    with Build(controller, tmp_path).start() as process:

        def offer(
            number: int,
            starts: list[int],
            rows: list[ut.models.mechanism.FloatArray],
            checks: list[int],
        ) -> PlanAnswer:
            words = ["p", str(number), str(len(rows))]
            for start, row in zip(starts, rows, strict=True):
                words += [str(start), *map(repr, row.tolist())]
            return PlanAnswer(int(process._ask(" ".join([*words, *map(str, checks)]))[0]))

        for k in range(3):
            for i in range(6):
                for bit in rng.choice(64, 8, replace=False).tolist():
                    damaged = [row.copy() for row in flat]
                    damaged[k].view(np.uint64)[i] ^= np.uint64(1) << np.uint64(bit)
                    if np.isfinite(damaged[k]).all():
                        assert offer(2, starts, damaged, checks) is PlanAnswer.CORRUPT
            for bit in range(64):
                wrong = [c ^ (1 << bit) * (j == k) for j, c in enumerate(checks)]
                assert offer(2, starts, flat, wrong) is PlanAnswer.CORRUPT
        both = [row.copy() for row in flat]
        both[0][[1, 3]] *= -1  # two signs at once
        assert offer(2, starts, both, checks) is PlanAnswer.CORRUPT
        assert offer(3, starts, flat, checks) is PlanAnswer.CORRUPT
        assert offer(2, [0, starts[1] + 1, starts[2]], flat, checks) is PlanAnswer.CORRUPT
        assert offer(2, starts[:2], flat[:2], checks[:2]) is PlanAnswer.CORRUPT
        assert offer(2, starts, [flat[0], flat[2], flat[1]], checks) is PlanAnswer.CORRUPT
        assert offer(2, starts, flat, checks) is PlanAnswer.ACCEPTED


def test_no_number_of_a_plan_locks_out_the_next(tmp_path: Path) -> None:
    """Numbers of every size, one after another; only the last and those just behind are stale."""
    controller = exported()
    twin = Twin(controller)
    plan = controller.plan
    with Build(controller, tmp_path).start() as process:

        def offer(number: int) -> PlanAnswer:
            verdict = process.offer(plan, number)
            assert verdict == twin.offer(plan, number)
            for side in (process, twin):
                side.step([0.0, 0.0])
            return verdict

        assert offer(2**64 - 1) is PlanAnswer.STALE  # two behind 1
        for number in (5, 2**31 - 1, 5, 2**31 + 5, 6, 2**63 + 10**6, 2**32 - 1, 2**32, 1, 2):
            assert offer(number) is PlanAnswer.ACCEPTED
            assert offer(number) is PlanAnswer.STALE
            assert offer((number - 1) % 2**64) is PlanAnswer.STALE
        assert offer(2 + 2**16) is PlanAnswer.ACCEPTED
        assert offer(3) is PlanAnswer.STALE
        assert offer(2) is PlanAnswer.ACCEPTED


@pytest.mark.parametrize("name", ["rotary_pendulum", M, "triple_pendulum_on_a_cart"])
def test_the_polynomial_has_the_eigenvalues_of_the_motion_on_the_surface(name: str) -> None:
    """Its roots are the eigenvalues that the stability margin is taken from."""
    mechanism = LIBRARY[name]()
    n, m = mechanism.n, mechanism.m
    symbols = sp.symbols(f"c:{2 * m * n}")
    coefficients = sp.lambdify(symbols, characteristic_polynomial(mechanism, symbols))
    rng = np.random.default_rng(0)
    vector = ut.first_surface(mechanism).vector
    for _ in range(20):
        changed = vector * rng.uniform(0.7, 1.3, len(vector))
        roots = np.sort_complex(np.roots(np.array(coefficients(*changed), dtype=float)))
        expected = np.sort_complex(np.linalg.eigvals(sliding_matrix(mechanism, changed)))
        assert np.abs(roots - expected).max() <= 1e-4 * np.abs(expected).max()


@pytest.mark.parametrize(
    ("name", "real"),
    [
        pytest.param(name, real, marks=() if (name, real) in QUICK else pytest.mark.slow)
        for name in LIBRARY
        for real in ("double", "float")
    ],
)
def test_a_plan_whose_motion_does_not_die_out_is_refused(
    name: str, real: str, tmp_path: Path
) -> None:
    """Signs flipped and numbers changed at random: taken if and only if all eigenvalues are left.

    Eigenvalues near the axis are left out: there the criterion is rounding.
    """
    controller = exported(name, real=real)
    mechanism = controller.mechanism
    rng = np.random.default_rng(0)
    vector = ut.first_surface(mechanism).vector
    number, stable, unstable = 1, 0, 0
    rest = np.zeros(mechanism.n)
    with Build(controller, tmp_path).start() as process:
        for k in range(200):
            flips = np.where(rng.random(len(vector)) < 0.15 * (k % 2), -1.0, 1.0)
            spread = 0.05 if k % 3 else 0.4
            changed = vector * flips * rng.uniform(1 - spread, 1 + spread, len(vector))
            surface = ut.Surface.from_vector(changed, mechanism.n, mechanism.m)
            margin = float(stability_margin(mechanism, surface))
            speed = np.abs(np.linalg.eigvals(sliding_matrix(mechanism, changed))).max()
            if abs(margin) < (1e-9 if real == "double" else 1e-3) * speed:
                continue
            number += 1
            verdict = process.offer(Plan.of(surface), number)
            assert verdict is (PlanAnswer.ACCEPTED if margin > 0 else PlanAnswer.INVALID), margin
            process.step(rest)
            stable, unstable = stable + (margin > 0), unstable + (margin <= 0)
    assert min(stable, unstable) >= 15


def test_an_unstable_surface_is_not_exported() -> None:
    """What would be refused as a plan is not built in either."""
    rig = LIBRARY["rotary_pendulum"]()
    s = ut.first_surface(rig)
    with pytest.raises(UnstableSurfaceError, match="margin"):
        EmbeddedController(rig, ut.Surface(s.alpha_a, -s.lambda_a, s.alpha_u, -s.lambda_u))


def test_a_sensor_that_is_lost_from_the_start_latches_as_later(tmp_path: Path) -> None:
    """Up to ``missed`` periods are waited for; after that the output stays off."""
    controller = exported(missed=4)
    gone, q = [math.nan, 0.1], [0.02, 0.1]
    for wait, latched in ((4, False), (5, True)):
        folder = tmp_path / str(wait)
        folder.mkdir()
        with Build(controller, folder).start() as process:
            before = [process.step(gone) for _ in range(wait)]
            assert all(u == 0.0 and status & Status.LOST for u, status in before)
            u, status = process.step(q)
            assert bool(status & Status.LOST) == (u[0] == 0.0) == latched
            assert bool(process.step_state([*q, 0.0, 0.0])[1] & Status.LOST) == latched
            process.arm()
            assert not process.step(q)[1] & Status.LOST


INTERRUPTED = r"""
#include <signal.h>
#include <stdio.h>
#include <sys/time.h>
#include "rotary_pendulum.h"

/* One side runs in a signal handler, as in an interrupt, the other in the main loop. Plans are
 * offered whose rows are all the same number, and each step looks whether it ever sees two. */
static ut_controller c;
static ut_plan plan;
static volatile sig_atomic_t steps, torn, changes, accepted, refused, wrong;

static void fast(void)
{
    static const ut_real q[UT_N] = {0.0, 0.01};
    ut_real u[UT_M];
    const int status = ut_step(&c, q, u);
    if (status & UT_SWITCHED) {
        changes++;
    }
    if (status & UT_FALLBACK) {
        torn++;
    }
    const ut_plan *used = &c.slot[c.taken];
    for (int k = 0; k < UT_ROWS; k++) {
        if (used->row[k].surface[1] != used->row[0].surface[1] ||
            used->row[k].eta[0] != -10 * used->row[0].surface[1]) {
            torn++;
        }
    }
    steps++;
}

static void slow(void)
{
    const double size = 1 + (double)(plan.number % 97) / 97;
    for (int k = 0; k < UT_ROWS; k++) {
        plan.row[k].surface[1] = -size;
        plan.row[k].eta[0] = 10 * size;
    }
    plan.number++;
    ut_plan_seal(&plan);
    const int verdict = ut_offer(&c, &plan);
    accepted += verdict == UT_ACCEPTED;
    refused += verdict == UT_BUSY;
    wrong += verdict != UT_ACCEPTED && verdict != UT_BUSY;
}

static void handler(int signum)
{
    (void)signum;
    HANDLER();
}

int main(void)
{
    struct itimerval every = {{0, 50}, {0, 50}};
    plan = ut_built_in;
    for (int k = 0; k < UT_ROWS; k++) {
        plan.row[k] = plan.row[0];
        plan.start[k] = (unsigned long)k;
    }
    plan.count = UT_ROWS;
    ut_init(&c);
    slow();
    signal(SIGALRM, handler);
    setitimer(ITIMER_REAL, &every, NULL);
    for (unsigned long n = 0; accepted < 2000 && n < 2000000000UL; n++) {
        MAIN();
    }
    printf("%d %d %d %d %d %d\n", (int)accepted, (int)refused, (int)steps, (int)changes, (int)torn,
           (int)wrong);
    return torn != 0 || wrong != 0;
}
"""


@pytest.mark.parametrize(
    ("handler", "main"), rest_slow([("fast", "slow"), ("slow", "fast")], ("slow", "fast"))
)
def test_plans_are_exchanged_whole_under_interruption(
    handler: str, main: str, tmp_path: Path
) -> None:
    """One side interrupts the other at any instant: never is a mixed plan in use."""
    controller = replace(exported(), rows=16)
    build = Build(controller, tmp_path)
    (tmp_path / "interrupted.c").write_text(INTERRUPTED)
    sides = (f"-DHANDLER={handler}", f"-DMAIN={main}")
    sources = ("rotary_pendulum.c", "interrupted.c")
    done = gcc(tmp_path, "-std=gnu99", "-O2", *sides, *sources, "-lm", "-o", "run")
    assert done.returncode == 0, done.stderr
    ran = subprocess.run(
        [build.folder / "run"], capture_output=True, text=True, check=False, timeout=60
    )
    assert ran.returncode == 0, ran.stdout
    accepted, refused, steps, changes, torn, wrong = map(int, ran.stdout.split())
    assert accepted >= 2000
    assert refused > 0 or handler == "slow"
    assert steps > 1000
    assert changes > 1000
    assert torn == wrong == 0


# -- in the loop ---------------------------------------------------------------------------------


def test_a_process_over_a_pipe_balances_the_realistic_rig(tmp_path: Path) -> None:
    """Show 6: the SRV02 bench from 35°, encoders, friction and delay, positions measured alone."""
    controller = exported()
    start = controller.mechanism.state(phi=math.radians(35))
    rig = RealisticRig(srv02_rig(), start, seed=3)
    with Build(controller, tmp_path).start() as process:
        loop = run_on_rig(process, rig, 4.0)
    assert loop.held
    assert np.abs(rig.truth[1]) < 0.05
    assert np.abs(loop.u).max() <= 15.0
    assert abs(loop.q[0, 1]) > 0.5
    # The same positions through the Python twin give the same outputs.
    twin = Twin(controller)
    for q, u in zip(loop.q[:500], loop.u[:500], strict=True):
        assert np.abs(twin.step(q)[0] - u).max() <= 1e-12 * 15


@pytest.mark.slow
def test_the_model_knows_velocities_sooner_than_a_filter(tmp_path: Path) -> None:
    """A wheeled pendulum is lost to the filtered derivative's lag; the observer holds it."""
    name, held = "wheeled_inverted_pendulum", []
    bench = plausible_rig(LIBRARY[name]())
    for number, step in enumerate((DerivativeStep(), KalmanStep())):
        folder = tmp_path / str(number)
        folder.mkdir()
        build = Build(exported(name, differentiator=step), folder)
        for seed in range(2):
            with build.start() as process:
                held.append(run_on_rig(process, RealisticRig(bench, seed=seed), 6.0).held)
    assert held == [False, False, True, True]


def test_an_observer_that_is_thrown_off_starts_again(tmp_path: Path) -> None:
    """Absurd positions leave no estimate that is no number behind; C and Python agree on it."""
    controller = exported(differentiator=KalmanStep())
    twin = Twin(controller)
    rng = np.random.default_rng(0)
    with Build(controller, tmp_path).start() as process:
        for k in range(300):
            q = 1e-3 * rng.standard_normal(2) + (k % 50 == 0) * rng.uniform(-9e8, 9e8, 2)
            (u, said), (u_twin, said_twin) = process.step(q), twin.step(q)
            assert said == said_twin
            assert np.abs(u - u_twin).max() <= 1e-9 * 15
    assert np.abs(twin.x).max() < 10


def test_without_control_the_rig_falls(tmp_path: Path) -> None:
    """``held`` is no matter of course: on a rig whose input is cut the pendulum falls."""
    controller = exported()
    bench = srv02_rig()
    dead = replace(bench, amplifiers={"voltage": ut.plants.Amplifier(1e-9)})
    with Build(controller, tmp_path).start() as process:
        assert not run_on_rig(process, RealisticRig(dead, seed=0), 2.0).held


# -- names, refusals -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "coordinates", "channel", "parameters", "stem", "prefix"),
    [
        ("math", ("double", "float"), "return", "for while struct", "math_rig", "ut"),
        ("ut_rig", ("ut_x", "UT_N"), "ut_u", "M N X", "ut_rig", "foo"),
        ("Über/pendel", ("θ", "φ"), "main", "α EOF NAN", "Uber_pendel", "ut"),
    ],
)
def test_names_of_a_user_stay_clear_of_c(
    name: str, coordinates: tuple[str, str], channel: str, parameters: str, stem: str, prefix: str,
    tmp_path: Path,
) -> None:  # fmt: skip
    """Keywords, names of headers, of this export and of no ASCII letter: it compiles, and runs."""
    mechanism = bar(name, coordinates, channel, parameters)
    controller = EmbeddedController(mechanism, ut.first_surface(mechanism), prefix=prefix)
    assert Build(controller, tmp_path).self_test()[0]
    assert (tmp_path / f"{stem}.h").exists()
    if coordinates == ("θ", "φ"):
        header = (tmp_path / f"{stem}.h").read_text()
        assert "q[0]  theta" in header
        assert "#define UT_PARAMETER_0_alpha 0.8" in header


def test_parameters_that_are_one_name_in_ascii_are_told_apart(tmp_path: Path) -> None:
    """``θ`` is spelled out, and stands beside ``theta``: their places tell them apart."""
    mechanism = bar("bar", ("x", "y"), "f", "θ theta c")
    controller = EmbeddedController(mechanism, ut.first_surface(mechanism))
    assert Build(controller, tmp_path).self_test()[0]
    header = (tmp_path / "bar.h").read_text()
    assert "#define UT_PARAMETER_0_theta 0.8" in header
    assert "#define UT_PARAMETER_1_theta " in header


@pytest.mark.skipif(shutil.which("arm-none-eabi-gcc") is None, reason="needs arm-none-eabi-gcc")
def test_single_precision_asks_a_small_processor_for_no_double(tmp_path: Path) -> None:
    """On a Cortex-M4 all arithmetic is the FPU's: nothing is emulated."""
    Build(exported(real="float", differentiator=SuperTwistingStep()), tmp_path)
    unit = "rotary_pendulum"
    cpu = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-c")
    subprocess.run(
        ["arm-none-eabi-gcc", *FLAGS, *STRICT, *cpu, f"{unit}.c"], cwd=tmp_path, check=True
    )
    asked = subprocess.run(
        ["arm-none-eabi-nm", "-u", f"{unit}.o"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert set(asked) - {"U"} <= {"sinf", "cosf", "sqrtf", "memcpy"}


def test_far_from_zero_single_precision_rounds_as_the_page_says() -> None:
    """A position of |q| rad is rounded by |q| 2⁻²⁴, its derivative by 4/(2τ + T) times that."""
    far = 2 * math.pi * 100
    bound = 4 / (2 * 0.01 + 0.001) * far * 2.0**-24
    assert bound < 8e-3  # rad/s, as docs/embedded.md has it
    truth = Twin(exported())
    rounded = Twin(exported())
    worst = 0.0
    for k in range(400):
        q = np.array([far + 0.3 * math.sin(0.01 * k), 0.0])
        truth.step(q)
        rounded.step(q.astype(np.float32))
        worst = max(worst, abs(float(truth.x[2] - rounded.x[2])))
    assert 0.1 * bound < worst <= bound


def test_two_controllers_link_into_one_program(tmp_path: Path) -> None:
    """Prefixes keep their names apart, and C++ may include the headers."""
    for name, prefix in (("rotary_pendulum", "one"), ("cart_pendulum", "two")):
        Build(exported(name, prefix=prefix), tmp_path)
    (tmp_path / "main.c").write_text(
        '#include "rotary_pendulum.h"\n#include "cart_pendulum.h"\n'
        "int main(void)\n{\n    static one_controller a;\n    static two_controller b;\n"
        "    one_init(&a);\n    two_init(&b);\n    return ONE_N + TWO_N - 4;\n}\n"
    )
    sources = ["main.c", "rotary_pendulum.c", "cart_pendulum.c"]
    done = gcc(tmp_path, *FLAGS, *STRICT, *sources, "-lm", "-o", "both")
    assert done.returncode == 0, done.stderr
    assert subprocess.run([tmp_path / "both"], check=False).returncode == 0
    names = subprocess.run(
        ["nm", "-g", "--defined-only", "both"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert not re.search(r"\but_", names)


def test_the_example_of_the_page_compiles(tmp_path: Path) -> None:
    """``docs/embedded.md`` shows C that fits the header, and commands that exist."""
    page = (Path(__file__).parents[2] / "docs" / "embedded.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```c\n(.*?)```", page, re.DOTALL)
    Build(exported(), tmp_path)
    needs = (
        "#include <math.h>\nextern double read_arm(void), read_pendulum(void);\n"
        "extern void write_voltage(double u), brake(void), start_timer(void), reply(int verdict);\n"
        "extern int receive(void *plan), restart_pressed(void);\nvoid timer_interrupt(void);\n"
    )
    (tmp_path / "example.c").write_text(needs + code)
    done = gcc(tmp_path, *FLAGS, *STRICT, "-c", "example.c")
    assert done.returncode == 0, done.stderr
    code_of_help, shown, _ = invoke("--help")
    assert code_of_help == 0
    ours = re.sub(r"^fmpy .*", "", page, flags=re.MULTILINE)
    wanted = set(re.findall(r"--[a-z][a-z-]+", ours)) - {"--version"}
    assert wanted <= set(re.findall(r"--[a-z-]+", shown))


def test_bad_requests_are_refused_with_value_and_limit() -> None:
    """Nothing is written for a controller that could not run."""
    rig = LIBRARY["rotary_pendulum"]()
    s = ut.first_surface(rig)
    free = replace(rig, inputs=(ut.Input("voltage", "V"),))
    requests: tuple[tuple[Callable[[], object], str], ...] = (
        (lambda: EmbeddedController(free, s), "with_input_limit"),
        (lambda: EmbeddedController(rig, s, period=0.02), "below 2 ε/k"),
        (lambda: EmbeddedController(rig, s, period=math.nan), "> 0, < 1 s"),
        (lambda: EmbeddedController(rig, s, slew=-1.0), "slew rate"),
        (lambda: EmbeddedController(rig, s, prefix="2x"), "a C name"),
        (lambda: EmbeddedController(rig, s, missed=-1), "0 to 32766"),
        (lambda: EmbeddedController(rig, s, missed=1.5), "a whole number"),  # type: ignore[arg-type]
        (lambda: ut.export_c(rig, s, "never", perid=0.002), "Did you mean period?"),
        (lambda: ut.export_c(rig, s, "never", period="1 ms"), "must be a number"),
        (lambda: ut.export_c(rig, s, "never", differentiator="kalman"), "KalmanStep()"),
        (lambda: EmbeddedController(rig, s, missed=2**15 - 1), "0 to 32766"),
        (lambda: EmbeddedController(rig, three_rows(rig), rows=2), "3 (those of the plan)"),
        (lambda: EmbeddedController(rig, Plan((s, s), (0.0, 1e-4))), "apart"),
        (lambda: EmbeddedController(rig, s, differentiator=DerivativeStep(0.0)), "> 0"),
        (lambda: EmbeddedController(rig, s, differentiator=KalmanStep(-1.0)), "position_noise"),
        (lambda: EmbeddedController(rig, Plan((s, s), (0.0, 1e7))), "2^32"),
        (
            lambda: KalmanStep().gains(LIBRARY["wheeled_inverted_pendulum"](), 0.01),
            "below 0.00829 s, twice the time constant",
        ),
    )
    for build, words in requests:
        with pytest.raises(InvalidInputError, match=re.escape(words)):
            build()


def test_expressions_that_c_does_not_know_are_refused() -> None:
    """A model with a function beyond math.h says so, and numbers beyond single precision."""
    x = sp.Symbol("x", real=True)
    tape = Tape()
    with pytest.raises(ModelError, match=r"math\.h"):
        C99Emitter(tape, {}).statements({"y": tape.let(sp.besselj(0, x))})
    with pytest.raises(ModelError, match="single precision"):
        literal(1e300, "float")
    assert literal(1e-300, "float") == "1.1754944e-38f"


def test_printed_expressions_are_those_of_numpy(tmp_path: Path) -> None:
    """Powers, roots, signs, cases, constants: C and NumPy at the same numbers."""
    x, y = sp.symbols("x y", real=True)
    expressions = [
        x**2 * y - y**-3,
        sp.sqrt(1 + x**2) / sp.sqrt(2 + y**2),
        (x**2 + 1) ** sp.Rational(1, 3),
        sp.Max(x, y, sp.Rational(1, 3)) - sp.Min(x, -y),
        sp.sign(x) * sp.Abs(y) + sp.pi * sp.E,
        sp.Piecewise((x, x > y), (y**2, sp.And(x < 0, y > 0)), (sp.Float(0.5), True)),
        sp.tanh(x) + sp.exp(-(y**2)) + sp.atan2(x, y) + sp.tan(x / 2),
        sp.sin(x + y) * sp.cos(x + y) - sp.cos(3 * x),
    ]
    helpers = (
        "static double ut_max(double a, double b) { return a > b ? a : b; }\n"
        "static double ut_min(double a, double b) { return a < b ? a : b; }\n"
        "static double ut_sign(double a) { return (a > 0) - (a < 0); }\n"
    )
    tape = Tape()
    laid = tape.let_all(expressions)
    body = C99Emitter(tape, {x: "v[0]", y: "v[1]"}).statements(
        {f"out[{i}]": e for i, e in enumerate(laid)}
    )
    (tmp_path / "e.c").write_text(
        "#include <math.h>\n#include <stdio.h>\ntypedef double ut_real;\n"
        f"{helpers}int main(void)\n{{\n    double v[2], out[{len(laid)}];\n"
        '    while (scanf("%lf %lf", v, v + 1) == 2) {\n'
        f"{body}\n"
        f"        for (int i = 0; i < {len(laid)}; i++)\n"
        '            printf("%.17g ", out[i]);\n        printf("\\n");\n    }\n    return 0;\n}\n'
    )
    done = gcc(tmp_path, *FLAGS, "e.c", "-lm", "-o", "e")
    assert done.returncode == 0, done.stderr
    points = np.random.default_rng(0).uniform(-2, 2, (50, 2))
    text = "\n".join(f"{a!r} {b!r}" for a, b in points.tolist())
    ran = subprocess.run([tmp_path / "e"], input=text, capture_output=True, text=True, check=True)
    got = np.array([line.split() for line in ran.stdout.splitlines()], dtype=float)
    expected = [sp.lambdify((x, y), e, "numpy")(*points.T) for e in expressions]
    assert np.allclose(got, np.array(expected).T, rtol=1e-13, atol=1e-14)


def test_missing_tools_and_broken_c_are_said(tmp_path: Path) -> None:
    """No compiler: what to install. C that does not compile: the first complaint."""
    with pytest.raises(MissingExtraError, match="Install no-such-compiler"):
        tool("no-such-compiler")
    controller = exported()
    for name, content in written(controller).items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "rotary_pendulum.c").write_text("int x = ;\n")
    with pytest.raises(ArtefactError, match="expected expression"):
        Build(controller, tmp_path).self_test()


def test_a_process_that_ends_is_noticed(tmp_path: Path) -> None:
    """No answer on the pipe is an error, not a wait."""
    with Build(exported(), tmp_path).start() as process:
        process._process.kill()
        process._process.wait()
        with pytest.raises(ArtefactError, match="no answer"):
            process.step([0.0, 0.0])


# -- the command line ----------------------------------------------------------------------------


def invoke(*words: str, columns: int = 120) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["export", "c", *words], env={"COLUMNS": str(columns)})
    return result.exit_code, result.stdout, result.stderr


def test_command_writes_tests_and_says_so(tmp_path: Path) -> None:
    """Files in the folder, its own test passed, ASCII alone; the same request, the same bytes."""
    out = tmp_path / "firmware"
    request = ("rotary_pendulum", "--velocity", "super-twisting", "--slew", "400", "--check")
    code, said, _ = invoke(*request, "--out", str(out))
    assert code == 0
    assert "0 failed" in said
    written = {path.name: path.read_bytes() for path in out.iterdir()}
    assert set(written) == {
        "rotary_pendulum" + end for end in (".c", ".h", "_test.c", "_vectors.h", "_pipe.c")
    }
    assert all(content.isascii() for content in written.values())
    header = written["rotary_pendulum.h"].decode()
    assert "theta  rad  arm angle about the vertical" in header
    assert "voltage, at most 15 V, 400 V/s" in header
    invoke(*request[:-1], "--out", str(tmp_path / "again"))
    assert written == {p.name: p.read_bytes() for p in (tmp_path / "again").iterdir()}


def test_the_header_of_a_file_says_where_zero_is_and_what_inputs_count_in(tmp_path: Path) -> None:
    """Two targets of one file are two headers, with what a joint's input counts in."""
    file = tmp_path / "cart.urdf"
    file.write_text(
        """<robot name="cart"><link name="rail"/>
  <link name="cart"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial></link>
  <link name="bar"><inertial><origin xyz="0 0 0.3"/><mass value="0.3"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001"/></inertial></link>
  <joint name="x" type="prismatic"><parent link="rail"/><child link="cart"/>
    <axis xyz="1 0 0"/></joint>
  <joint name="tilt" type="continuous"><parent link="cart"/><child link="bar"/>
    <axis xyz="0 1 0"/></joint></robot>"""
    )
    code, _, error = invoke(f"{file}:x", "--out", str(tmp_path / "unlimited"))
    assert code
    assert "--limit x_force=10" in error
    for target, place in (("upright", "tilt = 0 deg"), ("hanging", "tilt = 180 deg")):
        out = tmp_path / target
        code, _, _ = invoke(f"{file}:x@{target}", "--limit", "x_force=7", "--out", str(out))
        assert code == 0
        header = (out / "cart.h").read_text(encoding="ascii")
        assert f"x = 0 m, {place} of the file" in header
        assert "x_force on x" in header
        assert "u[0]  x_force, at most 7 N\n" in header


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ((), "neither a name nor --all"),
        (("rotary_pendulum", "--all", "--check"), "a name and --all"),
        (("rotary_pendulum",), "none of --out"),
        (("rotary_pendulum", "--check", "--period", "0.05"), "below 2 ε/k"),
        (("rotary_pendulum", "--check", "--compiler", "no-such-cc"), "Install no-such-cc"),
        (("piano", "--check"), "'piano'"),
    ],
)
def test_command_refuses(words: tuple[str, ...], part: str) -> None:
    """One line, with value and limit."""
    code, _, error = invoke(*words)
    assert code in (1, 2)
    assert error.startswith("error: ")
    assert part in error


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("valgrind") is None, reason="needs valgrind")
def test_report_counts_instructions_and_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``--report`` prints a row with agreement, instructions and sizes, and keeps it as CSV.

    Of what users get: optimised.
    """
    monkeypatch.setattr(host, "FLAGS", FLAGS)
    code, said, _ = invoke(
        "rotary_pendulum", "--report", "--states", "1000", "--out", str(tmp_path), columns=80
    )
    assert code == 0
    assert "Instructions of a step" in said
    (row,) = csv.DictReader((tmp_path / "report.csv").read_text().splitlines())
    assert row["mechanism"] == "rotary_pendulum"
    assert 200 < int(row["instr."]) < 1000
    assert max(len(line) for line in said.splitlines() if "Written" not in line) <= 80


@pytest.mark.parametrize(
    "words",
    rest_slow(["*\\ #error run /*", "/* */*/", "????/ \\", "kg/*m**/ ???"], "/* */*/"),
)
def test_words_of_a_user_stay_in_their_comment(words: str, tmp_path: Path) -> None:
    """Names, units and descriptions neither end a comment nor begin one: the C compiles."""
    plain = ut.mechanisms.cart_pendulum()
    parameters = tuple(replace(p, unit=words, description=words) for p in plain.parameters)
    odd = replace(plain, name=f"x {words}", parameters=parameters, description=words)
    controller = EmbeddedController(odd, ut.first_surface(plain), ut.ReachingLaw())
    passed, said = Build(controller, tmp_path).self_test()
    assert passed, said
