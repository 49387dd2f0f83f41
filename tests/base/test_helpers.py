"""Checks of arguments and conditions, as every other package uses them."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest

from undertow.base import InvalidInputError, UndertowError, between, errors, one_for_each

KINDS = [
    kind
    for kind in vars(errors).values()
    if isinstance(kind, type) and issubclass(kind, UndertowError)
]


class Odd:
    """What no other process knows."""

    def __reduce__(self) -> str:
        raise TypeError("not to be pickled")

    def __repr__(self) -> str:
        return "something odd"


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("value", [None, 3.5, Odd()])
def test_a_condition_reads_alike_in_another_process(
    kind: type[UndertowError], value: object
) -> None:
    """Its class, what it says and its parts; a value as text, whatever it is."""
    error = kind("what", value=value, limit="less", remedy="Do it")
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is kind
    assert str(again) == str(error)
    assert (again.what, again.limit, again.remedy) == ("what", "less", "Do it")
    assert again.value == (None if value is None else str(value))


@pytest.mark.parametrize("value", [-0.1, 5.1, math.nan, math.inf])
def test_a_number_outside_is_refused_with_the_interval(value: float) -> None:
    between("span", 0.0, 0, 5)
    between("span", 5, 0, 5)
    with pytest.raises(InvalidInputError, match=rf"span: got {value:g} m, must be 0 m to 5 m"):
        between("span", value, 0, 5, "m")


@pytest.mark.parametrize(
    ("values", "infinite"),
    [
        ((1.0, 2.0), False), ([[1.0], [2.0], [3.0]], False), ((1.0, -1.0, 2.0), False),
        (0.0, True), (math.nan, True), (math.inf, False),
    ],
)  # fmt: skip
def test_one_number_for_each_has_their_shape_and_sign(values: object, infinite: bool) -> None:
    assert one_for_each("noise", 2, 3).tolist() == [2.0, 2.0, 2.0]
    assert one_for_each("noise", (1, np.inf, 3), 3, infinite=True).tolist() == [1.0, np.inf, 3.0]
    with pytest.raises(InvalidInputError, match="noise"):
        one_for_each("noise", values, 3, infinite=infinite)  # type: ignore[arg-type]
