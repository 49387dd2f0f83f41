"""The paper's experiment."""

from __future__ import annotations

from pathlib import Path

from undertow.cli import options
from undertow.cli.terminal import carry_out, command


@command(
    "undertow reproduce", "undertow reproduce --out results --seed 1", "undertow reproduce --quick"
)
def reproduce(out: Path = Path("results"), seed: options.Seed = 0, quick: bool = False) -> None:
    """Run the paper's experiment: Tables 1 and 2 beside the paper's, Figures 3 to 6.

    Also its appendix, corrected: tables of the five cases and Figures 7 to 11 (not with --quick).

    Parameters
    ----------
    out
        Folder for tables, figures and manifest.
    quick
        Quick look: one condition, short searches, no bounds.
    """
    from undertow.studies.paper import Effort, reproduction

    effort = Effort.quick() if quick else Effort()
    carry_out(reproduction(seed=seed, effort=effort), out, seed=seed)
