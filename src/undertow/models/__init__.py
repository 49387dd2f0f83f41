"""What moves: a mechanism, its physical parameters, and whether its model is valid."""

from undertow.models.mechanism import Mechanism, require_mechanism
from undertow.models.partition import Partition
from undertow.models.quantities import (
    TIME,
    Coordinate,
    FloatArray,
    Input,
    Parameter,
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
    "TIME",
    "Coordinate",
    "FloatArray",
    "Input",
    "Mechanism",
    "Parameter",
    "Partition",
    "by_names",
    "check_symbols",
    "expression_of",
    "is_smooth",
    "kinks",
    "normal_name",
    "number_of",
    "numbers",
    "require_mechanism",
    "require_smooth",
    "shortened",
    "vocabulary",
]
