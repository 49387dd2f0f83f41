"""C of where the state comes from: a differentiator for each coordinate, or the model itself."""

from __future__ import annotations

from collections.abc import Mapping

import sympy as sp

from undertow.export.differentiators import DifferentiatorStep, StepSymbols
from undertow.export.observer import KalmanStep, lay_accelerations
from undertow.models import Mechanism
from undertow.symbolic import C99Emitter, Real, Tape, literal

__all__ = ["EstimatorStep", "estimate_code"]

EstimatorStep = DifferentiatorStep | KalmanStep

_DIFFERENTIATOR = """static const ut_real ut_gain[UT_N] = {{{gains}}};

static void ut_differentiate(ut_real gain, ut_real q, ut_real filter[2])
{{
{step}
}}

static void ut_estimate(ut_controller *c, const ut_real q[UT_N])
{{
    for (int i = 0; i < UT_N; i++) {{
        /* The estimate is the memory: where they differ, one was upset. */
        const int same = c->filter[i][0] == c->x[i] && c->filter[i][1] == c->x[UT_N + i];
        if (!c->running || !same) {{
            c->filter[i][0] = q[i];
            c->filter[i][1] = 0;
        }}
        ut_differentiate(ut_gain[i], q[i], c->filter[i]);
        if (!ut_sound(c->filter[i][0]) || !ut_sound(c->filter[i][1])) {{
            c->filter[i][0] = q[i];
            c->filter[i][1] = 0;
        }}
        c->x[i] = c->filter[i][0];
        c->x[UT_N + i] = c->filter[i][1];
    }}
}}"""

_OBSERVER = """static const ut_real ut_gain[UT_X][UT_N] = {{
{gains}
}};

/* The accelerations of the model. */
static void ut_model(const ut_real x[UT_X], const ut_real u[UT_M], ut_real rate[UT_N])
{{
{step}
}}

static void ut_estimate(ut_controller *c, const ut_real q[UT_N])
{{
    ut_real ahead[UT_X];
    ut_real rate[UT_N];
    int good = 1;
    for (int i = 0; i < UT_N; i++) {{
        if (!c->running) {{
            c->x[i] = q[i];
            c->x[UT_N + i] = 0;
        }}
    }}
    ut_model(c->x, c->u, rate);
    for (int i = 0; i < UT_N; i++) {{
        const ut_real v = c->x[UT_N + i];
        ahead[i] = c->x[i] + UT_PERIOD * (v + {half} * UT_PERIOD * rate[i]);
        ahead[UT_N + i] = v + UT_PERIOD * rate[i];
    }}
    for (int i = 0; i < UT_X; i++) {{
        c->x[i] = ahead[i];
        for (int k = 0; k < UT_N; k++) {{
            c->x[i] += ut_gain[i][k] * (q[k] - ahead[k]);
        }}
        good &= ut_sound(c->x[i]);
    }}
    for (int i = 0; i < UT_N; i++) {{
        if (!good) {{
            c->x[i] = q[i];
            c->x[UT_N + i] = 0;
        }}
    }}
}}"""


def estimate_code(
    step: EstimatorStep,
    mechanism: Mechanism,
    period: float,
    parameters: Mapping[sp.Symbol, str],
    real: Real,
) -> dict[str, str]:
    """Return the parts of the templates that make the state from positions.

    Parameters
    ----------
    step
        Differentiator or observer.
    mechanism, period
        Of the controller, s.
    parameters
        C text of the parameters' symbols.
    real
        Floating-point type.
    """

    def row(values: list[float]) -> str:
        return ", ".join(literal(v, real) for v in values)

    tape = Tape()
    if isinstance(step, KalmanStep):
        names = {x: f"x[{i}]" for i, x in enumerate(mechanism.x)}
        names |= {u: f"u[{i}]" for i, u in enumerate(mechanism.u)}
        rates = {f"rate[{i}]": a for i, a in enumerate(lay_accelerations(mechanism, tape))}
        body = C99Emitter(tape, {**names, **parameters}, real).statements(rates)
        rows = [f"    {{{row(r)}}}," for r in step.gains(mechanism, period).tolist()]
        text = _OBSERVER.format(gains="\n".join(rows), step=body, half=literal(0.5, real))
        return {"estimate": text, "memory": "", "place": "", "remember": ""}
    symbols = StepSymbols.new()
    position, velocity = step.lay(tape, symbols)
    names = {
        symbols.gain: "gain",
        symbols.q: "q",
        symbols.position: "filter[0]",
        symbols.velocity: "filter[1]",
        symbols.period: "UT_PERIOD",
    }
    places = {"filter[0]": position, "filter[1]": velocity}
    body = C99Emitter(tape, names, real).statements(places)
    return {
        "estimate": _DIFFERENTIATOR.format(gains=row(step.gains(mechanism.n).tolist()), step=body),
        "memory": "    ut_real filter[UT_N][2];       "
        "/* memory of the estimator, for each coordinate */\n",
        "place": "UT_PLACE(filter), ",
        "remember": "            c->filter[i % UT_N][i / UT_N] = at[i]; "
        "/* where ut_step would go on */\n",
    }
