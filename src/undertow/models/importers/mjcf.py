"""Mechanisms from MJCF, MuJoCo's XML: bodies, joints, tendons as couplings, motors."""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from undertow.base import InvalidInputError, ModelError, checked, one_of
from undertow.models.importers.equilibrium import at_equilibrium
from undertow.models.importers.mjcf_bodies import Frame, link_of
from undertow.models.importers.mjcf_document import Document, free_body, mjcf_document
from undertow.models.importers.mujoco_compiler import compared, compiled, engine, tree_of
from undertow.models.importers.reading import described, names_of
from undertow.models.importers.rigid_body import check_held, mechanism_from_tree
from undertow.models.importers.tree import (
    WORLD,
    Actuator,
    Coupling,
    Joint,
    Link,
    Tree,
    Vector,
)
from undertow.models.importers.xml_files import computable, is_text, numbers_of
from undertow.models.mechanism import FloatArray, Mechanism

#: Sections that do not touch the equations of motion of a tree of bodies.
_HARMLESS = {"asset", "compiler", "default", "extension", "option"}
_READ = {"worldbody", "actuator", "tendon", "equality"}
_BODY_PARTS = {"body", "inertial", "joint", "freejoint", "geom", "site"}


@checked
def from_mjcf(
    source: str | Path,
    *,
    actuated: Sequence[str] | None = None,
    frozen: Sequence[str] = (),
    equilibrium: Mapping[str, float] | str | None = None,
    start: Mapping[str, float] | None = None,
    effort: Mapping[str, float] | None = None,
) -> Mechanism:
    """Build a mechanism from an MJCF file or text.

    Where MuJoCo is installed its own compiler reads the file: includes, default classes, frames,
    meshes, servos (their springs and dampers become the mechanism's) and gears as it has them; and
    the mechanism's accelerations are compared with MuJoCo's at random states.  Elsewhere the
    reader of this package does: bodies with ``<inertial>`` or with spheres, capsules, cylinders,
    boxes and ellipsoids of given mass or density; hinge and slide joints with range, damping,
    stiffness, armature and ``frictionloss`` (a bound on the disturbance); default classes;
    ``motor`` actuators on joints and on ``fixed`` tendons, whose own damping, stiffness and
    armature count too.  Contacts are left out.  The description of the mechanism says what was
    read, and which inputs the file gives no limit for.

    Parameters
    ----------
    source
        Path of the file, or the text itself.
    actuated
        Names of the actuated joints, in the order of the inputs: torques or forces on them,
        instead of the file's motors.
    frozen
        Names of joints that do not belong to the mechanism: their bodies stay as they are drawn.
    equilibrium
        The target, joint name to rad or m; zero where left out.  Or a word of
        :func:`~undertow.models.importers.at_equilibrium`: upright, hanging, nearest.
    start
        A usual initial state, errors from the target, by state names.
    effort
        Joint name to actuator limit, N m or N (with ``actuated``).

    Returns
    -------
    Mechanism
        With the file's motors as inputs (in the units of ``ctrl``), or those of ``actuated``.

    Raises
    ------
    ArtefactError
        For a file that cannot be read.
    InvalidInputError
        For malformed XML, invalid numbers, unknown or repeated actuated joints.
    ModelError
        For ball and free joints, equality constraints, massless moving bodies, inertias that no
        body has, elements that change the motion in ways that are not read here, more joints
        than equations can be derived for, and accelerations that are not MuJoCo's.
    """
    with computable("MJCF"):
        document = mjcf_document(source, names_of(frozen, "frozen"))
        tree, model, refusal = _read(document, motors=actuated is None)
        if isinstance(equilibrium, str):
            check_held(tree, actuated or ())
        place = equilibrium if isinstance(equilibrium, Mapping) else None
        mechanism = mechanism_from_tree(
            tree,
            actuated=actuated,
            equilibrium=place,
            start=start,
            effort=effort,
            source="MJCF text" if is_text(source) else str(source),
        )
        how = "this package's own reader; MuJoCo, which would compare, is not installed"
        if model is not None:
            how = compared(mechanism, tree, model, place or {}, driven=actuated is None)
        elif refusal:
            how = f"this package's own reader; MuJoCo's would refuse: {refusal}"
        mechanism = described(mechanism, tree, f"MJCF '{tree.name}' by {how}", document.frozen)
        if isinstance(equilibrium, str):
            return at_equilibrium(mechanism, equilibrium)
        return mechanism


