"""The generated kernel against C written by hand for the same job, and against the usual ways.

256 surfaces, 2500 Runge-Kutta steps of 2 ms, rotary pendulum, one thread, float64.  The fast
entrants run in turn, round after round; ratios are of medians to the C of the same run.  The
same scheme with the same step must give the same cost: the largest relative difference is
printed.  SciPy's adaptive integrators are another scheme, so theirs shows the error of the
Runge-Kutta steps instead; they run for a few surfaces and are scaled up.

Last, eight times as many surfaces by one thread and by two, in turn, on the wall clock: by the
generated kernel with ``threads=2``, and by the C, called by two threads for half of them each,
which shows what the machine and its other users leave to a second thread; and the processor time
of both threads, which shows what sharing costs.
"""

from __future__ import annotations

from harness import clock, command_line, need, race, table  # isort: skip  first: one thread

import ctypes
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numba
import numpy as np
from scipy.integrate import solve_ivp

import undertow as ut
from undertow.models import FloatArray

SURFACES, STEPS, STEP = 256, 2500, 0.002
HERE = Path(__file__).parent
GCC = ["-O3", "-march=native", "-ffast-math", "-mprefer-vector-width=512"]

rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
loop = ut.ClosedLoop(rig, ut.MinimumEnergy(), step=STEP)
x0 = rig.state(phi=ut.deg(30))
rng = np.random.default_rng(0)
spread = 1 + 0.05 * rng.standard_normal((SURFACES, 4)) * np.array([0, 1, 1, 1])
vectors = np.array([-1.0, -1.59, 1.96, 12.1]) * spread

Entrant = Callable[[], FloatArray]


class Parameters(ctypes.Structure):
    """The C side's constants."""

    NAMES = ("a", "b", "c", "d", "d_e", "a_e", "limit", "eta", "layer")
    _fields_ = [(n, ctypes.c_double) for n in NAMES]

    @property
    def values(self) -> tuple[float, ...]:
        """All of them, in order."""
        return tuple(getattr(self, name) for name in self.NAMES)


def constants() -> Parameters:
    """The pendulum's lumped constants, SI."""
    p = {q.name: q.value for q in rig.parameters}
    m, half, r = p["m"], p["l"], p["r_o"]
    a, b, c, d = p["I_e"] + m * r * r, m * half * r, 4 / 3 * m * half**2, m * p["g"] * half
    return Parameters(a, b, c, d, p["d_e"], p["a_e"], 15.0, 20.0, 0.1)


def shared_library(source: Path, folder: Path) -> Path:
    """Compile a C file with gcc as fast as it goes."""
    gcc = shutil.which("gcc")
    if gcc is None:
        sys.exit("error: this benchmark compiles C, and there is no gcc. Install gcc.")
    library = folder / f"{source.stem}.so"
    command = [gcc, *GCC, "-std=c99", "-shared", "-fPIC", "-o", str(library), str(source), "-lm"]
    subprocess.run(command, check=True)
    return library


def compiled_c(folder: Path, copies: int = 1, threads: int = 1) -> Entrant:
    """rollout.c, written by hand, for so many copies of the surfaces."""
    function = ctypes.CDLL(str(shared_library(HERE / "rollout.c", folder))).rollout
    pointer = np.ctypeslib.ndpointer(dtype=np.float64, flags="C")
    function.argtypes = [
        pointer, pointer, ctypes.c_size_t, ctypes.c_long, ctypes.c_double,
        ctypes.POINTER(Parameters), pointer,
    ]  # fmt: skip
    function.restype = None
    values, count = constants(), SURFACES * copies // threads
    lists = np.split(np.tile(vectors, (copies, 1)), threads)
    out = np.empty((threads, count, 5))

    def part(k: int) -> None:
        function(x0, lists[k], count, STEPS, STEP, ctypes.byref(values), out[k])

    def run() -> FloatArray:
        if threads == 1:
            part(0)
        else:
            with ThreadPoolExecutor(threads) as pool:
                list(pool.map(part, range(threads)))
        return out[:, :, 0].ravel()

    return run


def ours(copies: int = 1, threads: int = 1) -> Entrant:
    """The generated block kernel, with all it watches."""
    shared, surfaces = replace(loop, threads=threads), np.tile(vectors, (copies, 1))
    return lambda: shared.batch(x0, surfaces, duration=STEPS * STEP, terminal=0.0).cost


