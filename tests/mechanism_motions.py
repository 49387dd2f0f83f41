"""Motions of any mechanism from the edges of claimed starts, by code unlike the provers'.

Of a certificate the graph of M, f and B is read, and the numbers of its law and its claims; the
nodes are evaluated and the law is written down again in plain NumPy, as
``docs/certificate-format.md`` has them, sections 3 and 4, for inputs that are renewed at every
instant.  Motions are followed by the classical Runge-Kutta method until all are in the terminal
set of the claim's hint and 1 s more; one that is not home then, or leaves the set again, is
followed in finer steps before it counts.

``python tests/mechanism_motions.py tests/data/mechanism_loops/*.json`` follows 400 from each claim.
With ``--limit`` it prints instead what is claimed, how much that is of what comes home by
simulation, and how many tubes the hint begins with.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from claimed_motions import FloatArray, box_of, number, numbers, on_faces

#: Step, s; it is so much finer before a motion counts as one that failed, and coarser for limits.
STEP, FINER, COARSER = 1e-3, 10, 4

#: Longest motion, and how long one is watched in the terminal set, s.
LONGEST, WATCHED = 20.0, 1.0

UNARY = {"sin": np.sin, "cos": np.cos, "tanh": np.tanh, "exp": np.exp, "log": np.log,
         "sqrt": np.sqrt, "neg": np.negative}  # fmt: skip
BINARY = {"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide}


@dataclass(frozen=True)
class Claimed:
    """One claim of a closed loop: model, law, starts (2n, 2), terminal set, parts of the starts."""

    model: dict[str, Any]
    law: dict[str, Any]
    starts: FloatArray
    W: FloatArray
    radius: float
    parts: int

    @cached_property
    def nodes(self) -> list[Any]:
        """Return the nodes, with the values of numbers and parameters in their place."""
        known = [number(p["value"]) for p in self.model["parameters"]]
        return [
            number(args[0]) if kind == "number" else np.pi if kind == "pi"
            else known[args[0]] if kind == "parameter" else (kind, *args)
            for kind, *args in self.model["nodes"]
        ]  # fmt: skip

    @cached_property
    def numbers(self) -> list[FloatArray]:
        """Return the blocks of the surface, η, ε and the limits of the inputs."""
        assert self.law["switching"] == "saturation"
        assert not any(map(number, self.law["disturbance"]))
        keys = ("alpha_a", "lambda_a", "alpha_u", "lambda_u", "eta", "layer")
        limits = [number(i["limit"]) if i["limit"] else np.inf for i in self.model["inputs"]]
        return [*(numbers(self.law[k]) for k in keys), np.array(limits)]

    @property
    def words(self) -> str:
        """Return the starts in words."""
        names = [p["name"] for p in self.model["positions"]]
        ends = zip([*names, *(f"{k}_dot" for k in names)], self.starts[:, 1], strict=True)
        return ", ".join(f"|{k}| ≤ {v:.4g}" for k, v in ends if v)

    @cached_property
    def sizes(self) -> tuple[int, int]:
        """Return n and m."""
        return len(self.model["f"]), len(self.model["inputs"])

    def plant(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return M (L, n, n), f (L, n) and B (L, m, m) at states (L, 2n)."""
        n, _ = self.sizes
        leaves = {"position": x[:, :n].T, "velocity": x[:, n:].T}
        values: list[Any] = []
        for node in self.nodes:
            if isinstance(node, float):
                values.append(node)
                continue
            kind, a, *b = node
            if kind in leaves:
                values.append(leaves[kind][a])
            elif kind == "pow":
                values.append(values[a] ** b[0])
            elif kind in UNARY:
                values.append(UNARY[kind](values[a]))
            else:
                values.append(BINARY[kind](values[a], values[b[0]]))

        def table(rows: list[list[int]]) -> FloatArray:
            one = np.ones(len(x))
            return np.array([[values[k] * one for k in row] for row in rows]).transpose(2, 0, 1)

        whole = [[self.model["M"][max(i, j)][min(i, j)] for j in range(n)] for i in range(n)]
        return table(whole), table([self.model["f"]])[:, 0], table(self.model["B"])

    def rates(self, x: FloatArray) -> FloatArray:
        """Return ẋ of states (L, 2n) under the law, its layer and its clip."""
        n, m = self.sizes
        alpha_a, lambda_a, alpha_u, lambda_u, eta, layer, limits = self.numbers
        M, f, B = self.plant(x)
        q_a, q_u, v_a, v_u = np.split(x, [m, n, n + m], axis=1)
        s = v_a @ alpha_a.T + q_a @ lambda_a.T + v_u @ alpha_u.T + q_u @ lambda_u.T
        wanted = -eta * np.clip(s / layer, -1, 1)  # ṡ
        # q̈_a that makes ṡ so, with the passive rows M_ua q̈_a + M_uu q̈_u = f_u
        X = np.linalg.solve(M[:, m:, m:], M[:, m:, :m])
        y = np.linalg.solve(M[:, m:, m:], f[:, m:, None])[..., 0]
        right = wanted - v_a @ lambda_a.T - v_u @ lambda_u.T - y @ alpha_u.T
        w_a = np.linalg.solve(alpha_a - alpha_u @ X, right[..., None])[..., 0]
        w = np.concatenate([w_a, y - np.einsum("lij,lj->li", X, w_a)], axis=1)
        force = np.einsum("lij,lj->li", M[:, :m], w) - f[:, :m]
        u = np.clip(np.linalg.solve(B, force[..., None])[..., 0], -limits, limits)
        f[:, :m] += np.einsum("lij,lj->li", B, u)
        return np.concatenate([x[:, n:], np.linalg.solve(M, f[..., None])[..., 0]], axis=1)

    def moved(self, x: FloatArray, h: float) -> FloatArray:
        """Return states h later, by one step."""
        a = self.rates(x)
        b = self.rates(x + h / 2 * a)
        c = self.rates(x + h / 2 * b)
        return x + h / 6 * (a + 2 * b + 2 * c + self.rates(x + h * c))

    def inside(self, x: FloatArray) -> Any:
        """Whether states are in the terminal set."""
        return np.linalg.norm(x @ self.W.T, axis=1) <= self.radius

    def failed(self, x: FloatArray, step: float = STEP) -> Any:
        """Which motions from states (L, 2n) do not end in the terminal set, or leave it again."""
        left, been = np.zeros(len(x), dtype=bool), self.inside(x)
        last, t = LONGEST, 0.0
        with np.errstate(all="ignore"):
            for t in step * np.arange(1, round(LONGEST / step) + 1):
                x = self.moved(x, step)
                x[~(np.abs(x) < 1e6)] = np.nan
                now = self.inside(x)
                left |= been & ~now
                been |= now
                last = min(last, t + WATCHED) if been.all() else last
                lost = np.isnan(x).any(axis=1)
                if t >= last or ((been | lost).all() and lost.any()):
                    break
        return left | ~self.inside(x)

    def tried(self, rng: np.random.Generator, count: int, step: float = STEP) -> int:
        """How many motions from the edges of the starts fail."""
        x = on_faces(self.starts)(rng, np.empty((count, 0)))
        bad = np.nonzero(self.failed(x, step))[0][:16]
        return int(self.failed(x[bad], STEP / FINER).sum()) if len(bad) else 0

    def share(self, rng: np.random.Generator, count: int) -> float:
        """The starts as a part of the largest of their shape of which all come home, by halving."""

        def home(size: float) -> bool:
            x = on_faces(self.starts * size)(rng, np.empty((count, 0)))
            return not self.failed(x, STEP * COARSER).any()

        low, high = 1.0, 1.5
        while home(high):
            low, high = high, 1.5 * high
        while high > 1.02 * low:
            middle = (low * high) ** 0.5
            low, high = (middle, high) if home(middle) else (low, middle)
        return 1 / low


