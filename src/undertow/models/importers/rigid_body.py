"""Trees of rigid bodies with hinge and slide joints, planar or in space: tree to mechanism.

Velocities run outwards along the tree *in the frames of the bodies*, where they are short:
with r the way from parent to child, R(q) the rotation of the child in its parent, and â the
joint axis,

    ω_c = Rᵀ ω_p + â q̇,        v_c = Rᵀ (v_p + ω_p × r)        (hinge)
    ω_c = Rᵀ ω_p,              v_c = Rᵀ (v_p + ω_p × r) + â q̇  (slide)

Each is linear in q̇, so the recursion carries the Jacobians J_ω and J_v, and
``M = Σ m J_cᵀ J_c + J_ωᵀ I J_ω`` with J_c at the centre of mass.  Gravity needs only the
direction of the vertical in each body's frame and the height of its origin.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy as sp

from undertow.base import InvalidInputError, ModelError, checked, one_of
from undertow.models.importers.coordinates import number, tidy
from undertow.models.importers.equations import from_matrices, lagrange_force, unit_inputs
from undertow.models.importers.reading import names_of
from undertow.models.importers.tree import WORLD, Joint, Link, Tree
from undertow.models.mechanism import (
    Coordinate,
    FloatArray,
    Input,
    Mechanism,
    Parameter,
    check_underactuated,
)
from undertow.models.quantities import code_points, normal_name

#: Longest mass matrix, in operations of its upper half: deriving f from it takes some 10 s.
MOST_OPERATIONS = 8_000


@checked
def mechanism_from_tree(
    tree: Tree,
    *,
    actuated: Sequence[str] | None = None,
    equilibrium: Mapping[str, float] | None = None,
    start: Mapping[str, float] | None = None,
    effort: Mapping[str, float] | None = None,
    source: str = "",
) -> Mechanism:
    """Derive M, f and B of a tree; masses, inertias, damping and gravity become parameters.

    Parameters
    ----------
    tree
        The bodies and joints.
    actuated
        Names of the actuated joints, in the order of the inputs; the tree's own actuators by
        default.  All other joints are free.
    equilibrium
        The target, joint name to rad or m; zero where left out.
    start
        A usual initial state, errors from the target, by state names.
    effort
        Joint name to actuator limit, N m or N, in place of the tree's (``actuated`` only).
    source
        As for :class:`~undertow.models.Mechanism`.

    Raises
    ------
    ModelError
        For a tree without actuators, or as for
        :func:`~undertow.models.importers.from_matrices`.
    InvalidInputError
        For an actuated joint that does not exist or is named twice.
    """
    if actuated is not None:
        actuated = names_of(actuated, "actuated", tree.name)
    joints = tree.moving
    if not joints:
        raise ModelError(
            f"'{tree.name}'",
            value="no moving joint",
            limit="at least two, and fewer motors than joints",
            remedy="There is nothing to balance",
        )
    names = _distinct([joint.name for joint in joints])
    coordinates = [
        Coordinate(
            name,
            "rad" if joint.kind == "hinge" else "m",
            f"{joint.kind} joint '{joint.name}' of '{joint.child}'",
            joint.low,
            joint.high,
        )
        for name, joint in zip(names, joints, strict=True)
    ]
    index = {joint.name: i for i, joint in enumerate(joints)}
    inputs, B = _inputs(tree, joints, coordinates, index, actuated, effort or {})
    check_underactuated(identifier(tree.name), len(joints), len(inputs))  # before long work
    _check_moved(joints, inputs, B)
    book = _Book()
    mass, potential = _energies(tree, coordinates, index, book)
    dissipation = sp.Integer(0)
    for joint, c in zip(joints, coordinates, strict=True):
        if joint.damping:
            unit = "N m s/rad" if joint.kind == "hinge" else "N s/m"
            damping = book.take(f"{c.name}_damping", joint.damping, unit, "viscous damping", True)
            dissipation += damping * c.velocity**2 / 2
    for coupling in tree.couplings:
        rate = sum(k * coordinates[index[j]].velocity for j, k in coupling.coefficients.items())
        dissipation += coupling.damping * rate**2 / 2
    force = lagrange_force(coordinates, mass, potential, dissipation)
    given = equilibrium or {}
    friction = [joint.friction for joint in joints]
    names_of_strokes, gains = (None, None) if actuated is not None else _strokes(tree)
    return from_matrices(
        identifier(tree.name),
        coordinates,
        inputs,
        mass,
        force,
        B,
        parameters=list(book.parameters.values()),
        potential=potential,
        actuated=names_of_strokes,
        gains=gains,
        equilibrium=dict(zip(_distinct(list(given)), given.values(), strict=True)),
        disturbance_bounds=friction if any(friction) else (),
        start=start,
        description=f"rigid-body tree '{tree.name}'" + _unlimited(inputs),
        source=source,
    )


def _check_moved(joints: Sequence[Joint], inputs: Sequence[Input], B: sp.Matrix) -> None:
    """Refuse a driven joint whose dry friction is more than its inputs can do."""
    gains = np.abs(np.array(B.tolist(), dtype=float))
    limits = np.array([channel.limit for channel in inputs])
    for joint, row in zip(joints, gains, strict=True):
        driving = row > 0
        most = float(row[driving] @ limits[driving]) if driving.any() else math.inf
        if joint.friction >= most:
            unit = "N m" if joint.kind == "hinge" else "N"
            raise ModelError(
                f"dry friction of joint '{joint.name}'",
                value=f"{joint.friction:g} {unit}",
                limit=f"less than its inputs can do, {most:g} {unit}",
                remedy="Nothing would move it: correct the friction or the limit of the input",
            )


def check_held(tree: Tree, actuated: Sequence[str]) -> None:
    """Refuse a tree that falls whatever its joints do: no pose of it is an equilibrium.

    The tree has the file's own actuators; joints that are driven besides are ``actuated``. Raises
    ModelError for a slide that nothing but contact could hold against gravity.
    """
    driven = {name for a in tree.actuators for name in a.coefficients} | set(actuated)
    driven |= {name for c in tree.couplings if c.stiffness for name in c.coefficients}
    turns: dict[str, FloatArray | None] = {WORLD: np.eye(3)}  # None behind a hinge
    for joint in tree.ordered():
        before = turns[joint.parent]
        turn = None if before is None else before @ np.asarray(joint.rotation)
        turns[joint.child] = None if joint.kind == "hinge" else turn
        if joint.kind != "slide" or joint.stiffness or joint.name in driven or turn is None:
            continue
        along = turn @ np.asarray(joint.axis, dtype=float) @ np.asarray(tree.gravity)
        if abs(along) > 1e-3 * np.linalg.norm(tree.gravity) * np.linalg.norm(joint.axis):
            raise ModelError(
                f"joint '{joint.name}' of '{tree.name}'",
                value="a slide along which the mechanism falls",
                limit="held by a motor or a spring: contacts are left out",
                remedy=f"What stands, walks or flies is not balanced here; freeze it, "
                f"FILE:-{joint.name}, or drive it, FILE:{joint.name}",
            )


def identifier(name: str) -> str:
    """Return the name as a Python identifier: what is no letter or digit becomes ``_``.

    >>> identifier("joint 1"), identifier("1")
    ('joint_1', 'n1')
    """
    text = re.sub(r"\W", "_", normal_name(name))
    return text if text.isidentifier() and not text.startswith("_") else f"n{text}"


def _distinct(names: Sequence[str]) -> list[str]:
    """Return names as identifiers; refuse those that differ in punctuation only."""
    made: dict[str, str] = {}
    for name in names:
        text = identifier(name)
        if text in made:
            raise _alike(f"{code_points(made[text])!r} and {code_points(name)!r} are {text!r}")
        made[text] = name
    return list(made)


def _alike(value: str) -> ModelError:
    return ModelError(
        "links or joints whose names differ in punctuation only",
        value=value,
        limit="names that stay different as identifiers",
        remedy="Rename one of them",
    )


class _Book:
    """Parameters as they are met."""

    def __init__(self) -> None:
        self.parameters: dict[str, Parameter] = {}

    def take(
        self, name: str, value: float, unit: str, description: str, positive: bool = False
    ) -> sp.Symbol:
        if name in self.parameters:
            raise _alike(f"both give the parameter {name!r}")
        low = -1e-12 if positive else -math.inf
        self.parameters[name] = Parameter(name, float(value), unit, description, low)
        return self.parameters[name].symbol


def _inputs(
    tree: Tree,
    joints: Sequence[Joint],
    coordinates: Sequence[Coordinate],
    index: Mapping[str, int],
    actuated: Sequence[str] | None,
    effort: Mapping[str, float],
) -> tuple[list[Input], sp.Matrix]:
    """Inputs with their limits, and the (n, m) matrix they act through."""
    if actuated is not None:
        wanted = [identifier(joint) for joint in actuated]
        B = unit_inputs(coordinates, wanted)
        for joint in effort:
            one_of(f"effort of '{tree.name}'", joint, actuated, "Limit joints that are actuated")
        chosen = {identifier(j.name): j for j in joints}
        pushes = {"hinge": ("torque", "N m"), "slide": ("force", "N")}
        made = []
        for given, name in zip(actuated, wanted, strict=True):
            push, unit = pushes[chosen[name].kind]
            made.append(Input(f"{name}_{push}", unit, effort.get(given, chosen[name].effort)))
        return made, B
    if effort:
        raise InvalidInputError(
            f"effort of '{tree.name}'",
            value=", ".join(map(str, effort)),
            limit="joints that are named as actuated; the file's motors have limits of their own",
            remedy="Name the joints, actuated=['...'], or take mechanism.with_input_limit(...)",
        )
    if not tree.actuators:
        raise ModelError(
            f"'{tree.name}' names no actuator",
            value=f"joints {', '.join(j.name for j in joints)}",
            limit="at least one actuated joint",
            remedy="Say which joints are actuated: actuated=['...'], or FILE:JOINT on the command "
            "line",
        )
    B = sp.zeros(len(joints), len(tree.actuators))
    driver: dict[tuple[str, ...], str] = {}
    for k, actuator in enumerate(tree.actuators):
        first = driver.setdefault(alone := tuple(actuator.coefficients), actuator.name)
        if len(alone) == 1 and first != actuator.name:
            raise ModelError(
                f"joint '{alone[0]}' of '{tree.name}'",
                value=f"two motors, {first} and {actuator.name}",
                limit="one: what two push together is one input",
                remedy=f"Merge them, or drive the joint instead: actuated=['{alone[0]}'], "
                f"FILE:{alone[0]} on the command line",
            )
        for joint, coefficient in actuator.coefficients.items():
            whose = f"joint of actuator '{actuator.name}' of '{tree.name}'"
            one_of(whose, joint, index, "Check the spelling, and that the joint moves")
            B[index[joint], k] += number(actuator.gain) * number(coefficient)
    taken = {c.name for c in coordinates} | {c.velocity.name for c in coordinates}
    taken |= {identifier(a.stroke) for a in tree.actuators if a.stroke}
    names = [identifier(a.name) for a in tree.actuators]
    # Motors are often named after their joints; inputs and coordinates are told apart.
    return [
        Input(f"{name}_motor" if name in taken else name, a.unit, a.limit)
        for name, a in zip(names, tree.actuators, strict=True)
    ], B


def _unlimited(inputs: Sequence[Input]) -> str:
    """Return words about the inputs that nothing limits."""
    names = [i.name for i in inputs if math.isinf(i.limit)]
    return f"; {', '.join(names)} without limit: the file gives none" if names else ""


def _strokes(tree: Tree) -> tuple[list[Coordinate | None], list[sp.Expr | None]]:
    """Names and gains of the strokes that are more than one joint."""
    kinds = {joint.name: joint.kind for joint in tree.moving}
    names: list[Coordinate | None] = []
    gains: list[sp.Expr | None] = []
    for actuator in tree.actuators:
        named = bool(actuator.stroke)
        sliding = all(kinds[joint] == "slide" for joint in actuator.coefficients)
        text = " + ".join(f"{c:g} {joint}" for joint, c in actuator.coefficients.items())
        stroke = Coordinate(identifier(actuator.stroke or "_"), "m" if sliding else "rad", text)
        names.append(stroke if named else None)
        gains.append(number(actuator.gain) if named else None)
    return names, gains


def _energies(
    tree: Tree, coordinates: Sequence[Coordinate], index: Mapping[str, int], book: _Book
) -> tuple[sp.Matrix, sp.Expr]:
    """Return M(q), (n, n), and V(q), J."""
    n = len(coordinates)
    links = {link.name: link for link in tree.links}
    strength = float(np.linalg.norm(tree.gravity))
    gravity = sp.zeros(3, 1)
    if strength > 0:
        gravity = book.take("gravity", strength, "m/s²", "gravity", True) * _matrix(
            np.asarray(tree.gravity) / strength
        )
    frames = {WORLD: _Frame(sp.zeros(3, n), sp.zeros(3, n), gravity, sp.Integer(0))}
    mass, potential, size = sp.zeros(n), sp.Integer(0), 0
    for joint in tree.ordered():
        frame = _outwards(frames[joint.parent], joint, coordinates, index)
        frames[joint.child] = frame
        i = index.get(joint.name)
        if i is not None:
            name, q = coordinates[i].name, coordinates[i].symbol
            turning = joint.kind == "hinge"
            if joint.armature:
                unit = "kg m²" if turning else "kg"
                mass[i, i] += book.take(f"{name}_armature", joint.armature, unit, "rotor", True)
            if joint.stiffness:
                unit = "N m/rad" if turning else "N/m"
                spring = book.take(f"{name}_stiffness", joint.stiffness, unit, "spring", True)
                potential += spring * (q - number(joint.rest)) ** 2 / 2
        body_mass, body_potential = _body(links[joint.child], frame, book)
        size += sum(int(sp.count_ops(body_mass[j, k])) for j in range(n) for k in range(j, n))
        if size > MOST_OPERATIONS:
            raise ModelError(
                f"mass matrix of '{tree.name}', {n} moving joints",
                value=f"more than {size} operations, '{joint.child}' included",
                limit=f"at most {MOST_OPERATIONS}: about six joints in a plane, or four with "
                "axes askew",
                remedy="Fix joints that do not matter, or give a planar mechanism's M, f and B",
            )
        mass += body_mass
        potential += body_potential
    for coupling in tree.couplings:
        row = sp.zeros(1, n)
        for name, coefficient in coupling.coefficients.items():
            row[index[name]] = number(coefficient)
        mass += coupling.armature * row.T * row
        if coupling.stiffness:
            stretch = sum(k * c.symbol for k, c in zip(row, coordinates, strict=True))
            potential += coupling.stiffness * (stretch - number(coupling.rest)) ** 2 / 2
    mass = sp.Matrix(n, n, lambda i, j: tidy(mass[min(i, j), max(i, j)]))
    return mass, tidy(potential)


@dataclass(frozen=True, eq=False)
class _Frame:
    """Of a link's frame, in its own axes: Jacobians, gravity; and −g · (its origin)."""

    J_v: sp.Matrix
    J_w: sp.Matrix
    gravity: sp.Matrix
    height: sp.Expr

    def step(self, r: sp.Matrix) -> tuple[sp.Matrix, sp.Expr]:
        """Return J_v and −g · p of the point at r in this frame."""
        velocity = (self.J_v - _cross(r) * self.J_w).applyfunc(tidy)
        return velocity, tidy(self.height - (self.gravity.T * r)[0, 0])

    def carried(
        self, r: sp.Matrix, turn: sp.Matrix, extra_v: sp.Matrix, extra_w: sp.Matrix
    ) -> _Frame:
        """Return the frame at r, turned, that moves by so much besides."""
        velocity, height = self.step(r)
        return _Frame(
            (turn.T * velocity).applyfunc(tidy) + extra_v,
            (turn.T * self.J_w).applyfunc(tidy) + extra_w,
            (turn.T * self.gravity).applyfunc(tidy),
            height,
        )