def _rate(th, ph, w, v, aa, la, au, lu, a, b, c, d, d_e, a_e, limit, eta, layer):  # type: ignore[no-untyped-def]
    """Accelerations and input of the pendulum under its law, as one would write them down."""
    sn, cs = math.sin(ph), math.cos(ph)
    X = -b * cs / c
    fy = (d * sn + c * sn * cs * w * w) / c
    f_a = -b * sn * v * v - 2 * c * sn * cs * v * w - d_e * w
    S = a + c * sn * sn + b * cs * X
    h = f_a + b * cs * fy
    s = aa * w + la * th + au * v + lu * ph
    sat = max(-1.0, min(1.0, s / layer))
    drive = au * fy + la * w + lu * v + eta * sat
    u = max(-limit, min(limit, (-S * drive / (aa - au * X) - h) / a_e))
    q_a = (h + a_e * u) / S
    return q_a, fy - X * q_a, u


_rate_compiled = numba.njit(cache=True, error_model="numpy")(_rate)


@numba.njit(cache=True, error_model="numpy")
def _loop(x0, vectors, steps, h, constants):  # type: ignore[no-untyped-def]
    """A plain loop over surfaces, steps and stages, on scalars."""
    out = np.empty(len(vectors))
    for i in range(len(vectors)):
        aa, la, au, lu = vectors[i]
        x_0, x1, x2, x3 = x0
        cost = 0.0
        for _ in range(steps):
            y0, y1, y2, y3 = x_0, x1, x2, x3
            d0 = d1 = d2 = d3 = dc = 0.0
            for stage in range(4):
                qa, qu, u = _rate_compiled(y0, y1, y2, y3, aa, la, au, lu, *constants)
                weight = 1.0 if stage in (0, 3) else 2.0
                d0 += weight * y2
                d1 += weight * y3
                d2 += weight * qa
                d3 += weight * qu
                dc += weight * u * u
                reach = 0.5 * h if stage < 2 else h
                y0, y1, y2, y3 = (
                    x_0 + reach * y2, x1 + reach * y3, x2 + reach * qa, x3 + reach * qu
                )  # fmt: skip
            x_0 += h / 6 * d0
            x1 += h / 6 * d1
            x2 += h / 6 * d2
            x3 += h / 6 * d3
            cost += h / 6 * dc
        out[i] = cost
    return out


def plain_numba() -> FloatArray:
    """The same equations as a plain numba loop."""
    return np.asarray(_loop(x0, vectors, STEPS, STEP, constants().values))


