"""The example drivers: a pendulum balanced over a pseudo-terminal, and over UDP with losses."""

from __future__ import annotations

import contextlib
import importlib
import math
import os
import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import undertow as ut
from undertow.cli import app
from undertow.mechanisms.named import named
from undertow.models import linearise
from undertow.plants import OutputOnError, check_rig

EXAMPLES = Path(__file__).parents[2] / "examples"
POSIX = pytest.mark.skipif(sys.platform == "win32", reason="pseudo-terminals are POSIX")


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], ModuleType]:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The device's end of a serial line, and the name of the driver's port."""
    ours, theirs = os.openpty()
    yield ours, os.ttyname(theirs)
    for end in (ours, theirs):
        with contextlib.suppress(OSError):
            os.close(end)


@pytest.mark.parametrize("name", ["serial_rig", "udp_rig"])
def test_a_driver_of_twenty_lines_balances(name: str, example: Callable[[str], ModuleType]) -> None:
    if name == "serial_rig" and sys.platform == "win32":
        pytest.skip("pseudo-terminals are POSIX")
    largest = example(name).main(seconds=3.0)
    assert largest < ut.deg(1)


def test_what_cannot_be_read_is_a_lost_reading(example: Callable[[str], ModuleType]) -> None:
    wire = example("wire")
    for garbage in (b"", b"q", b"\xff\xfe", b"q 1 0.1 x 3", b"q 1 0.1 5", b"u 1 0.1 5 6", b"\0\0"):
        number, lost = wire.parse(garbage)
        assert number == -1
        assert np.isnan(lost.q).all()
    number, sound = wire.parse(b"q 7 0.25 1024 -2048\n")
    assert (number, sound.t) == (7, 0.25)
    assert sound.q.tolist() == pytest.approx([math.pi / 2, -math.pi])


def not_at_zero(rig: Any) -> None:
    """Close a driver whose device answers no more: it said nothing of that."""
    with pytest.raises(OutputOnError, match="may still drive the motor"):
        rig.close()


@POSIX
def test_a_serial_line_with_garbage_late_and_lost_answers(
    line: tuple[int, str], example: Callable[[str], ModuleType]
) -> None:
    """The newest answer to a command of this driver counts, whatever else is on the line."""
    device, port = line
    rig = example("serial_rig").SerialRig(port, timeout=0.01)
    assert re.fullmatch(rb"u 1 0\.000000\n", os.read(device, 100))
    os.write(device, b"\xff\x00q 9 noise\nq 1 0.001 1024 0\n")
    assert rig.read().q[0] == pytest.approx(math.pi / 2)
    rig.write([1.0])
    assert math.isnan(rig.read().t)  # no answer: lost, after 10 ms
    rig.write([1.0])
    os.write(device, b"q 2 0.002 0 0\nq 3 0.0")  # the late one, and half of the next
    assert rig.read().t == 0.002
    os.write(device, b"03 0 1\n")
    assert rig.read().t == 0.003
    rig.write([1.0])
    os.write(device, b"q 99 9.9 0 0\n" + b"x" * 3000)  # of another driver, and a flood
    assert math.isnan(rig.read().t)
    os.write(device, b"\nq 4 0.004 0 0\n")
    assert rig.read().t == 0.004
    not_at_zero(rig)


@POSIX
def test_a_serial_line_that_is_unplugged_is_an_error_and_no_wait(
    line: tuple[int, str], example: Callable[[str], ModuleType]
) -> None:
    """Reads fail at once, so do writes; closing says that nobody knows what the motor does."""
    device, port = line
    rig = example("serial_rig").SerialRig(port)
    os.close(device)
    with pytest.raises(OSError, match=r"closed|error"):
        rig.read()
    with pytest.raises(OSError, match="error"):
        rig.write([1.0])
    not_at_zero(rig)


def test_datagrams_that_are_lost_late_or_of_others(example: Callable[[str], ModuleType]) -> None:
    device = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    device.bind(("127.0.0.1", 0))
    device.settimeout(5.0)
    rig = example("udp_rig").UdpRig(*device.getsockname(), timeout=0.01)
    _, driver = device.recvfrom(100)
    assert math.isnan(rig.read().t)
    rig.write([1.0])
    for answer in (b"garbage", b"q 2 0.002 5 6\n", b"q 1 0.001 3 4\n"):  # out of order
        device.sendto(answer, driver)
    assert rig.read().t == 0.002
    rig.write([1.0])
    assert math.isnan(rig.read().t)  # what came too late for its turn is not taken now
    device.close()
    rig.write([1.0])
    with pytest.raises(ConnectionError):
        rig.read()
    not_at_zero(rig)


@POSIX
def test_a_serial_port_is_one_drivers_alone(
    line: tuple[int, str], example: Callable[[str], ModuleType]
) -> None:
    """A second one is refused by name while the first is open, and takes over when it is closed."""
    _, port = line
    serial_rig = example("serial_rig")
    first = serial_rig.SerialRig(port)
    with pytest.raises(OSError, match="in use by another program"):
        serial_rig.SerialRig(port)
    not_at_zero(first)
    not_at_zero(serial_rig.SerialRig(port))


def test_a_lost_datagram_costs_less_than_a_period(example: Callable[[str], ModuleType]) -> None:
    """The shortest of reads without an answer: a busy machine delays some."""
    silent = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    silent.bind(("127.0.0.1", 0))
    rig = example("udp_rig").UdpRig(*silent.getsockname())
    times = []
    for _ in range(21):
        rig.write([1.0])
        began = time.perf_counter()
        assert math.isnan(rig.read().t)
        times.append(time.perf_counter() - began)
    assert min(times) < rig.period
    assert rig.timeout < 0.5 * rig.period
    not_at_zero(rig)
    assert example("serial_rig").SerialRig.__init__.__defaults__[-1] is None
    silent.close()


def test_an_emulated_device_obeys_one_sender(example: Callable[[str], ModuleType]) -> None:
    """What another socket sends is neither applied nor answered; nor does the driver hear it."""
    udp_rig = example("udp_rig")
    bench = udp_rig.srv02_rig()
    device = udp_rig.RealisticRig(bench, seed=1)
    host, port = udp_rig.emulate(device)
    rig = udp_rig.UdpRig(host, port, timeout=1.0)
    assert rig.read().t > 0
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    other.settimeout(0.1)
    before = device.t
    other.sendto(b"u 1 15.000000\n", (host, port))
    with pytest.raises(TimeoutError):
        other.recvfrom(256)
    assert device.t == before
    rig.write([0.0])
    other.sendto(b"q 2 9.0 0 0\n", rig.socket.getsockname())
    assert rig.read().t != 9.0
    rig.close()
    other.close()


def test_the_driver_of_the_page_is_a_rig(monkeypatch: pytest.MonkeyPatch) -> None:
    """``docs/rigs.md``, with a card of 4096 counts a turn that stands for the hardware."""
    page = (EXAMPLES.parent / "docs" / "rigs.md").read_text(encoding="utf-8")
    code = page.split("## A driver of your own")[1].split("```python\n")[1].split("```")[0]
    counts, volts = [100, 200], list[float]()
    card = SimpleNamespace(counts=lambda: list(counts), set_volt=volts.append)
    monkeypatch.setitem(sys.modules, "daq", SimpleNamespace(open=lambda: card))
    names: dict[str, Any] = {}
    exec(code, names)
    rig = names["MyRig"]()
    check_rig(rig, ut.mechanisms.rotary_pendulum())
    counts[:] = [100 + 1024, 200 - 2048]
    assert rig.read().q.tolist() == pytest.approx([math.pi / 2, 0.0])
    rig.write(np.array([3.0]))
    rig.close()
    assert volts == [3.0, 0.0]


@POSIX
@pytest.mark.slow
def test_the_runtime_drives_the_example_from_the_command_line(tmp_path: Path) -> None:
    """``undertow run --rig FILE.py:NAME``: a mechanism is balanced by one's own driver, logged."""
    words = ("run", "rotary_pendulum", "--rig", f"{EXAMPLES / 'serial_rig.py'}:emulated")
    log = tmp_path / "run.db"
    result = CliRunner().invoke(
        app, [*words, "--start", "phi=20deg", "--seconds", "2", "--log", str(log)]
    )
    assert result.exit_code == 0, result.stderr
    assert "BALANCE" in result.stdout
    assert "end of the time asked for" in result.stdout
    assert CliRunner().invoke(app, ["replay", str(log)]).exit_code == 0


