"""Motions from the edges of what certificates claim, by code that shares nothing with the provers.

The plant and the law are written by hand in ``claimed_motions.c``, for the rotary pendulum; of a
certificate its numbers are read, and nothing else.  Motions begin on faces and corners of boxes of
starts, on ellipsoids, and where a function of a region is 1, with the plant and the forces mostly
at corners of their boxes.  Each has to do what its claim says.

``python tests/claimed_motions.py tests/data/*.json`` follows a million of them, says how many did
not, and ends with 1 if there is one.  With ``--limit`` it says instead how much of what comes home
by simulation is claimed.  Needs gcc or another C compiler; some minutes.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Document = dict[str, Any]

HERE = Path(__file__).parent
COMPILER = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)

#: The order of states and parameters in the C file, and what its outcomes are called.
STATES = ("theta", "phi", "theta_dot", "phi_dot")
PARAMETERS = ("l", "r_o", "m", "I_e", "d_e", "a_e", "g")
OUTCOMES = ("home", "not home in time", "singular or lost", "left the set", "left layer or limits")

#: Step of a law that is renewed always, s, of RK4; parts of a period; both this much finer before
#: a motion counts as one that failed.
STEP, PARTS, FINER = 1e-3, 1, 20

#: Motions that say how long those of a set are; quick ones are followed more often.
PILOT = 32

#: Longest motion, s; ‖x‖ at which one is home, and what is left of |W z| then.
LONGEST, HOME, INSIDE = 100.0, 0.05, 0.1


class Task(ctypes.Structure):
    """``struct task`` of the C file."""

    _fields_ = (
        ("known", ctypes.c_double * 7), ("law", ctypes.c_double * 6), ("limit", ctypes.c_double),
        ("period", ctypes.c_double), ("parts", ctypes.c_int64), ("step", ctypes.c_double),
        ("duration", ctypes.c_double), ("home", ctypes.c_double), ("W", ctypes.c_double * 16),
        ("radius", ctypes.c_double),
    )  # fmt: skip


class Simulator:
    """The C file, compiled for this machine."""

    def __init__(self, folder: Path) -> None:
        assert COMPILER is not None, "needs a C compiler: install gcc"
        built = folder / "claimed_motions.so"
        flags = ["-std=c11", "-O3", "-march=native", "-Wall", "-Wextra", "-Werror"]
        made = ["-shared", "-fPIC", "-o", str(built), str(HERE / "claimed_motions.c"), "-lm"]
        subprocess.run([COMPILER, *flags, *made], check=True)
        self.library = ctypes.CDLL(str(built))

    def follow(
        self, task: Task, states: FloatArray, plants: FloatArray, forces: FloatArray
    ) -> tuple[FloatArray, NDArray[np.int64], FloatArray]:
        """Return the last states (N, 4), outcomes and times of motions, which end there."""
        x, count = np.ascontiguousarray(states).copy(), len(states)
        outcomes, times = np.full(count, -1, dtype=np.int64), np.empty(count)
        plants, forces = (np.ascontiguousarray(v, dtype=float) for v in (plants, forces))
        assert plants.shape == (count, 7)
        assert forces.shape == (count, 2)
        pointers = [v.ctypes.data_as(ctypes.c_void_p) for v in (x, plants, forces, outcomes, times)]
        self.library.follow(ctypes.byref(task), ctypes.c_int64(count), *pointers)
        return x, outcomes, times

    def accelerations(self, plant: FloatArray, state: FloatArray, u: float) -> FloatArray:
        """Return (θ̈, φ̈) of one plant at one state."""
        found = np.empty(2)
        pointers = [
            np.ascontiguousarray(v, dtype=float).ctypes.data_as(ctypes.c_void_p)
            for v in (plant, state)
        ]
        self.library.accelerations(
            *pointers, ctypes.c_double(u), found.ctypes.data_as(ctypes.c_void_p)
        )
        return found


def number(text: str) -> float:
    """Return the number of a certificate's text."""
    return float.fromhex(text) if "0x" in text else float(Fraction(text))


def numbers(data: Any) -> Any:
    """Return an array of number texts."""
    return np.vectorize(number, otypes=[float])(np.array(data))


