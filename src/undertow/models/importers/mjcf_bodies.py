"""MJCF bodies: orientations, and inertia inferred from geoms as MuJoCo does."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from undertow.base import InvalidInputError, ModelError
from undertow.models.importers.tree import LARGEST, Link
from undertow.models.importers.xml_files import (
    numbers_of,
    rotation_from_quaternion,
    without_rounding,
)
from undertow.models.mechanism import FloatArray

_ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")


@dataclass(frozen=True)
class Frame:
    """The compiler's conventions for angles."""

    degrees: bool = True
    eulerseq: str = "xyz"

    def angle(self, value: float) -> float:
        """Return an angle of the file in rad."""
        return math.radians(value) if self.degrees else value

    def rotation(self, element: ET.Element) -> FloatArray:
        """Return the orientation of an element, (3, 3)."""
        given = [name for name in _ORIENTATIONS if element.get(name) is not None]
        if len(given) > 1:
            raise InvalidInputError(
                f"orientation of <{element.tag} name={element.get('name', '')!r}>",
                value=" and ".join(given),
                limit="one of them",
                remedy="Leave the others out",
            )
        if not given:
            return np.eye(3)
        name = given[0]
        count = {"quat": 4, "axisangle": 4, "euler": 3, "xyaxes": 6, "zaxis": 3}[name]
        values = numbers_of(element, name, None, count)
        if name == "quat":
            return rotation_from_quaternion(values)
        if name == "axisangle":
            return _turn(values[:3], self.angle(values[3]))
        if name == "euler":
            return self._euler(values)
        if name == "xyaxes":
            x = _unit(values[:3])
            y = np.asarray(values[3:]) - np.dot(x, values[3:]) * x
            y = _unit(list(y))
            return np.column_stack([x, y, np.cross(x, y)])
        return _to_z(_unit(values))

    def _euler(self, values: Sequence[float]) -> FloatArray:
        """Lower case turns about the moving axes, upper case about the fixed ones."""
        R = np.eye(3)
        for letter, value in zip(self.eulerseq, values, strict=True):
            axis = [float(letter.lower() == a) for a in "xyz"]
            step = _turn(axis, self.angle(value))
            R = R @ step if letter.islower() else step @ R
        return R


def link_of(
    body: ET.Element, name: str, frame: Frame, geoms: Sequence[ET.Element], infer: str
) -> Link:
    """Return the link of a body: its ``<inertial>``, or the sum over its geoms.

    ``geoms`` have their defaults filled in; ``infer`` is the compiler's ``inertiafromgeom``:
    ``"true"``, ``"false"`` or ``"auto"``.

    Raises
    ------
    ModelError
        For a geom whose inertia is not known here (meshes, height fields).
    """
    inertial = body.find("inertial")
    if inertial is not None and infer != "true":
        return _from_inertial(inertial, name, frame)
    if infer == "false":
        return Link(name)
    return _from_geoms(geoms, name, frame)


def _from_inertial(inertial: ET.Element, name: str, frame: Frame) -> Link:
    (mass,) = numbers_of(inertial, "mass", None, 1)
    x, y, z = numbers_of(inertial, "pos", "0 0 0", 3)
    R = frame.rotation(inertial)
    if inertial.get("fullinertia") is not None:
        xx, yy, zz, xy, xz, yz = numbers_of(inertial, "fullinertia", None, 6)
        tensor = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    else:
        tensor = np.diag(numbers_of(inertial, "diaginertia", None, 3))
    return Link(name, mass, (x, y, z), _symmetric(R @ tensor @ R.T))


def _from_geoms(geoms: Sequence[ET.Element], name: str, frame: Frame) -> Link:
    total, first = 0.0, np.zeros(3)
    parts: list[tuple[float, FloatArray, FloatArray]] = []
    for geom in geoms:
        mass, centre, tensor = _geom(geom, name, frame)
        if mass < 0:
            raise ModelError(
                f"mass of a geom of body '{name}'",
                value=f"{mass:g} kg",
                limit="≥ 0",
                remedy="Check the signs of mass and density",
            )
        if mass > 0:
            parts.append((mass, centre, tensor))
            total += mass
            first += mass * centre
    if not parts:
        return Link(name)
    com = first / total
    inertia = np.zeros((3, 3))
    for mass, centre, tensor in parts:
        d = centre - com
        inertia += tensor + mass * (np.dot(d, d) * np.eye(3) - np.outer(d, d))
    x, y, z = (float(v) for v in com)
    return Link(name, total, (x, y, z), _symmetric(inertia))


