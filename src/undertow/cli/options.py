"""Options and arguments that commands share, each declared once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from undertow.base import InvalidInputError, one_of
from undertow.models.importers.formats import file_words


def option(*names_and_help: str, **more: Any) -> Any:
    """Return an option: its names, where not the parameter's own, then what help says of it."""
    *names, words = names_and_help
    return typer.Option(*names, help=words, **more)


OneName = Annotated[
    str | None,
    typer.Argument(
        help="Mechanism, e.g. rotary_pendulum, or your own as FILE.py:NAME.", metavar="NAME"
    ),
]
AnyName = Annotated[
    str,
    typer.Argument(
        help="Mechanism of the library, e.g. rotary_pendulum, or your own: FILE.py:NAME, "
        f"{file_words()}. Append :JOINT,JOINT to name the actuated joints where a URDF or MJCF "
        "file does not, :-JOINT to freeze one, @upright, @hanging, @nearest or @JOINT=180deg to "
        "choose its equilibrium.",
        metavar="NAME",
    ),
]
Start = Annotated[
    list[str] | None,
    option(
        "Initial state, with units: phi=40deg, theta_dot=10deg/s, x=0.2m. Repeatable; states "
        "that are not named are zero. Default: the mechanism's usual start, if it has one.",
        metavar="STATE=VALUE",
    ),
]
Settings = Annotated[
    list[str] | None,
    option("--set", "Value of a parameter, SI units: d_e=0.025. Repeatable.", metavar="NAME=VALUE"),
]
Limits = Annotated[
    list[str] | None,
    option(
        "--limit",
        "Largest magnitude of an input, in its own unit: voltage=10. Repeatable. Default: "
        "the mechanism's.",
        metavar="INPUT=VALUE",
    ),
]
HardInput = Annotated[
    bool,
    option(
        "--hard-input",
        "Reject motions on which the law demands more than the input limit. Default: the "
        "actuator saturates.",
    ),
]
Box = Annotated[
    list[str] | None,
    option(
        "Bounds on a state along the motion, with units: theta=60deg for both sides, or "
        "x=-0.2m:0.5m. Repeatable. Checked every 2 ms. Default: 95 % of the travel that the "
        "mechanism declares.",
        metavar="STATE=LOW:HIGH",
    ),
]
Goal = Annotated[
    str,
    option(
        "--objective",
        "What is minimised until ‖x‖ has fallen to a radius. energy: ∫uᵀu dt, and time: the "
        "duration, both to 0.01 as in the paper. bench-energy: ∫(uᵀu + 0.05 xᵀx)dt, and "
        "bench-time: ∫(1 + 2.25 Σ(u/u_max)²)dt, to 0.05. effort: ∫(Σ(u/u_max)² + 0.01 xᵀx)dt, "
        "to 0.01.",
        metavar="WORD",
    ),
]
Target = Annotated[
    list[str] | None,
    option(
        "--target",
        "Where to, with units. x=1m: a set-point; x=-1m@2s: another one from 2 s on; "
        "theta=45deg@0.5Hz: a sine; FILE.csv: a path through its points, 't (s), x (m)' in its "
        "first line. Repeatable. Default: x = 0. On a rig a set-point takes effect as soon as "
        "there is a plan for it. For a URDF or MJCF file also upright, hanging, nearest or "
        "JOINT=180deg: the equilibrium that is x = 0.",
        metavar="STATE=VALUE[@TIME]|FILE.csv",
    ),
]
SurfaceText = Annotated[
    str | None,
    option(
        "--surface",
        "A surface of your own: 'lambda_a=-0.5 alpha_u=5 lambda_u=10'; commas between "
        "entries of a row, semicolons between rows, or as it is printed; alpha_a is -1 if not "
        "given.",
        metavar="BLOCKS",
    ),
]
Horizon = Annotated[float, option("Longest motion, s.")]
Seed = Annotated[int, option("Seed of the random numbers.", min=0)]


def check_control(control: str | None, words: Sequence[str], surface: str | None) -> None:
    """Refuse a word of ``--control`` that is none of these, or one beside ``--surface``."""
    if control is None:
        return
    both = "The surface that is designed is 'designed', the first optimum is 'one-time'"
    one_of("--control", control, words, both if control == "first" else "")
    if surface is not None:
        raise InvalidInputError(
            "--surface with --control",
            value=control,
            limit="one of them",
            remedy="A surface of your own is kept: leave --control out",
        )
