"""The mechanism: from energies, or M, f and B, to a model that is checked and can be linearised.

Begin at :class:`Mechanism` (:mod:`.mechanism`), made of named :mod:`.quantities` and checked by
:mod:`.validity`; :mod:`.lagrange` derives its equations, :mod:`.partition` prepares them for the
law, :mod:`.linearisation` judges them at the target. :mod:`.importers` reads other forms.
"""

from undertow.models.error_dynamics import (
    error_dynamics,
    invariant_coordinates,
    reference_names,
    with_positions,
)
from undertow.models.linearisation import (
    AT_REST,
    UNCONTROLLABLE,
    Linearisation,
    controllability,
    fastest_rate,
    force_scale,
    full_accelerations,
    growth_rate,
    has_linear_model,
    linear_accelerations,
    linear_numbers,
    linearise,
    longest_step,
    steps_in,
    uncontrollable,
)
from undertow.models.mechanism import Mechanism
from undertow.models.partition import Partition
from undertow.models.quantities import (
    TIME,
    Coordinate,
    FloatArray,
    Input,
    Parameter,
    StateLike,
    deg,
    in_degrees,
    normal_name,
    number_of,
    numbers,
)
from undertow.models.validity import (
    by_names,
    check_symbols,
    expression_of,
    is_smooth,
    kinks,
    require_smooth,
    shortened,
    vocabulary,
)

__all__ = [
    "AT_REST",
    "TIME",
    "UNCONTROLLABLE",
    "Coordinate",
    "FloatArray",
    "Input",
    "Linearisation",
    "Mechanism",
    "Parameter",
    "Partition",
    "StateLike",
    "by_names",
    "check_symbols",
    "controllability",
    "deg",
    "error_dynamics",
    "expression_of",
    "fastest_rate",
    "force_scale",
    "full_accelerations",
    "growth_rate",
    "has_linear_model",
    "in_degrees",
    "invariant_coordinates",
    "is_smooth",
    "kinks",
    "linear_accelerations",
    "linear_numbers",
    "linearise",
    "longest_step",
    "normal_name",
    "number_of",
    "numbers",
    "reference_names",
    "require_smooth",
    "shortened",
    "steps_in",
    "uncontrollable",
    "vocabulary",
    "with_positions",
]
