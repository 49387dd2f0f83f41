"""How long work tells how far it is."""

from __future__ import annotations

from collections.abc import Callable

#: Called with what is being done, in words, and the part of all that is done, 0 to 1.
Progress = Callable[[str, float], None]


def no_progress(_what: str, _part: float) -> None:
    """Tell nobody: the default where progress may be watched."""