def _outwards(
    parent: _Frame, joint: Joint, coordinates: Sequence[Coordinate], index: Mapping[str, int]
) -> _Frame:
    """Carry the recursion over one joint."""
    turn, r = _matrix(joint.rotation), _matrix(joint.position)
    extra_v = extra_w = sp.zeros(3, len(coordinates))
    i = index.get(joint.name)
    if i is None:
        return parent.carried(r, turn, extra_v, extra_w)
    length = float(np.linalg.norm(joint.axis))
    if not length > 0:
        raise ModelError(
            f"axis of joint '{joint.name}'",
            value=joint.axis,
            limit="not zero",
            remedy="Give the direction of the hinge or slide",
        )
    axis = _matrix(np.asarray(joint.axis) / length)
    q = coordinates[i].symbol - number(joint.reference)
    anchor = _matrix(joint.anchor)
    pick = sp.zeros(1, len(coordinates))
    pick[i] = 1
    if joint.kind == "slide":
        there = (r + turn * axis * q).applyfunc(tidy)
        return parent.carried(there, turn, axis * pick, extra_w)
    turned = turn * rotation_about(axis, q)
    at_anchor = parent.carried(r + turn * anchor, turned, extra_v, axis * pick)
    if not any(joint.anchor):
        return at_anchor
    velocity, height = at_anchor.step(-anchor)
    return _Frame(velocity, at_anchor.J_w, at_anchor.gravity, height)


