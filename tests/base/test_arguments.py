"""Every argument of every public callable, wrong in turn: refused by a condition of ours, or used.

What is public is asked of ``undertow.__all__`` and of the modules in it: a new name, and a new
argument of an old one, are tried without a line here, as long as their required arguments are
called what others are called.
"""

from __future__ import annotations

import dataclasses
import enum
import inspect
import math
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy as sp
from sympy.physics import mechanics

import undertow as ut
from undertow.base import InvalidInputError, ModelError, UndertowError, checked
from undertow.estimators import KalmanFilter

#: What is given instead of each argument.
WRONG: tuple[Any, ...] = (None, "a", math.nan, math.inf, -1, [], [[]], {}, object(), True)

#: What is short in the tests where the default is not.
SHORT = {
    "duration", "horizon", "samples", "compiled", "seconds", "simulated",
    "intervals",
}  # fmt: skip

#: What the library makes and hands out: nobody calls their constructors.
MADE = {"MechanismReport", "Policy", "Proposal", "Run", "Trajectory"}

#: Not meant for arguments of users: a number's own methods, ``math.radians``, tape and symbols.
NOT_OURS = {
    "deg", "Mechanism.partition", "ClosedLoop.roll_out", "Cascade.gate",
    "Cascade.start_to", "MinimumEnergy.stage", "MinimumTime.stage",
}  # fmt: skip

URDF = """<robot name="r"><link name="base"/><link name="cart"><inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="pole">
<inertial><origin xyz="0 0 0.5"/><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
iyz="0"/></inertial></link><joint name="x" type="prismatic"><parent link="base"/><child
link="cart"/><axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="9" velocity="9"/></joint>
<joint name="phi" type="continuous"><parent link="cart"/><child link="pole"/><axis xyz="0 1 0"/>
</joint></robot>"""
MJCF = """<mujoco><worldbody><body name="cart"><joint name="x" type="slide" axis="1 0 0"/><geom
type="sphere" size="0.1" mass="1"/><body name="pole"><joint name="phi" type="hinge" axis="0 1 0"/>
<geom type="sphere" size="0.1" pos="0 0 0.5" mass="1"/></body></body></worldbody><actuator><motor
joint="x" ctrllimited="true" ctrlrange="-9 9"/></actuator></mujoco>"""


