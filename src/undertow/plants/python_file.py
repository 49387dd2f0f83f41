"""A driver of one's own from a Python file, for the command line."""

from __future__ import annotations

import math
from contextlib import suppress
from numbers import Real
from typing import Any

import numpy as np

from undertow.base import ArtefactError, InvalidInputError, UndertowError, raised_at
from undertow.models import Mechanism
from undertow.models.importers.python_file import object_from_file
from undertow.plants.interface import Rig

__all__ = ["check_rig", "rig_from_file"]


def rig_from_file(text: str, mechanism: Mechanism) -> Rig:
    """Load a rig of one's own: ``FILE.py:NAME``, a class or function that makes one, or a rig.

    It is called without arguments, and read once.

    Raises
    ------
    ArtefactError
        When the file cannot be read or fails, or the rig cannot be read.
    InvalidInputError
        When what is there has not what a rig has, see :class:`undertow.plants.Rig`.
    """
    rig: Rig = object_from_file(text, "rig", lambda v: callable(v) or hasattr(v, "read"))
    try:
        check_rig(rig, mechanism, text)
    except UndertowError:
        with suppress(Exception):  # it may be no rig at all
            rig.close()
        raise
    return rig


def check_rig(rig: Rig, mechanism: Mechanism, name: str = "rig of one's own") -> None:
    """Refuse what is no rig of a mechanism, before it moves; it is read once.

    Parameters
    ----------
    rig
        What is to be one.
    mechanism
        Whose positions it must read.
    name
        For messages.

    Raises
    ------
    ArtefactError
        When it cannot be read.
    InvalidInputError
        When it has not what a rig has, see :class:`undertow.plants.Rig`.
    """
    lacking = [part for part in ("read", "write", "close") if not callable(getattr(rig, part, 0))]
    period = getattr(rig, "period", None)
    if not isinstance(period, Real) or not 0 < float(period) < math.inf:
        lacking.append("period > 0, s")
    if lacking:
        raise InvalidInputError(
            f"'{name}', a {type(rig).__name__}",
            value=f"without {', '.join(lacking)}",
            limit="read(), write(u), close() and a period",
            remedy="See undertow.plants.Rig and examples/serial_rig.py",
        )
    try:
        measurement: Any = rig.read()
    except Exception as error:  # a driver may do anything
        raise ArtefactError(
            f"first reading of '{name}'",
            value=f"{type(error).__name__}: {error}{raised_at(error)}",
            limit="an undertow.plants.Measurement",
            remedy="Is it connected, and switched on?",
        ) from error
    q: Any = getattr(measurement, "q", None)
    shape = np.shape(q)
    names = [c.name for c in mechanism.coordinates]
    if shape != (mechanism.n,):
        raise InvalidInputError(
            f"first reading of '{name}'",
            value=f"{type(measurement).__name__} with q of shape {shape}",
            limit=f"undertow.plants.Measurement with q = ({', '.join(names)})",
            remedy="Positions in rad or m, in that order, NaN where a sensor gave nothing",
        )
