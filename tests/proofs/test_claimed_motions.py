"""What the kept certificates claim, against motions by other code; and that it would notice."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from claimed_motions import COMPILER, PARAMETERS, Simulator, edges, number

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")

DATA = Path(__file__).parents[1] / "data"
KEPT = sorted(p.name for p in DATA.glob("*.json"))

Document = dict[str, Any]


@pytest.fixture(scope="session")
def simulator(tmp_path_factory: pytest.TempPathFactory) -> Simulator:
    return Simulator(tmp_path_factory.mktemp("motions"))


def document(name: str) -> Document:
    data: Document = json.loads((DATA / name).read_text())
    return data


def failed(data: Document, simulator: Simulator, count: int, what: str = "") -> dict[str, int]:
    """How many motions do not do what is claimed, by the set that they begin on."""
    rng = np.random.default_rng(7)
    found = [edge for edge in edges(data) if what in edge.what]
    return {e.what: int(e.run(simulator, rng, count)[1:-1].sum()) for e in found}


# -- the equations --------------------------------------------------------------------------------


def of_the_file(model: Document, x: Any, p: list[float], u: float) -> Any:
    """q̈ by the nodes of a model."""
    values: list[float] = []
    for kind, *args in model["nodes"]:
        if kind == "number":
            values.append(number(args[0]))
        elif kind in ("position", "velocity", "parameter"):
            values.append({"position": x[:2], "velocity": x[2:], "parameter": p}[kind][args[0]])
        elif kind == "pow":
            values.append(values[args[0]] ** args[1])
        elif kind in ("sin", "cos"):
            values.append(getattr(math, kind)(values[args[0]]))
        else:
            a, b = values[args[0]], values[args[-1]]
            values.append({"add": a + b, "sub": a - b, "mul": a * b, "neg": -a}[kind])
    M = [[values[model["M"][max(i, j)][min(i, j)]] for j in (0, 1)] for i in (0, 1)]
    first, second = (values[k] for k in model["f"])
    return np.linalg.solve(M, [first + values[model["B"][0][0]] * u, second])


@pytest.mark.parametrize("name", KEPT)
def test_the_equations_by_hand_are_those_of_the_file(name: str, simulator: Simulator) -> None:
    model, rng = document(name)["model"], np.random.default_rng(3)
    known = {p["name"]: number(p["value"]) for p in model["parameters"]}
    for _ in range(50):
        x = rng.uniform(-1, 1, 4) * [3.0, 1.5, 10.0, 10.0]
        own = {k: v * rng.uniform(0.5, 2.0) for k, v in known.items()}
        u = rng.uniform(-15, 15)
        wanted = of_the_file(model, x, [own[p["name"]] for p in model["parameters"]], u)
        found = simulator.accelerations(np.array([own[k] for k in PARAMETERS]), x, u)
        assert found == pytest.approx(wanted, rel=1e-11, abs=1e-11)


# -- what is claimed ------------------------------------------------------------------------------


def test_motions_from_the_edges_of_quick_claims_do_what_is_claimed(simulator: Simulator) -> None:
    names = ("certificate_v2", "held_loop_v2", "held_loop_plants_v2", "held_loop_starts_v2")
    for name in (f"{name}.json" for name in names):
        counted = failed(document(name), simulator, 64)
        assert len(counted) >= 2
        assert not any(counted.values()), counted


@pytest.mark.slow
@pytest.mark.parametrize("name", KEPT)
def test_motions_from_the_edges_of_all_kept_claims_do_what_is_claimed(
    name: str, simulator: Simulator
) -> None:
    counted = failed(document(name), simulator, 200)
    assert counted
    assert not any(counted.values()), counted


def larger(claim: Document, factor: float) -> None:
    """The set that is claimed, larger."""
    if claim["kind"] == "surface region":
        for V in claim["functions"]:
            V["coefficients"] = [_times(v, 1 / factor**2) for v in V["coefficients"]]
            V["G"] = [[_times(v, 1 / factor) for v in row] for row in V["G"]]
    elif claim["kind"] == "terminal ellipsoid":
        claim["radius"] = _times(claim["radius"], 100 * factor)
    elif claim["kind"] == "reaching":
        claim["disturbance"] = [_times(v, factor) for v in claim["disturbance"]]
    elif claim["kind"] == "closed loop":
        claim["starts"] = {
            k: [_times(v, factor) for v in pair] for k, pair in claim["starts"].items()
        }
        end = claim["hint"]["terminal"]
        end["radius"] = _times(end["radius"], 100 * factor)


def _times(text: str, factor: float) -> str:
    return float(number(text) * factor).hex()


@pytest.mark.parametrize(
    ("name", "law", "factor"),
    [
        ("certificate_v2.json", 0, 2),
        ("held_loop_v2.json", 0, 1.5),
        ("held_loop_v2.json", 1, 2.2),
        ("held_loop_plants_v2.json", 0, 10),
        ("held_loop_starts_v2.json", 0, 16),
        ("closed_loop_v2.json", 4, 1.5),
        ("regions.json", 4, 30),
    ],
)
def test_claims_that_are_too_large_are_noticed(
    name: str, law: int, factor: float, simulator: Simulator
) -> None:
    data = document(name)
    data["subjects"] = [data["subjects"][law]]
    assert not any(failed(data, simulator, 16).values())
    for claim in data["subjects"][0]["claims"]:
        larger(claim, factor)
    counted = failed(data, simulator, 80)
    if name == "regions.json":  # inner sets are small, and in the regions of attraction still
        counted = dict([counted.popitem()])
    assert counted
    assert all(counted.values()), counted


def _period(claim: Document) -> None:
    claim["period"] = "1/50"  # the layer's own rate is 200/s


def _plants(claim: Document) -> None:
    claim["plant"] = {"a_e": ["1/1000", "1/2"]}


def _gone(claim: Document) -> None:
    claim["hint"] = {}


def test_plants_of_a_box_are_tried_at_its_corners(simulator: Simulator) -> None:
    """Boxes that are too wide are noticed, of the loop and of its terminal set."""
    data = document("held_loop_plants_v2.json")
    claims = data["subjects"][0]["claims"]
    own = [p for p in data["model"]["parameters"] if p["name"] == "m"]
    known = number(own[0]["value"])
    for claim in claims:
        assert number(claim["plant"]["m"][0]) == pytest.approx(0.98 * known)
        claim["plant"]["m"] = [float(v * known).hex() for v in (0.2, 5.0)]
    counted = failed(data, simulator, 200)
    assert len(counted) == 2 * len(claims)
    assert all(counted.values()), counted


@pytest.mark.parametrize("change", [_period, _plants])
def test_loops_of_other_samplers_or_plants_are_noticed(
    change: Callable[[Document], None], simulator: Simulator
) -> None:
    data = copy.deepcopy(document("held_loop_v2.json"))
    claims = [claim for subject in data["subjects"] for claim in subject["claims"]]
    for claim in claims:
        _gone(claim)
        change(claim)
    counted = failed(data, simulator, 100)
    assert len(counted) == len(claims)
    assert all(counted.values()), counted
