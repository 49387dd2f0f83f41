"""The verdicts of :mod:`undertow.base.verdict`, under the name of the package that gives most."""

from undertow.base.verdict import Kind, Verdict

__all__ = ["Kind", "Verdict"]
