"""MuJoCo as the plant: an engine that shares no equation with the controller's model."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from undertow.errors import InvalidInputError, MissingExtraError
from undertow.mechanism import FloatArray, Mechanism
from undertow.mechanisms.scenes import Scene, mujoco_scene
from undertow.rig.interface import Measurement

__all__ = ["MuJoCoRig"]


class MuJoCoRig:
    """A MuJoCo simulation behind the interface of a rig; positions alone are measured.

    Parameters
    ----------
    mechanism
        Gives names, the usual start and, for mechanisms of the library, the scene.
    x0
        Start, (2n,); the mechanism's usual ``start`` by default.
    scene
        MJCF of your own, with the matrix that turns coordinates into its joints; the
        library's by default.
    period
        Period of the inner loop, s.
    steps
        Steps of the engine (fourth-order Runge-Kutta) per period.

    Raises
    ------
    MissingExtraError
        When MuJoCo is not installed.
    InvalidInputError
        When the scene has other joints or actuators than the mechanism.
    """

    def __init__(
        self,
        mechanism: Mechanism,
        x0: ArrayLike | None = None,
        *,
        scene: Scene | None = None,
        period: float = 0.001,
        steps: int = 1,
    ) -> None:
        try:
            import mujoco
        except ImportError as error:
            raise MissingExtraError(
                "MuJoCo is not installed", remedy="pip install 'undertow[mujoco]'"
            ) from error
        self.mechanism, self.period = mechanism, period
        scene = mujoco_scene(mechanism) if scene is None else scene
        self._engine: Any = mujoco
        self._model = mujoco.MjModel.from_xml_string(scene.xml)
        n, m = mechanism.n, mechanism.m
        if (self._model.nq, self._model.nu) != (n, m) or scene.joints.shape != (n, n):
            raise InvalidInputError(
                f"MuJoCo scene for '{mechanism.name}'",
                value=f"{self._model.nq} joints, {self._model.nu} actuators",
                limit=f"{n} joints, {m} actuators",
                remedy="One joint per coordinate, one actuator per input",
            )
        if not period > 0 or steps < 1:
            raise InvalidInputError(
                "timing of a MuJoCo rig",
                value=f"period {period} s, {steps} steps",
                limit="period > 0, at least one step",
            )
        self._model.opt.timestep = period / steps
        self._model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self._data = mujoco.MjData(self._model)
        self._to_joints, self._steps = scene.joints, steps
        self._to_coordinates = np.linalg.inv(scene.joints)
        start = mechanism.state(**mechanism.start) if x0 is None else mechanism.check_state(x0)
        self._data.qpos[:] = scene.joints @ start[:n]
        self._data.qvel[:] = scene.joints @ start[n:]
        self._limits = mechanism.input_limits

    @property
    def truth(self) -> FloatArray:
        """The true state, (2n,), which no controller sees."""
        return np.concatenate(
            [self._to_coordinates @ self._data.qpos, self._to_coordinates @ self._data.qvel]
        )

    def read(self) -> Measurement:
        """Return the present measurement."""
        return Measurement(float(self._data.time), self._to_coordinates @ self._data.qpos)

    def write(self, u: FloatArray) -> None:
        """Apply the inputs u, (m,), clipped to their limits, and advance by one period."""
        self._data.ctrl[:] = np.clip(u, -self._limits, self._limits)
        self._engine.mj_step(self._model, self._data, self._steps)

    def close(self) -> None:
        """Let go of the simulation."""
