"""Starting again: what was derived and generated once is found, and never taken for another's."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp

import undertow as ut
import undertow.cascade.swing_up.search
import undertow.runtime.sensors
import undertow.runtime.steps
from undertow.closed_loop import kernel
from undertow.law import stability
from undertow.mechanisms import LIBRARY
from undertow.models import lagrange, linearise, numbers
from undertow.symbolic import store

PACKAGE = Path(ut.__file__).parent


@pytest.fixture(autouse=True)
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A cache folder of one's own, and nothing in memory."""
    monkeypatch.setenv("UNDERTOW_CACHE", str(tmp_path))
    monkeypatch.setattr("undertow.models.mechanism._derived", lagrange.derived)
    kernel.compile_loop.cache_clear()
    yield tmp_path
    kernel.compile_loop.cache_clear()


def derivations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the mechanisms that are derived afresh from now on."""
    names: list[str] = []
    original = lagrange.quadratic_form

    def counted(name: str, *rest: Any) -> Any:
        names.append(name)
        return original(name, *rest)

    monkeypatch.setattr(lagrange, "quadratic_form", counted)
    return names


def generations(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the mechanisms whose loop is written afresh from now on."""
    names: list[str] = []
    original = kernel.build_loop_graph

    def counted(loop: kernel.LoopEquations) -> Any:
        names.append(loop.belief.name)
        return original(loop)

    def not_compiled(name: str, source: str) -> Any:
        return type("Module", (), {"rollout": staticmethod(lambda: source)})

    monkeypatch.setattr(kernel, "build_loop_graph", counted)
    monkeypatch.setattr(store, "load_module", not_compiled)
    return names


def source(*arguments: Any) -> str:
    """Source of a kernel as a new process would find or write it."""
    kernel.compile_loop.cache_clear()
    return str(kernel.compile_loop(kernel.LoopEquations(*arguments)).rollout())


# -- equations -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_equations_from_disk_are_the_derived_ones(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: a second start derives nothing, and M, f and the generated code are the same."""
    names = derivations(monkeypatch)
    first = LIBRARY[name]()
    assert names == [name]
    second = LIBRARY[name]()
    assert names == [name]
    assert second.mass_matrix == first.mass_matrix
    assert second.force == first.force
    assert second.fingerprint == first.fingerprint


def oscillators(stiffness: float = 2.0, coupling: float = 0.5, *, turned: bool = False) -> None:
    a, b = ut.Coordinate("a", "m"), ut.Coordinate("b", "m")
    order = [b, a] if turned else [a, b]
    ut.Mechanism.from_energies(
        "pair",
        order,
        [ut.Input("force", "N", 1.0)],
        kinetic=a.velocity**2 + coupling * a.velocity * b.velocity + b.velocity**2,
        potential=stiffness * (a.symbol - b.symbol) ** 2,
    )


def test_a_changed_energy_never_finds_the_old_equations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: energies, order of coordinates, this file's text and versions are all in the key."""
    names = derivations(monkeypatch)
    oscillators()
    oscillators()
    assert len(names) == 1
    oscillators(stiffness=2.0 + 1e-15)
    oscillators(coupling=0.5000001)
    oscillators(turned=True)
    assert len(names) == 4
    monkeypatch.setattr(sp, "__version__", "0.0")
    oscillators()
    assert len(names) == 5