@checked
def read_mjcf(source: str | Path, *, motors: bool = True) -> Tree:
    """Read an MJCF file as a tree; ``motors=False`` leaves its actuators out.

    Raises
    ------
    ArtefactError, InvalidInputError, ModelError
        As for :func:`from_mjcf`.
    """
    return _read(mjcf_document(source), motors=motors)[0]


@np.errstate(all="ignore")  # what overflows is refused with the tree
def _read(document: Document, *, motors: bool) -> tuple[Tree, Any, str]:
    """Return the tree; MuJoCo's compiled model where it has one; and why it has none."""
    mujoco, name = engine(), document.root.get("model", "mujoco")
    if mujoco is None:
        return _own_tree(document.root, motors), None, ""
    try:
        model = compiled(mujoco, document)
    except InvalidInputError as error:
        # This reader may see a reason of mechanics, and how to mend it.  It grants files that
        # they round moments of inertia, and rods that are thin.
        tree, refusal = _own_tree(document.root, motors), str(error.value)
        if "inertia" not in refusal:
            raise
        return tree, None, refusal
    return tree_of(mujoco, model, name, motors=motors), model, ""


def _own_tree(root: ET.Element, motors: bool) -> Tree:
    for section in root:
        if section.tag not in _HARMLESS | _READ:
            raise _unread(f"<{section.tag}>", "Write the model out without it")
    for equality in root.iterfind("equality/*"):
        raise ModelError(
            f"equality constraint <{equality.tag} name={equality.get('name', '')!r}>",
            value="a closed loop or a coupled joint",
            limit="a tree of independent joints",
            remedy="Cut the loop, or eliminate it and give M, f and B",
        )
    reader = _Reader(root)
    worldbody = root.find("worldbody")
    if worldbody is not None:
        reader.bodies(worldbody, WORLD, None)
    kinds = {joint.name: joint.kind for joint in reader.joints}
    couplings = {c.name: c for c in reader.tendons(kinds)}
    actuators = reader.actuators(kinds, couplings) if motors else ()
    return Tree(
        root.get("model", "mujoco"),
        tuple(reader.links),
        tuple(reader.joints),
        reader.gravity(),
        tuple(couplings.values()),
        tuple(actuators),
    )


def _unread(what: str, remedy: str) -> ModelError:
    return ModelError(f"MJCF with {what}", limit="a tree of rigid bodies and motors", remedy=remedy)


