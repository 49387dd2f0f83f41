"""Sentences of the checker's own, from the numbers that it decided."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import ROUND_CEILING, ROUND_DOWN, ROUND_FLOOR, Context, Decimal
from fractions import Fraction

from undertow.proofs.kernel.model import Model, Quantity

Region = Mapping[str, tuple[Fraction, Fraction]]


def _digits(value: Fraction, digits: int, rounding: str) -> str:
    """Round to some digits; a double that its shortest decimal names in as many stays as it is."""
    try:
        near = value.numerator / value.denominator
    except OverflowError:
        near = 0.0
    if Fraction(near) == value:
        short = Decimal(repr(near))
        if len(short.normalize().as_tuple().digits) <= digits:
            return f"{near:.{digits}g}"
    context = Context(prec=digits, rounding=rounding)
    return (
        f"{float(context.divide(Decimal(value.numerator), Decimal(value.denominator))):.{digits}g}"
    )


def inward(value: Fraction, digits: int = 6) -> str:
    """Return a number as text, rounded towards 0."""
    return _digits(value, digits, ROUND_DOWN)


def within(low: Fraction, high: Fraction) -> str:
    """Return an interval as text, its ends rounded inwards, or exactly where it has no room."""
    ends = _digits(low, 6, ROUND_CEILING), _digits(high, 6, ROUND_FLOOR)
    if not low <= Fraction(ends[0]) <= Fraction(ends[1]) <= high:
        ends = f"{float(low)!r}", f"{float(high)!r}"
    return f"[{ends[0]}, {ends[1]}]"


def region(positions: Sequence[Quantity], box: Region) -> str:
    """Return a region of positions in words."""
    units = {p.name: p.unit for p in positions}
    parts = [
        f"|{k}| ≤ {inward(b)} {units[k]}".rstrip() if a == -b
        else f"{k} in {within(a, b)} {units[k]}".rstrip()
        for k, (a, b) in box.items()
        if a != 0 or b != 0
    ]  # fmt: skip
    if not parts:
        return "at the target"
    rest = ", the other coordinates at the target" if len(parts) < len(positions) else ""
    return f"for {', '.join(parts)}{rest}"


def limits(model: Model) -> str:
    """Return the input limits in words, each as it is."""
    parts = [
        f"|{i.name}| ≤ {'inf' if i.value is None else repr(float(i.value))} {i.unit}".rstrip()
        for i in model.inputs
    ]
    return ", ".join(parts)
