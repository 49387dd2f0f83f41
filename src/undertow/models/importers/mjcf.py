"""Mechanisms from MJCF, MuJoCo's XML: bodies, joints, tendons as couplings, motors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from undertow.base import checked, require_extra
from undertow.models.importers.equilibrium import at_equilibrium
from undertow.models.importers.mjcf_document import Document, mjcf_document
from undertow.models.importers.mujoco_compiler import compared, compiled, tree_of
from undertow.models.importers.reading import described, names_of
from undertow.models.importers.rigid_body import check_held, mechanism_from_tree
from undertow.models.importers.tree import Tree
from undertow.models.importers.xml_files import computable, is_text
from undertow.models.mechanism import Mechanism


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

    MuJoCo's own compiler reads the file (it comes with ``undertow[mujoco]``): includes, default
    classes, frames, meshes, servos (their springs and dampers become the mechanism's) and gears as
    it has them.  ``frictionloss`` becomes a bound on the disturbance; contacts are left out.  The
    mechanism's accelerations are compared with MuJoCo's at random states.  Its description says
    what was read, and which inputs the file gives no limit for.

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
        For malformed XML, unknown or repeated actuated joints, and in MuJoCo's own words for what
        its compiler refuses.
    MissingExtraError
        Where MuJoCo is not installed.
    ModelError
        For ball and free joints, equality constraints, massless moving bodies, inertias that no
        body has, elements that change the motion in ways that are not read here, more joints
        than equations can be derived for, and accelerations that are not MuJoCo's.
    """
    with computable("MJCF"):
        document = mjcf_document(source, names_of(frozen, "frozen"))
        tree, model = _read(document, motors=actuated is None)
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
        how = compared(mechanism, tree, model, place or {}, driven=actuated is None)
        mechanism = described(mechanism, tree, f"MJCF '{tree.name}' by {how}", document.frozen)
        if isinstance(equilibrium, str):
            return at_equilibrium(mechanism, equilibrium)
        return mechanism


@checked
def read_mjcf(source: str | Path, *, motors: bool = True) -> Tree:
    """Read an MJCF file as a tree; ``motors=False`` leaves its actuators out.

    Raises
    ------
    ArtefactError, InvalidInputError, MissingExtraError, ModelError
        As for :func:`from_mjcf`.
    """
    return _read(mjcf_document(source), motors=motors)[0]


@np.errstate(all="ignore")  # what overflows is refused with the tree
def _read(document: Document, *, motors: bool) -> tuple[Tree, Any]:
    """Return the tree, and MuJoCo's compiled model."""
    need = "MJCF is read by MuJoCo's own compiler, which is not installed"
    mujoco = require_extra("mujoco", "mujoco", need)
    model = compiled(mujoco, document)
    name = document.root.get("model", "mujoco")
    return tree_of(mujoco, model, name, motors=motors), model
