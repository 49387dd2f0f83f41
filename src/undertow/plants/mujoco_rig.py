"""MuJoCo as the plant: an engine that shares no equation with the controller's model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from undertow.base import InvalidInputError, at_least, check_file, positive, require_extra
from undertow.models import FloatArray, Mechanism
from undertow.models.importers.rigid_body import identifier
from undertow.plants.interface import Measurement
from undertow.plants.scenes import Scene, mujoco_scene


class MuJoCoRig:
    """A MuJoCo simulation behind the interface of a rig; positions alone are measured.

    Parameters
    ----------
    mechanism
        Gives names, limits, the usual start and, for mechanisms of the library, the scene.
    x0
        Start, (2n,); the mechanism's usual ``start`` by default.
    scene
        The library's own scene by default.  Or MJCF of your own, a path or the text: its
        joints are found by the names of the coordinates, motors by those of the inputs (``u_1``,
        ``u_2``, … where they have none, as in :func:`undertow.models.importers.from_mjcf`) or else
        by the joints that they drive, in any order.  Ranges of joints, contacts, dry friction and
        gears of the file act; its time step and integrator do not.  Or a
        :class:`~undertow.plants.scenes.Scene`, where coordinates are no joints.
    target
        Joint positions at the target, coordinate name to rad or m, zero where left out: the
        ``equilibrium`` of :func:`undertow.models.importers.from_mjcf`.  For MJCF of your own.
    period
        Period of the inner loop, s.
    steps
        Steps of the engine (fourth-order Runge-Kutta) per period.

    Raises
    ------
    MissingExtraError
        When MuJoCo is not installed.
    InvalidInputError
        When the scene cannot be loaded, or has other joints or motors than the mechanism.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        x0: ArrayLike | None = None,
        *,
        scene: Scene | str | Path | None = None,
        target: Mapping[str, float] | None = None,
        period: float = 0.001,
        steps: int = 1,
    ) -> None:
        mujoco = require_extra("mujoco", "mujoco", "MuJoCo is not installed")
        positive("period of a MuJoCo rig, s", period)
        at_least("steps of a MuJoCo rig", steps, 1)
        self.mechanism, self.period = mechanism, period
        self._engine: Any = mujoco
        given = mujoco_scene(mechanism) if scene is None else scene
        self._model = self._loaded(given.xml if isinstance(given, Scene) else given)
        model, n, m = self._model, mechanism.n, mechanism.m
        joints = given.joints.shape if isinstance(given, Scene) else (n, n)
        if (model.nq, model.nv, model.nu) != (n, n, m) or joints != (n, n):
            raise InvalidInputError(
                f"MuJoCo scene for '{mechanism.name}'",
                value=f"{model.njnt} joints with {model.nq} positions, {model.nu} motors",
                limit=f"{n} hinge or slide joints, {m} motors",
                remedy="One joint per coordinate, one motor per input",
            )
        self._origin = np.zeros(n)
        self._motors = np.arange(m)
        if isinstance(given, Scene):
            self._to_joints = given.joints
        else:
            self._by_names(target or {})
        model.opt.timestep = period / steps
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self._data = mujoco.MjData(model)
        self._steps = steps
        self._to_coordinates = np.linalg.inv(self._to_joints)
        start = mechanism.state(**mechanism.start) if x0 is None else mechanism.check_state(x0)
        self._data.qpos[:] = self._origin + self._to_joints @ start[:n]
        self._data.qvel[:] = self._to_joints @ start[n:]
        self._limits = mechanism.input_limits

    def _loaded(self, source: str | Path) -> Any:
        text = str(source).lstrip().startswith("<")
        if not text and Path(source).exists():
            check_file(Path(source), "MuJoCo scene")
        try:
            if text:
                return self._engine.MjModel.from_xml_string(str(source))
            return self._engine.MjModel.from_xml_path(str(source))
        except ValueError as error:  # MuJoCo's own words name the element
            raise InvalidInputError(
                f"MuJoCo scene for '{self.mechanism.name}'",
                value=" ".join(str(error).split()),
                limit="MJCF that MuJoCo loads" if text else "a file of MJCF that MuJoCo loads",
            ) from error

    def _by_names(self, target: Mapping[str, float]) -> None:
        """Find joints and motors by the names of coordinates and inputs."""
        model, mechanism = self._model, self.mechanism
        joints = [identifier(self._joint_name(k)) for k in range(model.njnt)]
        coordinates = [c.name for c in mechanism.coordinates]
        self._to_joints = np.zeros((mechanism.n, mechanism.n))
        order = _places("joint", coordinates, joints, mechanism)
        self._to_joints[order, range(mechanism.n)] = 1.0
        channels = [channel.name for channel in mechanism.inputs]
        motors = [identifier(model.actuator(k).name or f"u_{k + 1}") for k in range(model.nu)]
        if set(motors) != set(channels):  # then by the joints that they drive
            acts = mechanism.B != 0.0
            alone = np.outer(acts.sum(axis=1) == 1, acts.sum(axis=0) == 1) & acts
            driven = {coordinates[i]: channels[j] for i, j in np.argwhere(alone)}
            on_joint = model.actuator_trntype == int(self._engine.mjtTrn.mjTRN_JOINT)
            places = [
                joints[i] if on_joint[k] else "" for k, i in enumerate(model.actuator_trnid[:, 0])
            ]
            motors = [driven.get(p, motor) for p, motor in zip(places, motors, strict=True)]
        self._motors = np.array(_places("motor", channels, motors, mechanism))
        for name, value in target.items():
            if name not in coordinates:
                raise InvalidInputError(
                    f"target of '{mechanism.name}' in MuJoCo",
                    value=repr(name),
                    limit=f"among {', '.join(coordinates)}",
                    remedy="Use the mechanism's own names",
                )
            self._origin[order[coordinates.index(name)]] = value

    def _joint_name(self, k: int) -> str:
        """Return a joint's name; without one, the name that ``from_mjcf`` gives it."""
        model = self._model
        sliding = model.jnt_type[k] == int(self._engine.mjtJoint.mjJNT_SLIDE)
        body = model.body(model.jnt_bodyid[k]).name
        return model.joint(k).name or f"{body}_{'slide' if sliding else 'hinge'}"

    @property
    def truth(self) -> FloatArray:
        """The true state, (2n,), which no controller sees."""
        return np.concatenate([self._positions(), self._to_coordinates @ self._data.qvel])

    def _positions(self) -> FloatArray:
        q: FloatArray = self._to_coordinates @ (self._data.qpos - self._origin)
        return q

    def read(self) -> Measurement:
        """Return the present measurement."""
        return Measurement(float(self._data.time), self._positions())

    def write(self, u: FloatArray) -> None:
        """Apply the inputs u, (m,), clipped to their limits, and advance by one period."""
        self._data.ctrl[self._motors] = np.clip(u, -self._limits, self._limits)
        self._engine.mj_step(self._model, self._data, self._steps)

    def close(self) -> None:
        """Let go of the simulation."""


def _places(
    what: str, wanted: Sequence[str], found: Sequence[str], mechanism: Mechanism
) -> list[int]:
    """Return where each name is among those of the scene."""
    if set(wanted) != set(found):
        raise InvalidInputError(
            f"{what}s of a MuJoCo scene for '{mechanism.name}'",
            value=", ".join(found),
            limit=f"the names {', '.join(wanted)}, in any order",
            remedy=f"Name each {what} as the mechanism does, or give a Scene with its matrix",
        )
    return [found.index(name) for name in wanted]
