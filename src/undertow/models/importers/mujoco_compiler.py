"""MJCF through MuJoCo's own compiler: the compiled numbers as a tree.

What the compiler makes of includes, default classes, frames, meshes and gears is taken as it is,
body by body; what the class of mechanisms has no place for is refused by its name.  A mechanism
read in any way is compared with the engine's accelerations at random states.
"""

from __future__ import annotations

import copy
import importlib
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np

from undertow.base import InvalidInputError, ModelError
from undertow.models.importers.mjcf_document import Document, free_body
from undertow.models.importers.rigid_body import identifier
from undertow.models.importers.tree import WORLD, Actuator, Coupling, Joint, Link, Tree, Vector
from undertow.models.importers.xml_files import (
    numbers_of,
    rotation_from_quaternion,
    without_rounding,
)
from undertow.models.mechanism import FloatArray, Mechanism

#: Largest difference of accelerations from the engine's, relative to the largest of a state.
AGREEMENT = 1e-8

#: States at which they are compared.
_STATES = 16

#: How many numbers attributes of a URDF have.
_LENGTHS = {"xyz": 3, "rpy": 3, "lower": 1, "upper": 1}

#: What the compiler's refusals of masses and moments of inertia have in them.
_INERTIA = re.compile(r"\binertia\b")

_ALIKE = "accelerations as its own to"
_EYE, _ORIGIN = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)


def engine() -> Any | None:
    """MuJoCo, or None where it is not installed."""
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        return None


@contextmanager
def _quiet(mujoco: Any) -> Iterator[None]:
    """Keep the compiler's warnings from the terminal, and from a log file in the user's folder."""
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda _: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)


def compiled(mujoco: Any, document: Document) -> Any:
    """Return MuJoCo's model of a document, with the moments of inertia that the document gives.

    The compiler refuses those that no body has, and files round theirs and have thin rods; what
    they are is for the tree to judge.

    Raises
    ------
    InvalidInputError
        In MuJoCo's own words, where its compiler refuses.
    ModelError
        Likewise, where the mechanics is the reason: an inertia, or a part that does not exist.
    """
    try:
        with _quiet(mujoco):
            try:
                return mujoco.MjModel.from_xml_string(document.text, document.files)
            except ValueError as error:
                if not _INERTIA.search(str(error)):
                    raise
                return _of_any_inertia(mujoco, document)
    except (ValueError, mujoco.FatalError) as error:
        said = " ".join(str(error).split())
        mechanics = _INERTIA.search(said) or "not found" in said
        refusal = ModelError if mechanics else InvalidInputError
        raise refusal(
            document.what,
            value=said.removeprefix("XML ").removeprefix("Error: "),
            limit="a model that MuJoCo's compiler takes",
            remedy="Correct the file there; MuJoCo's documentation says what each element takes",
        ) from error


def _of_any_inertia(mujoco: Any, document: Document) -> Any:
    """Compile with masses and moments of 1 in place of those that are given, and put these in."""
    spec = mujoco.MjSpec.from_string(document.text, assets=document.files)
    given = []
    whole = spec.compiler  # what it makes of all masses together
    if max(whole.settotalmass, whole.boundmass, whole.boundinertia) <= 0:
        for body in spec.bodies[1:]:
            if not body.explicitinertial and body.geoms:
                continue
            moments = np.array(body.inertia)
            if not np.isnan(body.fullinertia[0]):
                xx, yy, zz, xy, xz, yz = body.fullinertia
                moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
                axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])  # right-handed
                turn = np.zeros(4)
                mujoco.mju_mat2Quat(turn, axes.ravel())
                body.iquat, body.fullinertia[0] = turn, math.nan
            given.append((body, body.mass, moments))
            body.explicitinertial, body.mass, body.inertia = True, 1.0, np.ones(3)
    model = spec.compile()
    for body, mass, moments in given:
        model.body_mass[body.id], model.body_inertia[body.id] = mass, moments
    return model