@cache
def parts() -> dict[str, Any]:
    """A mechanism, and what belongs to it, by the names that arguments have."""
    rig = ut.mechanisms.rotary_pendulum()
    problem = ut.MinimumTime(horizon=0.05)
    loop = ut.ClosedLoop(rig, problem)
    surface, budget = ut.first_surface(rig), ut.Budget(64)
    cascade = ut.Cascade(rig, problem, cold=budget, warm=budget, belief="exact")
    x = rig.state(phi=0.001)
    state, proposal = cascade.start(x)
    belief = ut.Belief.relative(rig, m=0.2)
    run = cascade.simulate(x)
    coordinates = (ut.Coordinate("a"), ut.Coordinate("b"))
    a, b = (c.velocity for c in coordinates)
    link, world = ut.modelling.Link("arm", 1.0), ut.modelling.Link("world")
    joint = ut.modelling.Joint("a", "hinge", "world", "arm")
    tree = ut.modelling.read_urdf(URDF)[0]
    motor = ut.modelling.DCMotor(1.0, 1.0)
    reference = ut.Reference.sine(1.0, theta=0.1)
    return {
        "Belief": belief, "Budget": budget, "Cascade": cascade, "ClosedLoop": loop,
        "Mechanism": rig,
        "Constraint": ut.Constraint("c", lambda v: v.phi - 1), "Coordinate": coordinates[0],
        "DecisionVariables": ut.DecisionVariables(), "Input": ut.Input("u", "V"),
        "MinimumEnergy": ut.MinimumEnergy(),
        "MinimumTime": problem, "Objective": ut.Objective("o", lambda v: 1),
        "Optimiser": ut.Optimiser(loop, cold=budget, warm=budget), "Plan": ut.Plan((surface,)),
        "Parameter": ut.Parameter("p", 1.0, "m"), "Policy": ut.policy(loop, surface),
        "Proposal": proposal,
        "ReachingLaw": ut.ReachingLaw(), "Run": run, "Surface": surface,
        "SlidingModeLaw": ut.SlidingModeLaw(rig, surface), "Trajectory": run.trajectory,
        "MechanismReport": ut.check_mechanism(rig, samples=1, compiled=False),
        "SetPoints": ut.SetPoints({"theta": 0.1}), "Reference": reference,
        "points": {"theta": 0.1}, "paths": dict(reference.paths), "names": ["theta"],
        "target": {"theta": 0.1}, "motion": reference.legs(rig, 0.05)[0][1], "frequency": 1.0,
        "times": [0.0, 1.0],
        "Tree": tree, "Link": link, "Joint": joint, "DCMotor": motor,
        "Actuator": ut.modelling.Actuator("u", {"a": 1.0}),
        "Coupling": ut.modelling.Coupling("c", {"a": 1.0}),
        "ActuatedForm": ut.modelling.actuate(
            coordinates, sp.Matrix([[2, 1], [1, 3]]), sp.Matrix([0, 0]), sp.Matrix([1, 0])
        ),
        # arguments
        "mechanism": rig, "surface": surface, "surfaces": surface, "loop": loop, "state": state,
        "proposal": proposal, "x": x, "x0": x, "horizon": 0.05, "t": 0.0, "u": [0.0],
        "qdd": [0.0, 0.0], "q": [0.0, 0.0], "name": "name", "which": "force", "evaluations": 64,
        "formula": lambda v: v.phi - 1, "stage": lambda v: v.voltage**2, "unit": "rad",
        "coordinates": coordinates, "inputs": (ut.Input("u", "V"),), "force": sp.Matrix([0, 0]),
        "mass_matrix": sp.Matrix([[2, 1], [1, 3]]), "input_matrix": sp.Matrix([1, 0]),
        "kinetic": a**2 + b**2 + a * b, "potential": sp.Integer(0), "value": 1.0,
        "plans": [ut.Plan((surface,))], "other": ut.Plan((surface,)),
        "otherwise": ut.ReachingLaw(), "what": surface,
        "m": 1, "n": 2, "period": 0.01, "vector": surface.vector, "alpha_a": -1, "lambda_a": -1,
        "alpha_u": 1, "lambda_u": 1, "pieces": [run.trajectory], "poles": [-1.0, -2.0, -3.0],
        "duration": 0.05, "samples": 1, "compiled": False,
        "links": (world, link), "joints": (joint,), "kind": "hinge", "parent": "world",
        "child": "arm", "coefficients": {"a": 1.0}, "torque_constant": 1.0, "resistance": 1.0,
        "tree": tree, "motors": motor, "text": "rotary_pendulum.py:NAME",
        "objective": problem, "cascade": cascade, "controllers": [ut.lqr(rig)],
        "controller": cascade, "observation": x, "y": surface.sliding_coordinates(x),
        "folder": "firmware",
        "tolerances": {"m": 0.01}, "estimate": belief.prior, "offsets": [0.0],
        "values": rig.parameter_values, "path": "run.db",
        "seconds": 0.01, "simulated": True, "intervals": 8, "error": x, "until": 0.01,
        "estimator": KalmanFilter(rig, period=0.001, position_noise=1e-3),
    }  # fmt: skip


@cache
def lagrange() -> tuple[Any, dict[Any, ut.Input]]:
    """Lagrange's method of two coupled masses, and the input."""
    a, b = mechanics.dynamicsymbols("a b", real=True)
    force = sp.Symbol("F", real=True)
    L = a.diff() ** 2 + b.diff() ** 2 + a.diff() * b.diff() - b**2
    frame = mechanics.ReferenceFrame("N")
    point = mechanics.Point("P")
    point.set_vel(frame, a.diff() * frame.x)
    method = mechanics.LagrangesMethod(L, [a, b], forcelist=[(point, force * frame.x)], frame=frame)
    method.form_lagranges_equations()
    return method, {force: ut.Input("F", "N")}