@dataclass(frozen=True)
class Edge:
    """One set of starts, and what motions from it have to do.

    Parameters
    ----------
    what
        Its name.
    task
        Law, limits and when a motion is home.
    starts
        Draws states (N, 4) on its edge, for as many plants (N, 7).
    plants, forces
        Ends of the parameters, (7, 2), and largest forces, (2,).
    growth
        With a claim about s alone: how fast |s| has to fall, 1/s.
    share
        Part of its claim's motions.
    box
        Of a closed loop: its starts, (4, 2).
    """

    what: str
    task: Task
    starts: Callable[[np.random.Generator, FloatArray], FloatArray]
    plants: FloatArray
    forces: FloatArray = field(default_factory=lambda: np.zeros(2))
    growth: float | None = None
    share: float = 1.0
    box: FloatArray | None = None

    def run(self, simulator: Simulator, rng: np.random.Generator, count: int) -> FloatArray:
        """Follow motions; return how many there are of each outcome, and the latest arrival, s."""
        corner = rng.random(count) < 0.75
        part = np.where(corner[:, None], rng.integers(0, 2, (count, 7)), rng.random((count, 7)))
        plants = self.plants[:, 0] + part * (self.plants[:, 1] - self.plants[:, 0])
        x = self.starts(rng, plants)
        forces = rng.choice([-1.0, 1.0], (len(x), 2)) * self.forces
        end, outcomes, times = simulator.follow(self.task, x, plants, forces)
        if self.growth is not None:
            row = np.array(self.task.law)[[1, 3, 0, 2]]
            before, after = np.abs(x @ row), np.abs(end @ row)
            outcomes = np.where(
                after <= before - self.growth * times + 1e-9, 0, np.maximum(outcomes, 1)
            )
        again = np.nonzero(outcomes)[0] if self.growth is None else np.empty(0, dtype=int)
        if len(again):
            finer = Task.from_buffer_copy(self.task)
            finer.step, finer.parts = finer.step / FINER, finer.parts * FINER
            some = again[:16]  # so many are enough to know
            _, outcomes[some], times[some] = simulator.follow(
                finer, x[some], plants[some], forces[some]
            )
        home = times[outcomes == 0]
        counted = np.bincount(outcomes, minlength=len(OUTCOMES)).astype(float)
        return np.append(counted, home.max(initial=0.0))

    def part(self, simulator: Simulator, rng: np.random.Generator, count: int) -> float:
        """Return the starts of a closed loop as a part of the largest that all come home.

        Boxes of the same shape are tried, each a hundredth larger, with so many motions each.
        """
        assert self.box is not None
        for percent in itertools.count(101):
            larger = replace(self, starts=on_faces(self.box * percent / 100))
            if larger.run(simulator, rng, count)[1:-1].any():
                return 100.0 / (percent - 1)
        raise AssertionError


def box_of(data: Mapping[str, list[str]], names: tuple[str, ...], at: FloatArray) -> FloatArray:
    """Return ends of named quantities, (K, 2), those that are not named at their values."""
    ends = [
        [number(v) for v in data[k]] if k in data else [a, a]
        for k, a in zip(names, at, strict=True)
    ]
    return np.array(ends)


def on_faces(box: FloatArray) -> Callable[[np.random.Generator, FloatArray], FloatArray]:
    """Draw from a box (N, 2): half of all entries at an end, most points on a face."""

    def draw(rng: np.random.Generator, plants: FloatArray) -> FloatArray:
        shape = (len(plants), len(box))
        part = np.where(rng.random(shape) < 0.5, rng.integers(0, 2, shape), rng.random(shape))
        return np.asarray(box[:, 0] + part * (box[:, 1] - box[:, 0]))

    return draw


def on_ellipsoid(
    W: FloatArray, radius: float, law: FloatArray, held: bool
) -> Callable[[np.random.Generator, FloatArray], FloatArray]:
    """Draw from {|W z| = radius}, a hair inside, as states; z = (q, p, s) if the input is held."""

    def draw(rng: np.random.Generator, plants: FloatArray) -> FloatArray:
        e = rng.normal(size=(len(plants), 4))
        e *= radius * (1 - 1e-9) / np.linalg.norm(e, axis=1, keepdims=True)
        z = np.linalg.solve(W, e.T).T
        if held:
            length, r_o, m = plants[:, :3].T
            a_a, l_a, a_u, l_u = law[:4]
            b, c = m * length * r_o * np.cos(z[:, 1]), 4 / 3 * m * length**2
            # c v_u − b v_a = p and a_a v_a + a_u v_u = s − l_a q_a − l_u q_u
            rest = z[:, 3] - l_a * z[:, 0] - l_u * z[:, 1]
            v_a = (rest - a_u * z[:, 2] / c) / (a_a + a_u * b / c)
            z = np.column_stack([z[:, :2], v_a, (z[:, 2] + b * v_a) / c])
        return np.asarray(z)

    return draw