def tree_of(mujoco: Any, model: Any, name: str, *, motors: bool = True) -> Tree:
    """Return a compiled model as a tree; ``motors=False`` leaves its actuators out.

    Raises ModelError for what is no tree of rigid bodies with motors in still air.
    """
    _check_world(mujoco, model)
    reader = _Compiled(mujoco, model)
    reader.bodies()
    couplings = {c.name: c for c in reader.tendons()}
    actuators = list(reader.actuators(couplings)) if motors else []
    made = [*couplings.values(), *reader.servos]
    x, y, z = (float(v) for v in reader.gravity)
    return Tree(
        name,
        tuple(reader.links),
        tuple(reader.joints),
        (x, y, z),
        tuple(c for c in made if c.damping or c.stiffness or c.armature),
        tuple(actuators),
    )


def _refused(what: str, remedy: str) -> ModelError:
    return ModelError(f"MJCF with {what}", limit="a tree of rigid bodies and motors", remedy=remedy)


def _check_world(mujoco: Any, model: Any) -> None:
    """Refuse what acts on bodies besides joints, springs, gravity and motors."""
    option = model.opt
    for what, given in (("density", option.density), ("viscosity", option.viscosity)):
        if given:
            raise _refused(f"option {what}", "Give drag as a disturbance of the plant")
    if np.any(option.wind):
        raise _refused("option wind", "Give drag as a disturbance of the plant")
    if np.any(model.body_gravcomp):
        raise _refused("gravcomp on a body", "Leave it out")
    if np.any(model.eq_active0):
        raise ModelError(
            "equality constraint of the MJCF",
            value="a closed loop or a coupled joint",
            limit="a tree of independent joints",
            remedy="Cut the loop, or eliminate it and give M, f and B",
        )
    if getattr(model, "nflex", 0) or getattr(model, "nplugin", 0):
        raise _refused("deformable bodies or plugins", "Write rigid bodies out")
    bits = mujoco.mjtDisableBit
    for what in ("SPRING", "DAMPER", "PASSIVE", "ACTUATION"):
        if option.disableflags & int(getattr(bits, f"mjDSBL_{what}", 0)):
            raise _refused(f"flag {what.lower()} disabled", "Take the elements themselves out")


