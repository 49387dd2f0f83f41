"""Co-simulation units: valid, equal to Python, coupled they balance, and they bear bad masters."""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import undertow as ut
from support import rest_slow, unoptimised
from undertow.base import InvalidInputError, MissingExtraError
from undertow.export import EmbeddedController, Status, SuperTwistingStep, Twin, carriers
from undertow.export.co_simulation import Variable, base_units
from undertow.export.fmi import controller_unit, fmi_units, plant_unit
from undertow.export.host import FLAGS
from undertow.export.twin import random_states, run_positions
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray

fmpy = pytest.importorskip("fmpy")
Refused = pytest.importorskip("fmpy.fmi1").FMICallException
pytestmark = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")

T = 0.001


@lru_cache(maxsize=4)
def exported(name: str = "rotary_pendulum", real: str = "double") -> EmbeddedController:
    mechanism = LIBRARY[name]()
    return EmbeddedController(mechanism, ut.first_surface(mechanism), real=real)  # type: ignore[arg-type]


@pytest.fixture(scope="module", autouse=True)
def compiled_soon() -> Iterator[None]:
    """Units are compiled without optimising."""
    with unoptimised():
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the two units of the rotary pendulum, and what is unpacked from them."""
    folder = tmp_path_factory.mktemp("units")
    unpack(fmi_units(exported()), folder)
    return folder


def unpack(made: dict[str, bytes], folder: Path) -> None:
    for name, content in made.items():
        (folder / name).write_bytes(content)
        fmpy.extract(str(folder / name), str(folder / Path(name).stem))


class Loaded:
    """A unit in memory, its variables by name; what it says is kept."""

    def __init__(self, folder: Path, name: str, start: dict[str, float] | None = None) -> None:
        from fmpy.fmi3 import FMU3Slave, fmi3LogMessageCallback

        description = fmpy.read_model_description(str(folder / name))
        self.at = {v.name: v for v in description.modelVariables}
        self.said: list[str] = []
        self._log = fmi3LogMessageCallback(lambda *words: self.said.append(words[-1].decode()))
        self.unit = FMU3Slave(
            guid=description.guid,
            modelIdentifier=description.coSimulation.modelIdentifier,
            unzipDirectory=str(folder / name),
            instanceName=name,
        )
        self.unit.instantiate(logMessage=self._log)
        for key, value in (start or {}).items():
            self[key] = value
        self.unit.enterInitializationMode()
        self.unit.exitInitializationMode()

    def __getitem__(self, name: str) -> Any:
        variable = self.at[name]
        get = getattr(self.unit, f"get{variable.type}")
        return get([variable.valueReference])[0]

    def __setitem__(self, name: str, value: float) -> None:
        variable = self.at[name]
        getattr(self.unit, f"set{variable.type}")([variable.valueReference], [value])

    def read(self, names: tuple[str, ...] | list[str]) -> FloatArray:
        return np.array([self[name] for name in names])

    def step(self, t: float, size: float = T) -> None:
        self.unit.doStep(t, size)


@contextmanager
def loaded(folder: Path, name: str, start: dict[str, float] | None = None) -> Iterator[Loaded]:
    unit = Loaded(folder, name, start)
    yield unit
    unit.unit.freeInstance()


def runge_kutta(mechanism: ut.Mechanism, x: FloatArray, u: FloatArray, h: float) -> FloatArray:
    """One step of Runge and Kutta's fourth-order method under a held input."""
    n = mechanism.n

    def slope(at: FloatArray) -> FloatArray:
        return np.concatenate([at[n:], mechanism.accelerations(0.0, at, u)])

    a = slope(x)
    b = slope(x + h / 2 * a)
    c = slope(x + h / 2 * b)
    d = slope(x + h * c)
    return x + h / 6 * (a + 2 * b + 2 * c + d)


def states(mechanism: ut.Mechanism) -> list[str]:
    names = [c.name for c in mechanism.coordinates]
    return names + [f"{name}_dot" for name in names]


# -- what they compute --------------------------------------------------------------------------


