"""S-function and ROS 2 controller against stand-ins of their hosts: they compile, and are Python's.

Neither Simulink nor ROS is here: ``stubs/`` has what the exported code uses of them, with the names
and types that their documentation gives.
"""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
import zipfile
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import undertow as ut
from support import bar, unoptimised
from undertow.base import InvalidInputError
from undertow.cli import app
from undertow.export import EmbeddedController, Status, Twin, carriers, files
from undertow.export.host import FLAGS
from undertow.export.twin import run_positions
from undertow.mechanisms import LIBRARY
from undertow.models import FloatArray

STUBS = Path(__file__).parent / "stubs"
pytestmark = pytest.mark.skipif(
    shutil.which("gcc") is None or shutil.which("g++") is None, reason="needs gcc and g++"
)


@lru_cache(maxsize=4)
def exported(name: str, prefix: str = "ut") -> EmbeddedController:
    mechanism = LIBRARY[name]()
    return EmbeddedController(mechanism, ut.first_surface(mechanism), prefix=prefix)


def run(folder: Path, *words: str | Path, text: str | None = None) -> tuple[int, str, str]:
    done = subprocess.run(
        [*map(str, words)],
        cwd=folder, input=text, capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def write(folder: Path, made: dict[str, bytes]) -> None:
    for name, content in made.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)


def lines(rows: FloatArray) -> str:
    return "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist())


def build_s_function(controller: EmbeddedController, folder: Path) -> Path:
    """Compile as ``mex`` would, every warning an error, and return the program."""
    write(folder, files(controller) | carriers(controller, ["simulink"]))
    name = controller.stem
    code, _, said = run(
        folder, "gcc", *FLAGS, f"-I{STUBS}", "-DMATLAB_MEX_FILE", f"{name}_sfun.c", f"{name}.c",
        "-lm", "-o", "block",
    )  # fmt: skip
    assert code == 0, said
    return folder / "block"


@pytest.mark.parametrize(
    ("name", "prefix"),
    [("rotary_pendulum", "ut"), pytest.param("gantry_crane", "crane", marks=pytest.mark.slow)],
)
def test_the_s_function_is_the_python_law(name: str, prefix: str, tmp_path: Path) -> None:
    """A run with lost sensors and one arming, period by period: the twin's numbers to 1e-9."""
    controller = exported(name, prefix)
    n, m = controller.mechanism.n, controller.mechanism.m
    block = build_s_function(controller, tmp_path)
    positions = run_positions(controller)
    arm = np.zeros((len(positions), 1))
    arm[190:] = 1.0
    code, out, said = run(tmp_path, block, str(n), text=lines(np.hstack([positions, arm])))
    assert code == 0, said
    period, *rows = out.splitlines()
    assert float(period) == controller.period
    got = np.array([row.split() for row in rows], dtype=float)
    twin, lost = Twin(controller), 0
    for k, q in enumerate(positions):
        if k == 190:
            twin.arm()
        u, status = twin.step(q)
        lost += bool(status & Status.LOST)
        assert int(got[k, m]) == status
        assert (np.abs(got[k, :m] - u) <= 1e-9 * controller.mechanism.input_limits).all()
        assert np.abs(got[k, -2 * n :] - twin.x).max() <= 1e-9
        if not status & Status.LOST:
            assert np.abs(got[k, m + 1 : 2 * m + 1] - twin.law(0.0, twin.x).s).max() <= 1e-9
    assert len(got) == len(positions)
    assert 10 < lost < 40  # switched off for a while, and on again


def test_the_s_function_takes_whole_states_too_and_no_other_width(tmp_path: Path) -> None:
    controller = exported("rotary_pendulum")
    block = build_s_function(controller, tmp_path)
    states = 0.2 * np.random.default_rng(0).standard_normal((50, 4))
    code, out, _ = run(tmp_path, block, "4", text=lines(np.hstack([states, np.zeros((50, 1))])))
    assert code == 0
    got = np.array([row.split()[0] for row in out.splitlines()[1:]], dtype=float)
    said = controller.laws[0](0.0, states).u[:, 0]
    assert np.abs(got - said).max() <= 1e-9 * 15
    assert len(np.unique(said)) > 10
    code, out, _ = run(tmp_path, block, "3")
    assert code == 2
    assert "positions alone, or positions and rates" in out


