"""Generated kernels compute what the formulas say, and are compiled once."""

from __future__ import annotations

import errno
import hashlib
import math
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numba
import numpy as np
import pytest
import sympy as sp
from numba.core.caching import IndexDataCacheFile

import undertow as ut
from support import (
    SHAPES,
    interpreted,
    random_mechanism,
    random_states,
    random_surface,
    rest_slow,
    runge_kutta,
)
from undertow.base import ArtefactError
from undertow.closed_loop.kernel import LoopEquations, build_loop_graph
from undertow.closed_loop.kernel_source import _hoist, kernel_source
from undertow.law import Switching
from undertow.models import TIME, FloatArray
from undertow.symbolic import store

#: States to the values of all formulas there.
Evaluate = Callable[[FloatArray], dict[str, FloatArray]]

# -- single formulas -------------------------------------------------------------------------

FORMULAS = {
    "sin": lambda v: sp.sin(v.theta),
    "cos": lambda v: sp.cos(v.theta),
    "sine of a sum": lambda v: sp.sin(2 * v.theta - v.phi) * sp.cos(v.theta),
    "powers": lambda v: v.phi**3 - 2 / (1 + v.phi**2) + sp.Rational(-1, 3) * v.phi,
    "roots": lambda v: sp.sqrt(1 + v.phi**2) + 1 / sp.sqrt(2 + v.phi**2),
    "real power": lambda v: (1 + v.phi**2) ** sp.Float(0.7),
    "extremes": lambda v: sp.Max(v.phi, v.phi_dot, 0.5) - sp.Min(v.phi, v.phi_dot, 0),
    "sign and modulus": lambda v: sp.sign(v.phi) * sp.Abs(v.phi_dot) - sp.sign(v.phi_dot - 1),
    "hyperbolic": lambda v: sp.tanh(v.phi) + sp.exp(-(v.phi**2)) + sp.log(1 + v.phi**2),
    "cases": lambda v: sp.Piecewise((v.phi, v.phi > v.phi_dot), (v.phi_dot**2, True)),
    "parameters": lambda v: v.r_o / v.l * v.phi,
}


@pytest.fixture(scope="module")
def evaluate(rig: ut.Mechanism, base: ut.Surface) -> Evaluate:
    """A kernel that returns the formulas at states: margins of path constraints at the start."""

    def constraint(name: str) -> ut.Constraint:
        return ut.Constraint(name, lambda v: -FORMULAS[name](v))

    objective = ut.Objective(
        "formulas", lambda v: v.phi**2, constraints=tuple(constraint(name) for name in FORMULAS)
    )
    loop = ut.ClosedLoop(rig, objective)

    def margins(x: FloatArray) -> dict[str, FloatArray]:
        path = loop.batch(x, [base], duration=loop.step).path
        return dict(zip(FORMULAS, path.T, strict=True))

    return margins


@pytest.mark.parametrize(
    ("reach", "limit"),
    [
        (0.8, 2.5e-16),
        pytest.param(10.0, 4e-16, marks=pytest.mark.slow),
        (1e3, 4e-16),
        pytest.param(1e5, 2e-15, marks=pytest.mark.slow),
    ],
)
def test_inlined_sine_and_cosine_are_accurate(
    evaluate: Evaluate, reach: float, limit: float
) -> None:
    """The polynomials agree with the system's sine and cosine to a few units in the last place."""
    angles = np.random.default_rng(0).uniform(-reach, reach, 50_000)
    quadrants = np.arange(-40, 41) * (math.pi / 4)  # the seams between polynomials
    seams = np.concatenate([np.nextafter(quadrants, s) for s in (-np.inf, 0, np.inf)])
    angles = np.concatenate([angles, seams[np.abs(seams) <= reach]])
    x = np.zeros((len(angles), 4))
    x[:, 0], x[:, 3] = angles, 1.0  # outside the terminal set, where nothing is evaluated
    values = evaluate(x)
    assert np.abs(values["sin"] - np.sin(angles)).max() <= limit
    assert np.abs(values["cos"] - np.cos(angles)).max() <= limit