def check_units(controller: EmbeddedController, folder: Path) -> None:
    """No complaint; plant and controller equal Python's; coupled they do what Python does."""
    from fmpy.validation import validate_fmu

    mechanism, stem = controller.mechanism, controller.stem
    n, limit = mechanism.n, mechanism.input_limits
    x_names, u_names = states(mechanism), [u.name for u in mechanism.inputs]
    for kind in ("plant", "controller"):
        assert validate_fmu(str(folder / f"{stem}_{kind}.fmu")) == []

    with loaded(folder, f"{stem}_controller", {"loop.rates_measured": 1}) as law:
        drawn = random_states(mechanism, 200, seed=2)
        margins = np.abs(controller.laws[0](0.0, drawn).margin)
        for k, x in enumerate(drawn[margins > 0.1][:50]):  # nearer to 0 no precision is enough
            said = controller.laws[0](0.0, x)
            for name, value in zip(x_names, x, strict=True):
                law[name] = value
            law.step(k * T)
            assert (np.abs(law.read(u_names) - said.u) <= 1e-9 * limit).all()

    x = mechanism.state(**mechanism.start)
    twin = Twin(controller)
    with (
        loaded(folder, f"{stem}_plant") as plant,
        loaded(folder, f"{stem}_controller") as law,
    ):
        for k in range(200):
            u, status = twin.step(x[:n])
            for name in x_names[:n]:
                law[name] = plant[name]
            law.step(k * T)
            assert law["loop.status"] == status
            for name in u_names:
                plant[name] = law[name]
            plant.step(k * T)
            x = runge_kutta(mechanism, x, u, T)
            assert (np.abs(plant.read(x_names) - x) <= 1e-9 * np.maximum(1, np.abs(x))).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["two_motor_three_link"])
def test_units_are_valid_and_equal_python(name: str, tmp_path: Path) -> None:
    """Show 6: FMPy has no complaint, and there are 1e-9 between a unit and Python."""
    unpack(fmi_units(exported(name)), tmp_path)
    check_units(exported(name), tmp_path)


def test_units_of_the_rotary_pendulum(place: Path) -> None:
    check_units(exported(), place)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(LIBRARY))
def test_units_of_every_mechanism(name: str, tmp_path: Path) -> None:
    unpack(fmi_units(exported(name)), tmp_path)
    check_units(exported(name), tmp_path)


def test_fmpy_simulates_the_plant_as_python_does(place: Path) -> None:
    """``simulate_fmu`` under a voltage that varies: equal to 1e-9 after half a second."""
    mechanism = exported().mechanism
    t = np.arange(501) * T
    volts = np.round(3 * np.sin(20 * t), 3)
    signals = np.array(
        list(zip(t, volts, strict=True)), dtype=[("time", float), ("voltage", float)]
    )
    result = fmpy.simulate_fmu(
        str(place / "rotary_pendulum_plant.fmu"),
        stop_time=0.5,
        output_interval=T,
        start_values={"phi": 0.3, "m": 0.15},
        input=signals,
    )
    heavier = mechanism.with_parameters(m=0.15)
    x = heavier.state(phi=0.3)
    for u in volts[:-1]:
        x = runge_kutta(heavier, x, np.array([u]), T)
    assert len(result) == 501
    last = np.array([result[name][-1] for name in states(mechanism)])
    assert np.abs(last - x).max() <= 1e-9


@pytest.mark.parametrize("delayed", [False, True])
def test_coupled_they_balance(place: Path, delayed: bool) -> None:
    """From 20°, positions alone measured; also by a master that delays both by a period."""
    with (
        loaded(place, "rotary_pendulum_plant", {"phi": 0.35}) as plant,
        loaded(place, "rotary_pendulum_controller") as law,
    ):
        for k in range(3000):
            measured = plant.read(["theta", "phi"])
            if delayed:
                plant["voltage"] = law["voltage"]
                plant.step(k * T)
            law["theta"], law["phi"] = measured
            law.step(k * T)
            if not delayed:
                plant["voltage"] = law["voltage"]
                plant.step(k * T)
        assert abs(plant["phi"]) < ut.deg(1)
        assert law["loop.status"] == Status.OK
        assert np.abs(plant.read(["theta_dot", "phi_dot"])).max() < 0.1


def test_steps_of_any_length_are_divided_evenly(place: Path) -> None:
    """2.5 ms are three steps of a third each."""
    mechanism = exported().mechanism
    x = mechanism.state(phi=0.2)
    with loaded(place, "rotary_pendulum_plant", {"phi": 0.2}) as plant:
        for k in range(40):
            plant.step(k * 0.0025, 0.0025)
            for _ in range(3):
                x = runge_kutta(mechanism, x, np.zeros(1), 0.0025 / 3)
        assert np.abs(plant.read(states(mechanism)) - x).max() <= 1e-9


