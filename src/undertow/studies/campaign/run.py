"""Campaigns run: shards on any executor, their results in a store, what failed by its number."""

from __future__ import annotations

import faulthandler
import json
import logging
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any

from undertow.base import (
    ArtefactError,
    InvalidInputError,
    Progress,
    ResourceError,
    UndertowError,
    between,
    error_text,
    no_progress,
    printable,
    raised_at,
    require_extra,
    versions,
)
from undertow.studies.campaign.definition import Definition, mechanism_of
from undertow.studies.campaign.designs import Designs
from undertow.studies.campaign.league import League
from undertow.studies.campaign.random_plants import RandomPlants
from undertow.studies.campaign.region_map import RegionMap
from undertow.studies.campaign.store import DONE, PARTS, SHARD, Store, dataset, digest
from undertow.studies.campaign.study import Arrays, Study
from undertow.studies.experiment import Serial, ended
from undertow.symbolic import processor
from undertow.symbolic.store import content_key

#: Kinds of campaigns by the word for each.
KINDS: dict[str, type[Study]] = {
    kind.kind: kind for kind in (RegionMap, RandomPlants, Designs, League)
}

#: Failures after which a campaign ends: what they have in common will not pass.
MOST_FAILURES = 20

#: Shards of a campaign, at most: each is a file of every array.
MOST_SHARDS = 10**6

#: How often a worker may die of a shard before it counts as failed.
DEATHS = 2

#: Run by workers of this machine when they begin: Ctrl-C is for the process that started them.
DEAF = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"

_BUILDING, _COMPUTING = threading.RLock(), threading.Lock()


@lru_cache(maxsize=4)
def study_of(definition: Definition) -> Study:
    """Return the study that a definition means; the same object as long as it is in use.

    Raises InvalidInputError for a setting that is unknown or out of bounds.
    """
    with _BUILDING:
        settings = definition.settings
        kind = settings.word("kind", KINDS)
        study = KINDS[kind](mechanism_of(definition, settings), settings)
        if definition.code:
            study.enter(definition.code)
        settings.finish()
        between(
            "shards of the campaign", study.shards, 1, MOST_SHARDS,
            remedy="Put more into each with 'shard', or take fewer values along the axes",
        )  # fmt: skip
        for axis in study.axes:
            if axis.name in (*study.variables, DONE, SHARD):
                raise InvalidInputError(
                    f"axis '{axis.name}' of the campaign",
                    value="a name of what the store has itself",
                    limit=f"none of {', '.join((*study.variables, DONE, SHARD))}",
                    remedy="Call the coordinate or the parameter something else",
                )
    return study


@lru_cache(maxsize=4)
def key_of(definition: Definition) -> str:
    """Return the hash that names a campaign: settings, mechanism, sources and versions."""
    study = study_of(definition)
    return content_key(
        json.dumps(definition.said, sort_keys=True),
        repr([axis.name for axis in study.axes]),  # in the order in which they stand there
        *definition.code_hashes,
        *(mechanism.identity for mechanism in study.studied),
    )


def compute(definition: Definition, shard: int) -> Arrays:
    """Return the arrays of a shard: a pure function.

    Raises
    ------
    InvalidInputError
        For a number that the campaign does not have.
    """
    study = study_of(definition)
    between("shard of the campaign", shard, 0, study.shards - 1)
    if study.threaded:
        return study.compute(shard)
    with _COMPUTING:  # searches remember their last answer: one at a time in each process
        return study.compute(shard)


@lru_cache(maxsize=4)
def _opened(path: str, key: str) -> Store:
    """Return a store that stays open from shard to shard."""
    return Store(Path(path), key)


def work(definition: Definition, key: str, path: str, shard: int, limit: float | None) -> int:
    """Compute a shard and write it: what workers do; return the digest of its arrays.

    A process that has not finished after ``limit``, s, says where it is and ends itself.
    """
    if key_of(definition) != key:
        raise ResourceError(
            "worker of a campaign",
            value="another version of the package, of its libraries or of the mechanism's file",
            limit="what the campaign was begun with",
            remedy="Install the same on every machine",
        )
    if limit is not None:
        faulthandler.dump_traceback_later(limit, exit=True)
    try:
        arrays = compute(definition, shard)
        _opened(path, key).write(study_of(definition), shard, arrays)
    finally:
        if limit is not None:
            faulthandler.cancel_dump_traceback_later()
    return digest(study_of(definition).same_bits(arrays))


