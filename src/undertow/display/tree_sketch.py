"""Stick figures of one's own mechanisms, made from the kinematics of their URDF or MJCF files.

Every link is drawn from its joint to the joints that it carries; a link that carries none reaches
as far past its centre of mass as that is from the joint.  What turns about its own centre of mass
is a wheel; what slides is a box on a rail.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import sympy as sp

from undertow.display.sketches import Box, Disc, Line, Point, Sketch, View, sketch
from undertow.mechanisms.named import origin, tree_named
from undertow.models import FloatArray, Mechanism
from undertow.models.importers import Joint, Link, Tree
from undertow.models.importers.rigid_body import identifier, rotation_about
from undertow.models.importers.tree import WORLD

#: Shorter than this part of the whole, a way between two points is none.
SHORT = 1e-3


def sketch_named(name: str, mechanism: Mechanism) -> Sketch:
    """Return the figure of a mechanism that was asked for by name.

    The library's own; for a file of bodies one from its kinematics; labelled dials where neither
    can be had. Names are those of :func:`undertow.mechanisms.named.named`.
    """
    tree = tree_named(name)
    found = None if tree is None else tree_sketch(tree, mechanism, origin(name))
    return sketch(mechanism) if found is None else found


def tree_sketch(tree: Tree, mechanism: Mechanism, at: Mapping[str, float]) -> Sketch | None:
    """Return a stick figure of a tree of bodies; ``None`` where coordinates are no joints.

    ``at``: where the target is, in the joints' own positions, by coordinate. Inputs that act on
    several joints at once change the coordinates to sums of joints.
    """
    symbols = {c.name: c.symbol + at.get(c.name, 0.0) for c in mechanism.coordinates}
    names = {joint.name: identifier(joint.name) for joint in tree.moving}
    if {*names.values()} != {*symbols}:
        return None
    angles = {joint: symbols[name] for joint, name in names.items()}
    poses = _poses(tree, angles)
    turned, view = _turned(tree, poses)
    hanging: dict[str, list[Joint]] = {}
    for joint in tree.joints:
        hanging.setdefault(joint.parent, []).append(joint)
    links = {link.name: link for link in tree.links}
    size = _size(tree, poses, links)
    parts: list[Line | Disc | Box] = []
    tip: Point = (0, 0, 0)
    for joint in tree.ordered():
        rotation, origin = poses[joint.child]

        def place(at: object, rotation: sp.Matrix = rotation, origin: sp.Matrix = origin) -> Point:
            return _point(turned * (origin + rotation * _vector(at)))

        link, start = links[joint.child], np.asarray(joint.anchor, dtype=float)
        ends = [np.asarray(j.position) + j.rotation @ np.asarray(j.anchor) for j in
                hanging.get(joint.child, [])]  # fmt: skip
        com = np.asarray(link.com, dtype=float)
        if not ends and link.mass > 0:
            ends = [start + 2 * (com - start)]
        ends = [end for end in ends if np.linalg.norm(end - start) > SHORT * size]
        axis = np.asarray(joint.axis, dtype=float) / np.linalg.norm(joint.axis)
        if joint.kind == "slide":
            box = 0.08 * size
            parts += [_rail(tree, joint, poses[joint.parent], turned, size)]
            parts += [Box(place(start), box, 0.5 * box)]
        parts += [Line((place(start), place(end))) for end in ends]
        if joint.kind == "hinge" and not ends and link.mass > 0:
            radius = math.sqrt(2 * max(float(axis @ link.inertia @ axis), 0.0) / link.mass)
            radius = min(max(radius, 0.02 * size), 0.5 * size)
            spin = sum((angles[j.name] for j in _path(tree, joint) if j.kind == "hinge"), sp.S(0))
            parts += [Disc(place(start), radius, spin)]
        tip = place(ends[-1] if ends else start)
    return Sketch(tuple(parts), tip, view)


def _vector(at: object) -> sp.Matrix:
    return sp.Matrix([float(v) for v in np.asarray(at, dtype=float)])


def _point(place: sp.Matrix) -> Point:
    return place[0], place[1], place[2]


def _poses(tree: Tree, angles: dict[str, sp.Expr]) -> dict[str, tuple[sp.Matrix, sp.Matrix]]:
    """Return rotation, (3, 3), and origin, (3,), of each link in the fixed frame."""
    poses = {WORLD: (sp.eye(3), sp.zeros(3, 1))}
    for joint in tree.ordered():
        rotation, origin = poses[joint.parent]
        here, turn = (
            origin + rotation * _vector(joint.position),
            rotation * sp.Matrix(np.asarray(joint.rotation, dtype=float).round(12)),
        )
        if joint.name in angles:
            q = angles[joint.name] - joint.reference
            axis = _vector(np.asarray(joint.axis) / np.linalg.norm(joint.axis))
            if joint.kind == "slide":
                here = here + turn * axis * q
            else:
                anchor = _vector(joint.anchor)
                about = here + turn * anchor
                turn = turn * rotation_about(axis, q)
                here = about - turn * anchor
        poses[joint.child] = turn, here
    return poses


def _turned(tree: Tree, poses: dict[str, tuple[sp.Matrix, sp.Matrix]]) -> tuple[sp.Matrix, View]:
    """Return how to turn the world, (3, 3), and from where to look, so that most of it is seen.

    What turns about one direction only is seen along that; else, obliquely.
    """
    at_rest = {s: 0 for rotation, origin in poses.values()
               for s in rotation.free_symbols | origin.free_symbols}  # fmt: skip
    axes = []
    for joint in tree.moving:
        rotation = np.array(poses[joint.parent][0].subs(at_rest), dtype=float) @ joint.rotation
        axes.append((joint.kind, rotation @ np.asarray(joint.axis) / np.linalg.norm(joint.axis)))
    hinges = [np.abs(axis) for kind, axis in axes if kind == "hinge"]
    if hinges and all(axis @ hinges[0] > 0.99 for axis in hinges):
        along = int(np.argmax(hinges[0]))
        if hinges[0][along] > 0.99:
            if along == 0:  # seen along x: y to the right
                return sp.Matrix([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]), "front"
            return sp.eye(3), ("front" if along == 1 else "top")
    return sp.eye(3), "oblique"


def _size(
    tree: Tree, poses: dict[str, tuple[sp.Matrix, sp.Matrix]], links: dict[str, Link]
) -> float:
    """Return how large the mechanism is at rest, m."""
    at = [np.zeros(3)]
    for joint in tree.ordered():
        rotation, origin = poses[joint.child]
        zero = dict.fromkeys(rotation.free_symbols | origin.free_symbols, 0)
        R = np.array(rotation.subs(zero), dtype=float)
        o = np.array(origin.subs(zero), dtype=float).ravel()
        at += [o, o + 2 * R @ np.asarray(links[joint.child].com, dtype=float)]
    cloud: FloatArray = np.array(at)
    return max(float(np.ptp(cloud, axis=0).max()), 0.1)


def _rail(
    tree: Tree, joint: Joint, parent: tuple[sp.Matrix, sp.Matrix], turned: sp.Matrix, size: float
) -> Line:
    """Return the rail on which a joint slides, as far as it may."""
    rotation, origin = parent
    turn = rotation * sp.Matrix(np.asarray(joint.rotation, dtype=float).round(12))
    at = origin + rotation * _vector(joint.position)
    axis = turn * _vector(np.asarray(joint.axis) / np.linalg.norm(joint.axis))
    low = joint.low - joint.reference if math.isfinite(joint.low) else -2 * size
    high = joint.high - joint.reference if math.isfinite(joint.high) else 2 * size
    ends = (_point(turned * (at + axis * end)) for end in (low, high))
    return Line(tuple(ends), "frame")


def _path(tree: Tree, joint: Joint) -> list[Joint]:
    """Return the joints from the fixed frame to one of them."""
    over = {j.child: j for j in tree.joints}
    path = [joint]
    while path[0].parent in over:
        path.insert(0, over[path[0].parent])
    return [j for j in path if j.kind != "fixed"]
