"""Large batches of rollouts, shared by threads.

Kernels let go of the interpreter's lock, and no lane knows of another: whoever integrates it, its
results are the same to the last bit.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from undertow.closed_loop.work_array import GROUPS, LANES

#: Lanes that a rollout takes together.
BLOCK = GROUPS * LANES

#: Steps of single rollouts, about a millisecond, that a thread must find to be worth its beginning.
WORTH = 100_000

#: Parts of a batch for each thread, so that none waits long for another.
PARTS = 4

#: A kernel: the first lane, the one behind the last, and what it reads and writes.
Kernel = Callable[..., None]


def shared(kernel: Kernel, threads: int, lanes: int, steps: int) -> Kernel:
    """Return a kernel that so many threads share, fewer or one where more would not pay.

    ``kernel``: called with the first lane, the one behind the last, and more. ``threads``: the most
    threads. ``lanes``, ``steps``: what it will be called for: rollouts, whole groups of lanes, and
    their length.
    """
    threads = min(threads, lanes // BLOCK, lanes * steps // WORTH)
    return kernel if threads <= 1 else partial(_in_threads, kernel, threads)


def _in_threads(kernel: Kernel, threads: int, first: int, last: int, *arguments: object) -> None:
    """Call a kernel for parts of the lanes, in threads that end with the call.

    None of them is there when the process forks.  What one of them raises is raised here.
    """
    blocks = -(-(last - first) // BLOCK)
    part = -(-blocks // (threads * PARTS)) * BLOCK
    with ThreadPoolExecutor(threads) as pool:
        calls = [
            pool.submit(kernel, lane, min(lane + part, last), *arguments)
            for lane in range(first, last, part)
        ]
    for call in calls:
        call.result()
