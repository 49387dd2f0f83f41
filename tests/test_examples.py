"""The example drivers: a pendulum balanced over a pseudo-terminal, and over UDP with losses."""

from __future__ import annotations

import importlib
import math
import sys
from pathlib import Path
from types import ModuleType

import pytest

import undertow as ut

EXAMPLES = Path(__file__).parent.parent / "examples"


def _example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    return importlib.import_module(name)


@pytest.mark.parametrize("name", ["serial_rig", "udp_rig"])
def test_a_driver_of_twenty_lines_balances(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if name == "serial_rig" and sys.platform == "win32":
        pytest.skip("pseudo-terminals are POSIX")
    largest = _example(name, monkeypatch).main(seconds=3.0)
    assert largest < ut.deg(1)


def test_what_cannot_be_read_is_a_lost_reading(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = _example("wire", monkeypatch)
    for line in (b"", b"q", b"\xff\xfe", b"q 0.1 x 3"):
        assert math.isnan(wire.parse(line).q[0])
    sound = wire.parse(b"q 0.25 1024 -2048\n")
    assert sound.t == 0.25
    assert sound.q.tolist() == pytest.approx([math.pi / 2, -math.pi])
