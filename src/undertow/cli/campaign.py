"""Campaigns: many shards of work on threads, workers or machines, and their store."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from undertow.base import InvalidInputError, require, write_file
from undertow.cli.terminal import command, completed, end_interrupted, exit_unless, needs, show

if TYPE_CHECKING:
    from undertow.studies.campaign import CampaignResult


@command(
    "undertow campaign map.toml --out map.zarr --threads 2",
    "undertow campaign map.toml --out map.zarr --resume --workers 2",
    "undertow campaign map.toml --out map.zarr --scheduler tcp://host:8786",
    "undertow campaign map.toml --out map.zarr --status",
    "undertow campaign map.toml --out map.zarr --shard 17",
    "undertow campaign map.toml --out map.zarr --picture map.png",
    "undertow campaign league.toml --out league.zarr --entrant mine.py:Controller --workers 2",
    "undertow campaign league.toml --out league.zarr --tables",
)
def campaign(
    file: Path,
    out: Annotated[Path, typer.Option("--out")],
    mechanism: str | None = None,
    entrant: list[str] | None = None,
    threads: Annotated[int, typer.Option(min=1, max=1024)] = 1,
    workers: Annotated[int, typer.Option(min=0, max=1024)] = 0,
    scheduler: str = "",
    limit: Annotated[float | None, typer.Option(min=0.1)] = None,
    resume: bool = False,
    status: bool = False,
    shard: Annotated[int | None, typer.Option(min=0)] = None,
    tables: bool = False,
    picture: Path | None = None,
    proof: Path | None = None,
) -> None:
    """Run a campaign: maps, random plants, designs or the league, in a store that can be resumed.

    Parameters
    ----------
    file : FILE
        The definition, TOML: see docs/campaigns.md.
    out : STORE
        Folder of the store, zarr.
    mechanism
        Mechanism instead of the file's; the only way to name FILE.py:NAME, which is run.
    entrant
        Controller of your own for a league, FILE.py:NAME, which is run. Repeatable.
    threads
        Threads of this process.
    workers
        Processes of dask on this machine instead; needs the extra campaign.
    scheduler
        Address of a dask scheduler instead, which must see the same folder.
    limit
        Time after which a worker's shard counts as hanging, s; needs --workers or --scheduler, for
        a thread cannot be ended.
    resume
        Resume the existing store.
    status
        Show the progress, and nothing else.
    shard
        Compute this shard alone, in this process, and compare it with the store.
    tables
        Print what the store has, of any version, and nothing else.
    picture
        Draw what the store has into this PNG, and nothing else.
    proof
        Certificate whose region on the surface, or terminal set, the picture shows.
    """
    from undertow.studies.campaign import Campaign, Definition, executor_for
    from undertow.studies.campaign.report import alone, report
    from undertow.studies.campaign.report import status as status_of
    from undertow.studies.campaign.report import tables as tables_of

    if bool(scheduler) + bool(workers) + (threads > 1) > 1:
        raise InvalidInputError(
            "where the campaign runs",
            value="two places",
            limit="--threads, --workers or --scheduler",
        )
    if limit is not None and not (workers or scheduler):
        raise InvalidInputError(
            "time limit of a shard",
            value=f"{limit:g} s, for threads",
            limit="workers",
            remedy="A thread cannot be ended: add --workers 1",
        )
    views = {
        "--picture": picture is not None, "--tables": tables, "--status": status,
        "--shard": shard is not None,
    }  # fmt: skip
    asked = [name for name, given in views.items() if given]
    both = " and ".join(asked)
    require(len(asked) < 2, "what is shown of the campaign", both, "one of them")
    needs(
        not asked, f"with {both}", "for a run: this looks at what the store has, or at one shard",
        "threads", "workers", "scheduler", "limit", "resume",
    )  # fmt: skip
    needs(
        picture is not None, "without --picture", "for a picture that shows it", "proof",
        remedy="Add --picture map.png",
    )  # fmt: skip
    task = Campaign(Definition.read(file, mechanism, entrant or ()), out)
    if picture is not None:
        from undertow.studies.campaign.figures import picture_file

        image, words = picture_file(task, proof)
        show(*words, f"Written to {write_file(picture, image)}")
    elif tables:
        show(*tables_of(task))
    elif status:
        show(*status_of(task))
    elif shard is not None:
        show(*alone(task, shard))
    else:
        outcomes: list[CampaignResult] = []
        with executor_for(threads=threads, workers=workers, scheduler=scheduler) as (pool, width):
            whole = completed(
                lambda progress: outcomes.append(
                    task.run(pool, width=width, limit=limit, resume=resume, progress=progress)
                )
            )
        if not whole:
            end_interrupted("interrupted: finished shards are kept; go on with --resume")
        show(*report(task, outcomes[0]))
        exit_unless(outcomes[0].complete)