@pytest.mark.parametrize("name", rest_slow(["wheeled_inverted_pendulum", "cart"], "cart"))
def test_a_plant_with_a_fast_motor_is_followed(name: str, tmp_path: Path) -> None:
    """The wheels' back-EMF decays by 241/s, another's by 800/s: a period of 4 ms is long."""
    from scipy.integrate import solve_ivp

    if name == "cart":
        mechanism = LIBRARY["cart_pendulum"]().with_parameters(b_c=400.0).with_input_limit(1e4)
    else:
        mechanism = LIBRARY[name]()
    surface, reaching = ut.first_surface(mechanism), ut.ReachingLaw(layer=1.0)
    controller = EmbeddedController(mechanism, surface, reaching, period=0.004)
    unit = plant_unit(controller)
    unpack({f"{unit.name}.fmu": unit.build()}, tmp_path)
    names = states(mechanism)
    start = {names[1]: 0.1, names[2]: 1.0}
    with loaded(tmp_path, f"{controller.stem}_plant", start) as plant:
        plant.step(0.0, 0.004)
        found = plant.read(names)

    def rates(_t: float, x: Any, of: ut.Mechanism = mechanism) -> Any:
        return np.append(x[of.n :], of.accelerations(0.0, x, np.zeros(of.m)))

    x0 = mechanism.state(**start)
    true = solve_ivp(rates, (0.0, 0.004), x0, "LSODA", rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found, true.y[:, -1], rtol=2e-4, atol=1e-6)
    assert np.isfinite(run_positions(controller)[-1]).all()


def test_a_controller_takes_whole_periods(place: Path) -> None:
    """A step of three periods is three steps under held measurements."""
    twin = Twin(exported())
    with loaded(place, "rotary_pendulum_controller", {"phi": 0.1}) as law:
        for k in range(20):
            law["theta"] = 0.01 * k
            law.step(3 * k * T, 3 * T)
            for _ in range(3):
                u, _ = twin.step([0.01 * k, 0.1])
            assert abs(law["voltage"] - u[0]) <= 1e-9
            assert np.abs(law.read([f"estimate.{s}" for s in law_states()]) - twin.x).max() < 1e-9


def law_states() -> list[str]:
    return states(exported().mechanism)


def test_a_surface_is_tuned_while_it_runs(place: Path) -> None:
    """A stiffer surface is taken at the next step; one that would not do is refused."""
    controller = exported()
    surface = controller.plan.surfaces[0]
    stiffer = ut.Surface(
        surface.alpha_a, 1.2 * surface.lambda_a, surface.alpha_u, 1.2 * surface.lambda_u
    )
    twin = Twin(controller)
    with loaded(place, "rotary_pendulum_controller", {"phi": 0.1}) as law:
        for k in range(10):
            if k == 5:
                law["surface.lambda_a[1,1]"] = stiffer.lambda_a[0, 0]
                law["surface.lambda_u[1,1]"] = stiffer.lambda_u[0, 0]
                twin.offer(ut.Plan.of(stiffer), 2)
            law.step(k * T)
            u, status = twin.step([0.0, 0.1])
            assert abs(law["voltage"] - u[0]) <= 1e-9
            assert law["loop.status"] == status
            assert bool(status & Status.SWITCHED) == (k == 5)
        law["surface.lambda_u[1,1]"] = -stiffer.lambda_u[0, 0]
        with pytest.raises(Refused):
            law.step(10 * T)
        assert "UT_INVALID" in law.said[-1]
        law["surface.lambda_u[1,1]"] = stiffer.lambda_u[0, 0]
        law.step(10 * T)
        with pytest.raises(Refused):
            law["reaching.layer[1]"] = 0.0
        assert "not inside (0, inf)" in law.said[-1]


@pytest.mark.slow
def test_single_precision_another_prefix_and_a_name_of_our_own_files(tmp_path: Path) -> None:
    mechanism = replace(exported().mechanism, name="model")
    controller = EmbeddedController(
        mechanism,
        ut.first_surface(mechanism),
        differentiator=SuperTwistingStep(),
        real="float",
        prefix="arm",
    )
    unpack(fmi_units(controller), tmp_path)
    with loaded(tmp_path, "model_rig_controller", {"loop.rates_measured": 1}) as law:
        law["phi"] = 0.125
        law.step(0.0)
        expected = controller.laws[0](0.0, mechanism.state(phi=0.125)).u[0]
        assert abs(law["voltage"] - expected) <= 1e-3 * 15