def test_s_function_has_the_name_of_its_file(tmp_path: Path) -> None:
    """Simulink finds it by that name alone."""
    made = carriers(exported("rotary_pendulum"), ["simulink"])
    assert list(made) == ["rotary_pendulum_sfun.c"]
    text = made["rotary_pendulum_sfun.c"].decode()
    assert re.search(r"^#define S_FUNCTION_NAME rotary_pendulum_sfun$", text, re.MULTILINE)
    assert re.search(r"^#define S_FUNCTION_LEVEL 2$", text, re.MULTILINE)


def build_ros2(controller: EmbeddedController, folder: Path) -> Path:
    """Compile as CMakeLists.txt says, every warning an error, and return the program."""
    made = carriers(controller, ["ros2"])
    write(folder, made)
    package = folder / next(iter(made)).partition("/")[0]
    source = package / "src"
    code, _, said = run(source, "gcc", *FLAGS, "-c", f"{controller.stem}.c", "-o", "law.o")
    assert code == 0, said
    code, _, said = run(
        source, "g++", "-std=c++17", "-Wall", "-Wextra", "-Wpedantic", "-Werror", f"-I{STUBS}",
        "controller.cpp", STUBS / "ros2_main.cpp", "law.o", "-o", "node",
    )  # fmt: skip
    assert code == 0, said
    return source / "node"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rotary_pendulum", "gantry_crane"])
def test_the_ros2_controller_is_the_python_law(name: str, tmp_path: Path) -> None:
    """The life of a controller; its commands are the twin's to 1e-9, and zero when it is ended.

    Another rate and other joints are refused.
    """
    controller = exported(name)
    mechanism = controller.mechanism
    node = build_ros2(controller, tmp_path)
    joints = [f"joint_{c.name}" for c in mechanism.coordinates]
    positions = run_positions(controller)
    for rate in ("1000", "0:1050"):  # 0: that of the manager
        code, out, said = run(tmp_path, node, rate, "positions", *joints, text=lines(positions))
        assert code == 0, said
    commands, seen, *rows, last = out.splitlines()
    assert commands.split() == [f"{j}/effort" for j in joints[: mechanism.m]]
    assert seen.split() == [f"{j}/position" for j in joints]
    twin = Twin(controller)
    for row, q in zip(rows, positions, strict=True):
        u, _ = twin.step(q)
        got = np.array(row.split(), dtype=float)
        assert (np.abs(got - u) <= 1e-9 * mechanism.input_limits).all()
    assert [float(v) for v in last.split()] == [0.0] * mechanism.m
    assert said.count("status") == 1  # said once, not in every period
    states = 0.1 * np.random.default_rng(0).standard_normal((20, 2 * mechanism.n))
    code, out, _ = run(tmp_path, node, "1000", "velocities", *joints, text=lines(states))
    _, seen, *rows, _ = out.splitlines()
    assert seen.split()[mechanism.n :] == [f"{j}/velocity" for j in joints]
    got = np.array([row.split() for row in rows], dtype=float)
    expected = controller.laws[0](0.0, states).u
    assert (np.abs(got - expected) <= 1e-9 * mechanism.input_limits).all()
    for words, match in (
        (("500", "positions", *joints), "got 500 Hz, must be 1000 Hz"),
        (("1000", "positions"), f"joints: got 0, must be {mechanism.n}"),
    ):
        code, _, said = run(tmp_path, node, *words)
        assert code == 2
        assert match in said
    # A manager at 500 Hz, whose rate the controller has: the C was stepped half as often.
    code, out, said = run(tmp_path, node, "0:500", "positions", *joints, text=lines(positions))
    assert code == 5
    assert "period: got 0.002 s, the mean of 100, must be 0.001 s" in said
    assert [float(v) for v in out.splitlines()[-1].split()] == [0.0] * mechanism.m


