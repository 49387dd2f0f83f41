"""The control law: sliding surfaces, how the state reaches them, and whether they are stable.

:mod:`.sliding` writes the law (3)-(16) down; its numbers are a :class:`Surface` and a
:class:`ReachingLaw` (:mod:`.surface`), one of each or a schedule of them (:mod:`.schedule`).
:mod:`.stability` designs a first surface and judges any; :mod:`.reference` says where the
mechanism is to be; :mod:`.inner_loop` is the whole law as one compiled step, for the fast loop.
"""

from undertow.law.inner_loop import (
    LAYOUT,
    InnerLoop,
    feedback_at_target,
    law_module,
    matrix_at_target,
    pack_law_parameters,
)
from undertow.law.reference import Reference, ReferenceMotion, SetPoints, Target, target_of
from undertow.law.schedule import Plan, rising_from_zero
from undertow.law.sliding import (
    Control,
    LawSymbols,
    SlidingModeLaw,
    build_law_graph,
    check_surface_shape,
    coupling,
    gains_at_target,
    gamma_determinant,
)
from undertow.law.stability import (
    OVERSHOOTS,
    SUITED,
    Margin,
    check_surface,
    first_surface,
    placed_surface,
    quadratic_designs,
    sliding_matrix,
    stability_margin,
    surface_margins,
    usual_reaching,
)
from undertow.law.surface import LawLayout, ProvedSet, ReachingLaw, Surface, Switching

__all__ = [
    "LAYOUT",
    "OVERSHOOTS",
    "SUITED",
    "Control",
    "InnerLoop",
    "LawLayout",
    "LawSymbols",
    "Margin",
    "Plan",
    "ProvedSet",
    "ReachingLaw",
    "Reference",
    "ReferenceMotion",
    "SetPoints",
    "SlidingModeLaw",
    "Surface",
    "Switching",
    "Target",
    "build_law_graph",
    "check_surface",
    "check_surface_shape",
    "coupling",
    "feedback_at_target",
    "first_surface",
    "gains_at_target",
    "gamma_determinant",
    "law_module",
    "matrix_at_target",
    "pack_law_parameters",
    "placed_surface",
    "quadratic_designs",
    "rising_from_zero",
    "sliding_matrix",
    "stability_margin",
    "surface_margins",
    "target_of",
    "usual_reaching",
]
