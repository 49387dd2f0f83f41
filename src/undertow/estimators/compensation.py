"""Taking an estimated matched disturbance off a controller's output.

What enters where the input does (dry friction of a driven joint, a motor that is weaker than
its data sheet, a cable that pulls) can be undone by the input itself, as far as it is known.
An observer that keeps counting while a joint sticks also sets it free: integral action.
(Ohnishi's disturbance observer; Chen, Yang, Guo, Li, *IEEE Trans. Ind. Electronics* 63(2),
2016.)
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from undertow.estimators.drive import Controller
from undertow.estimators.interface import Estimator
from undertow.models import FloatArray
from undertow.symbolic import numba

__all__ = ["SHARE", "compensated", "subtract_disturbance"]

#: Largest part of an input's limit that an estimated disturbance may claim: of a sensor or an
#: actuator that has failed an observer believes anything.
SHARE = 0.5


@numba.njit(cache=True, error_model="numpy")
def subtract_disturbance(
    u: FloatArray, disturbance: FloatArray, limits: FloatArray, out: FloatArray
) -> None:
    """Write u − d̂, (m,), into ``out``: |d̂| at most ``SHARE`` of the limits, the sum within them."""
    for i in range(u.shape[0]):
        most = SHARE * limits[i]
        wanted = u[i] - max(-most, min(most, disturbance[i]))
        out[i] = max(-limits[i], min(limits[i], wanted))


def compensated(
    controller: Controller,
    estimator: Estimator,
    limits: FloatArray,
    when: Callable[[], bool] = lambda: True,
) -> Controller:
    """Return a controller whose output lacks what the estimator knows of the disturbance.

    Parameters
    ----------
    controller
        (t, x̂) to the inputs.
    estimator
        Whose ``disturbance`` is taken off.
    limits
        Largest |u_i|, (m,).
    when
        Asked after each step of the controller: whether its output shall lack it.
    """
    out = np.zeros_like(limits)

    def both(t: float, x: FloatArray) -> FloatArray:
        u = controller(t, x)
        if not when():
            return u
        subtract_disturbance(u, estimator.disturbance, limits, out)
        return out

    return both