def casadi_rollouts(ca: Any) -> Any:
    """Build the same rollouts as a CasADi function of all surfaces, (4, 256) to (1, 256)."""
    p = constants()
    state, surface = ca.SX.sym("state", 5), ca.SX.sym("surface", 4)

    def rate(z: Any) -> Any:
        th, ph, w, v, _ = ca.vertsplit(z)
        aa, la, au, lu = ca.vertsplit(surface)
        sn, cs = ca.sin(ph), ca.cos(ph)
        X = -p.b * cs / p.c
        fy = (p.d * sn + p.c * sn * cs * w * w) / p.c
        f_a = -p.b * sn * v * v - 2 * p.c * sn * cs * v * w - p.d_e * w
        S = p.a + p.c * sn * sn + p.b * cs * X
        h = f_a + p.b * cs * fy
        s = aa * w + la * th + au * v + lu * ph
        sat = ca.fmax(-1.0, ca.fmin(1.0, s / p.layer))
        drive = au * fy + la * w + lu * v + p.eta * sat
        u = ca.fmax(-p.limit, ca.fmin(p.limit, (-S * drive / (aa - au * X) - h) / p.a_e))
        q_a = (h + p.a_e * u) / S
        return ca.vertcat(w, v, q_a, fy - X * q_a, u * u)

    k1 = rate(state)
    k2 = rate(state + STEP / 2 * k1)
    k3 = rate(state + STEP / 2 * k2)
    k4 = rate(state + STEP * k3)
    step = ca.Function("step", [state, surface], [state + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    whole = step.fold(STEPS)
    z, one = ca.MX.sym("z", 5), ca.MX.sym("one", 4)
    member = ca.Function("member", [z, one], [whole(z, ca.repmat(one, 1, STEPS))])
    many, begin = ca.MX.sym("many", 4, SURFACES), np.append(x0, 0.0)
    ends = member.map(SURFACES)(ca.repmat(ca.DM(begin), 1, SURFACES), many)
    return ca.Function("rollouts", [many], [ends[4, :]])


def casadi_entrants(ca: Any, folder: Path) -> dict[str, Entrant]:
    """Return the CasADi function run by its virtual machine, and compiled by gcc."""
    machine = casadi_rollouts(ca)
    generator = ca.CodeGenerator("casadi_rollouts.c", {"with_header": False})
    generator.add(machine)
    generator.generate(f"{folder}/")
    compiled = ca.external("rollouts", str(shared_library(folder / "casadi_rollouts.c", folder)))
    return {
        "CasADi, code generation + gcc": lambda: np.array(compiled(vectors.T)).ravel(),
        "CasADi, virtual machine, map": lambda: np.array(machine(vectors.T)).ravel(),
    }


def scipy_members(method: Literal["LSODA", "RK45"], count: int) -> FloatArray:
    """SciPy's adaptive integrators at rtol 1e-8 for a few members."""
    costs = []
    values = constants().values
    for surface in vectors[:count].tolist():

        def rate(_t: float, z: FloatArray, surface: list[float] = surface) -> list[float]:
            th, ph, w, v, _ = z.tolist()
            q_a, q_u, u = _rate(th, ph, w, v, *surface, *values)  # type: ignore[no-untyped-call]
            return [w, v, q_a, q_u, u * u]

        end = solve_ivp(
            rate, (0, STEPS * STEP), [*x0, 0.0], method=method, rtol=1e-8, atol=1e-10,
            max_step=0.01,
        )  # fmt: skip
        costs.append(end.y[4, -1])
    return np.array(costs)


def two_threads(folder: Path, rounds: int) -> float:
    """Print what a second thread brings; return the ratio of the generated kernel."""
    copies = 8
    entrants: dict[str, Entrant] = {}
    for threads in (1, 2):
        entrants[f"C by hand, {threads}"] = compiled_c(folder, copies, threads)
        entrants[f"undertow, {threads}"] = ours(copies, threads)
    costs = {name: run() for name, run in entrants.items()}
    same = bool((costs["undertow, 1"] == costs["undertow, 2"]).all())
    wall = race(entrants, rounds, time.perf_counter, "threads")
    busy = race(entrants, rounds, time.process_time, "threads, processor time")
    rows, ratios = [], []
    for name in ("C by hand", "undertow"):
        waited, used = (
            [1e3 * statistics.median(times[f"{name}, {threads}"]) for threads in (1, 2)]
            for times in (wall, busy)
        )
        ratios.append(waited[0] / waited[1])
        rows.append([name, *(f"{ms:.1f}" for ms in (*waited, *used)), f"{ratios[-1]:.2f}"])
    title = f"{copies * SURFACES} surfaces, one thread and two: wall clock, processor time of both"
    table(title, ["", "one, ms", "two", "processor, one", "two", "times as fast"], rows)
    print(f"\nload {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    print(f"one thread and two: {'the same bits' if same else 'costs differ'}")
    return ratios[-1] if same else 0.0


def main() -> int:
    """Run the entrants in turn and print a table of ratios."""
    options = command_line(__doc__, "--clock cpu").parse_args()
    now, ca = clock(options.clock), need("casadi", "compare")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fast: dict[str, Entrant] = {
            "C by hand, gcc -O3, blocks of 32": compiled_c(folder),
            "undertow, generated kernel": ours(),
            "numba, plain loop": plain_numba,
        }
        both = casadi_entrants(ca, folder)
        slow = {"CasADi, virtual machine, map": both.pop("CasADi, virtual machine, map")}
        fast |= both
        results = {name: run() for name, run in (fast | slow).items()}  # warm-up, compile
        times = race(fast, 5 if options.quick else 25, now, "rounds")
        times |= race(slow, 1 if options.quick else 3, now, "slow rounds")
    seconds = {name: statistics.median(t) for name, t in times.items()}
    members = 1 if options.quick else 2
    methods: tuple[Literal["LSODA"], Literal["RK45"]] = ("LSODA", "RK45")
    for method in methods:
        key = f"SciPy {method} at 1e-8 ({members} of {SURFACES}, scaled)"
        began = now()
        results[key] = scipy_members(method, members)
        seconds[key] = (now() - began) / members * SURFACES
    first = next(iter(seconds))
    reference = results[first]
    rows = []
    for key, value in seconds.items():
        costs = results[key]
        error = np.max(np.abs(costs / reference[: len(costs)] - 1))
        rows.append(
            [key, f"{1e3 * value:.1f}", f"{value / seconds[first]:.2f}",
             "—" if key == first else f"{error:.1e}"]
        )  # fmt: skip
    title = f"{SURFACES} surfaces × {STEPS} steps × 4 stages, one thread, float64"
    table(title, ["entrant", "ms", "ratio to C", "cost differs by"], rows)
    with tempfile.TemporaryDirectory() as name:
        faster = two_threads(Path(name), 5 if options.quick else 25)
    same = max(float(row[3]) for row in rows[1:] if "SciPy" not in row[0])
    ratio = seconds["undertow, generated kernel"] / seconds[first]
    print(f"\nsame scheme, same step: costs agree to {same:.1e} (wanted: 1e-10)")
    print(f"the generated kernel takes {ratio:.2f} times as long as the C (wanted: 1.15)")
    print(f"two threads are {faster:.2f} times as fast as one (wanted: 1.85)")
    return 0 if same <= 1e-10 and faster > 0.0 else 1


if __name__ == "__main__":
    sys.exit(main())