def on_level(
    claim: Document, index: int, law: FloatArray
) -> Callable[[np.random.Generator, FloatArray], FloatArray]:
    """Draw states on the surface where function ``index`` of a region is 1, a hair inside.

    In c = (I + Σ τʲ Sⱼ) y, of which V(A c) and G c are made; rays from 0, from |G c| = 1 inwards.
    """
    V = claim["functions"][index]
    A, G, c = numbers(V["A"]), numbers(V["G"]), numbers(V["coefficients"])
    powers = np.array(V["exponents"])
    S = [numbers(v) for v in claim["stretch"]]
    pole = number(claim["pole"]) if claim["pole"] is not None else np.inf
    a_a, l_a, a_u, l_u = law[:4]

    def value(c_: FloatArray) -> FloatArray:
        z = c_ @ A.T
        table = [z**0]
        for _ in range(int(powers.max())):
            table.append(table[-1] * z)
        stack, product = np.array(table), np.ones((len(c_), len(powers)))
        for j in range(3):
            product *= stack[powers[:, j], :, j].T
        return np.asarray(product @ c)

    def stretched(y: FloatArray) -> tuple[FloatArray, FloatArray]:
        tau = y**2 / (pole**2 - y**2) if S else 0 * y
        return tau, y * (1 + sum(tau ** (j + 1) * s[0, 0] for j, s in enumerate(S)))

    def back(c_: FloatArray) -> FloatArray:
        low, high = np.zeros(len(c_)), np.minimum(np.abs(c_[:, 0]), pole)
        for _ in range(80):
            middle = (low + high) / 2
            with np.errstate(all="ignore"):
                larger = stretched(middle)[1] > np.abs(c_[:, 0])
            low, high = np.where(larger, low, middle), np.where(larger, middle, high)
        tau = stretched(low)[0]
        T = np.eye(3) + sum(tau[:, None, None] ** (j + 1) * s for j, s in enumerate(S))
        return np.linalg.solve(T, c_[..., None])[..., 0]

    def draw(rng: np.random.Generator, plants: FloatArray) -> FloatArray:
        e = rng.normal(size=(len(plants), 3))
        e = np.linalg.solve(G, (e / np.linalg.norm(e, axis=1, keepdims=True)).T).T
        out = np.ones(len(plants))
        for _ in range(60):  # the outermost point inside, roughly
            outside = value(out[:, None] * e) > 1
            if not outside.any():
                break
            out[outside] *= 0.95
        low, high = out, out / 0.95
        for _ in range(30):
            middle = (low + high) / 2
            inside = value(middle[:, None] * e) <= 1
            low, high = np.where(inside, middle, low), np.where(inside, high, middle)
        low = np.minimum(low, 1.0)
        phi, v, w = back(low[:, None] * e).T
        arm = -(l_a * w + a_u * v) / a_a
        return np.column_stack([w - l_u / l_a * phi, phi, arm, v])

    return draw


def beyond_layer(
    phi: FloatArray, law: FloatArray
) -> Callable[[np.random.Generator, FloatArray], FloatArray]:
    """Draw states with |s| of one to three layers, on the ends of a region as often as inside."""

    def draw(rng: np.random.Generator, plants: FloatArray) -> FloatArray:
        a_a, l_a, a_u, l_u, _, layer = law
        count = len(plants)
        x = rng.uniform(-1, 1, (count, 4)) * [1.0, 0.0, 3.0, 3.0]
        x[:, 1] = on_faces(phi[None])(rng, plants)[:, 0]
        x[:, 3] = -np.sign(x[:, 1]) * np.abs(x[:, 3])  # it does not leave the region
        s = layer * rng.uniform(1.01, 3.0, count) * rng.choice([-1.0, 1.0], count)
        x[:, 2] = (s - l_a * x[:, 0] - a_u * x[:, 3] - l_u * x[:, 1]) / a_a
        return x

    return draw