class _Reader:
    """Walks the file once; defaults and conventions at hand."""

    def __init__(self, root: ET.Element) -> None:
        self.root = root
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        compiler = ET.Element("compiler")
        for given in root.iterfind("compiler"):
            compiler.attrib |= given.attrib
        settings = compiler.attrib
        for name in ("boundmass", "boundinertia", "settotalmass"):
            if numbers_of(compiler, name, "0", 1)[0] > 0:
                raise _unread(f"compiler {name}", "Write the masses out as they are meant")
        if "inertiagrouprange" in settings:
            raise _unread("compiler inertiagrouprange", "Give the bodies an <inertial>")
        if settings.get("balanceinertia", "false") == "true":
            raise _unread("compiler balanceinertia", "Write the inertias out as they are meant")
        sequence = settings.get("eulerseq", "xyz")
        if len(sequence) != 3 or set(sequence.lower()) - set("xyz"):
            raise InvalidInputError(
                "compiler eulerseq",
                value=repr(sequence),
                limit="three of x, y, z, X, Y, Z",
                remedy="Leave it out for MuJoCo's usual one, xyz",
            )
        self.frame = Frame(settings.get("angle", "degree") == "degree", sequence)
        self.autolimits = settings.get("autolimits", "true") == "true"
        self.infer = settings.get("inertiafromgeom", "auto")
        self.classes: dict[str, dict[str, dict[str, str]]] = {"main": {}}
        for default in root.iterfind("default"):
            self._defaults(default, default.get("class", "main"), {})
            # The outermost class is the main one, whatever its name.
            self.classes["main"] = self.classes[default.get("class", "main")]

    def _defaults(
        self, element: ET.Element, name: str, inherited: Mapping[str, dict[str, str]]
    ) -> None:
        table = {tag: dict(attributes) for tag, attributes in inherited.items()}
        for child in element:
            if child.tag != "default":
                table[child.tag] = table.get(child.tag, {}) | child.attrib
        self.classes[name] = table
        for child in element.iterfind("default"):
            self._defaults(child, child.get("class", ""), table)

    def _filled(
        self, element: ET.Element, childclass: str | None, tag: str | None = None
    ) -> ET.Element:
        """A copy of the element with the attributes of its class filled in."""
        name = element.get("class") or childclass or "main"
        what = f"class of <{element.tag}>, one declared in <default>"
        one_of(what, name, self.classes, "Declare it, or leave class= out", ModelError)
        filled = copy.copy(element)
        defaults = self.classes[name].get(tag or element.tag, {})
        filled.attrib = {**defaults, **element.attrib}
        return filled

    def gravity(self) -> Vector:
        """Gravity, m/s²; refuses media that push on the bodies."""
        gravity: Vector = (0.0, 0.0, -9.81)
        for option in self.root.iterfind("option"):
            for name in ("density", "viscosity", "wind"):
                if any(numbers_of(option, name, "0")):
                    raise _unread(f"option {name}", "Give drag as a disturbance of the plant")
            x, y, z = numbers_of(option, "gravity", "0 0 -9.81", 3)
            gravity = (x, y, z)
            flag = option.find("flag")
            if flag is not None and flag.get("gravity") == "disable":
                gravity = (0.0, 0.0, 0.0)
        return gravity

    def bodies(self, parent: ET.Element, link: str, childclass: str | None) -> None:
        """Read the bodies under an element, each as a chain of its joints."""
        for body in parent.iterfind("body"):
            for part in body:
                if part.tag not in _BODY_PARTS:
                    raise _unread(f"<{part.tag}> in a body", "Write the bodies out")
            name = body.get("name") or f"body_{len(self.links) + 1}"
            if numbers_of(body, "gravcomp", "0", 1)[0] != 0 or body.get("mocap") == "true":
                raise _unread(f"gravcomp or mocap on body '{name}'", "Leave it out")
            inner = body.get("childclass") or childclass
            geoms = [self._filled(g, inner) for g in body.iterfind("geom")]
            x, y, z = numbers_of(body, "pos", "0 0 0", 3)
            pose: tuple[FloatArray, Vector] = self.frame.rotation(body), (x, y, z)
            carrier, joints = link, list(self._joints_of(body, name, inner))
            for k, joint in enumerate(joints, 1):
                child = name
                if k < len(joints):
                    child = f"{name}_frame_{k}"
                    self.links.append(Link(child))
                self.joints.append(self._joint(joint, carrier, child, *pose))
                carrier, pose = child, (np.eye(3), (0.0, 0.0, 0.0))
            if not joints:
                self.joints.append(Joint(f"{name}_fixed", "fixed", carrier, name, *pose))
            self.links.append(link_of(body, name, self.frame, geoms, self.infer))
            self.bodies(body, name, inner)

    def _joints_of(
        self, body: ET.Element, name: str, childclass: str | None
    ) -> Iterator[ET.Element]:
        for element in body:
            if element.tag == "freejoint":
                raise free_body(f"of '{name}'", "freejoint")
            if element.tag == "joint":
                joint = self._filled(element, childclass)
                if joint.get("type", "hinge") not in ("hinge", "slide"):
                    raise free_body(f"of '{name}'", joint.get("type", ""))
                yield joint

    def _joint(
        self, joint: ET.Element, parent: str, child: str, rotation: FloatArray, position: Vector
    ) -> Joint:
        kind = joint.get("type", "hinge")
        name = joint.get("name") or f"{child}_{kind}"
        turning = kind == "hinge"

        def number(attribute: str, default: str = "0") -> float:
            return numbers_of(joint, attribute, default, 1)[0]

        def place(attribute: str) -> float:
            value = number(attribute)
            return self.frame.angle(value) if turning else value

        low, high = -math.inf, math.inf
        if self._limited(joint, "limited", "range"):
            low, high = numbers_of(joint, "range", None, 2)
            if turning:
                low, high = self.frame.angle(low), self.frame.angle(high)
        effort = math.inf
        if self._limited(joint, "actuatorfrclimited", "actuatorfrcrange"):
            effort = min(abs(v) for v in numbers_of(joint, "actuatorfrcrange", None, 2))
        x, y, z = numbers_of(joint, "axis", "0 0 1", 3)
        ax, ay, az = numbers_of(joint, "pos", "0 0 0", 3)
        return Joint(
            name,
            "hinge" if turning else "slide",
            parent,
            child,
            rotation,
            position,
            axis=(x, y, z),
            anchor=(ax, ay, az),
            damping=number("damping"),
            stiffness=number("stiffness"),
            rest=place("springref"),
            armature=number("armature"),
            friction=number("frictionloss"),
            low=low,
            high=high,
            effort=effort,
            reference=place("ref"),
        )

    def _limited(self, element: ET.Element, switch: str, values: str) -> bool:
        given = element.get(switch, "auto")
        if given == "auto":
            return self.autolimits and element.get(values) is not None
        return given == "true"

    def tendons(self, kinds: Mapping[str, str]) -> Iterator[Coupling]:
        """Read fixed tendons as linear couplings of joints."""
        for element in self.root.iterfind("tendon/*"):
            if element.tag != "fixed":
                raise _unread(f"<{element.tag}> tendon", "Only fixed tendons are linear in q")
            filled = self._filled(element, None, "tendon")
            dry = numbers_of(filled, "frictionloss", "0", 1)[0] != 0
            if dry or filled.get("range") is not None:
                raise _unread("friction or limits on a tendon", "Put them on joints")
            coefficients: dict[str, float] = {}
            for part in element.iterfind("joint"):
                joint = part.get("joint", "")
                whose = f"joint of tendon '{element.get('name', '')}'"
                one_of(whose, joint, kinds, "Declare the joint, or correct its name", ModelError)
                coefficients[joint] = numbers_of(part, "coef", None, 1)[0]
            yield Coupling(
                element.get("name", ""),
                coefficients,
                damping=numbers_of(filled, "damping", "0", 1)[0],
                stiffness=numbers_of(filled, "stiffness", "0", 1)[0],
                rest=self._springlength(filled),
                armature=numbers_of(filled, "armature", "0", 1)[0],
            )

    def _springlength(self, tendon: ET.Element) -> float:
        """Rest length; MuJoCo takes −1 for the length in the pose drawn, where q = ref."""
        (rest,) = numbers_of(tendon, "springlength", "-1", 1)
        if rest != -1:
            return rest
        reference = {joint.name: joint.reference for joint in self.joints}
        return sum(
            float(part.get("coef", "0")) * reference[part.get("joint", "")]
            for part in tendon.iterfind("joint")
        )

    def actuators(
        self, kinds: Mapping[str, str], couplings: Mapping[str, Coupling]
    ) -> Iterator[Actuator]:
        """Read motors on joints and fixed tendons; other actuators are refused."""
        efforts = {joint.name: joint.effort for joint in self.joints}
        for k, element in enumerate(self.root.iterfind("actuator/*")):
            name = element.get("name") or f"u_{k + 1}"
            if element.tag != "motor":
                raise _unread(
                    f"actuator <{element.tag} name={name!r}>",
                    "Use <motor>, or name the actuated joints: actuated=['...']",
                )
            motor = self._filled(element, None)
            gears = numbers_of(motor, "gear", "1")
            if not gears or gears[0] == 0:
                raise ModelError(
                    f"gear of motor '{name}'",
                    value=motor.get("gear"),
                    limit="a first number that is not zero",
                    remedy="A motor that moves nothing is no input: leave it out",
                )
            gear = gears[0]
            joint, tendon = motor.get("joint"), motor.get("tendon")
            if joint is not None:
                coefficients = {joint: 1.0}
                unit = {"hinge": "N m", "slide": "N"}.get(kinds.get(joint, ""), "")
            elif tendon in couplings:
                coefficients, unit = dict(couplings[str(tendon)].coefficients), ""
            else:
                raise _unread(
                    f"motor '{name}' on neither joint nor fixed tendon", "Give joint= or tendon="
                )
            limits = [math.inf]
            for switch, values in (("ctrllimited", "ctrlrange"), ("forcelimited", "forcerange")):
                if self._limited(motor, switch, values):
                    limits.append(min(abs(v) for v in numbers_of(motor, values, None, 2)))
            if joint is not None:
                limits.append(efforts.get(joint, math.inf) / abs(gear))
            yield Actuator(
                name, coefficients, gear, min(limits), unit if gear == 1 else "", tendon or ""
            )