@pytest.fixture
def written(example: Callable[[str], ModuleType]) -> ModuleType:
    """The mechanisms that users would write."""
    return example("mechanisms")


OWN = (
    "furuta", "qube", "long_short_pendubot", "ball_on_a_wheel", "pendulum_on_an_inclined_rail",
)  # fmt: skip


@pytest.mark.parametrize("name", OWN)
def test_a_users_mechanism_is_one(name: str, written: ModuleType) -> None:
    """Claim: each is accepted, with its input reaching every mode, and falls when let go."""
    mechanism = named(f"{EXAMPLES / 'mechanisms.py'}:{name}")
    assert ut.check_mechanism(mechanism, compiled=False).passed
    assert mechanism.fingerprint == getattr(written, name)().fingerprint
    assert np.linalg.eigvals(linearise(mechanism).A).real.max() > 1  # it falls
    assert np.linalg.norm(mechanism.usual_start) > 0


STATES = np.random.default_rng(15).uniform(-1, 1, (5, 4))


def test_the_users_rotary_pendulums_are_the_librarys(written: ModuleType) -> None:
    """Claim: with its pivot's damping taken out each moves as the library's with those numbers.

    The library turns the arm the other way, and its rod has the mass and half-length of the same
    first and second moments.
    """
    flip = np.array([-1.0, 1.0, -1.0, 1.0])
    qube = ut.mechanisms.rotary_pendulum("qube_servo_2")
    numbers = {p.name: p.value for p in written.furuta().parameters}
    half = 0.75 * numbers["pendulum"] / (numbers["m"] * numbers["l"])
    mass = numbers["m"] * numbers["l"] / half
    furuta = ut.mechanisms.rotary_pendulum(
        l=half, m=mass, r_o=numbers["r"], d_e=numbers["d_1"], a_e=1.0,
        I_e=numbers["arm"] + (numbers["m"] - mass) * numbers["r"] ** 2,
    )  # fmt: skip
    for mine, theirs in ((written.qube(), qube), (written.furuta(), furuta)):
        mine = mine.with_parameters(d_2=1e-15)  # noqa: PLW2901
        assert mine.input_limits == pytest.approx(0.45 if theirs is furuta else theirs.input_limits)
        for x in STATES:
            u = np.array([0.3])
            np.testing.assert_allclose(
                mine.accelerations(0.0, x, u),
                flip[:2] * theirs.accelerations(0.0, flip * x, -u),
                rtol=1e-9,
            )