def _geom(geom: ET.Element, name: str, frame: Frame) -> tuple[float, FloatArray, FloatArray]:
    """Mass, centre and inertia about the centre in the body's axes."""
    kind = geom.get("type", "sphere")
    if kind not in _SHAPES:
        if kind == "plane" or (geom.get("mass") and numbers_of(geom, "mass")[0] == 0):
            return 0.0, np.zeros(3), np.zeros((3, 3))
        raise ModelError(
            f"inertia of body '{name}'",
            value=f"a geom of type {kind!r}",
            limit=f"an <inertial>, or geoms of type {', '.join(_SHAPES)}",
            remedy="Write the body's <inertial>: mujoco's compiler prints it",
        )
    size = numbers_of(geom, "size", "0 0 0")
    centre = np.array(numbers_of(geom, "pos", "0 0 0", 3))
    R = frame.rotation(geom)
    ends = geom.get("fromto")
    needed = 1 if ends is not None else _SIZES.get(kind, 3)
    used = size[:needed]
    if len(used) < needed or not 0 < min(used) <= max(used) <= LARGEST:
        raise InvalidInputError(
            f"size of a {kind} of body '{name}'",
            value=size,
            limit=f"{needed} numbers > 0" if ends is None else "its radius, a number > 0",
            remedy="Give half-sizes or radii, m, as MuJoCo has them",
        )
    if ends is not None:
        if kind not in ("capsule", "cylinder", "box", "ellipsoid"):
            raise InvalidInputError(
                "fromto of a geom",
                value=kind,
                limit="an elongated shape",
                remedy="A sphere has a pos= and a size=",
            )
        values = np.array(numbers_of(geom, "fromto", None, 6))
        along = values[3:] - values[:3]
        centre, half = (values[3:] + values[:3]) / 2, float(np.linalg.norm(along)) / 2
        R = _to_z(_unit(list(along)))
        size = [size[0], half] if kind in ("capsule", "cylinder") else [size[0], size[0], half]
    volume, moments = _SHAPES[kind](size)
    density = numbers_of(geom, "density", "1000", 1)[0]
    mass = numbers_of(geom, "mass", None, 1)[0] if geom.get("mass") else density * volume
    return mass, centre, R @ np.diag(mass * np.asarray(moments)) @ R.T


def _sphere(size: Sequence[float]) -> tuple[float, tuple[float, float, float]]:
    r = size[0]
    return 4 / 3 * math.pi * r**3, (0.4 * r**2,) * 3


def _ellipsoid(size: Sequence[float]) -> tuple[float, tuple[float, float, float]]:
    a, b, c = size[:3]
    moments = ((b**2 + c**2) / 5, (a**2 + c**2) / 5, (a**2 + b**2) / 5)
    return 4 / 3 * math.pi * a * b * c, moments


def _box(size: Sequence[float]) -> tuple[float, tuple[float, float, float]]:
    a, b, c = size[:3]
    return 8 * a * b * c, ((b**2 + c**2) / 3, (a**2 + c**2) / 3, (a**2 + b**2) / 3)


def _cylinder(size: Sequence[float]) -> tuple[float, tuple[float, float, float]]:
    r, h = size[:2]
    across = (3 * r**2 + 4 * h**2) / 12
    return 2 * math.pi * r**2 * h, (across, across, r**2 / 2)


def _capsule(size: Sequence[float]) -> tuple[float, tuple[float, float, float]]:
    """A cylinder of half-length h between two half spheres of radius r."""
    r, h = size[:2]
    tube, ball = 2 * math.pi * r**2 * h, 4 / 3 * math.pi * r**3
    volume = tube + ball
    along = (tube * r**2 / 2 + ball * 0.4 * r**2) / volume
    # The centre of a half sphere lies 3r/8 beyond its flat face.
    caps = ball * (0.4 * r**2 + h**2 + 0.75 * h * r)
    across = (tube * (3 * r**2 + 4 * h**2) / 12 + caps) / volume
    return volume, (across, across, along)


_SHAPES: dict[str, Callable[[Sequence[float]], tuple[float, tuple[float, float, float]]]] = {
    "sphere": _sphere,
    "capsule": _capsule,
    "cylinder": _cylinder,
    "box": _box,
    "ellipsoid": _ellipsoid,
}


#: How many numbers give the size of a shape without ``fromto``.
_SIZES = {"sphere": 1, "capsule": 2, "cylinder": 2}


def _unit(vector: Sequence[float]) -> FloatArray:
    array = np.asarray(vector, dtype=float)
    length = float(np.linalg.norm(array))
    if not 0 < length < math.inf:
        raise InvalidInputError(
            "a direction of the file",
            value=list(vector),
            limit="not zero, and finite",
            remedy="Give an axis, or two ends that differ",
        )
    return np.asarray(array / length)


def _turn(axis: Sequence[float], angle: float) -> FloatArray:
    x, y, z = _unit(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K)


def _to_z(direction: FloatArray) -> FloatArray:
    """The smallest rotation that takes the z axis to ``direction``."""
    axis = np.cross([0.0, 0.0, 1.0], direction)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3) if direction[2] > 0 else np.diag([1.0, -1.0, -1.0])
    return _turn(list(axis), math.atan2(sine, float(direction[2])))


def _symmetric(tensor: FloatArray) -> FloatArray:
    return without_rounding((tensor + tensor.T) / 2)