def test_the_ros2_package_fits_together() -> None:
    """Plugin, library and package have one name, in all files; the XML is XML."""
    made = carriers(exported("rotary_pendulum"), ["ros2"])
    name = "undertow_rotary_pendulum"
    assert {path.partition("/")[0] for path in made} == {name}
    package = ET.fromstring(made[f"{name}/package.xml"])
    plugin = ET.fromstring(made[f"{name}/plugin.xml"])
    assert package.findtext("name") == plugin.get("path") == name
    kind = plugin.find("class")
    assert kind is not None
    assert kind.get("type") == f"{name}::Controller"
    build = made[f"{name}/CMakeLists.txt"].decode()
    depends = {node.text for node in package.findall("depend")}
    assert depends == set(re.findall(r"find_package\((\w+)", build)) - {"ament_cmake"}
    for source in re.findall(r"src/[\w.]+", build):
        assert f"{name}/{source}" in made
    settings = made[f"{name}/config/controller.yaml"].decode()
    assert f"type: {kind.get('name')}" in settings
    declared = re.findall(
        r'auto_declare<.*?>\("(\w+)"', made[f"{name}/src/controller.cpp"].decode()
    )
    assert len(declared) == 3
    assert all(f"    {parameter}: " in settings for parameter in declared)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "coordinates", "channel", "parameters", "prefix"),
    [
        ('2 "y" <&> \\', ("y", "float"), "return", "for while struct", "ut"),
        ("Über/pendel", ("θ", "φ"), "main", "α EOF NAN", "foo"),
    ],
)
def test_names_of_a_user_stay_clear_of_all_of_them(
    name: str, coordinates: tuple[str, str], channel: str, parameters: str, prefix: str,
    tmp_path: Path,
) -> None:  # fmt: skip
    """Keywords, quotes, angle brackets, no ASCII letter: everything compiles, and XML is XML."""
    mechanism = bar(name, coordinates, channel, parameters)
    controller = EmbeddedController(mechanism, ut.first_surface(mechanism), prefix=prefix)
    build_s_function(controller, tmp_path)
    build_ros2(controller, tmp_path)
    package = next(tmp_path.glob("undertow_*"))
    assert mechanism.name.startswith("2") == (package.name == "undertow_rig_2_y")
    for path in package.glob("*.xml"):
        ET.parse(path)
    settings = (package / "config" / "controller.yaml").read_text()
    assert ('joints: ["y", "float"]' in settings) == (coordinates[0] == "y")
    for unit_name, content in carriers(controller, ["fmi"]).items():
        with zipfile.ZipFile(io.BytesIO(content)) as unit:
            described = ET.fromstring(unit.read("modelDescription.xml"))
        variables = {node.get("name") for node in described.iter("Float64")}
        assert {*coordinates, channel} <= variables
        model = described.find("CoSimulation")
        assert model is not None
        assert f"{model.get('modelIdentifier')}.fmu" == unit_name
        assert str(model.get("modelIdentifier")).isidentifier()


def test_a_period_that_no_update_rate_has_is_refused() -> None:
    mechanism = LIBRARY["rotary_pendulum"]()
    controller = EmbeddedController(mechanism, ut.first_surface(mechanism), period=0.0007)
    with pytest.raises(InvalidInputError, match=r"0\.0007 s.*--period 0\.00069979006"):
        carriers(controller, ["ros2"])
    carriers(replace(controller, period=0.00069979006), ["ros2"])  # the remedy is one


@pytest.mark.slow
def test_the_command_writes_them_beside_the_c(tmp_path: Path) -> None:
    """One command for all; nothing is written where no folder is named, or for another word."""
    words = ["export", "c", "rotary_pendulum", "--start", "phi=5deg"]
    asked = ["--for", "fmi", "--for", "simulink", "--for", "ros2"]
    for more in (asked, asked[-2:]):
        with unoptimised():
            done = CliRunner().invoke(app, [*words, *more, "--out", str(tmp_path / "made")])
        assert done.exit_code == 0, done.output
    made = {p.relative_to(tmp_path / "made").as_posix() for p in (tmp_path / "made").rglob("*")}
    expected = {
        "rotary_pendulum.c", "rotary_pendulum_plant.fmu", "rotary_pendulum_controller.fmu",
        "rotary_pendulum_sfun.c", "undertow_rotary_pendulum/src/controller.cpp",
        "earlier-1/undertow_rotary_pendulum/src/controller.cpp",
    }  # fmt: skip
    assert expected <= made
    for more in (["--for", "fmi"], ["--for", "fmu", "--out", str(tmp_path / "none")]):
        done = CliRunner().invoke(app, [*words, *more])
        assert done.exit_code != 0
    assert not list((tmp_path / "none").glob("*"))