def edges(document: Document) -> Iterator[Edge]:
    """Yield the sets of a certificate from whose edges motions can be followed."""
    model = document["model"]
    assert tuple(p["name"] for p in model["positions"]) == STATES[:2], "not the rotary pendulum"
    own = {p["name"]: number(p["value"]) for p in model["parameters"]}
    plant = np.array([own[k] for k in PARAMETERS])
    exact = np.column_stack([plant, plant])
    limit = number(model["inputs"][0]["limit"] or "0") or np.inf
    for k, subject in enumerate(document["subjects"], start=1):
        data = subject["law"]
        blocks = [number(data[v][0][0]) for v in ("alpha_a", "lambda_a", "alpha_u", "lambda_u")]
        law = np.array([*blocks, number(data["eta"][0]), number(data["layer"][0])])
        task = Task(
            tuple(plant), tuple(law), limit, 0.0, PARTS, STEP, LONGEST, HOME, (0.0,) * 16, 0.0
        )

        def with_set(terminal: Document, period: float, base: Task = task) -> tuple[Task, Any]:
            W, radius = numbers(terminal["W"]), number(terminal["radius"])
            own = Task.from_buffer_copy(base)
            own.period, own.W, own.radius = period, tuple(W.ravel()), radius
            own.home = INSIDE
            return own, (W, radius)

        for number_of, claim in enumerate(subject["claims"], start=1):
            kind, what = claim["kind"], f"law {k}, claim {number_of}"
            if kind == "terminal ellipsoid":
                own_task, (W, radius) = with_set(claim, 0.0)
                yield Edge(
                    f"{what}: ellipsoid",
                    own_task,
                    on_ellipsoid(W, radius, law, False),
                    exact,
                )
            elif kind == "reaching":
                brief = Task.from_buffer_copy(task)
                brief.limit, brief.duration, brief.step, brief.home = np.inf, 2e-4, 1e-5, 0.0
                ends = box_of(claim["region"], STATES, np.zeros(4))[1]
                loads, rate = numbers(claim["disturbance"]), number(claim["rate"][0])
                yield Edge(f"{what}: |s| falls", brief, beyond_layer(ends, law), exact, loads, rate)
            elif kind == "surface region":
                free = Task.from_buffer_copy(task)
                free.limit = np.inf
                box = box_of(claim["plant"], PARAMETERS, plant)
                for index in range(len(claim["functions"])):
                    yield Edge(
                        f"{what}: region, set {index + 1}", free, on_level(claim, index, law), box,
                        share=1 / len(claim["functions"]),
                    )  # fmt: skip
            elif kind == "closed loop":
                whole, period = Task.from_buffer_copy(task), number(claim["period"])
                whole.period = period
                box = box_of(claim["plant"], PARAMETERS, plant)
                starts = box_of(claim["starts"], STATES, np.zeros(4))
                yield Edge(f"{what}: loop", whole, on_faces(starts), box, box=starts)
                if "terminal" in claim.get("hint", {}):
                    own_task, (W, radius) = with_set(claim["hint"]["terminal"], period)
                    yield Edge(
                        f"{what}: its terminal set", own_task,
                        on_ellipsoid(W, radius, law, period > 0), box,
                    )  # fmt: skip


def main() -> int:
    """Follow motions from the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path, help="certificates")
    parser.add_argument("--motions", type=int, default=1_000_000, help="in all, more where short")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=int, metavar="N", help="try larger starts, N motions each")
    asked = parser.parse_args()
    found = [(f.name, e) for f in asked.files for e in edges(json.loads(f.read_text()))]
    failed, total = 0, 0
    with tempfile.TemporaryDirectory() as folder:
        simulator, rng = Simulator(Path(folder)), np.random.default_rng(asked.seed)
        if asked.limit:
            for name, edge in found:
                if edge.box is not None:
                    ends = np.rad2deg(edge.box[1, 1])
                    part = edge.part(simulator, rng, asked.limit)
                    print(f"{name}, {edge.what}: phi up to {ends:.2f} deg, {part:.0%} of "
                          f"{ends / part:.2f} deg, up to which all motions come home")  # fmt: skip
            return 0
        weights = np.array(
            [edge.share / np.sqrt(1 + edge.run(simulator, rng, PILOT)[-1]) for _, edge in found]
        )
        shares = np.ceil(asked.motions * weights / weights.sum()).astype(int)
        for (name, edge), share in zip(found, shares.tolist(), strict=True):
            began = time.process_time()
            *counted, latest = edge.run(simulator, rng, share)
            bad = {w: int(c) for w, c in zip(OUTCOMES[1:], counted[1:], strict=True) if c}
            total, failed = total + int(sum(counted)), failed + sum(bad.values())
            words = ", ".join(f"{c} {w}" for w, c in bad.items()) or "all did"
            print(f"{name}, {edge.what}: {int(sum(counted))} motions, {words}, the latest after "
                  f"{latest:.1f} s; {time.process_time() - began:.0f} s", flush=True)  # fmt: skip
    print(f"{total} motions from {len(found)} sets, {failed} did not do what is claimed")
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
