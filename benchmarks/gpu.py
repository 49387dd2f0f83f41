"""Rollouts of the rotary pendulum on a GPU, beside both cores of this machine.

One hundred million motions of 2 s from random states, in batches, in the small steps that the
processor takes with ``tail_rtol=0``; those of the first batch must agree with the processor's to
1e-9.  The processor rolls out one batch and is scaled up.  Where there is no GPU, the host's C++
compiler takes the same text for one small batch, and NVRTC, where it is installed, compiles it for
each mechanism of the library.
"""

from __future__ import annotations

import argparse
import os
import sys
import time

import numpy as np

import undertow as ut
from undertow.closed_loop import on_gpu
from undertow.closed_loop.cuda import CudaText
from undertow.models import FloatArray

SECONDS = 2.0
BATCH = 1_000_000

#: What the text is compiled for where there is no GPU to ask: that of an H100.
ARCHITECTURE = "sm_90"


def states(seed: int, count: int) -> FloatArray:
    """Return random states of the pendulum, (count, 4)."""
    rng = np.random.default_rng(seed)
    return np.array([1.0, 0.8, 2.0, 4.0]) * rng.uniform(-1, 1, (count, 4))


def accepted(text: str) -> str:
    """Return what NVRTC says to a text: the size of the cubin, or its complaint."""
    from cuda.bindings import nvrtc

    _, program = nvrtc.nvrtcCreateProgram(text.encode(), b"rollout.cu", 0, [], [])
    flags = [f"--gpu-architecture={ARCHITECTURE}".encode(), b"--std=c++17"]
    (said,) = nvrtc.nvrtcCompileProgram(program, len(flags), flags)
    if int(said) != 0:
        _, size = nvrtc.nvrtcGetProgramLogSize(program)
        log = b" " * size
        nvrtc.nvrtcGetProgramLog(program, log)
        return str(log.decode())[:500]
    return f"{nvrtc.nvrtcGetCUBINSize(program)[1]:,} bytes"


def compiled_by_nvrtc() -> None:
    """Compile the kernel of every mechanism, without a GPU."""
    try:
        import cuda.bindings.nvrtc  # noqa: F401
    except ImportError:
        print("NVRTC is not installed: pip install 'undertow[gpu]'")
        return
    for name in sorted(ut.mechanisms.LIBRARY):
        began = time.perf_counter()
        loop = ut.ClosedLoop(getattr(ut.mechanisms, name)(), ut.MinimumEnergy(horizon=SECONDS))
        said = accepted(CudaText(loop).text)
        print(f"NVRTC, {ARCHITECTURE}, {name}: {said} in {time.perf_counter() - began:.1f} s")


def main() -> None:
    """Print times, their ratio, and how far the motions are apart."""
    parser = argparse.ArgumentParser(
        prog="python benchmarks/gpu.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="examples:\n  python benchmarks/gpu.py\n  python benchmarks/gpu.py --motions 1e7",
    )
    parser.add_argument("--motions", type=float, default=1e8, help="how many on the GPU")
    parser.add_argument("--quick", action="store_true", help="fewer")
    options = parser.parse_args()
    count = int(1e5 if options.quick else options.motions)
    rig = ut.mechanisms.rotary_pendulum(d_e=0.025)
    cores = len(os.sched_getaffinity(0))
    loop = ut.ClosedLoop(rig, ut.MinimumEnergy(horizon=SECONDS), threads=cores)
    surface = ut.Surface(-1, -1.59, 1.96, 12.1)
    try:
        device, batch = on_gpu(loop), min(BATCH, count)
    except (ut.base.MissingExtraError, ut.base.ResourceError) as error:
        print(f"no GPU ({error})")
        compiled_by_nvrtc()
        device, batch, count = on_gpu(loop, "host"), 2_000, 0
    loop.batch(states(0, 64), surface), device.batch(states(0, 64), surface)  # compiled
    x = states(0, batch)
    began = time.perf_counter()
    expected = loop.batch(x, surface)
    of_cores = (time.perf_counter() - began) / batch
    got = device.batch(x, surface)
    same = (got.event == expected.event).mean()
    apart = np.abs(got.x - expected.x) / np.maximum(1, np.abs(expected.x))
    print(f"{batch:,} motions of {SECONDS:g} s: same event in {same:.6%}, final states apart by "
          f"{np.median(apart):.1e} in the median, {np.quantile(apart, 0.999):.1e} in 99.9 %, "
          f"{apart.max():.1e} at most")  # fmt: skip
    if not count:
        print("no GPU: no time to compare")
        return
    done, taken = 0, 0.0
    while done < count:
        x = states(1 + done // batch, min(batch, count - done))
        began = time.perf_counter()
        device.batch(x, surface)
        taken += time.perf_counter() - began
        done += len(x)
        print(f"\r{done:,} of {count:,}", end="", file=sys.stderr)
    print(file=sys.stderr)
    print(f"GPU: {count:,} motions in {taken:.2f} s; {cores} cores: {of_cores * count:.0f} s "
          f"(scaled up from {batch:,}), {of_cores * count / taken:.0f} times as long")  # fmt: skip


if __name__ == "__main__":
    main()
