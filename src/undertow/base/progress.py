"""How long work tells how far it is."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from typing import TypeVar

#: Called with what is being done, in words, and the part of all that is done, 0 to 1.
Progress = Callable[[str, float], None]

T = TypeVar("T")


def no_progress(_what: str, _part: float) -> None:
    """Tell nobody: the default where progress may be watched."""


def each(items: Collection[T], progress: Progress, words: Callable[[T], str]) -> Iterator[T]:
    """Yield items one by one; before each tell what it is, in words, and how many are done.

    >>> list(each("ab", lambda what, part: print(what, part), str.upper))
    A 0.0
    B 0.5
    ['a', 'b']
    """
    for number, item in enumerate(items):
        progress(words(item), number / len(items))
        yield item


def duration(seconds: float) -> str:
    """Return a time for people.

    >>> duration(42.0), duration(600.0), duration(9000.0)
    ('42 s', '10 min', '2.5 h')
    """
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"