class _Compiled:
    """Walks a compiled model once."""

    def __init__(self, mujoco: Any, model: Any) -> None:
        self.mujoco, self.model = mujoco, model
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        self.of_joint: dict[int, Joint] = {}
        self.servos: list[Coupling] = []

    @property
    def gravity(self) -> FloatArray:
        off = int(self.mujoco.mjtDisableBit.mjDSBL_GRAVITY)
        still = self.model.opt.disableflags & off
        return np.zeros(3) if still else np.array(self.model.opt.gravity)

    def name(self, kind: str, index: int) -> str:
        """What the file calls an element; nothing where it has no name."""
        kinds = self.mujoco.mjtObj
        return self.mujoco.mj_id2name(self.model, getattr(kinds, f"mjOBJ_{kind}"), index) or ""

    def bodies(self) -> None:
        """Read the bodies, each as a chain of its joints."""
        model = self.model
        names = {0: WORLD}
        for b in range(1, model.nbody):
            name = names[b] = self.name("BODY", b) or f"body_{len(self.links) + 1}"
            pose = _pose(model.body_quat[b], model.body_pos[b])
            carrier, first = names[int(model.body_parentid[b])], int(model.body_jntadr[b])
            count = int(model.body_jntnum[b])
            for k in range(count):
                child = name
                if k + 1 < count:
                    child = f"{name}_frame_{k + 1}"
                    self.links.append(Link(child))
                joint = self._joint(first + k, carrier, child, *pose)
                self.of_joint[first + k] = joint
                self.joints.append(joint)
                carrier, pose = child, _pose(_EYE, _ORIGIN)
            if not count:
                self.joints.append(Joint(f"{name}_fixed", "fixed", carrier, name, *pose))
            turn = rotation_from_quaternion(model.body_iquat[b].tolist())
            tensor = without_rounding(turn @ np.diag(model.body_inertia[b]) @ turn.T)
            com = _vector(without_rounding(model.body_ipos[b]).tolist())
            self.links.append(Link(name, float(model.body_mass[b]), com, (tensor + tensor.T) / 2))

    def _joint(
        self, j: int, parent: str, child: str, rotation: FloatArray, position: Vector
    ) -> Joint:
        model, kinds = self.model, self.mujoco.mjtJoint
        place, dof = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        of = {int(kinds.mjJNT_HINGE): "hinge", int(kinds.mjJNT_SLIDE): "slide"}
        kind: Literal["hinge", "slide"] | None = of.get(int(model.jnt_type[j]))  # type: ignore[assignment]
        if kind is None:
            free = int(model.jnt_type[j]) == int(kinds.mjJNT_FREE)
            raise free_body(self.name("JOINT", j) or f"of '{child}'", "free" if free else "ball")
        for what in ("dof_dampingpoly", "jnt_stiffnesspoly"):
            if np.any(getattr(model, what, 0)):
                raise _refused(f"a {what[4:-4]} of '{child}' that is not linear", "Leave it out")
        name = self.name("JOINT", j) or f"{child}_{kind}"
        if np.any(getattr(model, "jnt_springyield", np.zeros(j + 1))[j]):
            raise _refused(f"a spring of joint '{name}' that yields", "Leave springyield out")
        low, high = -math.inf, math.inf
        if model.jnt_limited[j]:
            low, high = (float(v) for v in model.jnt_range[j])
        effort = math.inf
        if model.jnt_actfrclimited[j]:
            effort = _one_size(f"actuatorfrcrange of joint '{name}'", model.jnt_actfrcrange[j])
        return Joint(
            name,
            kind,
            parent,
            child,
            rotation,
            position,
            axis=_vector(model.jnt_axis[j]),
            anchor=_vector(model.jnt_pos[j]),
            damping=float(model.dof_damping[dof]),
            stiffness=float(model.jnt_stiffness[j]),
            rest=float(model.qpos_spring[place]),
            armature=float(model.dof_armature[dof]),
            friction=float(model.dof_frictionloss[dof]),
            low=low,
            high=high,
            effort=effort,
            reference=float(model.qpos0[place]),
        )

    def tendons(self) -> Iterator[Coupling]:
        """Read fixed tendons: joints in disguise, or linear couplings of several."""
        model, wraps = self.model, self.mujoco.mjtWrap
        for t in range(model.ntendon):
            name = self.name("TENDON", t) or f"tendon_{t + 1}"
            parts = range(model.tendon_adr[t], model.tendon_adr[t] + model.tendon_num[t])
            if any(int(model.wrap_type[w]) != int(wraps.mjWRAP_JOINT) for w in parts):
                raise _refused(f"<spatial> tendon '{name}'", "Only fixed tendons are linear in q")
            if model.tendon_frictionloss[t] or model.tendon_limited[t]:
                raise _refused(f"friction or limits on tendon '{name}'", "Put them on joints")
            if np.any(getattr(model, "tendon_springyield", np.zeros(t + 1))[t]):
                raise _refused(f"a spring of tendon '{name}' that yields", "Leave springyield out")
            low, high = model.tendon_lengthspring[t]
            if model.tendon_stiffness[t] and low != high:
                raise _refused(f"a slack spring on tendon '{name}'", "Give one springlength")
            coefficients: dict[str, float] = {}
            for w in parts:
                joint = self.of_joint[int(model.wrap_objid[w])].name
                coefficients[joint] = coefficients.get(joint, 0.0) + float(model.wrap_prm[w])
            yield Coupling(
                name,
                coefficients,
                damping=float(model.tendon_damping[t]),
                stiffness=float(model.tendon_stiffness[t]),
                rest=float(low),
                armature=float(getattr(model, "tendon_armature", np.zeros(t + 1))[t]),
            )

    def actuators(self, couplings: dict[str, Coupling]) -> Iterator[Actuator]:
        """Read motors and servos on joints and fixed tendons."""
        model, mujoco = self.model, self.mujoco
        tendons = list(couplings.values())
        joint_like = {int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT)}
        for k in range(model.nu):
            name = self.name("ACTUATOR", k) or f"u_{k + 1}"
            what, on = f"actuator '{name}'", int(model.actuator_trnid[k, 0])
            if model.opt.disableactuator >> int(model.actuator_group[k]) & 1:
                raise _refused(f"{what} of a group that is switched off", "Take it out, or its "
                               "group out of actuatorgroupdisable")  # fmt: skip
            stateless = int(model.actuator_dyntype[k]) == int(mujoco.mjtDyn.mjDYN_NONE)
            if not stateless:
                raise _refused(f"{what} that has states of its own", "Use <motor>, or name the "
                               "actuated joints: actuated=['...']")  # fmt: skip
            if np.any(getattr(model, "actuator_delay", np.zeros(k + 1))[k]):
                raise _refused(f"{what} that acts late", "Take delay= out: delays are the rig's, "
                               "undertow.plants.Timing(input_delay=...)")  # fmt: skip
            linear = int(model.actuator_gaintype[k]) == int(mujoco.mjtGain.mjGAIN_FIXED)
            biases = {int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)}
            if not linear or int(model.actuator_biastype[k]) not in biases:
                raise _refused(f"{what} whose force is not linear", "Use <motor>, or name the "
                               "actuated joints: actuated=['...']")  # fmt: skip
            gear = float(model.actuator_gear[k, 0])
            gain = float(model.actuator_gainprm[k, 0])
            pull = math.inf  # of the tendon, along it
            if int(model.actuator_trntype[k]) in joint_like:
                joint = self.of_joint[on]
                coefficients, stroke, effort = {joint.name: 1.0}, "", joint.effort
                unit = "N m" if joint.kind == "hinge" else "N"
            elif int(model.actuator_trntype[k]) == int(mujoco.mjtTrn.mjTRN_TENDON):
                coefficients, stroke = dict(tendons[on].coefficients), tendons[on].name
                unit, effort = "", math.inf
                if np.any(getattr(model, "tendon_actfrclimited", np.zeros(on + 1))[on]):
                    label = f"actuatorfrcrange of tendon '{tendons[on].name}'"
                    pull = _one_size(label, model.tendon_actfrcrange[on]) / abs(gear or 1.0)
                if len(coefficients) == 1:  # a joint in disguise
                    ((alone, factor),) = coefficients.items()
                    (joint,) = (j for j in self.joints if j.name == alone)
                    coefficients, stroke, effort = {alone: 1.0}, "", joint.effort
                    gear, unit = gear * factor, "N m" if joint.kind == "hinge" else "N"
            else:
                raise _refused(f"{what} on neither joint nor fixed tendon", "Give joint= or "
                               "tendon=")  # fmt: skip
            if gear * gain == 0:
                raise ModelError(
                    f"gear of {what}",
                    value=f"{gear:g}, gain {gain:g}",
                    limit="numbers that are not zero",
                    remedy="A motor that moves nothing is no input: leave it out",
                )
            limits = [effort / abs(gear * gain), pull / abs(gain)]
            left_out = []
            for label, limited, (low, high), size in (
                ("ctrlrange", model.actuator_ctrllimited[k], model.actuator_ctrlrange[k], 1.0),
                ("forcerange", model.actuator_forcelimited[k], model.actuator_forcerange[k], gain),
            ):
                if limited:
                    smaller = _one_size(f"{label} of {what}", (low, high))
                    limits.append(smaller / abs(size))
                    if -low != high:
                        left_out.append(
                            f"{label} {low:g} to {high:g} of {name} beyond ±{smaller:g}"
                        )
            servo = self._servo(k, name, coefficients, gear)
            limited = model.actuator_forcelimited[k] or math.isfinite(min(effort, pull))
            if limited and (servo.stiffness or servo.damping):
                left_out.append(f"the force limit of {name} on its own spring and damper")
            force = gear * gain
            yield Actuator(
                name, coefficients, force, min(limits), unit if force == 1 else "", stroke,
                tuple(left_out),
            )  # fmt: skip

    def _servo(self, k: int, name: str, coefficients: dict[str, float], gear: float) -> Coupling:
        """What an actuator does without input: the spring and damper of a servo, a rotor."""
        model = self.model
        offset, spring, damper = (float(v) for v in model.actuator_biasprm[k, :3])
        if int(model.actuator_biastype[k]) == int(self.mujoco.mjtBias.mjBIAS_NONE):
            offset = spring = damper = 0.0
        own = [getattr(model, f"actuator_{what}", None) for what in ("damping", "armature")]
        damping, armature = (0.0 if v is None else float(np.ravel(v)[k]) for v in own)
        if offset and not spring:
            raise _refused(f"actuator '{name}' that pushes without input", "Leave its bias out")
        if np.any(getattr(model, "actuator_dampingpoly", 0)):
            raise _refused(f"a damping of actuator '{name}' that is not linear", "Leave it out")
        servo = Coupling(
            f"{name}_servo",
            coefficients,
            damping=(damping - damper) * gear**2,
            stiffness=-spring * gear**2,
            rest=-offset / (spring * gear) if spring else 0.0,
            armature=armature * gear**2,
        )
        self.servos.append(servo)
        return servo