def test_a_changed_source_file_never_finds_the_old_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: the key follows the name and the text of every file of the package."""
    monkeypatch.setattr(store, "PACKAGE", tmp_path)
    (tmp_path / "law").mkdir()
    file = tmp_path / "law" / "rule.py"
    keys = set()

    def note(*texts: str) -> None:
        store.sources_digest.cache_clear()
        keys.add(store.content_key(*texts))

    try:
        note("x")
        for text in ("a = 1\n", "a = 2\n"):
            file.write_text(text)
            note("x")
        file.rename(tmp_path / "rule.py")
        note("x")
        note("ab", "c")
        note("a", "bc")
    finally:
        store.sources_digest.cache_clear()
    assert len(keys) == 6


@pytest.mark.parametrize("damage", ["", "not equations", "other key"])
def test_a_damaged_file_is_derived_again(
    damage: str, empty_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: files that are cut off, changed, or sealed for another key are not used."""
    names = derivations(monkeypatch)
    oscillators()
    (path,) = empty_cache.glob("equations_*.txt")
    good = path.read_text(encoding="utf-8")
    text = good.partition("\n")[2]
    broken = {
        "": good[:-20],
        "not equations": f"{good.partition(chr(10))[0]}\nhello",
        "other key": f"{store._seal('another', text)}\n{text}",
    }
    path.write_text(broken[damage], encoding="utf-8")
    oscillators()
    assert len(names) == 2
    assert path.read_text(encoding="utf-8") == good


# -- kernels -------------------------------------------------------------------------------------


def test_kernels_of_a_second_start_are_not_written_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: same equations and options find the same source; values are arguments of it."""
    names = generations(monkeypatch)
    rig, goal = ut.mechanisms.rotary_pendulum(), ut.MinimumEnergy()
    first = source(rig, None, goal, "saturation", False)
    again = source(ut.mechanisms.rotary_pendulum(), None, goal, "saturation", False)
    heavier = source(rig.with_parameters(m=0.2), None, goal, "saturation", False)
    stronger = source(rig.with_input_limit(3.0), None, goal, "saturation", False)
    assert first == again == heavier == stronger
    assert len(names) == 1


def test_a_changed_loop_never_finds_an_old_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: whatever changes the source changes the key: one new file for each change."""
    names = generations(monkeypatch)
    rig, goal = ut.mechanisms.rotary_pendulum(), ut.MinimumEnergy()
    windy = rig.disturbed({"phi": sp.Rational(1, 100)})
    boxed = replace(goal, constraints=ut.state_box(theta=1.0))
    wider = replace(goal, constraints=ut.state_box(theta=2.0))
    bounded = rig.with_disturbance_bounds(0.0, 0.1)
    loops: list[tuple[Any, ...]] = [
        (rig, None, goal, "saturation", False),
        (rig, None, goal, "saturation", True),
        (rig, None, goal, "tanh", False),
        (rig, rig, goal, "saturation", False),
        (rig, rig, goal, "saturation", False, True),
        (rig, windy, goal, "saturation", False),
        (windy, None, goal, "saturation", False),
        (bounded, None, goal, "saturation", False),
        (rig.with_disturbance_bounds(0.0, 0.2), None, goal, "saturation", False),
        (rig, None, ut.MinimumTime(), "saturation", False),
        (rig, None, replace(goal, state_weight=0.1), "saturation", False),
        (rig, None, replace(goal, hard_input=True), "saturation", False),
        (rig, None, boxed, "saturation", False),
        (rig, None, wider, "saturation", False),
        (ut.mechanisms.cart_pendulum(), None, goal, "saturation", False),
    ]
    sources = [source(*loop) for loop in loops]
    assert len(names) == len(loops) == len(set(sources))
    assert [source(*loop) for loop in loops] == sources
    assert len(names) == len(loops)


# -- linearisation -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(LIBRARY))
def test_complex_step_equals_symbolic_derivatives(name: str) -> None:
    """Claim: F and D of the linearisation are those of SymPy, to rounding."""
    m = LIBRARY[name]()
    origin = dict.fromkeys(m.x, 0)
    exact = numbers(m.force.jacobian(list(m.x)).subs(origin).subs(m.substitution))
    lin = linearise(m)
    np.testing.assert_allclose(np.hstack([lin.F, lin.D]), exact, rtol=1e-13, atol=1e-15)


