"""The library of mechanisms: one file each, parameters as data, sources cited.

Each is a function of the values of its parameters, by name and in SI units; an unknown name, and a
value outside its bounds, raises InvalidInputError.
"""

from collections.abc import Callable

from undertow.mechanisms.acrobot import acrobot
from undertow.mechanisms.ball_and_beam import ball_and_beam
from undertow.mechanisms.cart_pendulum import cart_pendulum
from undertow.mechanisms.double_pendulum_on_a_cart import double_pendulum_on_a_cart
from undertow.mechanisms.gantry_crane import gantry_crane
from undertow.mechanisms.overhead_crane import overhead_crane
from undertow.mechanisms.pendubot import pendubot
from undertow.mechanisms.reaction_wheel_pendulum import reaction_wheel_pendulum
from undertow.mechanisms.rotary_pendulum import rotary_pendulum
from undertow.mechanisms.tora import tora
from undertow.mechanisms.triple_pendulum_on_a_cart import triple_pendulum_on_a_cart
from undertow.mechanisms.two_motor_three_link import two_motor_three_link
from undertow.mechanisms.wheeled_inverted_pendulum import wheeled_inverted_pendulum
from undertow.models import Mechanism

__all__ = [
    "acrobot",
    "ball_and_beam",
    "cart_pendulum",
    "double_pendulum_on_a_cart",
    "gantry_crane",
    "overhead_crane",
    "pendubot",
    "reaction_wheel_pendulum",
    "rotary_pendulum",
    "tora",
    "triple_pendulum_on_a_cart",
    "two_motor_three_link",
    "wheeled_inverted_pendulum",
]

#: Every mechanism of the library by name: call one to get it.  The names are ``__all__``.
LIBRARY: dict[str, Callable[..., Mechanism]] = {
    build.__name__: build
    for build in (
        rotary_pendulum,
        cart_pendulum,
        overhead_crane,
        pendubot,
        acrobot,
        reaction_wheel_pendulum,
        tora,
        ball_and_beam,
        wheeled_inverted_pendulum,
        double_pendulum_on_a_cart,
        two_motor_three_link,
        gantry_crane,
        triple_pendulum_on_a_cart,
    )
}
