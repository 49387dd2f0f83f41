"""The generated kernel against C written by hand for the same job, and against the usual ways.

256 surfaces, 2500 Runge-Kutta steps of 2 ms, rotary pendulum, one thread, float64.  Each
entrant runs in turn, round after round; ratios are of medians to the C of the same run.

    python benchmarks/kernel.py
"""

from __future__ import annotations

import ctypes
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
from scipy.integrate import solve_ivp

import undertow as ut
from undertow.mechanism import FloatArray
from undertow.sliding import SlidingModeLaw

SURFACES, STEPS, STEP = 256, 2500, 0.002
HERE = Path(__file__).parent

rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
loop = ut.ClosedLoop(rig, ut.MinimumEnergy(), step=STEP)
x0 = rig.state(phi=ut.deg(30))
rng = np.random.default_rng(0)
spread = 1 + 0.05 * rng.standard_normal((SURFACES, 4)) * np.array([0, 1, 1, 1])
vectors = np.array([-1.0, -1.59, 1.96, 12.1]) * spread


NAMES = ("a", "b", "c", "d", "d_e", "a_e", "limit", "eta", "layer")


class Parameters(ctypes.Structure):
    """The C side's constants."""

    _fields_ = [(n, ctypes.c_double) for n in NAMES]


def constants() -> Parameters:
    """The pendulum's lumped constants, SI."""
    p = {q.name: q.value for q in rig.parameters}
    m, half, r = p["m"], p["l"], p["r_o"]
    a, b, c, d = p["I_e"] + m * r * r, m * half * r, 4 / 3 * m * half**2, m * p["g"] * half
    return Parameters(a, b, c, d, p["d_e"], p["a_e"], 15.0, 20.0, 0.1)


def compiled_c(folder: Path) -> Callable[[], FloatArray] | None:
    """Compile rollout.c; None without gcc."""
    gcc = shutil.which("gcc")
    if gcc is None:
        return None
    library = folder / "rollout.so"
    flags = ["-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512", "-std=c99"]
    subprocess.run(
        [gcc, *flags, "-shared", "-fPIC", "-o", str(library), str(HERE / "rollout.c"), "-lm"],
        check=True,
    )
    function = ctypes.CDLL(str(library)).rollout
    pointer = np.ctypeslib.ndpointer(dtype=np.float64, flags="C")
    function.argtypes = [
        pointer, pointer, ctypes.c_size_t, ctypes.c_long, ctypes.c_double,
        ctypes.POINTER(Parameters), pointer,
    ]  # fmt: skip
    function.restype = None
    values, out = constants(), np.empty((SURFACES, 5))

    def run() -> FloatArray:
        function(x0, vectors, SURFACES, STEPS, STEP, ctypes.byref(values), out)
        return out[:, 0].copy()

    return run


def ours() -> FloatArray:
    """The generated block kernel, with all it watches."""
    return loop.batch(x0, vectors, duration=STEPS * STEP, terminal=0.0).cost


@numba.njit(cache=True, error_model="numpy")
def _scalar(x0, vectors, steps, h, a, b, c, d, d_e, a_e, limit, eta, layer):  # type: ignore[no-untyped-def]
    """A plain numba loop, one surface after another."""
    out = np.empty(len(vectors))
    for i in range(len(vectors)):
        aa, la, au, lu = vectors[i]
        x = x0.copy()
        cost = 0.0
        for _ in range(steps):
            y = x.copy()
            acc = np.zeros(4)
            cacc = 0.0
            for stage in range(4):
                th, ph, w, v = y
                sn, cs = np.sin(ph), np.cos(ph)
                X = -b * cs / c
                fy = (d * sn + c * sn * cs * w * w) / c
                f_a = -b * sn * v * v - 2 * c * sn * cs * v * w - d_e * w
                S = a + c * sn * sn + b * cs * X
                hh = f_a + b * cs * fy
                s = aa * w + la * th + au * v + lu * ph
                sat = max(-1.0, min(1.0, s / layer))
                drive = au * fy + la * w + lu * v + eta * sat
                u = max(-limit, min(limit, (-S * drive / (aa - au * X) - hh) / a_e))
                qa = (hh + a_e * u) / S
                k = np.array([w, v, qa, fy - X * qa])
                weight = 1.0 if stage in (0, 3) else 2.0
                acc += weight * k
                cacc += weight * u * u
                y = x + (0.5 * h if stage < 2 else h) * k
            x = x + h / 6 * acc
            cost += h / 6 * cacc
        out[i] = cost
    return out


def plain_numba() -> FloatArray:
    """The same equations as a plain numba loop."""
    p = constants()
    return np.asarray(
        _scalar(x0, vectors, STEPS, STEP, p.a, p.b, p.c, p.d, p.d_e, p.a_e, p.limit, p.eta, p.layer)
    )


def scipy_members(count: int = 2) -> FloatArray:
    """SciPy's LSODA at rtol 1e-8 for a few members (its time is scaled up)."""
    costs = []
    for vector in vectors[:count]:
        law = SlidingModeLaw(rig, ut.Surface.from_vector(vector, 2, 1))

        def rate(t: float, z: FloatArray, law: SlidingModeLaw = law) -> FloatArray:
            u = law(t, z[:4]).u
            return np.array([*z[2:4], *rig.accelerations(t, z[:4], u), float(u @ u)])

        end = solve_ivp(
            rate, (0, STEPS * STEP), [*x0, 0.0], method="LSODA", rtol=1e-8, atol=1e-10,
            max_step=0.01,
        )  # fmt: skip
        costs.append(end.y[4, -1])
    return np.array(costs)


def main() -> int:
    """Run the entrants in turn and print a table of ratios."""
    with tempfile.TemporaryDirectory() as folder:
        c = compiled_c(Path(folder))
        entrants: dict[str, tuple[Callable[[], Any], float]] = {
            "undertow, generated kernel": (ours, 1.0),
            "numba, plain loop": (plain_numba, 1.0),
        }
        if c is not None:
            entrants = {"C by hand, gcc -O3, blocks of 32": (c, 1.0), **entrants}
        results = {name: run() for name, (run, _) in entrants.items()}  # warm-up, compile
        times: dict[str, list[float]] = {name: [] for name in entrants}
        for _ in range(15):
            for name, (run, _) in entrants.items():
                began = time.perf_counter()
                run()
                times[name].append(time.perf_counter() - began)
        began = time.perf_counter()
        members = scipy_members()
        times["SciPy LSODA, 1e-8 (2 members, scaled)"] = [
            (time.perf_counter() - began) / len(members) * SURFACES
        ]
    medians = {name: statistics.median(t) for name, t in times.items()}
    first = next(iter(medians))
    print(f"{SURFACES} surfaces x {STEPS} steps x 4 stages, one thread, float64\n")
    print(f"{'entrant':40s} {'ms':>9s} {'ratio':>8s} {'cost agrees to':>15s}")
    reference = results[first]
    for name, median in medians.items():
        costs = results.get(name, members)
        error = np.max(np.abs(costs - reference[: len(costs)]) / reference[: len(costs)])
        print(f"{name:40s} {median * 1e3:9.1f} {median / medians[first]:8.2f} {error:15.1e}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