@cache
def kane() -> tuple[Any, dict[Any, ut.Input]]:
    """Kane's method of two masses on a spring, and the input."""
    a, b = q = mechanics.dynamicsymbols("a b", real=True)
    u = mechanics.dynamicsymbols("u v", real=True)
    force = sp.Symbol("F", real=True)
    frame = mechanics.ReferenceFrame("N")
    masses = []
    for name, speed in zip("PQ", u, strict=True):
        point = mechanics.Point(name)
        point.set_vel(frame, speed * frame.x)
        masses.append(mechanics.Particle(name, point, sp.Integer(1)))
    pushed = [(masses[0].point, (force - a + b) * frame.x), (masses[1].point, (a - b) * frame.x)]
    rates = [v - c.diff() for c, v in zip(q, u, strict=True)]
    method = mechanics.KanesMethod(frame, list(q), list(u), kd_eqs=rates)
    method.kanes_equations(masses, pushed)
    return method, {force: ut.Input("F", "N")}


#: Arguments that mean something else where they are.
ELSEWHERE: dict[str, Callable[[], Any]] = {
    "ClosedLoop.with_steps.step": lambda: 0.002,
    "ClosedLoop.with_steps.tail_rtol": lambda: 1e-3,
    "Cascade.about.target": lambda: None,
    "Reference.read.path": lambda: "path.csv",
    "Belief.relative.tolerances": lambda: {"m": 0.1},
    "Belief.learn.t": lambda: [0.0, 0.1],
    "Belief.learn.x": lambda: np.zeros((2, 4)),
    "Belief.learn.u": lambda: np.zeros((2, 1)),
    "Mechanism.disturbed.force": lambda: {"phi": 0.1},
    "Mechanism.check_plant.plant": lambda: parts()["mechanism"],
    "Mechanism.input_matrix": lambda: sp.Matrix([1]),
    "Mechanism.from_energies.input_matrix": lambda: sp.Matrix([1]),
    "Optimiser.horizon": lambda: None,
    "Mechanism.initial_state.x0": lambda: None,
    "Mechanism.initial_state.names": lambda: {"phi": 0.001},
    "Run.animate.path": lambda: "film.gif",
    "verify.certificate": lambda: ut.certify(parts()["mechanism"], parts()["surface"], seconds=0.0),
    "modelling.from_urdf.source": lambda: URDF,
    "modelling.read_urdf.source": lambda: URDF,
    "modelling.from_mjcf.source": lambda: MJCF,
    "modelling.read_mjcf.source": lambda: MJCF,
    "modelling.read_mjcf.motors": lambda: True,
    "modelling.voltage_driven.mechanism": ut.mechanisms.cart_pendulum,
    "modelling.from_kane.method": lambda: kane()[0],
    "modelling.from_lagrange.method": lambda: lagrange()[0],
    "modelling.from_kane.inputs": lambda: kane()[1],
    "modelling.from_lagrange.inputs": lambda: lagrange()[1],
    "modelling.ActuatedForm.transform": lambda: sp.eye(2),
    "modelling.ActuatedForm.bounds.q_bounds": lambda: [0.0, 0.0],
    "modelling.ActuatedForm.bounds.values": dict,
}  # fmt: skip


def public(module: Any = ut, prefix: str = "") -> Iterator[tuple[str, Callable[..., Any] | None]]:
    """Name and constructor, function or method (``None``: of what :func:`parts` has)."""
    for name in module.__all__:
        thing = getattr(module, name)
        if inspect.ismodule(thing):
            yield from public(thing, f"{prefix}{name}.")
        elif inspect.isclass(thing):
            if issubclass(thing, enum.Enum):
                continue
            if name not in MADE:
                yield prefix + name, thing
            for verb, found in inspect.getmembers_static(thing):
                method = isinstance(found, staticmethod | classmethod) or inspect.isfunction(found)
                if method and (verb == "__call__" or not verb.startswith("_")):
                    yield f"{prefix}{name}.{verb}", None
        elif callable(thing):
            yield prefix + name, thing


CASES = {name: thing for name, thing in public() if name not in NOT_OURS}


def bound(name: str) -> Callable[..., Any]:
    """Return what is called."""
    known = CASES[name]
    if known is not None:
        return known
    owner, verb = name.rsplit(".", 1)
    found: Callable[..., Any] = getattr(parts()[owner.rsplit(".", 1)[-1]], verb)
    return found


