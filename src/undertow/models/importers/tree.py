"""Trees of links and joints: the data of a rigid-body mechanism, checked as a whole."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from undertow.base import ModelError, check_fields, one_of
from undertow.models.mechanism import FloatArray
from undertow.models.validity import repeated_names

#: Name of the fixed frame that carries the root links.
WORLD = "world"

#: What to do about a joint that leaves a body free.
FREE_BASE = (
    "A free base leaves infinitely many equilibria (Remark 3): freeze the joint by its name, "
    "frozen=[NAME] or FILE:-NAME, or model it by hinges and slides"
)

Vector = tuple[float, float, float]

#: Most moving joints, and most links or joints, of a tree: beyond, nothing could be derived of it.
MOST_MOVING, MOST_PARTS = 16, 200

#: Largest number of a tree, SI units; efforts and ranges may be infinite.
LARGEST = 1e9

#: By how much, of the largest one, a principal moment may exceed the sum of the other two: files
#: give two or three digits.
ROUNDED = 0.01


@dataclass(frozen=True, eq=False)
class Link:
    """A rigid body.

    Parameters
    ----------
    name
        Unique in the tree.
    mass
        kg; zero for frames that carry nothing.
    com
        Centre of mass in the link's frame, m.
    inertia
        About the centre of mass in the axes of the link's frame, kg m², (3, 3).
    """

    name: str
    mass: float = 0.0
    com: Vector = (0.0, 0.0, 0.0)
    inertia: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint between two links, and where the child sits while it reads ``reference``.

    Parameters
    ----------
    name
        Unique in the tree.
    kind
        ``"hinge"``, ``"slide"`` or ``"fixed"``.
    parent, child
        Link names; :data:`WORLD` for the fixed frame.
    rotation, position
        Pose of the child's frame in its parent's, (3, 3) and m.
    axis
        In the child's frame; normalised here.
    anchor
        A point of the hinge's axis in the child's frame, m.
    damping, stiffness, rest
        Force −damping · q̇ − stiffness · (q − rest), SI units.
    armature
        Rotor inertia (hinge, kg m²) or mass (slide, kg) that turns with the joint.
    friction
        Largest dry friction, N m or N: becomes a bound of the disturbance.
    low, high
        Range of travel, rad or m.
    effort
        Largest force of the joint's actuator, N m or N.
    reference
        Reading of the joint in the pose given.
    """

    name: str
    kind: Literal["hinge", "slide", "fixed"]
    parent: str
    child: str
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    position: Vector = (0.0, 0.0, 0.0)
    axis: Vector = (0.0, 0.0, 1.0)
    anchor: Vector = (0.0, 0.0, 0.0)
    damping: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    armature: float = 0.0
    friction: float = 0.0
    low: float = -math.inf
    high: float = math.inf
    effort: float = math.inf
    reference: float = 0.0


@dataclass(frozen=True)
class Coupling:
    """A linear combination of joints, Σ c_j q_j, that is damped, sprung or carries inertia."""

    name: str
    coefficients: Mapping[str, float]
    damping: float = 0.0
    stiffness: float = 0.0
    rest: float = 0.0
    armature: float = 0.0


@dataclass(frozen=True)
class Actuator:
    """An input u that pushes along a stroke, Σ c_j q_j, with the force ``gain`` · u.

    Parameters
    ----------
    name
        Of the input.
    coefficients
        Joint name to c_j.
    gain
        Force along the stroke for each unit of input.
    limit, unit
        Of the input.
    stroke
        Name of Σ c_j q_j, which becomes a coordinate where it is no joint by itself.
    left_out
        What the file says of it and a tree cannot, in words.
    """

    name: str
    coefficients: Mapping[str, float]
    gain: float = 1.0
    limit: float = math.inf
    unit: str = ""
    stroke: str = ""
    left_out: tuple[str, ...] = ()


