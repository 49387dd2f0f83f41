"""Many tasks, one way: pure functions on any executor, each result kept as soon as it is there.

The tasks of an :class:`Experiment` give a few numbers each, which a ledger keeps: what ``undertow
trials``, ``survey``, ``models`` and ``reproduce`` do.  Campaigns hand over their shards by the same
:func:`ended`, and keep arrays in zarr: :mod:`undertow.studies.campaign`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from rich.console import RenderableType

from undertow.base import Progress, no_progress
from undertow.studies.ledger import Key, Ledger

#: Tasks that each worker finds waiting.
WAITING = 2

K = TypeVar("K")
V = TypeVar("V")
R = TypeVar("R")


class Serial(Executor):
    """An executor that computes at once, in the calling thread."""

    def submit(self, fn: Callable[..., V], /, *args: Any, **kwargs: Any) -> Future[V]:
        """Compute now."""
        future: Future[V] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def ended(
    executor: Executor, tasks: Iterable[tuple[K, tuple[Any, ...]]], width: int = 1
) -> Iterator[tuple[K, Future[Any]]]:
    """Yield every key with its ended future; only a few of the tasks are under way at once.

    A task is a function and its arguments; ``width`` is how many the executor computes at once.
    What waits is cancelled at the end.
    """
    left = iter(tasks)
    running: dict[Future[Any], K] = {}
    try:
        while True:
            for key, task in left:
                future = executor.submit(*task)
                running[future] = key
                if future.done() or len(running) >= width * WAITING:
                    break
            if not running:
                return
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future
    finally:
        for future in running:
            future.cancel()


def grouped(found: Mapping[Key, V]) -> dict[Any, list[V]]:
    """Return results by all of their keys but the last part, often a seed.

    >>> grouped({("cascade", 0): 2.5, ("cascade", 1): 3.0, ("kept", 0): 4.0})
    {'cascade': [2.5, 3.0], 'kept': [4.0]}
    """
    groups: dict[Any, list[V]] = {}
    for (*place, _), result in found.items():
        groups.setdefault(tuple(place) if len(place) > 1 else place[0], []).append(result)
    return groups


@dataclass(frozen=True)
class Experiment(Generic[V, R]):
    """Pure tasks, and what is made of their results.

    ``name``: of its ledger. ``line``: type of the ledger's lines, see
    :class:`undertow.studies.ledger.Ledger`. ``tasks``: by their keys.  Equal settings and key give
    the same result anywhere. ``settings``: what the results depend on besides. ``report``,
    ``files``: show what came of them, and return it as files by their names. ``notes``: sentences
    for the end. ``gather``: makes what these take of the results by their keys: by default all of
    them, in the order of the tasks. ``whole``: whether all results are needed for that, or those
    that there are will do.
    """

    name: str
    line: Any
    tasks: Mapping[Key, Callable[[], V]]
    settings: Mapping[str, Any]
    report: Callable[[R], Sequence[RenderableType]]
    files: Callable[[R], Mapping[str, bytes]] = lambda _: {}
    notes: Callable[[R], Sequence[str]] = lambda _: ()
    gather: Callable[[Mapping[Key, V]], R] = lambda found: tuple(found.values())  # type: ignore
    whole: bool = False

    def ledger(self, folder: Path | None) -> Ledger[V]:
        """Return the results that a folder has, to go on with; ``None`` keeps them nowhere.

        Raises ArtefactError when they are of other versions or settings, or cannot be read or
        written.
        """
        path = None if folder is None else folder / f"{self.name}.jsonl"
        return Ledger(path, self.line, self.settings)

    def finished(self, ledger: Ledger[V]) -> dict[Key, V]:
        """Return the results that there are, in the order of the tasks."""
        return {key: ledger.known[key] for key in self.tasks if key in ledger.known}

    def run(
        self,
        ledger: Ledger[V] | None = None,
        *,
        executor: Executor | None = None,
        width: int = 1,
        progress: Progress = no_progress,
    ) -> R:
        """Do what a ledger has not, and return what came of all tasks.

        ``executor`` is any of :mod:`concurrent.futures`, by default this thread; it does ``width``
        tasks at once.
        """
        book = self.ledger(None) if ledger is None else ledger

        def missing() -> Iterator[tuple[Key, tuple[Callable[[], V]]]]:
            for place, (key, task) in enumerate(self.tasks.items(), 1):
                if key not in book.known:
                    words = [part for part in key if part and isinstance(part, str)] or [self.name]
                    done, every = len(self.finished(book)), len(self.tasks)
                    which = f"{', '.join(words)} ({place} of {every})"
                    progress(which, done / every)
                    yield key, (task,)

        for key, future in ended(executor or Serial(), missing(), width):
            book.keep(key, future.result())
        return self.gather(self.finished(book))