def _one_size(what: str, given: Sequence[float]) -> float:
    """The size of a range that has both signs."""
    low, high = (float(v) for v in given)
    if not low < 0 < high:
        raise ModelError(
            what,
            value=f"{low:g} to {high:g}",
            limit="a range with zero inside: it pushes one way only",
            remedy="A propeller or a rope is no motor in the sense of this library; name others: "
            "actuated=['...']",
        )
    return min(-low, high)


def _vector(values: Sequence[float]) -> Vector:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _pose(quaternion: Sequence[float], position: Sequence[float]) -> tuple[FloatArray, Vector]:
    turn = rotation_from_quaternion([float(v) for v in quaternion])
    return without_rounding(turn), _vector(position)


# -- comparison ----------------------------------------------------------------------------------


def urdf_compiled(mujoco: Any, robot: ET.Element, gravity: Vector) -> Any | None:
    """MuJoCo's own reading of a URDF without its shapes; None where it has none."""
    bare = ET.fromstring(ET.tostring(robot))
    for link in bare.iterfind("link"):
        for shape in ("visual", "collision"):
            for element in link.findall(shape):
                link.remove(element)
    for element in list(bare):
        if element.tag not in ("link", "joint"):
            bare.remove(element)
    for element in bare.iter("inertia"):
        for product in ("ixy", "ixz", "iyz"):
            element.attrib.setdefault(product, "0")
    for element in bare.iter():  # as they were read, commas and all
        for attribute, count in _LENGTHS.items():
            if attribute in element.attrib:
                values = numbers_of(element, attribute, None, count)
                element.set(attribute, " ".join(map(repr, values)))
    try:
        with _quiet(mujoco):
            model = mujoco.MjModel.from_xml_string(ET.tostring(bare, encoding="unicode"))
    except (ValueError, mujoco.FatalError):
        return None
    model.opt.gravity[:] = gravity
    return model