# -- bad masters --------------------------------------------------------------------------------


def test_a_lost_sensor_and_arm(place: Path) -> None:
    """NaN is a lost measurement; after six the output is off, until loop.arm rises."""
    with loaded(place, "rotary_pendulum_controller", {"phi": 0.1}) as law:
        law.step(0.0)
        law["phi"] = np.nan
        for k in range(1, 8):
            law.step(k * T)
        assert law["loop.status"] & Status.LOST
        assert law["voltage"] == 0.0
        law["phi"] = 0.1
        law.step(8 * T)
        assert law["loop.status"] & Status.LOST
        law["loop.arm"] = True
        law.step(9 * T)
        assert not law["loop.status"] & Status.LOST
        assert law["voltage"] != 0.0


def test_a_wrong_token_is_refused(place: Path) -> None:
    from fmpy.fmi3 import FMU3Slave, fmi3LogMessageCallback

    said: list[str] = []
    log = fmi3LogMessageCallback(lambda *words: said.append(words[-1].decode()))
    unit = FMU3Slave(
        guid="another",
        modelIdentifier="rotary_pendulum_plant",
        unzipDirectory=str(place / "rotary_pendulum_plant"),
        instanceName="plant",
    )
    with pytest.raises(Exception, match="instantiate"):
        unit.instantiate(logMessage=log)
    assert "token another" in said[0]


def test_what_a_master_must_not_do_is_refused_and_changes_nothing(place: Path) -> None:
    names = law_states()
    with loaded(place, "rotary_pendulum_plant", {"phi": 0.2}) as plant:
        plant.step(0.0)
        before = plant.read(names)

        def refused(match: str, attempt: Any) -> None:
            with pytest.raises(Refused):
                attempt()
            assert match in plant.said[-1]
            assert (plant.read(names) == before).all()

        for size in (-T, 0.0, np.nan, np.inf, 1e9):
            refused("communication step", lambda size=size: plant.step(T, size))
        for t in (0.0, 5 * T, np.nan):
            refused("communication point", lambda t=t: plant.step(t))
        for value in (np.nan, np.inf):
            refused("not inside", lambda v=value: plant.__setitem__("voltage", v))
        for value in (0.0, -1.0, np.nan):
            refused("not inside (0, inf)", lambda v=value: plant.__setitem__("m", v))
        refused("before the first step", lambda: plant.__setitem__("phi", 0.0))
        refused("at all", lambda: plant.__setitem__("time", 0.0))
        refused("no variable of this type", lambda: plant.unit.getFloat64([999]))
        refused("no variable of this type", lambda: plant.unit.getInt32([1]))
        refused("no variable of this type", lambda: plant.unit.setBoolean([1], [True]))
        refused("not offered", plant.unit.enterEventMode)
        refused("not allowed in this mode", plant.unit.exitInitializationMode)
        refused("not allowed in this mode", plant.unit.enterInitializationMode)
        plant["voltage"] = 1e300
        refused("no longer finite", lambda: plant.step(T, 0.1))
        plant["voltage"] = 0.0
        plant.step(T)
        plant.unit.terminate()
        with pytest.raises(Refused):
            plant.step(2 * T)
    with loaded(place, "rotary_pendulum_controller") as law:
        for size in (-T, 0.5 * T, 1.5 * T, np.nan):
            with pytest.raises(Refused):
                law.step(0.0, size)
            assert "whole multiple" in law.said[-1]


def test_two_instances_share_nothing_and_reset_begins_anew(place: Path) -> None:
    for name, start, coordinate in (
        ("rotary_pendulum_plant", {"phi": 0.2}, "phi_dot"),
        ("rotary_pendulum_controller", {"phi": 0.2}, "voltage"),
    ):
        with loaded(place, name, start) as one, loaded(place, name) as other:
            quiet = other[coordinate]
            one.step(0.0)
            moved = one[coordinate]
            assert moved != 0.0
            assert other[coordinate] == quiet
            one.unit.reset()
            one["phi"] = 0.2
            one.unit.enterInitializationMode()
            one.unit.exitInitializationMode()
            assert one["time"] == 0.0
            assert one[coordinate] == 0.0
            one.step(0.0)
            assert one[coordinate] == moved