def usual(name: str, argument: str) -> Any:
    """Return what an argument may be."""
    if f"{name}.{argument}" in ELSEWHERE:
        return ELSEWHERE[f"{name}.{argument}"]()
    return parts()[argument]


def attempts(name: str) -> Iterator[tuple[str, tuple[Any, ...], dict[str, Any]]]:
    """Every argument with every wrong value, in words, and the call."""
    kinds = inspect.Parameter
    taken = inspect.signature(bound(name)).parameters.values()
    plain = [p for p in taken if p.kind not in (kinds.VAR_KEYWORD, kinds.VAR_POSITIONAL)]
    usually = {
        p.name: usual(name, p.name) for p in plain if p.default is kinds.empty or p.name in SHORT
    }
    for p in taken:
        if p.kind is kinds.VAR_KEYWORD and p.annotation == "Any":
            continue  # what another signature takes: that is tried by itself
        for wrong in WRONG:
            if wrong is True and p.annotation in (bool, "bool"):
                continue  # that is none of the wrong ones
            given = dict(usually)
            named = p.kind not in (kinds.VAR_KEYWORD, kinds.VAR_POSITIONAL)
            given |= {p.name: wrong} if named else {}
            first = [given.pop(q.name) for q in plain if q.kind is kinds.POSITIONAL_ONLY]
            first += [wrong] if p.kind is kinds.VAR_POSITIONAL else []
            for key in ("phi", "d_e", "no_such_name") if p.kind is kinds.VAR_KEYWORD else [""]:
                more = {key: wrong} if key else {}
                yield f"{key or p.name} = {wrong!r}", tuple(first), given | more