def test_the_users_pendubot_is_the_librarys_of_other_numbers(written: ModuleType) -> None:
    mine = written.long_short_pendubot()
    theirs = ut.mechanisms.pendubot(
        m_1=0.9, m_2=0.25, l_1=0.6, a_1=0.3, a_2=0.1, J_1=0.9 * 0.36 / 12, J_2=0.25 * 0.04 / 12,
        b_1=0.02, b_2=1e-3, g=9.81,
    )  # fmt: skip
    for x in STATES:
        u = np.array([0.7])
        np.testing.assert_allclose(
            mine.accelerations(0.0, x, u), theirs.accelerations(0.0, x, u), rtol=1e-9
        )


def test_a_ball_rolls_off_a_wheel_that_is_held(written: ModuleType) -> None:
    """Claim: 5/7 g sin φ along the rim, as a solid ball rolls on any slope."""
    mechanism = written.ball_on_a_wheel()
    x = mechanism.state(lean=0.4)
    M, f = mechanism.M(x[:2]), mechanism.f(x)
    held = f[1] / M[1, 1]  # the wheel does not turn
    assert 0.18 * held == pytest.approx(5 / 7 * 9.81 * np.sin(0.4))


def test_a_counterweight_holds_the_cart_on_its_slope(written: ModuleType) -> None:
    """Claim: nothing moves with the rod upright; M is that of its bodies' positions."""
    mechanism = written.pendulum_on_an_inclined_rail()
    assert mechanism.accelerations(0.0, mechanism.state(x=0.3), [0.0]) == pytest.approx([0, 0])
    slope, a, step = np.pi / 12, 0.3, 1e-6

    def centre(x: float, lean: float) -> np.ndarray:
        return np.array([x * np.cos(slope) + 0.25 * np.sin(lean),
                         x * np.sin(slope) + 0.25 * np.cos(lean)])  # fmt: skip

    J = np.column_stack(
        [
            (centre(0.1 + step, a) - centre(0.1 - step, a)) / (2 * step),
            (centre(0.1, a + step) - centre(0.1, a - step)) / (2 * step),
        ]
    )
    cart = 0.6 + 0.8 * np.sin(slope)
    wanted = 0.2 * J.T @ J + np.diag([cart, 0.2 * 0.5**2 / 12])
    np.testing.assert_allclose(mechanism.M([0.1, a]), wanted, atol=1e-8)