def test_a_state_is_taken_and_brought_back_also_as_bytes(place: Path) -> None:
    """The run from a state is repeated exactly; another unit's bytes are refused."""

    def go(unit: Loaded, k: int) -> FloatArray:
        for i in range(k, k + 20):
            if "voltage" in unit.at and unit.at["voltage"].causality == "output":
                unit["phi"] = 0.1 * np.cos(i)
            unit.step(i * T)
        return unit.read([n for n, v in unit.at.items() if v.type == "Float64"])

    kept: list[bytes] = []
    for name in ("rotary_pendulum_plant", "rotary_pendulum_controller"):
        with loaded(place, name, {"phi": 0.2}) as unit, loaded(place, name) as other:
            go(unit, 0)
            state = unit.unit.getFMUState()
            first = go(unit, 20)
            unit.unit.setFMUState(state)
            assert (go(unit, 20) == first).all()
            raw = unit.unit.serializeFMUState(state)
            unit.unit.freeFMUState(state)
            again = other.unit.deserializeFMUState(raw)
            other.unit.setFMUState(again)
            assert (go(other, 20) == first).all()
            other.unit.freeFMUState(again)
            for bad in (raw[:-1], b"x" * len(raw), *kept):
                with pytest.raises(Refused):
                    unit.unit.deserializeFMUState(bad)
            kept.append(bytes(raw))


# -- what they are made of ----------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["plant", "controller"])
def test_our_declarations_are_the_standards(kind: str, tmp_path: Path) -> None:
    """The sources compile with the standard's own header in the place of ours."""
    unit = (plant_unit if kind == "plant" else controller_unit)(exported())
    for name, content in unit.sources().items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / "fmi3.h").write_text('#include "fmi3Functions.h"\n')
    headers = Path(fmpy.__file__).parent / "c-code"
    words = [w for w in FLAGS if w != "-Werror"] + ["-Og"]
    done = subprocess.run(
        ["gcc", *words, "-Werror", f"-isystem{headers}", "-c", "unit.c", "-o", "unit.o"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "unit.c").read_text()
    (tmp_path / "unit.c").write_text(text.replace("fmi3Float64 size,\n", "fmi3Float32 size,\n"))
    done = subprocess.run(
        ["gcc", *words, f"-isystem{headers}", "-c", "unit.c", "-o", "unit.o"],
        cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60,
    )  # fmt: skip
    assert "conflicting types" in done.stderr


def test_every_function_of_the_standard_is_there(place: Path) -> None:
    headers = (Path(fmpy.__file__).parent / "c-code" / "fmi3Functions.h").read_text()
    asked = set(re.findall(r"FMI3_Export fmi3\w+TYPE\s+(fmi3\w+);", headers))
    library = next((place / "rotary_pendulum_plant" / "binaries").rglob("*.so"))
    symbols = subprocess.run(
        ["nm", "-D", "--defined-only", str(library)], capture_output=True, text=True, check=True
    ).stdout
    offered = {line.split()[-1] for line in symbols.splitlines()}
    assert len(asked) > 50
    assert asked <= offered
    assert all(name.startswith("fmi3") for name in offered)


def test_units_in_si() -> None:
    assert base_units("kg m²") == {"kg": 1, "m": 2}
    assert base_units("V s/rad") == {"kg": 1, "m": 2, "s": -2, "A": -1, "rad": -1}
    assert base_units("m/s²") == {"m": 1, "s": -2}
    assert base_units("furlong") is None
    for make in LIBRARY.values():
        mechanism = make()
        named = [p.unit for p in mechanism.parameters] + [u.unit for u in mechanism.inputs]
        assert all(base_units(unit) is not None for unit in named)


def test_the_same_export_is_the_same_unit() -> None:
    one, other = plant_unit(exported()), plant_unit(exported(), [0.0, 0.1, 0.0, 0.0])
    assert one.token == plant_unit(exported()).token
    assert one.token != other.token
    assert b'start="0.1"' in other.description()


def test_what_cannot_be_built_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingExtraError, match="program 'no-such-cc'"):
        carriers(exported(), ["fmi"], "no-such-cc")
    with pytest.raises(InvalidInputError, match=r"platform to export for.*fmi"):
        carriers(exported(), ["fmu"])
    monkeypatch.setattr(platform, "machine", lambda: "s390x")
    with pytest.raises(MissingExtraError, match="s390x"):
        carriers(exported(), ["fmi"])
    unit = plant_unit(exported())
    clash = replace(unit, groups={**unit.groups, "MORE": [Variable("phi", "input", "discrete")]})
    with pytest.raises(InvalidInputError, match="got phi, must be each of them once"):
        clash.sources()
