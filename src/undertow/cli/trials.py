"""Controllers on realistic rigs, many seeds: tables and figures."""

from __future__ import annotations

import inspect
import math
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from undertow.base import InvalidInputError
from undertow.cli.terminal import carry_out, command


@command(
    "undertow trials balance --out bench",
    "undertow trials balance --quick",
    "undertow trials swing-up",
    "undertow trials swing-up --fresh 1",
    "undertow trials mujoco",
    "undertow trials library --seeds 3",
    "undertow trials coverage --seeds 60 --out bench",
    "undertow trials robustness --rigs 50 --out bench",
)
def trials(
    what: Annotated[
        Literal["balance", "swing-up", "mujoco", "robustness", "estimators", "library", "coverage"],
        typer.Argument(show_choices=False),
    ],
    seeds: Annotated[int | None, typer.Option(min=1)] = None,
    angle: float | None = None,
    rigs: Annotated[int | None, typer.Option(min=1)] = None,
    single: bool | None = None,
    limits: bool | None = None,
    quick: bool = False,
    fresh: Annotated[int | None, typer.Option(min=0)] = None,
    out: Path | None = None,
) -> None:
    """Run controllers on realistic rigs with many seeds, and show the results as tables.

    Parameters
    ----------
    what : WHAT
        balance: the paper's experiment on the SRV02 bench. swing-up: from hanging at rest to
        balanced. mujoco: MuJoCo as the truth, no retuning. robustness: random rigs, and which
        single change makes each controller fail. estimators: the same law with each estimator.
        library: every mechanism through the runtime. coverage: how often the intervals that
        undertow bench identifies hold the truth.
    seeds
        Rigs, one for each seed; not for robustness and mujoco. Default: 20; 5 for estimators and
        library.
    angle
        balance: start of the pendulum, degrees from the upright. Default: 35.
    rigs
        robustness: random rigs. Default: 200.
    single
        robustness: also look for the largest single change that is survived. Default: yes.
    limits
        balance: also search for the catch limits, which takes longest. Default: yes.
    quick
        Quick look: three seeds, ten random rigs, no search for limits, where nothing else is said;
        not for mujoco.
    fresh : SEED
        swing-up: search for new gains with this seed, in place of the library's.
    out
        Folder for the table as text. balance: for balance.csv and the figures too. swing-up: for
        gains.json too, the gains as the library keeps them. robustness and coverage: for
        robustness.jsonl or coverage.jsonl alone. Each result is kept there as it is found; after an
        interruption the same command goes on.
    """
    from undertow.studies.trials.experiments import EXPERIMENTS

    takes = {name: {*inspect.signature(make).parameters} for name, make in EXPERIMENTS.items()}
    for own in takes.values():
        own.update({"quick"} if own else ())
    given = {
        "seeds": seeds, "angle": angle, "rigs": rigs, "single": single, "limits": limits,
        "quick": quick or None, "fresh": fresh,
    }  # fmt: skip
    asked = {option: value for option, value in given.items() if value is not None}
    for option, value in asked.items():
        takers = [name for name, own in takes.items() if option in own]
        if what not in takers:
            raise InvalidInputError(
                f"--{option} with undertow trials {what}",
                value=value,
                limit=f"an option of {', '.join(takers)}",
                remedy=f"Leave --{option} out",
            )
    if angle is not None:
        asked["angle"] = math.radians(angle)
    if asked.pop("quick", False):
        brief: dict[str, Any] = {"seeds": 3, "rigs": 10, "single": False, "limits": False}
        asked = {option: brief[option] for option in takes[what] & {*brief}} | asked
    carry_out(EXPERIMENTS[what](**asked), out)
