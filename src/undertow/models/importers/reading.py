"""What was read from a file, in a few lines: they are the mechanism's description."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from undertow.base import InvalidInputError
from undertow.models.importers.tree import Tree
from undertow.models.mechanism import Coordinate, Mechanism


def names_of(given: Sequence[str], what: str, of: str = "") -> list[str]:
    """Return names of joints, those of a tree ``of``, as a list; one alone may be a plain text.

    Raises InvalidInputError for what is no name.
    """
    names = [given] if isinstance(given, str) else list(given)
    odd = [name for name in names if not isinstance(name, str)]
    if odd:
        raise InvalidInputError(
            f"{what} joints" + (f" of '{of}'" if of else ""),
            value=repr(odd[0]),
            limit="names of joints",
            remedy=f"Write {what}=['shoulder']",
        )
    return names


def described(mechanism: Mechanism, tree: Tree, how: str, frozen: Sequence[str]) -> Mechanism:
    """Return the mechanism with the lines that say what was read.

    ``how`` says which file, by which reader; joints that are ``frozen`` were taken out.
    """
    joints = ", ".join(_range(c) for c in mechanism.coordinates)
    gains = {a.name: a.gain for a in tree.actuators}
    inputs = []
    for channel, coordinate in zip(mechanism.inputs, mechanism.coordinates, strict=False):
        gain = gains.get(channel.name.removesuffix("_motor"), 1.0)
        force = f" × {gain:g}" if gain != 1 else ""
        limit = (
            f"|{channel.name}| ≤ {channel.limit:g} {channel.unit}".rstrip()
            if math.isfinite(channel.limit)
            else f"{channel.name} without limit: the file gives none"
        )
        inputs.append(f"{channel.name}{force} on {coordinate.name}, {limit}")
    left = "contacts, shapes"
    if any(mechanism.disturbance_bounds):
        left += ", dry friction (a bound on the disturbance)"
    left += "".join(f", {words}" for actuator in tree.actuators for words in actuator.left_out)
    said = " ".join(c.description for c in mechanism.coordinates)
    for joint in tree.moving:
        if f"joint '{joint.name}'" not in said and math.isfinite(min(joint.high, -joint.low)):
            left += f", the range of {joint.name}, which no input moves alone"
    if frozen:
        left += f"; frozen {', '.join(frozen)}"
    lines = (how, f"joints {joints}", f"inputs {'; '.join(inputs)}", f"left out {left}")
    return replace(mechanism, description="\n".join(lines))


def _range(coordinate: Coordinate) -> str:
    """A joint with its travel, hinges in degrees."""
    turning = coordinate.unit == "rad"
    ends = [math.degrees(v) if turning else v for v in (coordinate.low, coordinate.high)]
    if all(map(math.isinf, ends)):
        return f"{coordinate.name} ({'°' if turning else 'm'})"
    return f"{coordinate.name} ({ends[0]:.4g} to {ends[1]:.4g}{'°' if turning else ' m'})"
