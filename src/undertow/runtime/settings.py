"""What a run keeps to: limits of the output, and timeouts of sensors, optimiser and clock."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from undertow.base import check_fields, checked_names, one_for_each, positive
from undertow.models import FloatArray, Mechanism
from undertow.objective import TRAVEL, Objective, range_words, state_box


@checked_names
@dataclass(frozen=True)
class Settings:
    """Limits and timeouts of the fast loop.

    Parameters
    ----------
    output_limit
        Largest |u|, in the input's unit, for all inputs or one for each; the mechanism's own
        limits apply besides.  Plans keep to the smaller of the two.
    slew_time
        Shortest time in which an input may cross its whole range, s: the slew rate is
        2 u_max / slew_time.  Inputs without a limit have none on their rate either.
    lead_time, max_lead_time
        How far ahead proposals are computed, s: from a request to the use of its answer.
        It starts at ``lead_time``, grows by half when an answer comes late, and shrinks by a tenth
        when one comes in less than half of it.
    optimiser_timeout
        An optimiser that has not answered for this long after its time is replaced, s.
    max_prediction_error
        A proposal is refused when, at its time of use, an entry of the state is off the
        predicted one by more than this, in units of 1 + |entry|.
    sensor_timeout
        Longest gap in a sensor that the model bridges, s.
    max_innovation
        Largest difference between a position and its prediction that is accepted, rad or m,
        besides two periods of motion at the present speed; or by which it grows from one accepted
        reading to the next, as after a knock.
    frozen_threshold
        A reading that does not move while the model has moved by this, rad or m, is frozen.
    dead_band
        Part of the input's limit that friction may swallow without anything moving.
    sensor_settling_time
        The sensors must have been sound for this long before the law takes over, s.
    settled_radius
        ‖(q_u, q̇_u)‖₂ of the unactuated coordinates within which the mechanism counts as
        settled; beyond twice that it does not.
    min_margin
        det Γ(q)/det Γ(0) below which the law is taken to be lost, (37).
    max_travel
        Largest |q_i|, rad or m, for all coordinates or one for each, besides their ranges: where a
        run is stopped.  Plans keep within 95 % of it, as of the ranges; free angles beyond
        ``fall_angle`` have fallen before.  A bound makes first searches four to ten times as long.
    fall_angle
        A free angle further than this from the target has fallen, rad; with a swing-up one further
        than 60° in any case.
    max_state_norm
        ‖x‖₂ beyond which the motion has escaped, whatever the predictions' own limit.
    max_step_interval
        Longest gap between two steps, s; after a longer one the loop stops safely.
    fault_window, max_failure_ratio, max_dropout_ratio
        When more than the share ``max_failure_ratio`` of the reads or of the writes fail, or more
        than ``max_dropout_ratio`` of the readings of one sensor are missing, over a sliding window
        of this length, s, the loop stops safely.
    max_deadline_miss_ratio
        When more than this share of the periods of the last second had no step that ended in
        time, the loop stops safely.
    max_clock_drift
        The rig's clock may go wrong against the host's, or against the steps made, by this much
        in a second, s; beyond that the loop stops safely.
    bring_up_timeout
        Longest bring-up, s; when the law cannot take over by then the loop stops safely.
    zero_output_timeout
        How long a rig that does not take an output of zero is asked again after a safe stop, s.
    target_radius, convergence_time
        ‖x‖₂ within which a run that ends settled has reached the target; and how long after
        it has settled, s, it is converging and may be four times as far away.
    """

    output_limit: float | tuple[float, ...] = math.inf
    slew_time: float = 0.004
    lead_time: float = 0.1
    max_lead_time: float = 0.5
    optimiser_timeout: float = 0.5
    max_prediction_error: float = 0.5
    sensor_timeout: float = 0.02
    max_innovation: float = 0.05
    frozen_threshold: float = 0.25
    dead_band: float = 0.05
    sensor_settling_time: float = 0.02
    settled_radius: float = 0.2
    min_margin: float = 0.02
    max_travel: float | tuple[float, ...] = math.inf
    fall_angle: float = math.pi / 2
    max_state_norm: float = 500.0
    max_step_interval: float = 0.1
    fault_window: float = 0.25
    max_failure_ratio: float = 0.2
    max_dropout_ratio: float = 0.6
    max_deadline_miss_ratio: float = 0.3
    max_clock_drift: float = 0.1
    bring_up_timeout: float = 2.0
    zero_output_timeout: float = 1.0
    target_radius: float = 0.35
    convergence_time: float = 5.0

    def __post_init__(self) -> None:
        """Refuse what is not positive."""
        check_fields(self)
        for item in fields(self):
            value = getattr(self, item.name)
            positive(
                f"{item.name} of a run", value, "Leave it out for the usual value", infinite=True
            )

    def limits(self, mechanism: Mechanism) -> FloatArray:
        """Largest |u_i|, (m,).

        Raises InvalidInputError where there is not one ``output_limit`` for each input.
        """
        most = one_for_each("output_limit", self.output_limit, mechanism.m, infinite=True)
        return np.minimum(mechanism.input_limits, most)

    def bounded(self, objective: Objective, mechanism: Mechanism) -> Objective:
        """Return an objective whose motions keep to ``max_travel``, where that is less than ranges.

        To 95 % of it, as to those of the travel that a mechanism declares; free angles only where
        they have not fallen before.
        """
        boxes, source = [], f"{100 * TRAVEL:g} % of the max_travel of the run"
        most = self._most_travel(mechanism).tolist()
        for i, (low, high) in enumerate((TRAVEL * self.travels(mechanism)).tolist()):
            c = mechanism.coordinates[i]
            falls = self.fall_angle if i >= mechanism.m and c.unit == "rad" else math.inf
            if most[i] < min(max(-c.low, c.high), falls):
                (box,) = state_box(**{c.name: (low, high)})
                named = range_words(c, low, high)
                boxes.append(replace(box, name=named, unit=c.unit, source=source))
        constraints = (*objective.constraints, *boxes)
        return replace(objective, constraints=constraints) if boxes else objective

    def slew(self, mechanism: Mechanism) -> FloatArray:
        """Largest |du_i/dt|, (m,), in the input's unit per second."""
        return 2.0 * self.limits(mechanism) / self.slew_time

    def bands(self, mechanism: Mechanism) -> FloatArray:
        """Part of each input that friction may swallow, (m,); 0 where there is no limit."""
        limits = self.limits(mechanism)
        return np.where(np.isfinite(limits), self.dead_band * limits, 0.0)

    def travels(self, mechanism: Mechanism) -> FloatArray:
        """Lowest and highest positions, (n, 2), rad or m.

        Raises InvalidInputError where there is not one ``max_travel`` for each coordinate.
        """
        low, high = zip(*((c.low, c.high) for c in mechanism.coordinates), strict=True)
        most = self._most_travel(mechanism)
        return np.column_stack([np.maximum(low, -most), np.minimum(high, most)])

    def _most_travel(self, mechanism: Mechanism) -> FloatArray:
        return one_for_each("max_travel", self.max_travel, mechanism.n, infinite=True)
