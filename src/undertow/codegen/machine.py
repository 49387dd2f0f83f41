"""numba, set up for the widest vectors that the processor has.

LLVM avoids 512-bit registers on most processors that have them, because they once lowered
the clock.  For lane loops of double arithmetic they are a quarter faster, see
``benchmarks/kernel.py``.  A user's own ``NUMBA_CPU_FEATURES`` is left alone, and numba's
cache keys on the features, so kernels of either kind never mix.
"""

from __future__ import annotations

import os

import llvmlite.binding as llvm
import numba

__all__ = ["numba"]


def _widen() -> None:
    features = llvm.get_host_cpu_features()
    if features.get("avx512f") and "NUMBA_CPU_FEATURES" not in os.environ:
        vars(numba.config)["CPU_FEATURES"] = features.flatten() + ",-prefer-256-bit"


_widen()