def test_sine_keeps_its_relative_accuracy_near_the_target(evaluate: Evaluate) -> None:
    angles = np.concatenate([np.logspace(-300, -1, 500), -np.logspace(-300, -1, 500)])
    x = np.zeros((len(angles), 4))
    x[:, 0], x[:, 3] = angles, 1.0  # outside the terminal set, where nothing is evaluated
    np.testing.assert_allclose(evaluate(x)["sin"], np.sin(angles), rtol=3e-16, atol=0)


@pytest.mark.parametrize("name", FORMULAS)
def test_compiled_formulas_equal_sympys(evaluate: Evaluate, name: str, rig: ut.Mechanism) -> None:
    x = random_states(rig, 48, seed=2)
    x[:3, 1] = 0.0
    x[3, 1] = x[3, 3]  # on the seam of the cases
    formula = sp.sympify(FORMULAS[name](ut.objective.objective.Names(rig))).subs(rig.substitution)
    expected = [float(formula.subs(dict(zip(rig.x, row, strict=True)))) for row in x]
    np.testing.assert_allclose(evaluate(x)[name], expected, rtol=1e-13, atol=1e-14)


# -- whole closed loops, any n and m ---------------------------------------------------------


LOOPS = [(n, m, "saturation") for n, m in SHAPES] + [
    (n, m, switching) for n, m in ((2, 1), (4, 2)) for switching in ("tanh", "sign")
]
SOME = {(2, 1, "saturation"), (2, 1, "tanh")}


