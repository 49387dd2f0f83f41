"""The verdicts of :mod:`undertow.verdict`, under the name of the room that gives most of them."""

from undertow.verdict import Kind, Verdict

__all__ = ["Kind", "Verdict"]