def test_what_is_not_analytic_is_differentiated_by_symbols() -> None:
    """Claim: |v| v is flat at zero and √(v²) v too, where a complex step may err."""
    rig = ut.mechanisms.cart_pendulum()
    v, c = sp.symbols("x_dot phi", real=True)
    drag = rig.disturbed({"x": -sp.Abs(v) * v - 3 * v, "phi": -sp.sqrt(c**2 + 1) * c})
    change = linearise(drag).D - linearise(rig).D
    np.testing.assert_allclose(change, [[-3, 0], [0, 0]], atol=1e-15)
    np.testing.assert_allclose(linearise(drag).F - linearise(rig).F, [[0, 0], [0, -1]], atol=1e-12)
    for name in ("M", "F", "D", "B"):
        np.testing.assert_array_equal(
            getattr(drag.linearise(), name), getattr(linearise(drag), name)
        )


def test_a_known_first_surface_is_not_designed_again(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The kept design has the same bits; for other parameters, weights or rates there is none."""
    monkeypatch.setenv("UNDERTOW_CACHE", str(tmp_path))
    rig = ut.mechanisms.cart_pendulum()
    designed = ut.first_surface(rig)
    assert ut.first_surface(rig, rate=0.5) != designed
    monkeypatch.setattr(stability, "_regular_form", None)  # a second design would fail here
    assert ut.first_surface(rig) == designed
    with pytest.raises(TypeError):
        ut.first_surface(rig, rate=0.5)
    with pytest.raises(TypeError):
        ut.first_surface(rig.with_parameters(m_p=0.1234))


def _assigned_arrays(source: str) -> Iterator[str]:
    """Yield what assigns more than a number to a slice or a row, in functions that are compiled.

    An array has rows where the same function also takes an entry of it by several indices.
    """
    number = re.compile(r"-?(\d|\.)+|(math|np)\.\w+|_NAN|\(.*\)")
    for function in ast.walk(ast.parse(source)):
        if not isinstance(function, ast.FunctionDef):
            continue
        words = " ".join(map(ast.unparse, function.decorator_list))
        nodes = [*ast.walk(function)] if re.search("njit|compiled|inner", words) else []
        assigned = [node for node in nodes if isinstance(node, ast.Assign)]
        parts = [node for node in assigned if not isinstance(node.targets[0], ast.Name)]
        parts = [node for node in parts if not number.fullmatch(ast.unparse(node.value))]
        entries = [node for node in nodes if isinstance(node, ast.Subscript)] if parts else []
        rows = {ast.unparse(one.value) for one in entries if isinstance(one.slice, ast.Tuple)}
        whole = {one for one in entries if ast.unparse(one.value) in rows}
        whole = {one for one in whole if not isinstance(one.slice, ast.Tuple)}
        for node in parts:
            if whole & {*node.targets} or ":" in " ".join(map(ast.unparse, node.targets)):
                yield f"{function.name}: {ast.unparse(node)}"


def _is_body(text: object) -> bool:
    return isinstance(text, str) and text.startswith(("\n@compiled", "\n@brief"))


def test_compiled_code_copies_arrays_by_their_entries() -> None:
    """For ``a[:] = b`` numba compiles the text of its error, strings and all: two seconds."""
    for body, found in (
        ("a[:] = b", 1), ("a[:] = 0.0", 0), ("a[0, 1] = 2.0\n    a[1] = b", 1),
        ("a[1] = b", 0), ("a[0, 1] = 2.0\n    b[i] = a[0, 0]", 0),
    ):  # fmt: skip
        assert len([*_assigned_arrays(f"@njit\ndef f(a, b, i):\n    {body}")]) == found, body
    texts = [file.read_text(encoding="utf-8") for file in PACKAGE.rglob("*.py")]
    texts = [text for text in texts if re.search("njit|compiled|inner", text)]
    modules = [module for name, module in sys.modules.items() if name.startswith("undertow.")]
    written = [text for module in modules for text in vars(module).values() if _is_body(text)]
    assert len(written) >= 6  # of generated functions
    assert not [found for text in [*texts, *written] for found in _assigned_arrays(text)]