#: Whose good arguments already take long.
LONG = {"certify", "compare"}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    "name", [pytest.param(k, marks=pytest.mark.slow) if k in LONG else k for k in CASES]
)
def test_wrong_arguments_are_conditions_of_ours(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is given, a raw exception never comes out; a condition carries all of its parts."""
    monkeypatch.chdir(tmp_path)  # some write files
    escaped = []
    for words, first, given in attempts(name):
        try:
            bound(name)(*first, **given)
        except UndertowError as error:
            if not (error.value is not None and error.limit is not None):
                escaped.append(f"{words}: {error!r} says too little")
        except Exception as error:  # whatever it is, it should not be
            escaped.append(f"{words}: {error!r}")
    assert not escaped, "\n".join(escaped)


@pytest.mark.parametrize(
    "odd",
    [
        lambda x: sp.Sum(x ** sp.Symbol("k", integer=True), (sp.Symbol("k", integer=True), 0, 3)),
        lambda x: sp.Subs(sp.sin(sp.Symbol("z")), sp.Symbol("z"), x),
        lambda x: sp.MatrixSymbol("A", 1, 1)[0, 0] * x,
        sp.gamma,
    ],
)
def test_a_force_that_no_code_is_written_for_is_refused(
    rig: ut.Mechanism, odd: Callable[[sp.Symbol], sp.Expr]
) -> None:
    """Where the mechanism is made, with what it is; a sum ended in a NameError of its code."""
    with pytest.raises(ModelError, match="functions that code is written for"):
        rig.disturbed({"theta": odd(rig.q[1])})


def test_a_force_with_sinc_is_computed(rig: ut.Mechanism) -> None:
    """It has a value at 0, and so has its code."""
    pushed = rig.disturbed({"theta": sp.sinc(rig.q[1])})
    difference = pushed.f([rig.state(), rig.state(phi=0.3)]) - rig.f(
        [rig.state(), rig.state(phi=0.3)]
    )
    np.testing.assert_allclose(difference[:, 0], np.sinc(np.array([0.0, 0.3]) / np.pi), rtol=1e-14)


@pytest.mark.parametrize("angle", ["10", None, True, [10.0]])
def test_degrees_are_a_number(angle: Any) -> None:
    with pytest.raises(InvalidInputError, match=r"angle: got .*number, in degrees.*deg\(10\)"):
        ut.deg(angle)
    assert ut.deg(180) == math.pi


def test_masked_numbers_are_no_states(rig: ut.Mechanism) -> None:
    """What is behind a mask was taken: an old reading, or anything."""
    x = np.ma.masked_array([0.1, 0.2, 0.0, 0.0], mask=[False, True, False, False])
    with pytest.raises(InvalidInputError, match=r"masked_array[\s\S]*must be numbers"):
        rig.check_state(x)
    assert rig.check_state(np.ma.masked_array(x.data)).tolist() == [0.1, 0.2, 0.0, 0.0]


def test_complex_numbers_are_no_states(rig: ut.Mechanism) -> None:
    """Their imaginary part is not dropped: numbers and arrays are refused alike."""
    for x in (np.full(4, 0.1 + 0.2j), [0.1j, 0.0, 0.0, 0.0], 1j):
        with pytest.raises(InvalidInputError, match="must be numbers"):
            rig.f(x)


def test_a_mapping_is_told_by_its_keys_and_values(rig: ut.Mechanism) -> None:
    """Plants by time are no names; a target is not to be written as text."""
    cascade = ut.Cascade(rig)
    with pytest.raises(InvalidInputError, match=r"a mapping of numbers to undertow\.Mechanism"):
        cascade.simulate(plant={0.0: None})  # type: ignore[dict-item]
    with pytest.raises(InvalidInputError, match=r"a mapping of names to numbers.*SetPoints") as e:
        cascade.simulate(target="theta=1")  # type: ignore[arg-type]
    assert "in quotes" not in str(e.value)
    with pytest.raises(InvalidInputError, match=r"a sequence of names\. Write \['x'\]"):
        ut.modelling.from_urdf("<robot/>", actuated="x")


@pytest.mark.parametrize("kind", [sp.Rational, Fraction, lambda a, b: np.float16(a / b)])
def test_numbers_of_every_kind_are_floats_where_these_are_asked_for(kind: Any) -> None:
    """Compiled code takes no fraction; half a precision rounds what is made of it."""

    @checked
    def told(span: float, *, part: float | None = None) -> list[type]:
        return [type(span), type(part)]

    number = kind(1, 4)
    assert told(number, part=number) == told(part=number, span=number) == [float, float]
    assert type(ut.Budget(8, seconds=number).seconds) is float
    with pytest.raises(InvalidInputError, match=r"span of .*a number"):
        told(10**400)
    with pytest.raises(InvalidInputError) as refusal:
        told(np.zeros((3, 3)))  # type: ignore[arg-type]
    assert "\n" not in str(refusal.value)


def test_an_unknown_argument_is_refused_with_those_that_are_like_it(rig: ut.Mechanism) -> None:
    """Python's TypeError knew neither."""
    with pytest.raises(InvalidInputError, match=r"argument of first_surface: .*mean weights"):
        ut.first_surface(rig, weight=[1.0] * 4)  # type: ignore[call-arg]
    loop = ut.ClosedLoop(rig)
    with pytest.raises(
        InvalidInputError, match=r"argument of ClosedLoop.simulate: .*mean duration"
    ):
        loop.simulate(rig.state(), ut.first_surface(rig), durations=1.0)  # type: ignore[call-arg]


RESULTS = ("LoopMargins", "MechanismReport", "Proposal", "Run", "Trajectory")

#: Dataclasses that users make.
MADE_BY_USERS = [
    owner
    for room in (ut, ut.plants, ut.runtime, ut.export)
    for owner in (getattr(room, name) for name in room.__all__)
    if isinstance(owner, type) and dataclasses.is_dataclass(owner)
    if owner.__name__ not in RESULTS and (room is ut or hasattr(owner, "__post_init__"))
]


@pytest.mark.parametrize("owner", MADE_BY_USERS, ids=lambda owner: owner.__qualname__)
def test_an_unknown_field_is_refused_with_those_that_are_like_it(owner: type) -> None:
    name = list(inspect.signature(owner).parameters)[-1]
    said = rf"argument of {owner.__qualname__}: got '{name}x', .*Did you mean .*{name}\b"
    with pytest.raises(InvalidInputError, match=said):
        owner(**{f"{name}x": None})