def _body(link: Link, frame: _Frame, book: _Book) -> tuple[sp.Matrix, sp.Expr]:
    """M and V that one link adds."""
    n = frame.J_w.cols
    name = identifier(link.name)
    mass, potential = sp.zeros(n), sp.Integer(0)
    if frame.J_v.is_zero_matrix and frame.J_w.is_zero_matrix:
        return mass, potential  # fixed to the world
    if link.mass > 0:
        m = book.take(f"{name}_mass", link.mass, "kg", f"mass of {link.name}", True)
        com = sp.Matrix(
            [
                book.take(f"{name}_com_{axis}", v, "m", f"centre of {link.name}") if v else 0
                for axis, v in zip("xyz", link.com, strict=True)
            ]
        )
        velocity, height = frame.step(com)
        mass += m * velocity.T * velocity
        potential += m * height
    if np.any(link.inertia):
        inertia = sp.zeros(3)
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
            value = float(link.inertia[i, j])
            if value:
                label = f"{name}_I_{'xyz'[i]}{'xyz'[j]}"
                symbol = book.take(label, value, "kg m²", f"inertia of {link.name}", i == j)
                inertia[i, j] = inertia[j, i] = symbol
        mass += frame.J_w.T * inertia * frame.J_w
    return mass, potential


def rotation_about(axis: sp.Matrix, q: sp.Expr) -> sp.Matrix:
    """Return the turn by q about a unit vector, Rodrigues' formula, exact for the frame's axes."""
    K = _cross(axis)
    s, c = sp.sin(q), sp.cos(q)
    along = axis * axis.T
    return (c * (sp.eye(3) - along) + s * K + along).applyfunc(tidy)


def _cross(v: Iterable[sp.Expr]) -> sp.Matrix:
    x, y, z = v
    return sp.Matrix([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def _matrix(values: object) -> sp.Matrix:
    array = np.asarray(values, dtype=float)
    if array.ndim == 1:
        array = array[:, None]
    return sp.Matrix(*array.shape, [number(v) for v in array.ravel()])