# -- a card with encoders and an analogue output -------------------------------------------------


def test_the_driver_of_a_card_balances_a_simulated_one(
    example: Callable[[str], ModuleType],
) -> None:
    quanser = example("quanser_rig")
    assert quanser.balance(quanser.simulated(), seconds=3.0) < ut.deg(1)


def test_the_driver_of_a_card_counts_scales_and_lets_go(
    example: Callable[[str], ModuleType], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Signs, zeros, counters that begin again, the card's range, the watchdog, the end."""
    quanser = example("quanser_rig")
    said: list[tuple[str, Any]] = []

    class HIL(quanser.SimulatedCard):  # type: ignore[misc, name-defined]
        counts = (0, 0)

        def __init__(self, *words: str) -> None:
            said.append(("open", words))

        def read_encoder(self, channels: Any, count: int, buffer: Any) -> None:
            assert list(channels) == [0, 1]
            for k in range(count):
                buffer[k] = self.counts[k]

        def write_analog(self, channels: Any, count: int, buffer: Any) -> None:
            said.append(("write", buffer[0]))

        def watchdog_start(self, seconds: float) -> None:
            said.append(("watchdog", seconds))

        def watchdog_reload(self) -> None:
            said.append(("reload", None))

        def close(self) -> None:
            said.append(("close", None))

    monkeypatch.setitem(sys.modules, "quanser", SimpleNamespace())
    monkeypatch.setitem(sys.modules, "quanser.hardware", SimpleNamespace(HIL=HIL))
    rig = quanser.connected()
    check_rig(rig, ut.mechanisms.rotary_pendulum())
    assert said == [("open", ("q2_usb", "0")), ("write", 0.0)]
    assert rig.read().q.tolist() == pytest.approx([0.0, math.pi])
    rig.card.counts = (2**23 - 10, -2048)
    for _ in range(2):
        q = rig.read().q
    rig.card.counts = (-(2**23) + 10, -2048)  # 20 counts on
    assert rig.read().q - q == pytest.approx([20 * 2 * math.pi / 4096, 0.0])
    assert q[1] == pytest.approx(0.0)
    said.clear()
    rig.write(np.array([6.0]))
    rig.write(np.array([-99.0]))
    assert said == [("watchdog", 0.02), ("write", 2.0), ("reload", None), ("write", -10.0)]
    said.clear()
    rig.close()
    assert said == [("write", 0.0), ("close", None)]

    def gone(*_: Any) -> None:
        raise RuntimeError("-1073: the device is not there")

    rig.card.write_analog = gone
    said.clear()
    with pytest.raises(OutputOnError, match="the device is not there"):
        rig.close()
    assert said == [("close", None)]


def test_a_card_is_zeroed_where_it_hangs(example: Callable[[str], ModuleType]) -> None:
    """The simulated one hangs: after ``zero`` it reads so, whatever its counters said before."""
    quanser = example("quanser_rig")
    rig = quanser.simulated(phi=math.pi)
    rig.card.offset = [77, -1000]
    assert abs(rig.read().q[1] - math.pi) > 1.0
    rig.zero()
    assert rig.read().q.tolist() == pytest.approx([0.0, math.pi], abs=1e-9)