#: The numbers of a tree's parts that cannot be infinite.
_NUMBERS = {
    "links": ("mass", "com", "inertia"),
    "joints": (
        "rotation", "position", "axis", "anchor", "damping", "stiffness", "rest", "armature",
        "friction", "reference",
    ),
    "couplings": ("coefficients", "damping", "stiffness", "rest", "armature"),
    "actuators": ("coefficients", "gain"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Tree:
    """A tree of links and joints under gravity, m/s², with its actuators."""

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    gravity: Vector = (0.0, 0.0, -9.81)
    couplings: tuple[Coupling, ...] = ()
    actuators: tuple[Actuator, ...] = ()

    def __post_init__(self) -> None:
        """Refuse repeated names, dangling ends, loops, and links that cannot be bodies."""
        for parts in ("links", "joints", "couplings", "actuators"):
            check_fields(self, parts)
        moving = sum(joint.kind != "fixed" for joint in self.joints)
        for what, count, most in (
            ("moving joints", moving, MOST_MOVING),
            ("links", len(self.links), MOST_PARTS),
            ("joints", len(self.joints), MOST_PARTS),
            ("actuators and couplings", len(self.actuators) + len(self.couplings), MOST_PARTS),
        ):
            if count > most:
                raise ModelError(
                    f"{what} of '{self.name}'",
                    value=count,
                    limit=f"at most {most}",
                    remedy="Keep the bodies that the mechanism is about; make the others fixed, "
                    "or lump them together",
                )
        for what, names in (
            ("link", [link.name for link in self.links]),
            ("joint", [joint.name for joint in self.joints]),
            ("actuator", [actuator.name for actuator in self.actuators]),
        ):
            repeated = repeated_names(names)
            if repeated:
                raise ModelError(
                    f"a {what} of '{self.name}' is named twice",
                    value=repeated,
                    limit="unique names",
                    remedy=f"Rename one {what}",
                )
        self._check_sizes()
        known = {WORLD, *(link.name for link in self.links)}
        parents: dict[str, str] = {}
        for joint in self.joints:
            for end in (joint.parent, joint.child):
                whose = f"link of joint '{joint.name}' of '{self.name}'"
                one_of(
                    whose, end, sorted(known), "Declare the link, or correct its name", ModelError
                )
            if joint.child == WORLD:
                raise ModelError(
                    f"joint '{joint.name}' of '{self.name}'",
                    value=f"child {WORLD!r}, the fixed frame",
                    limit="a link that can move",
                    remedy="The fixed frame carries the tree: turn the joint round, or rename it",
                )
            if joint.child in parents:
                raise ModelError(
                    f"link '{joint.child}' of '{self.name}' closes a loop",
                    value=f"child of joints '{parents[joint.child]}' and '{joint.name}'",
                    limit="a tree: one parent for each link",
                    remedy="Cut the loop, or eliminate it and give M, f and B",
                )
            parents[joint.child] = joint.name
        ordered = self.ordered()
        if len(ordered) != len(self.joints):
            astray = sorted({j.name for j in self.joints} - {j.name for j in ordered})
            raise ModelError(
                f"joints of '{self.name}' that do not hang on the fixed frame",
                value=", ".join(astray),
                limit="a tree rooted in the fixed frame",
                remedy="A loop among them has no root: cut it, or fix one link to the world",
            )
        self._check_inertia()

    def ordered(self) -> list[Joint]:
        """Return the joints from the root outwards."""
        return self._beyond(WORLD)

    def _beyond(self, link: str) -> list[Joint]:
        """Return the joints from a link outwards."""
        children: dict[str, list[Joint]] = {}
        for joint in self.joints:
            children.setdefault(joint.parent, []).append(joint)
        order: list[Joint] = []
        frontier = [link]
        while frontier:
            hanging = children.get(frontier.pop(0), [])
            order += hanging
            frontier += [joint.child for joint in hanging]
        return order

    @property
    def moving(self) -> list[Joint]:
        """The hinge and slide joints, from the root outwards: the coordinates."""
        return [joint for joint in self.ordered() if joint.kind != "fixed"]

    def _check_sizes(self) -> None:
        """Refuse values that are not numbers, or so large that their products would overflow."""
        named: list[tuple[str, str, Any]] = [("gravity", self.name, self.gravity)]
        if np.shape(self.gravity) != (3,):
            raise ModelError(
                f"gravity of '{self.name}'",
                value=repr(self.gravity),
                limit="three numbers, m/s²",
                remedy="Write gravity=(0, 0, -9.81)",
            )
        for parts, numbers in _NUMBERS.items():
            for part in getattr(self, parts):
                named += [(what, part.name, getattr(part, what)) for what in numbers]
        for what, name, given in named:
            value = list(given.values()) if isinstance(given, Mapping) else given
            try:
                size = np.abs(np.asarray(value, dtype=float)).max(initial=0.0)
            except (TypeError, ValueError):  # no numbers at all
                size = math.nan
            if not size <= LARGEST:
                raise ModelError(
                    f"{what} of '{name}'",
                    value=f"{size:g} among {value}",
                    limit=f"numbers up to {LARGEST:g} in SI units",
                    remedy="Check the units",
                )

    def _check_inertia(self) -> None:
        links = {link.name: link for link in self.links}
        for link in self.links:
            inertia = np.asarray(link.inertia, dtype=float)
            values = np.linalg.eigvalsh(inertia)
            what, moments = f"inertia of link '{link.name}'", values.round(9).tolist()
            if link.mass < 0 or values[0] < -1e-9 * max(1e-12, values[-1]):
                raise ModelError(
                    what,
                    value=f"mass {link.mass:g} kg, principal moments {moments}",
                    limit="mass ≥ 0 and no negative moment of inertia",
                    remedy="Check the units and the signs of the products of inertia",
                )
            if values[2] - values[1] - values[0] > ROUNDED * values[2]:
                raise ModelError(
                    what,
                    value=f"principal moments {moments} kg m²: {values[2]:.4g} > "
                    f"{values[0]:.4g} + {values[1]:.4g}",
                    limit=f"none larger than the sum of the others, to {ROUNDED:.0%}: no body has",
                    remedy="Check the units, and that the moments are about the centre of mass; a "
                    "thin rod has one that is zero and two that are equal",
                )
        armed = {j for c in self.couplings if c.armature > 0 for j in c.coefficients}
        for joint in self.moving:
            further = self._beyond(joint.child)
            carried = [links[j.child] for j in (joint, *further)]
            mass = sum(link.mass for link in carried)
            turning = sum(float(np.trace(link.inertia)) for link in carried)
            if joint.kind == "hinge":
                turning += sum(link.mass * float(np.dot(link.com, link.com)) for link in carried)
                turning += mass if further else 0.0
                turning += mass * float(np.dot(joint.anchor, joint.anchor))
            heavy = mass > 0 if joint.kind == "slide" else turning > 0
            if not (heavy or joint.armature > 0 or joint.name in armed):
                raise ModelError(
                    f"link '{joint.child}' of '{self.name}', moved by joint '{joint.name}'",
                    value="mass 0 kg, no inertia" if mass == 0 else "no inertia about the joint",
                    limit="> 0: a massless link has no M > 0",
                    remedy="Give the link a mass and an inertia, or make the joint fixed",
                )
