"""Controllers on realistic rigs, many seeds: tables and figures."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import typer

from undertow.cli.options import option
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
        typer.Argument(
            help="balance: the paper's experiment on the SRV02 bench. swing-up: from hanging at "
            "rest to balanced. mujoco: MuJoCo as the truth, no retuning. "
            "robustness: random rigs, and which single change makes each controller fail. "
            "estimators: the same law with each estimator. "
            "library: every mechanism through the runtime. coverage: how often the intervals that "
            "undertow bench identifies hold the truth.",
            metavar="WHAT",
            show_choices=False,
        ),
    ],
    seeds: Annotated[int, option("Rigs, one for each seed.", min=1)] = 20,
    angle: Annotated[
        float, option("balance: start of the pendulum, degrees from the upright.")
    ] = 35.0,
    rigs: Annotated[int, option("robustness: random rigs.", min=1)] = 200,
    single: Annotated[
        bool, option("robustness: also look for the largest single change that is survived.")
    ] = True,
    limits: Annotated[
        bool, option("balance: also search for the catch limits, which takes longest.")
    ] = True,
    quick: Annotated[
        bool, option("--quick", "Quick look: three rigs, no search for catch limits.")
    ] = False,
    fresh: Annotated[
        int | None,
        option(
            "swing-up: search for new gains with this seed, in place of the library's.",
            metavar="SEED",
            min=0,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        option(
            "Folder for the table as text. balance: for balance.csv and the figures too. "
            "swing-up: for gains.json too, the gains as the library keeps them. robustness and "
            "coverage: for robustness.jsonl or coverage.jsonl alone. Each result is kept there as "
            "it is found; after an interruption the same command goes on."
        ),
    ] = None,
) -> None:
    """Run controllers on realistic rigs with many seeds, and show the results as tables."""
    from undertow.studies.trials.experiments import experiment

    work = experiment(
        what,
        seeds=min(seeds, 3) if quick else seeds,
        angle=math.radians(angle),
        limits=limits and not quick,
        rigs=min(rigs, 10) if quick else rigs,
        single=single and not quick,
        fresh=fresh,
    )
    carry_out(work, out)