@pytest.mark.parametrize(
    ("n", "m", "switching"),
    rest_slow(LOOPS, *SOME),
)
def test_continuous_kernels_step_as_runge_kutta_in_numpy_does(
    n: int, m: int, switching: Switching
) -> None:
    """Same method, same step, same law: agreement to rounding, with gains (13) at work."""
    mechanism = random_mechanism(n, m).with_disturbance_bounds(*(0.1,) * n)
    surface, x0 = random_surface(n, m), random_states(mechanism, 1, position=0.3, speed=0.3)[0]
    reaching = ut.ReachingLaw(eta=tuple(4.0 + i for i in range(m)), layer=0.4, switching=switching)
    loop = interpreted(ut.ClosedLoop(mechanism, reaching=reaching, step=0.002))
    run = loop.simulate(x0, surface, duration=0.012, terminal=0.0)
    law = ut.SlidingModeLaw(mechanism, surface, reaching)
    expected = runge_kutta(mechanism, lambda t, x: law(t, x).u, x0, 0.002, 6)
    np.testing.assert_allclose(run.x, expected, rtol=1e-10, atol=1e-12)
    recorded = law(0.0, expected[:-1])
    np.testing.assert_allclose(run.u[:-1], recorded.u, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(run.s[:-1], recorded.s, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(run.margin[:-1], recorded.margin, rtol=1e-10)


@pytest.mark.parametrize(("n", "m"), rest_slow(SHAPES, (2, 1), (3, 2)))
def test_sampled_kernels_hold_the_input_of_a_belief_that_is_wrong(n: int, m: int) -> None:
    """Zero-order hold, noise, another plant with a disturbance in time: still the same numbers."""
    belief, surface = random_mechanism(n, m), random_surface(n, m)
    plant = belief.with_parameters(scale=1.6, friction=0.2).disturbed(
        {"q0": 0.5 * sp.cos(30 * TIME), f"q{n - 1}": -0.2 * sp.sin(20 * TIME)}
    )
    x0 = random_states(belief, 1, position=0.3, speed=0.3)[0]
    noise = 0.01 * np.random.default_rng(8).standard_normal((5, 2 * n))
    reaching = ut.ReachingLaw(eta=5.0, layer=0.5)
    loop = interpreted(
        ut.ClosedLoop(belief, reaching=reaching, plant=plant, step=0.002, zoh_steps=3)
    )
    run = loop.simulate(x0, surface, duration=0.024, terminal=0.0, noise=noise, start=0.3)
    law = ut.SlidingModeLaw(belief, surface, reaching)

    def sampled(t: float, x: FloatArray) -> FloatArray:
        return law(t, x + noise[round((t - 0.3) / 0.006)]).u

    expected = runge_kutta(plant, sampled, x0, 0.002, 12, hold=3, start=0.3)
    np.testing.assert_allclose(run.x, expected, rtol=1e-10, atol=1e-12)
    assert run.t[0] == 0.3
    assert len(np.unique(run.u[:-1], axis=0)) == 4


@pytest.mark.parametrize("many_plants", [False, True])
@pytest.mark.parametrize("wrong", [False, True])
@pytest.mark.parametrize("hard_input", [False, True])
def test_lines_are_computed_as_seldom_as_they_may(
    many_plants: bool, wrong: bool, hard_input: bool
) -> None:
    """What parameters alone decide once a call, what the surface decides once a surface.

    And of either only what something later reads.
    """
    belief = ut.mechanisms.reaction_wheel_pendulum().with_disturbance_bounds(0.1, 0.1)
    plant = belief if wrong or many_plants else None
    objective = ut.MinimumEnergy(hard_input=hard_input)
    loop = LoopEquations(belief, plant, objective, "tanh", many_plants=many_plants)
    program = build_loop_graph(loop)
    calls = {*program.plant_parameters, *program.belief_parameters, *program.limits}
    lanes = {*program.lane_inputs}
    outputs = [*program.demand, *program.s, program.singular, *program.derivative, program.stage]
    outputs += [program.input_margin] if program.input_margin is not None else []
    live = program.tape.live(outputs)
    bases: dict[sp.Basic, set[sp.Basic]] = {}
    read_by: dict[sp.Basic, set[str]] = {}
    levels: dict[sp.Basic, str] = {}
    for line in live:
        read = line.expression.free_symbols
        bases[line.symbol] = set().union(*(bases.get(s, {s}) for s in read))
        under = bases[line.symbol]
        levels[line.symbol] = (
            "call" if under <= calls else "lane" if under <= calls | lanes else "state"
        )
        for symbol in read:
            read_by.setdefault(symbol, set()).add(levels[line.symbol])
    for output in outputs:
        for symbol in sp.sympify(output).free_symbols:
            read_by.setdefault(symbol, set()).add("state")
    of_call, of_lane = _hoist(program)
    assert of_lane
    assert of_call or (many_plants and not wrong)
    assert set(of_call) == {
        s for s, level in levels.items() if level == "call" and read_by[s] & {"lane", "state"}
    }
    assert set(of_lane) == {
        s for s, level in levels.items() if level == "lane" and "state" in read_by[s]
    }
    order = [line.symbol for line in live]
    assert of_call == sorted(of_call, key=order.index)
    assert of_lane == sorted(of_lane, key=order.index)


# -- files -----------------------------------------------------------------------------------


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("UNDERTOW_CACHE", str(tmp_path / "kernels"))
    return tmp_path / "kernels"


def test_the_same_source_is_the_same_module(folder: Path) -> None:
    source = f"value = {os.getpid()}.25\n"
    first = store.load_module("proof", source)
    assert store.load_module("proof", source) is first
    assert first.value == os.getpid() + 0.25
    assert Path(str(first.__file__)).parent == folder
    other = store.load_module("proof", source + "\n")
    assert other is not first
    assert len(list(folder.glob("*.py"))) == 2
    assert not list(folder.glob("*.tmp"))


def test_a_damaged_file_is_written_again(folder: Path) -> None:
    source = f"value = {os.getpid()}.5\n"
    module = store.load_module("damaged", source)
    path = Path(str(module.__file__))
    path.write_text("value = ", encoding="utf-8")
    del sys.modules[module.__name__]
    assert store.load_module("damaged", source).value == os.getpid() + 0.5
    assert path.read_text(encoding="utf-8") == source


def full(*_: object) -> None:
    """Answer as a full disk does."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_is_told_and_leaves_no_half_file(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(ArtefactError, match=r"No space left.*UNDERTOW_CACHE=FOLDER"):
        store.load_module("full", f"value = {os.getpid()}.75\n")
    assert not list(folder.iterdir())


COMPILED = """from undertow.symbolic.compiler import compiled
@compiled()
def half(x):
    return 0.5 * x
"""


@pytest.mark.parametrize("kept", ["nbi", "nbc"])
def test_machine_code_that_is_cut_off_is_compiled_again(folder: Path, kept: str) -> None:
    """A disk that was full, a power that was lost; numba ended every later start."""

    def again() -> tuple[bool, Path]:
        module = store.load_module("cut", COMPILED)
        del sys.modules[module.__name__]
        assert module.half(3.0) == 1.5
        (path,) = folder.rglob(f"*.{kept}")
        return bool(module.half.stats.cache_hits), path

    read, path = again()
    assert not read
    path.write_bytes(path.read_bytes()[:20])
    assert not again()[0]
    assert again()[0]


def test_machine_code_that_finds_no_room_is_used_all_the_same(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(IndexDataCacheFile, "save", full)
    assert store.load_module("room", f"# {os.getpid()}\n{COMPILED}").half(3.0) == 1.5


def test_a_folder_that_cannot_be_made_is_no_obstacle(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("in the way", encoding="utf-8")
    monkeypatch.setenv("UNDERTOW_CACHE", str(blocked / "kernels"))
    assert store.load_module("homeless", f"value = {os.getpid()}\n").value == os.getpid()


def test_changed_numbers_need_no_new_kernel_and_changed_formulas_do(rig: ut.Mechanism) -> None:
    kernel = ut.ClosedLoop(rig)._kernels.rollout
    numbers = rig.with_parameters(d_e=0.05, m=0.2).with_input_limit(3.0)
    assert ut.ClosedLoop(numbers)._kernels.rollout is kernel
    assert (
        ut.ClosedLoop(rig, step=0.001, reaching=ut.ReachingLaw(9.0, 0.3))._kernels.rollout is kernel
    )
    assert ut.ClosedLoop(rig, ut.MinimumEnergy(horizon=5.0))._kernels.rollout is kernel
    others = [
        ut.ClosedLoop(rig, ut.MinimumTime()),
        ut.ClosedLoop(rig, ut.MinimumEnergy(state_weight=0.1)),
        ut.ClosedLoop(rig, reaching=ut.ReachingLaw(switching="tanh")),
        ut.ClosedLoop(rig, zoh_steps=2),
        ut.ClosedLoop(rig.disturbed({"phi": 0.01})),
        ut.ClosedLoop(rig, plant=numbers),
        ut.ClosedLoop(rig.with_disturbance_bounds(0.1, 0.0)),
    ]
    kernels = {loop._kernels.rollout for loop in others} | {kernel}
    assert len(kernels) == len(others) + 1


SOURCE_HASH = """
import errno
import hashlib
import undertow as ut
from undertow.closed_loop.kernel_source import kernel_source
from undertow.base import ArtefactError
from undertow.closed_loop.kernel import LoopEquations, build_loop_graph
rig = ut.mechanisms.rotary_pendulum()
other = rig.with_parameters(m=0.2)
program = build_loop_graph(LoopEquations(rig, other, ut.MinimumEnergy(), "saturation"))
print(hashlib.sha256(kernel_source(program, header="").encode()).hexdigest())
"""


@pytest.mark.slow
def test_source_does_not_depend_on_the_order_of_hashing() -> None:
    """Another process, with another hash seed, writes the same file: its kernel is cached."""
    environment = os.environ | {"PYTHONHASHSEED": "1"}
    printed = subprocess.run(
        [sys.executable, "-c", SOURCE_HASH],
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    rig = ut.mechanisms.rotary_pendulum()
    other = rig.with_parameters(m=0.2)
    program = build_loop_graph(LoopEquations(rig, other, ut.MinimumEnergy(), "saturation"))
    source = kernel_source(program, header="")
    assert hashlib.sha256(source.encode()).hexdigest() == printed


def test_lane_loops_have_no_branches_and_the_source_fits_the_block() -> None:
    """Inside a lane loop everything is an expression: that is what lets it be vectorised."""
    rig = ut.mechanisms.rotary_pendulum()
    loop = LoopEquations(rig, None, ut.MinimumEnergy(), "saturation")
    source = kernel_source(build_loop_graph(loop), header="")
    lines = source.splitlines()
    heads = [i for i, line in enumerate(lines) if re.match(r"\s*for i(__\d+)? in range\(", line)]
    assert len(heads) >= 18
    for head in heads:
        depth = len(lines[head]) - len(lines[head].lstrip())
        for line in lines[head + 1 :]:
            if line.strip() and len(line) - len(line.lstrip()) <= depth:
                break
            assert not line.strip().startswith(("if ", "for ", "while ", "break", "continue"))


@pytest.mark.slow  # what is read from the cache shows no assembly: compiled for this alone
@pytest.mark.skipif(platform.machine() != "x86_64", reason="reads x86-64 instructions")
def test_lane_loops_are_compiled_to_vectors() -> None:
    """The arithmetic of a step is packed: what is left as scalars runs once a block or a call."""
    rig = ut.mechanisms.rotary_pendulum()
    loop = ut.ClosedLoop(rig)
    loop.batch(rig.state(phi=0.1), [ut.first_surface(rig)], duration=0.01)
    cached = loop._kernels.rollout
    options = {k: cached.targetoptions[k] for k in ("nogil", "error_model", "fastmath")}
    kernel = numba.njit(**options)(cached.py_func)  # a cached one shows no assembly
    kernel.compile(next(iter(cached.signatures)))
    (code,) = kernel.inspect_asm().values()

    def count(pattern: str) -> int:
        return len(re.findall(rf"\tv?{pattern}\s", code))

    products = "(mul|fn?m(add|sub)[0-9]*)"
    assert count(products + "pd") > 150
    assert count(products + "sd") <= 0.15 * count(products + "pd")


@pytest.mark.parametrize(
    ("parameter", "coordinate"),
    rest_slow([("d_1", "b"), ("h", "W"), ("v0", "step"), ("limit_0", "noise")], ("h", "W")),
)
def test_names_of_users_meet_no_variable_of_the_kernel(parameter: str, coordinate: str) -> None:
    """A mechanism may call its parameters and coordinates what the kernel calls its own."""

    def cost(parameter: str, coordinate: str) -> float:
        mass = ut.Parameter(parameter, 0.125, "kg", low=0)
        arm, rod = ut.Coordinate("arm"), ut.Coordinate(coordinate)
        w, p, p_dot, m = arm.velocity, rod.symbol, rod.velocity, mass.symbol
        mechanism = ut.Mechanism.from_energies(
            "names",
            [arm, rod],
            [ut.Input("torque", "N m", 15.0)],
            kinetic=(0.0036 + 0.046 * m) * w**2 / 2
            - 0.0045 * sp.cos(p) * w * p_dot
            + 0.0047 * p_dot**2 / 2,
            potential=0.2 * sp.cos(p),
            parameters=(mass,),
        )
        surface = ut.first_surface(mechanism)
        loop = interpreted(ut.ClosedLoop(mechanism, step=0.005))
        return loop.simulate(mechanism.state(**{coordinate: 0.4}), surface, duration=0.2).cost

    assert cost(parameter, coordinate) == pytest.approx(cost("mass", "phi"), rel=1e-12)
