"""Bring-up of a rig: what is wired wrongly, how late it is, what its parameters are."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group

from undertow.cli import options
from undertow.cli.parsing import mechanism_named, parse_values
from undertow.cli.terminal import (
    check_out,
    command,
    enter_pressed,
    exit_unless,
    needs,
    progress_bar,
    show,
    write,
)
from undertow.models.importers.python_file import in_a_file

if TYPE_CHECKING:
    from undertow.plants import Rig


@command(
    "undertow bench rotary_pendulum",
    "undertow bench rotary_pendulum --fault voltage=-1",
    "undertow bench cart_pendulum --fault x=4 --fault delay=0.001 --out findings",
    "undertow bench my_arm.py:arm --rig my_driver.py:Driver --out findings",
)
def bench(
    name: options.AnyName,
    rig: str = "realistic",
    fault: list[str] | None = None,
    delay: float | None = None,
    quick: bool = False,
    setting: options.Settings = None,
    seed: options.Seed = 0,
    out: Path | None = None,
) -> None:
    """Check a rig at rest by small safe motions: signs, scales, delay, friction, parameters.

    Parameters
    ----------
    rig : RIG
        realistic: a simulated bench with friction, delay and encoders. ideal: the model.
        FILE.py:NAME: your own driver, a class or a function that returns one.
    fault : PART=VALUE
        Wire the simulated rig wrongly: INPUT=-1 or COORDINATE=2 (a factor, 0: cable off),
        swap=COORDINATE,COORDINATE (two encoders), delay=0.002 (s, besides its own, whole periods),
        friction=12 (times the realistic rig's own). Each once. Repeatable.
    delay
        From a write to its effect in a reading, s, as it should be. Default: the simulated rig's
        own. On your own rig, without this option, the delay is measured and not judged.
    quick
        Check signs, scales and breakaway only.
    out
        Folder for findings.json, motion.csv and motion.png.
    """
    from undertow.bring_up import bring_up, miswired, rest_state
    from undertow.bring_up.faults import rig_named
    from undertow.plants import RealisticRig
    from undertow.runtime.processes import signals_handled
    from undertow.studies.rigs.bring_up import (
        files,
        findings_table,
        handed_on,
        parameter_table,
        summary,
    )

    needs(not quick, "with --quick", "left out: a quick check does not measure it", "delay")
    drawn = "for the realistic rig, whose friction and noise are drawn by it"
    needs(rig == "realistic", f"with --rig {rig}", drawn, "seed")
    request = {"mechanism": name, "rig": rig, "fault": fault or [], "seed": seed}
    request |= {"setting": setting or [], "delay": delay, "quick": quick}
    belief = mechanism_named(name, setting)
    rest, faults = rest_state(belief), fault or ()
    check_out(out)
    plant = rig_named(rig, belief, mechanism_named(name), rest, faults, seed)
    if delay is None and isinstance(plant, RealisticRig):
        delay = plant.bench.timing.delay
    # Whatever asks for a stop is Ctrl-C.  Closed after what was found is shown: that may fail.
    with signals_handled(signal.default_int_handler), _closed(plant):
        if in_a_file(rig):
            ready = f"Ready. Let {name} come to rest, hands off, and press Enter."
            exit_unless(enter_pressed(ready))
        with progress_bar(left=False) as progress:  # how long it swings nobody knows
            found = bring_up(
                miswired(plant, belief, faults),
                belief,
                delay=delay,
                rest=rest,
                learn=not quick,
                progress=progress,
            )
        table = findings_table(found)
        written = write(out, lambda: files(request, belief, rest, found), table)
        show(table)
        if found.identification is not None:
            show(Group("", parameter_table(found.identification)))
        said = handed_on(name, rig, found, parse_values(setting)) if in_a_file(rig) else ()
        show(*summary(found), *said, *written)
        exit_unless(not found.wrong)


@contextmanager
def _closed(plant: Rig) -> Iterator[None]:
    """Close a rig in the end."""
    from undertow.plants.interface import driver_errors

    try:
        yield
    finally:
        with driver_errors("close() of the rig", "a rig that is let go of", "Look at the device"):
            plant.close()
