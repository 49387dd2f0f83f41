"""What URDF and MJCF share: reading XML safely, and numbers out of attributes."""

from __future__ import annotations

import contextlib
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path
from xml.parsers import expat

import numpy as np

from undertow.base import (
    ArtefactError,
    InvalidInputError,
    ModelError,
    a_kind,
    error_text,
    read_file,
    require,
)
from undertow.models.mechanism import FloatArray

#: Largest file, bytes; deepest nesting, and most elements, of one that is read.
LARGEST, DEEPEST, MOST = 1 << 24, 64, 20_000


#: What tools leave in the XML of people's files: a declaration that does not come first, the
#: defaults of ROS' substitutions, and zeros at the end.
_DECLARATION = re.compile(r"<\?xml\b[^>]*\?>")
_DEFAULTED = re.compile(r"\$\(optenv\s+\S+\s+([^()]*)\)")
#: A full stop behind a number that has one.
_STOP = re.compile(r"(\d\.\d+)\.(?=\s|$)")


#: What to do about a file that xacro, the macros of ROS, is yet to make.
EXPAND = "Let xacro expand it first: xacro FILE.xacro > FILE.urdf"


def is_text(source: str | Path) -> bool:
    """Whether a source is XML itself, and no path."""
    return isinstance(source, str) and source.lstrip().startswith("<")


def source_words(source: str | Path, root: str) -> str:
    """Say for a message which file a source is, or that it is text."""
    return f"<{root}> text" if is_text(source) else f"model file '{source}'"


def parse_xml(source: str | Path, root: str, *more: str) -> ET.Element:
    """Parse XML text (it starts with ``<``) or a file, and check the name of its root.

    A declaration that does not come first is passed over, and ``$(optenv NAME DEFAULT)`` is its
    default. Raises ArtefactError when the file cannot be read; InvalidInputError for XML that is
    not well formed, or declares entities; ModelError for another root element.
    """
    what = source_words(source, root)
    if not isinstance(source, str | Path):
        raise InvalidInputError(
            f"<{root}> file",
            value=a_kind(source),
            limit="a path, or XML text",
            remedy="Give pathlib.Path('model.xml'), or the text itself",
        )
    if is_text(source):
        text = str(source)
    else:
        try:
            text = read_file(Path(source), "model file", most=LARGEST).decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise ArtefactError(
                what,
                value="no UTF-8 text",
                limit="a readable file, or XML text",
                remedy="Save it as UTF-8",
            ) from error
    if "<!ENTITY" in text:
        raise InvalidInputError(
            what, value="entity declarations", limit="plain XML", remedy="Expand the entities first"
        )
    text = _DEFAULTED.sub(r"\1", _DECLARATION.sub("", text)).rstrip("\0 \t\r\n")
    try:
        _check_size(text, what)
        element = ET.fromstring(text)
    except ET.ParseError as error:
        line, column = error.position
        raise InvalidInputError(
            f"{what} is no well-formed XML",
            value=f"{error.msg.split(':')[0]} at line {line}, column {column}",
            limit="every tag closed and every attribute quoted",
            remedy="Correct the file there",
        ) from error
    if element.tag not in (root, *more):
        raise ModelError(
            what,
            value=f"root <{element.tag}>",
            limit=f"<{root}>",
            remedy="URDF has <robot>: from_urdf; MJCF <mujoco>: from_mjcf",
        )
    return element


def _check_size(text: str, what: str) -> None:
    """Refuse what is nested or repeated beyond any mechanism, before a tree is built of it.

    Raises InvalidInputError beyond :data:`DEEPEST` or :data:`MOST`.
    """
    depth = count = 0

    def begin(_tag: str, _attributes: object) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEEPEST or count > MOST:
            raise InvalidInputError(
                what,
                value=f"elements nested {depth} deep" if depth > DEEPEST else f"{count} elements",
                limit=f"at most {DEEPEST} deep, {MOST} in all",
                remedy="Keep the bodies of one mechanism alone",
            )

    def end(_tag: str) -> None:
        nonlocal depth
        depth -= 1

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EndElementHandler = begin, end
    with contextlib.suppress(expat.ExpatError):  # the parser of the tree says where
        parser.Parse(text, True)


@contextlib.contextmanager
def computable(what: str) -> Iterator[None]:
    """Refuse numbers of a file from which no mechanism can be computed.

    Raises InvalidInputError where arithmetic overflows or has no result.
    """
    try:
        yield
    except (ArithmeticError, np.linalg.LinAlgError) as error:
        raise InvalidInputError(
            f"numbers of the {what}",
            value=error_text(error),
            limit="those of a mechanism, SI units",
            remedy="Look for one that is far too large or too small",
        ) from error


def numbers_of(
    element: ET.Element,
    attribute: str,
    default: str | None = None,
    count: int | None = None,
    *,
    of: str = "",
) -> list[float]:
    """Return the numbers of an attribute; ``of`` names what the element belongs to.

    Commas do as well as spaces; surplus zeros and the stop of ``1.57.`` are passed over: people's
    files have them. Raises InvalidInputError when the attribute is missing (and has no default),
    holds something else than finite numbers, or another count of them.
    """
    text = element.get(attribute, default)
    owner = of or element.get("name", "")
    label = f"{attribute} of <{element.tag}>" + f" of '{owner}'" * bool(owner)
    if text is None:
        raise InvalidInputError(
            label, value="missing", limit="given", remedy="The format has no default for it"
        )
    wanted, shown = "Write numbers, 0.5 or 1e-3, with spaces between", repr(text[:60])
    if "${" in text or "$(" in text:
        wanted = EXPAND
    try:
        if not text.isascii() or "_" in text:  # of which Python, but no XML reader, makes numbers
            raise ValueError(text)
        values = [float(word) for word in _STOP.sub(r"\1", text.replace(",", " ")).split()]
    except ValueError as error:
        raise InvalidInputError(label, value=shown, limit="numbers", remedy=wanted) from error
    require(all(map(math.isfinite, values)), label, shown, "finite numbers", wanted)
    if count is not None and not any(values[count:]):  # zeros too many mean nothing
        values = values[:count]
    if count is not None and len(values) != count:
        raise InvalidInputError(label, value=shown, limit=f"{count} numbers", remedy=wanted)
    return values


def rotation_from_rpy(rpy: list[float]) -> FloatArray:
    """URDF's fixed-axis roll, pitch, yaw: R = R_z(yaw) R_y(pitch) R_x(roll), (3, 3)."""
    (cr, cp, cy), (sr, sp_, sy) = np.cos(rpy), np.sin(rpy)
    Rx = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    Ry = np.array([[cp, 0, sp_], [0, 1, 0], [-sp_, 0, cp]])
    Rz = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return np.asarray(Rz @ Ry @ Rx)


def rotation_from_quaternion(quaternion: list[float]) -> FloatArray:
    """Rotation matrix of a quaternion (w, x, y, z) of any length but zero, (3, 3)."""
    length = float(np.linalg.norm(quaternion))
    if not 0 < length < math.inf:
        raise InvalidInputError(
            "quaternion",
            value=quaternion,
            limit="not zero, and finite",
            remedy="1 0 0 0 turns nothing",
        )
    w, x, y, z = np.asarray(quaternion) / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def without_rounding(values: FloatArray, scale: float = 0.0) -> FloatArray:
    """Drop what rotations leave of entries that should be zero, beside the largest or ``scale``."""
    clean = np.array(values, dtype=np.float64)
    clean[np.abs(clean) < 1e-14 * max(float(np.abs(clean).max()), scale, 1e-300)] = 0.0
    return clean