def claims(document: dict[str, Any]) -> list[Claimed]:
    """Return what a certificate says of closed loops."""
    found, model = [], document["model"]
    names = [p["name"] for p in model["positions"]]
    states = (*names, *(f"{name}_dot" for name in names))
    for subject in document["subjects"]:
        for claim in (c for c in subject["claims"] if c["kind"] == "closed loop"):
            assert number(claim["period"]) == 0
            assert not claim["plant"]
            assert not any(map(number, claim["disturbance"]))
            end, law = claim["hint"]["terminal"], subject["law"]
            starts = box_of(claim["starts"], states, np.zeros(len(states)))
            cuts = [[number(v) for v in claim["hint"]["boxes"].get(k, ())] for k in states
                    if k in claim["starts"]] if "boxes" in claim["hint"] else [[]]  # fmt: skip
            cuts[0] = [v for v in cuts[0] if v > 0]  # the loops are odd: one side will do
            parts = math.prod(1 + len(v) for v in cuts)
            W, radius = numbers(end["W"]), number(end["radius"])
            found.append(Claimed(model, law, starts, W, radius, parts))
    return found


def main() -> int:
    """Try files; return 1 if a motion did not do what is claimed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--count", type=int, default=400)
    parser.add_argument("--limit", action="store_true")
    given = parser.parse_args()
    total = 0
    for path in given.files:
        for claim in claims(json.loads(path.read_text())):
            rng = np.random.default_rng(5)
            if given.limit:
                print(f"{path.stem}: {claim.words}: {claim.share(rng, 16):.0%} of what comes home, "
                      f"{claim.parts} tubes", flush=True)  # fmt: skip
                continue
            bad = claim.tried(rng, given.count)
            print(f"{path.stem}: {given.count} motions, {bad} failed", flush=True)
            total += bad
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