def compared(
    mechanism: Mechanism, tree: Tree, model: Any, q_target: Mapping[str, float], *, driven: bool
) -> str:
    """Say in words how a mechanism's accelerations at random states are those of MuJoCo.

    ``mechanism``: as it was read, with the inputs of ``tree`` or with joints named as actuated.
    ``tree``: its bodies and joints. ``model``: the engine's compiled model of the same file; dry
    friction, ranges of joints and contacts are switched off in a copy. ``q_target``: the target in
    the mechanism's coordinates as they are before it is made zero. ``driven``: whether the
    mechanism's inputs are the tree's actuators; else MuJoCo's are switched off. Raises ModelError
    where the largest relative difference is beyond :data:`AGREEMENT`.
    """
    mujoco = engine()
    assert mujoco is not None  # it compiled the model
    kinds = mujoco.mjtObj
    own = [joint.name for joint in tree.moving]
    read = [joint.name for joint in tree.joints if joint.kind != "fixed"]  # as MuJoCo has them
    named = (mujoco.mj_id2name(model, kinds.mjOBJ_JOINT, j) for j in range(model.njnt))
    order = [own.index(name or read[j]) for j, name in enumerate(named)]
    n, m, bits = mechanism.n, mechanism.m, mujoco.mjtDisableBit
    model = copy.copy(model)
    off = ["CONTACT", "LIMIT", "FRICTIONLOSS", "CLAMPCTRL", *["ACTUATION"] * (not driven)]
    for what in off:
        model.opt.disableflags |= int(getattr(bits, f"mjDSBL_{what}"))
    model.actuator_forcelimited[:] = 0
    model.jnt_actfrclimited[:] = 0
    getattr(model, "tendon_actfrclimited", model.jnt_actfrclimited)[:] = 0
    data = mujoco.MjData(model)
    rows = _rows(mechanism, tree, own, driven)
    target = np.array([q_target.get(c.name, 0.0) for c in mechanism.coordinates])
    scale = np.where(np.isfinite(mechanism.input_limits), mechanism.input_limits, 1.0)
    rng, worst = np.random.default_rng(0), 0.0
    for _ in range(_STATES):
        q, v = rng.uniform(-2, 2, (2, n))
        u = rng.uniform(-1, 1, m) * scale * driven
        data.qpos[:], data.qvel[:] = q[order], v[order]
        if driven:
            data.ctrl[:] = u
        with _quiet(mujoco):
            mujoco.mj_forward(model, data)
        theirs = np.zeros(n)
        theirs[order] = data.qacc
        theirs = rows @ theirs
        ours = mechanism.accelerations(0.0, np.concatenate([rows @ q - target, rows @ v]), u)
        largest = max(float(np.abs(theirs).max()), 1e-9)
        worst = max(worst, float(np.abs(ours - theirs).max()) / largest)
    if not worst <= AGREEMENT:
        raise ModelError(
            f"accelerations of '{mechanism.name}'",
            value=f"{worst:.2g} from MuJoCo's, relative, at the worst of {_STATES} random states",
            limit=f"at most {AGREEMENT:g}",
            remedy="Something in the file moves the bodies and is not read here: take out what "
            "is no joint, body or motor",
        )
    return f"MuJoCo {mujoco.__version__}, {_ALIKE} {worst:.1g}"


def agreement(mechanism: Mechanism) -> str:
    """To what the accelerations of a mechanism from a file are MuJoCo's; nothing where unknown."""
    said = mechanism.description.partition(_ALIKE)[2]
    return said.partition("\n")[0].strip()


def _rows(mechanism: Mechanism, tree: Tree, joints: Sequence[str], driven: bool) -> FloatArray:
    """The mechanism's coordinates as combinations of joints, (n, n)."""
    places = {identifier(name): j for j, name in enumerate(joints)}
    strokes = [a.coefficients for a in tree.actuators] if driven else []
    rows = np.zeros((mechanism.n, len(joints)))
    for k, coordinate in enumerate(mechanism.coordinates):
        if k < len(strokes):
            for joint, factor in strokes[k].items():
                rows[k, joints.index(joint)] = factor
        else:
            rows[k, places[coordinate.name]] = 1.0
    return rows
