"""Mechanisms from URDF files: links and joints, inertias, damping, limits, transmissions."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from undertow.base import InvalidInputError, ModelError, checked, one_of
from undertow.models.importers.equilibrium import at_equilibrium
from undertow.models.importers.mujoco_compiler import compared, engine, urdf_compiled
from undertow.models.importers.reading import described, names_of
from undertow.models.importers.rigid_body import check_held, mechanism_from_tree
from undertow.models.importers.tree import FREE_BASE, WORLD, Joint, Link, Tree, Vector
from undertow.models.importers.xml_files import (
    EXPAND,
    computable,
    is_text,
    numbers_of,
    parse_xml,
    rotation_from_rpy,
    without_rounding,
)
from undertow.models.mechanism import FloatArray, Mechanism

#: Where the elements of ROS' macros come from.
_XACRO = ("{http://www.ros.org/wiki/xacro}", "{http://ros.org/wiki/xacro}")

_KINDS: dict[str, Literal["hinge", "slide", "fixed"]] = {
    "revolute": "hinge",
    "continuous": "hinge",
    "prismatic": "slide",
    "fixed": "fixed",
}


@checked
def from_urdf(
    source: str | Path,
    *,
    actuated: Sequence[str] | None = None,
    frozen: Sequence[str] = (),
    equilibrium: Mapping[str, float] | str | None = None,
    gravity: Vector = (0.0, 0.0, -9.81),
    start: Mapping[str, float] | None = None,
    effort: Mapping[str, float] | None = None,
) -> Mechanism:
    """Build a mechanism from a URDF file or text.

    Its root link is fixed to the world.  Masses, centres of mass, inertias, damping and the
    strength of gravity become parameters; joint ranges become those of the coordinates;
    effort limits those of the inputs (one without is unlimited, and the description of the
    mechanism says so); dry friction a bound on the disturbance.  Shapes,
    velocity limits and safety controllers are not read.

    Parameters
    ----------
    source
        Path of the file, or the text itself.
    actuated
        Names of the actuated joints, in the order of the inputs.  By default those of the file's
        ``<transmission>`` elements and those with a command interface in its ``<ros2_control>``
        elements, or, without any, those with an effort limit where others have none.
    frozen
        Names of joints that do not belong to the mechanism: they become fixed as they are drawn.
    equilibrium
        The target, joint name to rad or m; zero where left out.  Or a word of
        :func:`~undertow.models.importers.at_equilibrium`: upright, hanging, nearest.
    gravity
        m/s², in the frame of the root link.
    start
        A usual initial state, errors from the target, by state names.
    effort
        Joint name to actuator limit, N m or N, in place of the file's.

    Returns
    -------
    Mechanism
        With the actuated joints first; coordinates are named after the joints.

    Raises
    ------
    InvalidInputError
        For malformed XML, macros that xacro has yet to expand, invalid numbers, unknown or repeated
        actuated joints.
    ModelError
        For loops, massless moving links, inertias that no body has, floating or planar joints,
        mimic joints, repeated names, and more joints than equations can be derived for.
    """
    with computable("URDF"):
        robot = _frozen(parse_xml(source, "robot"), names_of(frozen, "frozen"))
        tree, transmitted = _read(robot, gravity)
        if actuated is None:
            _check_transmitted(tree, transmitted)
        driven = actuated if actuated is not None else transmitted or _driven(tree) or None
        if isinstance(equilibrium, str):
            check_held(tree, driven or ())
        place = equilibrium if isinstance(equilibrium, Mapping) else None
        mechanism = mechanism_from_tree(
            tree,
            actuated=driven,
            equilibrium=place,
            start=start,
            effort=effort,
            source="URDF text" if is_text(source) else str(source),
        )
        how = "this package's reader"
        mujoco = engine()
        model = None if mujoco is None else urdf_compiled(mujoco, robot, gravity)
        if model is not None:
            how += ", compared with " + compared(mechanism, tree, model, place or {}, driven=False)
        mechanism = described(mechanism, tree, f"URDF '{tree.name}' by {how}", names_of(frozen, ""))
        if isinstance(equilibrium, str):
            return at_equilibrium(mechanism, equilibrium)
        return mechanism


def _check_transmitted(tree: Tree, transmitted: Sequence[str]) -> None:
    """Refuse transmissions to joints that are not there: of part of a robot, or misspelt."""
    moving = {joint.name for joint in tree.moving}
    for name in transmitted:
        if name not in moving:
            raise ModelError(
                f"transmission of URDF '{tree.name}'",
                value=f"to '{name}', which is no joint of it",
                limit=f"to one of {', '.join(sorted(moving))}",
                remedy="Mend the file, or name what is driven: actuated=[...], FILE.urdf:JOINT",
            )


def _driven(tree: Tree) -> list[str]:
    """The joints with an effort limit, where there are others without."""
    efforts = {joint.name: joint.effort for joint in tree.moving}
    given = [name for name, effort in efforts.items() if math.isfinite(effort)]
    return given if len(given) < len(efforts) else []


def _frozen(robot: ET.Element, frozen: Sequence[str]) -> ET.Element:
    """Make joints fixed."""
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    for name in frozen:
        one_of("frozen joint", name, joints, "Name joints as the file does")
        joints[name].set("type", "fixed")
    for transmission in robot.findall("transmission"):
        if any(joint.get("name") in frozen for joint in transmission.iterfind("joint")):
            robot.remove(transmission)
    return robot


@np.errstate(all="ignore")  # what overflows is refused with the tree
@checked
def read_urdf(
    source: str | Path, gravity: Vector = (0.0, 0.0, -9.81)
) -> tuple[Tree, tuple[str, ...]]:
    """Read a URDF: the tree, and the joints that its transmissions name.

    Raises
    ------
    ArtefactError, InvalidInputError, ModelError
        As for :func:`from_urdf`.
    """
    return _read(parse_xml(source, "robot"), gravity)


@np.errstate(all="ignore")
def _read(robot: ET.Element, gravity: Vector) -> tuple[Tree, tuple[str, ...]]:
    name = robot.get("name", "robot")
    _check_expanded(robot)
    links = [_link(element) for element in robot.findall("link")]
    joints = [_joint(element) for element in robot.findall("joint")]
    if not links:
        raise ModelError(
            f"URDF '{name}'",
            value="no link",
            limit="at least one",
            remedy="Give the bodies as <link>, the way they move as <joint>",
        )
    # MuJoCo's way with what no body can be: a link without mass that moves with another.
    welded = {joint.child for joint in joints if joint.kind == "fixed"}
    links = [
        replace(link, inertia=np.zeros((3, 3))) if link.name in welded and not link.mass else link
        for link in links
    ]
    children = {joint.child for joint in joints}
    roots = [link.name for link in links if link.name not in children]
    if len(roots) > 1:
        raise ModelError(
            f"URDF '{name}'",
            value=f"{len(roots)} root links: {', '.join(roots)}",
            limit="one",
            remedy="Connect every link to the tree by a joint",
        )
    if roots and roots[0] != WORLD:
        joints.append(Joint(f"{roots[0]}_to_world", "fixed", WORLD, roots[0]))
    kept = tuple(link for link in links if link.name != WORLD)
    tree = Tree(name, kept, tuple(joints), gravity)
    still = {joint.name for joint in joints if joint.kind == "fixed"}
    driven = list(robot.iterfind("transmission/joint"))
    driven += robot.iterfind("ros2_control/joint[command_interface]")
    transmitted = dict.fromkeys(joint.get("name", "") for joint in driven)
    return tree, tuple(name for name in transmitted if name not in still)


def _check_expanded(robot: ET.Element) -> None:
    """Refuse what xacro has not put its own elements into yet: bodies would be missing."""
    left = next((e.tag for e in robot.iter() if e.tag.startswith(_XACRO)), None)
    if left is not None:
        raise InvalidInputError(
            f"URDF '{robot.get('name', 'robot')}'",
            value=f"<xacro:{left.partition('}')[2]}>",
            limit="a URDF without macros",
            remedy=EXPAND,
        )


def _pose(element: ET.Element, of: str) -> tuple[FloatArray, Vector]:
    origin = element.find("origin")
    if origin is None:
        return np.eye(3), (0.0, 0.0, 0.0)
    x, y, z = numbers_of(origin, "xyz", "0 0 0", 3, of=of)
    return rotation_from_rpy(numbers_of(origin, "rpy", "0 0 0", 3, of=of)), (x, y, z)


def _name(element: ET.Element) -> str:
    name = element.get("name")
    if not name:
        raise ModelError(
            f"a <{element.tag}> of the URDF",
            value="no name",
            limit="a name",
            remedy="Give every link and joint a name=",
        )
    return name


def _child(element: ET.Element, tag: str, of: str) -> ET.Element:
    found = element.find(tag)
    if found is None:
        raise ModelError(
            f"<{element.tag}> of '{of}'",
            value=f"no <{tag}>",
            limit="one",
            remedy=f"URDF wants a <{tag}> there",
        )
    return found


def _link(element: ET.Element) -> Link:
    link = Link(_name(element))
    inertial = element.find("inertial")
    if inertial is None:
        return link
    R, com = _pose(inertial, link.name)
    (mass,) = numbers_of(_child(inertial, "mass", link.name), "value", None, 1, of=link.name)
    tensor = np.zeros((3, 3))
    given = inertial.find("inertia")
    if given is not None:
        for label, (i, j) in {
            "ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2),
            "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2),
        }.items():  # fmt: skip
            tensor[i, j] = tensor[j, i] = numbers_of(given, label, "0", 1, of=link.name)[0]
    rotated = without_rounding(R @ tensor @ R.T)
    return replace(link, mass=mass, com=com, inertia=(rotated + rotated.T) / 2)


def _joint(element: ET.Element) -> Joint:
    name = _name(element)
    kind = element.get("type", "")
    free = FREE_BASE if kind in ("floating", "planar") else "Model it by hinges and slides"
    one_of(f"type of joint '{name}'", kind, _KINDS, free, ModelError)
    if kind != "fixed" and element.find("mimic") is not None:
        raise ModelError(
            f"joint '{name}'",
            value="a mimic joint, which is a constraint",
            limit="independent joints",
            remedy="Eliminate it and give M, f and B, or make the joint fixed: "
            f"frozen=['{name}'], FILE:-{name}",
        )
    R, position = _pose(element, name)
    parent = _child(element, "parent", name).get("link", "")
    child = _child(element, "child", name).get("link", "")
    joint = Joint(name, _KINDS[kind], parent, child, R, position)
    if joint.kind == "fixed":
        return joint
    axis_element = element.find("axis")
    x, y, z = (
        (1.0, 0.0, 0.0)
        if axis_element is None
        else numbers_of(axis_element, "xyz", "1 0 0", 3, of=name)
    )
    joint = replace(joint, axis=(x, y, z))
    dynamics = element.find("dynamics")
    if dynamics is not None:
        (damping,) = numbers_of(dynamics, "damping", "0", 1, of=name)
        (friction,) = numbers_of(dynamics, "friction", "0", 1, of=name)
        joint = replace(joint, damping=damping, friction=friction)
    limit = element.find("limit")
    if limit is not None:
        (effort,) = numbers_of(limit, "effort", "0", 1, of=name)
        if effort < 0:
            raise ModelError(
                f"effort of joint '{name}'",
                value=effort,
                limit="≥ 0",
                remedy="Give the largest magnitude, N m or N; 0 where it is not known",
            )
        # URDF demands an effort and writes 0 for "not known".
        joint = replace(joint, effort=effort if effort > 0 else math.inf)
        if kind != "continuous":
            (low,) = numbers_of(limit, "lower", "0", 1, of=name)
            (high,) = numbers_of(limit, "upper", "0", 1, of=name)
            if low > high:
                raise ModelError(
                    f"limits of joint '{name}'",
                    value=f"lower {low:g}, upper {high:g}",
                    limit="lower ≤ upper",
                    remedy="Give the lower end first; equal ends say that there is no limit",
                )
            if low < high:
                joint = replace(joint, low=low, high=high)
    return joint
