"""A claim of the kernel's as a certificate's file has it: what the kernel's reader reads."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from undertow.proofs.kernel import claims as kernel


def number_text(value: Fraction | float) -> str:
    """Return the number text of a double, or of a rational number, in full."""
    exact = Fraction(value)
    try:
        near = exact.numerator / exact.denominator
    except OverflowError:
        return str(exact)
    return near.hex() if exact.denominator > 1 and Fraction(near) == exact else str(exact)


def claim_data(claim: kernel.Claim) -> dict[str, Any]:
    """Return the object of ``docs/certificate-format.md``, section 5, that a claim is read from."""
    data: dict[str, Any] = {"kind": claim.kind}
    if isinstance(claim, kernel.SurfaceRegion):
        data |= {"stretch": _written(claim.stretch.S), "pole": _written(claim.stretch.L)}
    data |= {key: _written(getattr(claim, key)) for key in claim.keys if key not in data}
    if isinstance(claim, kernel.ClosedLoop):
        hint: dict[str, Any] = {"step": claim.step, "terminal": claim.terminal, "boxes": claim.cuts}
        data["hint"] = {key: _written(value) for key, value in hint.items() if value}
    return data


def _written(value: Any) -> Any:
    if isinstance(value, Fraction):
        return number_text(value)
    if isinstance(value, tuple):
        return [_written(v) for v in value]
    if dataclasses.is_dataclass(value):
        value = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return {k: _written(v) for k, v in value.items()} if isinstance(value, Mapping) else value