@dataclass
class CampaignResult:
    """What came of a campaign: ``done`` of ``shards`` finished, and why others failed, by number.

    ``computed`` now, in ``seconds``; ``repaired`` were damaged in the store.
    """

    shards: int
    done: int
    computed: int = 0
    seconds: float = 0.0
    repaired: list[int] = field(default_factory=list)
    failures: dict[int, str] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Whether every shard is in the store."""
        return self.done == self.shards


class Campaign:
    """A definition and its store.

    ``definition``: what is computed. ``path``: folder of the store.
    """

    def __init__(self, definition: Definition, path: Path) -> None:
        self.definition = definition
        self.path = path.absolute()
        self.study = study_of(definition)
        self.key = key_of(definition)

    def open(self, *, resume: bool = False) -> Store:
        """Return the store: a new one, or with ``resume`` the one that is there.

        Raises
        ------
        ArtefactError
            When there is one and it is not to be resumed, none that could be, or another one.
        """
        if resume:
            return Store(self.path, self.key, self.about)
        made_by = {"versions": versions(), "processor": processor()["processor"]}
        return Store.create(self.path, self.study, self.key, self.about | made_by)

    @property
    def about(self) -> dict[str, Any]:
        """What the attributes of a store say of this campaign, whatever the version."""
        studied, code = self.study.studied, self.definition.code_hashes
        return {
            "title": f"{self.study.kind} of {', '.join(m.name for m in studied)}",
            "definition": self.definition.said | {"mechanism": self.definition.mechanism},
            "mechanism_identity": " ".join(m.identity for m in studied),
            "seed": self.study.seed,
        } | ({"code": list(self.definition.code), "code_hashes": list(code)} if code else {})

    def dataset(self) -> Any:
        """Return what the store has as an ``xarray.Dataset``, read lazily; of any version.

        Raises
        ------
        ArtefactError
            When it is of another definition or mechanism.
        """
        data = dataset(self.path)
        for name, mine in self.about.items():
            if data.attrs.get(name) != mine:
                raise ArtefactError(
                    f"{PARTS.get(name, name)} in the store '{self.path}'",
                    value=data.attrs.get(name),
                    limit=mine,
                    remedy="Give the file, --mechanism and --entrant that it was begun with, or "
                    "name another store with --out",
                )
        return data

    def run(
        self,
        executor: Executor,
        *,
        width: int = 1,
        limit: float | None = None,
        resume: bool = False,
        progress: Progress = no_progress,
    ) -> CampaignResult:
        """Compute what the store has not, and return what came of it.

        Parameters
        ----------
        executor
            Where shards are computed: any of :mod:`concurrent.futures`.
        width
            Shards that it computes at once; a few more are handed over.
        limit
            For executors of processes: time after which a shard counts as hanging, s.
        resume
            Go on with the store that is there; what was damaged is computed again.
        progress
            Told how many shards are done.

        Raises
        ------
        ArtefactError
            For a store in use, of another campaign, or that cannot be written.
        ResourceError
            When the executor is lost.
        """
        store = self.open(resume=resume)
        with store.alone():
            repaired = store.repair(self.study) if resume else []
            marks = store.marks()
            outcome = CampaignResult(len(marks), int((marks != 0).sum()), repaired=repaired)
            missing = (
                (k, (work, self.definition, self.key, str(self.path), k, limit))
                for k in (marks == 0).nonzero()[0].tolist()
            )
            clock = time.perf_counter()
            try:
                for shard, future in ended(executor, missing, width):
                    self._count(outcome, shard, future)
                    progress(_words(outcome), outcome.done / outcome.shards)
                    if len(outcome.failures) >= MOST_FAILURES:
                        break
            finally:
                outcome.seconds = time.perf_counter() - clock
        return outcome

    def _count(self, outcome: CampaignResult, shard: int, future: Future[int]) -> None:
        """Count an ended shard; raise what is wrong with the store or the executor."""
        if future.cancelled():
            raise _lost("it cancelled a shard")
        error = future.exception()
        if error is None:
            outcome.done += 1
            outcome.computed += 1
            return
        name = type(error).__name__
        if isinstance(error, ArtefactError | ResourceError):
            raise error
        if name in ("CommClosedError", "FutureCancelledError", "CancelledError"):
            raise _lost(str(error)) from error
        if name in ("KilledWorker", "BrokenProcessPool"):
            words = "its worker died, killed by it, by the system or by the time limit"
        elif isinstance(error, UndertowError):
            words = str(error)
        else:
            words = f"{error_text(error)}{raised_at(error)}"
        outcome.failures[shard] = printable(" ".join(words.split()))


@contextmanager
def executor_for(
    *, threads: int = 1, workers: int = 0, scheduler: str = ""
) -> Iterator[tuple[Executor, int]]:
    """Open threads of this process, workers of this machine, or those of a dask scheduler.

    Yields the executor, and how many shards it computes at once.

    Raises
    ------
    MissingExtraError
        Without dask.distributed.
    ResourceError
        When the scheduler does not answer, or has no workers.
    """
    if not (workers or scheduler):
        if threads == 1:
            yield Serial(), 1
            return
        pool = ThreadPoolExecutor(threads)
        try:
            yield pool, threads
        finally:
            pool.shutdown(cancel_futures=True)
        return
    distributed = require_extra("distributed", "campaign", "workers are dask.distributed's")
    dask = require_extra("dask", "campaign", "workers are dask.distributed's")
    settings = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.scheduler.worker-saturation": 1.0,  # a dead one had one shard, no other's
        "distributed.admin.tick.limit": "1h",
        "distributed.comm.timeouts.connect": "20s",
        "distributed.worker.preload": [*dask.config.get("distributed.worker.preload", []), DEAF],
    }
    with dask.config.set(settings):
        cluster = None
        try:
            if workers:
                cluster = distributed.LocalCluster(
                    n_workers=workers, threads_per_worker=1, dashboard_address="127.0.0.1:0",
                    silence_logs=logging.CRITICAL,
                )  # fmt: skip
            with distributed.Client(cluster or scheduler, set_as_default=False) as client:
                if not workers:
                    client.wait_for_workers(1, timeout=20)
                width = sum(client.nthreads().values())
                yield client.get_executor(pure=False), width
        except UndertowError:
            raise
        except (OSError, RuntimeError) as error:  # of dask: no scheduler, no workers, timeouts
            raise _lost(str(error)) from error
        finally:
            if cluster is not None:
                cluster.close()


def _lost(words: str) -> ResourceError:
    return ResourceError(
        "workers of the campaign",
        value=printable(words)[:200],
        limit="a scheduler that answers, with workers",
        remedy="Start it again, then go on with --resume: finished shards are kept",
    )


def _words(outcome: CampaignResult) -> str:
    """Say how far a campaign is; a new sentence at each per cent."""
    failed = f", {len(outcome.failures)} failed" if outcome.failures else ""
    return f"{100 * outcome.done // outcome.shards} % of {outcome.shards} shards{failed}"
