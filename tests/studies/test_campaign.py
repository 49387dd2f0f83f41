"""Campaigns: the same bits from every executor, and nothing lost, twice or mixed by any fault."""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import undertow as ut
from support import rest_slow
from undertow.base import (
    ArtefactError,
    InvalidInputError,
    ModelError,
    ResourceError,
    UndertowError,
)
from undertow.cli import app
from undertow.closed_loop import ClosedLoop, Event
from undertow.runtime.processes import fork
from undertow.studies.campaign import (
    Campaign,
    Definition,
    Store,
    compute,
    dataset,
    digest,
    executor_for,
)
from undertow.studies.campaign.figures import (
    picture,
    picture_file,
    proved_set,
)
from undertow.studies.campaign.report import alone, status
from undertow.studies.campaign.report import tables as tables_of
from undertow.studies.campaign.run import study_of
from undertow.studies.survey import survey

pytest.importorskip("zarr")
xarray = pytest.importorskip("xarray")
distributed = pytest.importorskip("distributed")
cloudpickle = pytest.importorskip("cloudpickle")
cloudpickle.register_pickle_by_value(sys.modules[__name__])

RIG = "rotary_pendulum"
AXES = {
    "phi": {"from": -1.2, "to": 1.2, "count": 12},
    "phi_dot": {"from": -8.0, "to": 8.0, "count": 8},
}
REGION: dict[str, Any] = {"kind": "region", "axes": AXES, "horizon": 8.0, "shard": 16}
PLANTS: dict[str, Any] = {"kind": "plants", "plants": 4, "shard": 1, "seconds": 0.3}
DESIGNS: dict[str, Any] = {
    "kind": "designs", "plants": 4, "start": {"phi": 0.2}, "horizon": 5.0,
    "axes": {"l": {"from": 0.15, "to": 0.18, "count": 4}},
}  # fmt: skip

MAP = Definition.of(RIG, **REGION)


def run(definition: Definition, path: Path, **how: Any) -> Store:
    """Run a campaign to its end."""
    with executor_for(**how) as (pool, width):
        outcome = Campaign(definition, path).run(pool, width=width)
    assert outcome.complete, outcome.failures
    return Store(path)


def content(path: Path) -> dict[str, bytes]:
    """All that a store says, but where its definition was."""
    return {
        str(file.relative_to(path)): file.read_bytes()
        for file in sorted(path.rglob("*"))
        if file.is_file()
    }


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("campaign") / "serial"
    run(MAP, path)
    return path


def resumed(path: Path) -> Any:
    with executor_for() as (pool, _):
        return Campaign(MAP, path).run(pool, resume=True)


def test_a_map_says_what_rollouts_say(serial: Path) -> None:
    """Every state of the slice, from the store, against a batch of its own."""
    rig = ut.mechanisms.rotary_pendulum()
    data = dataset(serial)
    phi, phi_dot = np.meshgrid(data.phi.values, data.phi_dot.values, indexing="ij")
    states = np.zeros((phi.size, 4))
    states[:, 1], states[:, 3] = phi.ravel(), phi_dot.ravel()
    loop = ClosedLoop(rig, ut.MinimumEnergy(horizon=8.0))  # small steps to the end
    batch = loop.batch(states, ut.first_surface(rig))
    home = batch.event == Event.REACHED
    assert 0.2 < home.mean() < 0.9
    assert (data.event.values.ravel() == batch.event).all()
    assert data.time.values.ravel()[home] == pytest.approx(batch.time[home], rel=1e-2)
    assert data.cost.values.ravel()[home] == pytest.approx(batch.cost[home], rel=1e-2)
    assert np.isnan(data.time.values.ravel()[~home]).all()


def test_a_store_is_read_lazily_with_units_and_provenance(serial: Path) -> None:
    data = dataset(serial)
    assert data.cost.chunks == ((2,) * 6, (8,))
    assert (data.cost.attrs["units"], data.phi_dot.attrs["units"]) == ("V² s", "rad/s")
    assert data.attrs["definition"]["mechanism"] == RIG
    assert data.attrs["definition"]["axes"] == AXES
    assert data.attrs["versions"]["numba"]


def test_states_on_the_surface_are_on_it() -> None:
    axes = {"phi": {"from": -0.5, "to": 0.5, "count": 3}, "theta": AXES["phi"]}
    campaign = Definition.of(RIG, kind="region", axes=axes, sliding=True)
    study: Any = Campaign(campaign, Path("nowhere")).study
    _, states = study.states(0)
    s = study.surface
    n, m = 2, 1
    rest = states[:, :m] @ s.lambda_a.T + states[:, m:n] @ s.lambda_u.T
    rest += states[:, n : n + m] @ s.alpha_a.T + states[:, n + m :] @ s.alpha_u.T
    assert abs(rest).max() < 1e-12
    assert abs(states[:, 2]).max() > 1


@pytest.mark.parametrize(
    "how",
    rest_slow([{"threads": 2}, {"workers": 1}, {"workers": 2}, {"workers": 4}], {"threads": 2}),
    ids=str,
)
def test_every_executor_writes_the_same_bits(
    serial: Path, tmp_path: Path, how: dict[str, int]
) -> None:
    run(MAP, tmp_path / "other", **how)
    assert content(tmp_path / "other") == content(serial)


def test_costs_of_contenders_are_compared_over_balanced_runs_alone() -> None:
    """A run that was lost in the first second cost next to nothing."""
    study = study_of(Definition.of(RIG, kind="plants", plants=3, controllers=["kept", "lqr"]))
    found: dict[str, Any] = {
        "kept_balanced": [1, 0, 1], "kept_settled": [1.0, np.inf, 2.0],
        "kept_cost": [4.0, 0.001, 6.0], "kept_chatter": [7.0, 900.0, 9.0],
        "lqr_balanced": [0, 0, -1], "lqr_settled": [np.inf, np.inf, np.nan],
        "lqr_cost": [0.1, 0.2, np.nan], "lqr_chatter": [1.0, 1.0, np.nan],
    }  # fmt: skip
    data = xarray.Dataset({k: ("plant", np.array(v)) for k, v in found.items()})
    data.attrs["title"] = "plants of a rig"
    console = Console(width=100, record=True, file=io.StringIO())
    console.print(*study.report(data))
    rows = [line.split() for line in console.export_text().splitlines()]
    assert ["kept", "2", "of", "3", "1.5", "5", "6", "8"] in rows
    assert ["lqr", "0", "of", "2", "—", "—", "—", "—"] in rows


@pytest.mark.slow
@pytest.mark.parametrize("said", [PLANTS, DESIGNS], ids=["plants", "designs"])
def test_studies_of_plants_and_designs_have_the_same_bits_too(
    said: dict[str, Any], tmp_path: Path
) -> None:
    definition = Definition.of(RIG, **said)
    run(definition, tmp_path / "serial")
    for how in ({"threads": 2}, {"workers": 1}, {"workers": 2}, {"workers": 4}):
        path = tmp_path / str(how)
        run(definition, path, **how)
        assert content(path) == content(tmp_path / "serial"), how
    data = dataset(tmp_path / "serial")
    assert all(np.isfinite(data[name]).any() for name in ("energy", "lqr_cost") if name in data)


class Faulty(Executor):
    """Another executor, on which one shard is spoilt."""

    def __init__(self, pool: Executor, shard: int, fault: Callable[..., Any]) -> None:
        self.pool, self.shard, self.fault = pool, shard, fault

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        if args[3] == self.shard:
            return self.pool.submit(self.fault, fn, *args)
        return self.pool.submit(fn, *args)


def killed_once(fn: Callable[..., Any], *args: Any) -> Any:
    """The first time, SIGKILL when one array of the shard is written and the others are not."""
    from undertow.studies.campaign import run as module

    mark = Path(args[2]).with_suffix(".killed")
    if not mark.exists():
        mark.touch()
        study, store = module.study_of(args[0]), Store(Path(args[2]))
        store._arrays["event"][study.part(args[3])] = compute(args[0], args[3])["event"]
        os.kill(os.getpid(), signal.SIGKILL)
    return fn(*args)


def segfaults(fn: Callable[..., Any], *args: Any) -> Any:
    os.kill(os.getpid(), signal.SIGSEGV)


def hangs(fn: Callable[..., Any], *args: Any) -> Any:
    from undertow.studies.campaign import run as module

    module.compute = lambda *_: time.sleep(600)  # type: ignore[assignment]
    return fn(*args)


@pytest.mark.slow
def test_a_worker_killed_in_the_middle_of_a_shard_loses_nothing(
    serial: Path, tmp_path: Path
) -> None:
    path = tmp_path / "store"
    with executor_for(workers=1) as (pool, width):
        outcome = Campaign(MAP, path).run(Faulty(pool, 2, killed_once), width=width)
    assert path.with_suffix(".killed").exists()
    assert outcome.complete, outcome.failures
    assert content(path) == content(serial)


@pytest.mark.slow
@pytest.mark.parametrize("fault", [segfaults, hangs])
def test_a_shard_that_kills_its_worker_is_named_and_the_rest_is_kept(
    serial: Path, tmp_path: Path, fault: Callable[..., Any]
) -> None:
    path = tmp_path / "store"
    with executor_for(workers=1) as (pool, width):
        campaign = Campaign(MAP, path)
        outcome = campaign.run(Faulty(pool, 3, fault), width=width, limit=20.0)
    assert outcome.done == outcome.shards - 1
    assert list(outcome.failures) == [3]
    assert "worker died" in outcome.failures[3]
    assert resumed(path).computed == 1
    assert content(path) == content(serial)


SCHEDULER = """
import distributed, logging, sys
if __name__ == "__main__":
    cluster = distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None,
                                       silence_logs=logging.CRITICAL)
    print(cluster.scheduler_address, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A scheduler with a worker, in a process of their own."""
    script = tmp_path / "scheduler.py"
    script.write_text(SCHEDULER)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        stderr=subprocess.DEVNULL, env=environment,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        yield process, process.stdout.readline().strip()
        process.kill()


@pytest.mark.slow
def test_a_campaign_goes_on_when_its_scheduler_was_killed(
    serial: Path, tmp_path: Path, scheduler: tuple[subprocess.Popen[str], str]
) -> None:
    process, address = scheduler
    path = tmp_path / "store"

    def stop(_what: str, _part: float) -> None:
        process.kill()

    with (
        pytest.raises(ResourceError, match=r"workers of the campaign.*--resume"),
        executor_for(scheduler=address) as (pool, width),
    ):
        Campaign(MAP, path).run(pool, width=width, progress=stop)
    outcome = resumed(path)
    assert outcome.complete
    assert outcome.computed < outcome.shards
    assert content(path) == content(serial)


def test_a_process_killed_in_between_is_resumed(serial: Path, tmp_path: Path) -> None:
    """Kill -9 of everything after some shards; nothing finished is computed again."""
    path = tmp_path / "store"

    def stop(_what: str, part: float) -> None:
        if part > 0.4:
            os.kill(os.getpid(), signal.SIGKILL)

    def work() -> None:
        with executor_for(threads=2) as (pool, width):
            Campaign(MAP, path).run(pool, width=width, progress=stop)

    ended = fork(work, (), "a campaign that is killed", daemon=False)
    ended.join(60.0)
    assert ended.exitcode == -signal.SIGKILL
    marked = int((Store(path).marks() != 0).sum())
    assert 3 <= marked < 6
    outcome = resumed(path)
    assert (outcome.computed, outcome.complete) == (6 - marked, True)
    assert content(path) == content(serial)


def spoil(path: Path, how: str) -> None:
    """Damage one chunk of shard 2 and one of shard 4, and the mark of shard 5."""
    chunk = path / "cost" / "c" / "2" / "0"
    if how == "half-written":
        chunk.write_bytes(chunk.read_bytes()[: chunk.stat().st_size // 2])
    elif how == "missing":
        chunk.unlink()
    else:
        chunk.write_bytes((path / "cost" / "c" / "3" / "0").read_bytes())
    (path / "time" / "c" / "4" / "0").write_bytes(b"")
    (path / "done" / "c" / "5").write_bytes(b"123")
    (path / "cost" / "c" / "1" / "0.abcdef.partial").write_bytes(b"left by a killed worker")


@pytest.mark.parametrize("how", ["half-written", "missing", "of another shard"])
def test_damaged_chunks_are_found_and_computed_again(
    serial: Path, tmp_path: Path, how: str
) -> None:
    path = tmp_path / "store"
    run(MAP, path)
    spoil(path, how)
    for look in (picture, tables_of):
        with pytest.raises(ArtefactError, match=r"Go on with --resume"):
            look(Campaign(MAP, path))
    found = Campaign(MAP, path)
    shards, damaged, missing = status(found)
    assert f" {found.study.shards - 3} of {found.study.shards} shards" in shards
    assert damaged.startswith("damaged: shards 2, 4; ")
    assert missing == "not in it: 5"
    assert "is damaged there" in alone(found, 4)[0]
    outcome = resumed(path)
    assert outcome.repaired == [2, 4]
    assert (outcome.computed, outcome.complete) == (3, True)
    assert content(path) == content(serial)


@pytest.mark.slow
def test_a_full_disk_ends_the_campaign_and_keeps_what_is_done(serial: Path, tmp_path: Path) -> None:
    """Files of at most so many bytes, by the system: a write fails in its middle."""
    path = tmp_path / "store"
    code = f"""
import resource, signal
from pathlib import Path
from undertow.base import ArtefactError
from undertow.studies.campaign import *
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
campaign = Campaign(Definition({MAP.mechanism!r}, {MAP.text!r}), Path({str(path)!r}))
def full(what, part):
    if part > 0.3: resource.setrlimit(resource.RLIMIT_FSIZE, (16, 16))
with executor_for() as (pool, width):
    try:
        campaign.run(pool, width=1, progress=full)
    except ArtefactError as error:
        print(error)
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    ended = subprocess.run(
        [sys.executable, "-c", code], env=environment, check=True, timeout=300,
        capture_output=True, text=True,
    )  # fmt: skip
    assert "File too large" in ended.stdout
    assert "--resume" in ended.stdout
    done = int((Store(path).marks() != 0).sum())
    assert 2 <= done < 6
    assert resumed(path).computed == 6 - done
    assert content(path) == content(serial)


def test_a_changed_definition_is_refused(serial: Path) -> None:
    before = content(serial)
    with executor_for() as (pool, _):
        for other, what in (
            (Definition.of(RIG, **REGION | {"horizon": 9.0}), "another definition,"),
            (
                Definition.of(RIG, **REGION, parameters={"m": 0.13}),
                "another definition and another mechanism,",
            ),
            (Definition.of("cart_pendulum", **REGION), "another mechanism,"),
        ):
            with pytest.raises(ArtefactError, match=rf"another campaign.*{what}.*--out"):
                Campaign(other, serial).run(pool, resume=True)
        with pytest.raises(ArtefactError, match=r"a store that is there.*--resume"):
            Campaign(MAP, serial).run(pool)
        with pytest.raises(ArtefactError, match=r"in the store.*that it was begun with"):
            Campaign(Definition.of("cart_pendulum", **REGION), serial).dataset()
    assert content(serial) == before


def test_a_folder_that_is_no_store_is_not_to_be_resumed(tmp_path: Path) -> None:
    """It was: --resume then answered that there is no store."""
    (tmp_path / "notes").mkdir()
    with executor_for() as (pool, _), pytest.raises(ArtefactError, match="something else") as said:
        Campaign(MAP, tmp_path / "notes").run(pool)
    assert "--resume" not in str(said.value)


def test_a_definition_without_a_mechanism_says_how_to_name_one(tmp_path: Path) -> None:
    file = tmp_path / "map.toml"
    file.write_text('kind = "region"')
    with pytest.raises(InvalidInputError, match=r"got none.*or --mechanism"):
        Definition.read(file)


def test_two_campaigns_at_once_do_not_share_a_store(serial: Path) -> None:
    with (
        executor_for() as (pool, _),
        Store(serial).alone(),
        pytest.raises(ArtefactError, match="another process"),
    ):
        Campaign(MAP, serial).run(pool, resume=True)
    assert resumed(serial).computed == 0


def test_a_shard_that_raises_is_named_and_others_go_on(
    serial: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "store"
    campaign = Campaign(MAP, path)
    good = type(campaign.study).compute

    def bad(study: Any, shard: int) -> Any:
        if shard == 1:
            raise FloatingPointError("it went wrong")
        return good(study, shard)

    with monkeypatch.context() as patch, executor_for(threads=2) as (pool, width):
        patch.setattr(type(campaign.study), "compute", bad)
        outcome = campaign.run(pool, width=width)
    assert list(outcome.failures) == [1]
    assert "FloatingPointError: it went wrong" in outcome.failures[1]
    assert resumed(path).computed == 1
    assert content(path) == content(serial)


OWN = """
import sympy as sp
import undertow as ut

x, a = ut.Coordinate("x", "m", low=-0.8, high=0.8), ut.Coordinate("a", "rad")
mass = ut.Parameter("m", 0.3, "kg", low=0.0)
m, v, w, c = mass.symbol, x.velocity, a.velocity, sp.cos(a.symbol)
own = ut.Mechanism.from_energies(
    "own", [x, a], [ut.Input("F", "N", 9.0)],
    kinetic=(1 + m) * v**2 / 2 + m * c * v * w / 4 + m * w**2 / 24, potential=2.5 * m * c,
    parameters=(mass,), start={"a": 0.1},
)
"""


@pytest.mark.parametrize(
    ("said", "edited"),
    [
        ("low=-0.8", "low=-0.7"),
        ('"x", "m"', '"x", "rad"'),
        ("0.3, ", "0.31, "),
        ("low=0.0", "low=0.1"),
        ("9.0", "8.0"),
        ("0.1}", "0.2}"),
    ],
)
def test_another_mechanism_in_the_same_file_is_another_campaign(
    said: str, edited: str, tmp_path: Path
) -> None:
    """Its travel and units decide results as its equations do: edited, they were the same store."""
    axes = {"a": {"from": -0.1, "to": 0.1, "count": 2}}
    keys, surveyed = [], []
    for folder, text in (("one", OWN), ("two", OWN.replace(said, edited))):
        path = tmp_path / folder / "own.py"
        path.parent.mkdir()
        path.write_text(text)
        definition = Definition.of(f"{path}:own", kind="region", axes=axes)
        keys.append(Campaign(definition, tmp_path / "map.zarr").key)
        surveyed += survey([f"{path}:own"], bounds=False).settings["models"]
    assert len({*keys}) == len({*surveyed}) == 2


def test_a_worker_of_another_version_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "store"
    campaign = Campaign(MAP, path)
    campaign.key = "0" * 64  # of the store, not of what a worker finds
    with executor_for() as (pool, _), pytest.raises(ResourceError, match="another version"):
        campaign.run(pool)
    assert not Store(path).marks().any()


@pytest.mark.slow
def test_ctrl_c_ends_workers_without_their_tracebacks(tmp_path: Path) -> None:
    """A terminal sends it to every process of the command."""
    file, out = tmp_path / "map.toml", tmp_path / "map.zarr"
    file.write_text(TOML.replace("count = 12", "count = 4000"))  # 2,000 shards
    hears = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code = f"{hears}from undertow.cli import main; main()"
    with subprocess.Popen(
        [sys.executable, "-c", code, "campaign", str(file), "--out", str(out), "--workers", "2"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    ) as process:  # fmt: skip
        assert process.stdout is not None
        said = ""
        for line in process.stdout:
            said += line
            if "% of" in line:
                os.killpg(process.pid, signal.SIGINT)
                break
        said += process.stdout.read()
    assert process.returncode == 130
    assert "Traceback" not in said
    assert "go on with --resume" in said
    assert 0 < (Store(out).marks() != 0).sum() < 2000


TOML = """
kind = "region"
mechanism = "rotary_pendulum"
horizon = 8.0
shard = 16
[axes.phi]
from = -1.2
to = 1.2
count = 12
[axes.phi_dot]
from = -8.0
to = 8.0
count = 8
"""


def test_the_command_line_runs_shows_and_repeats_a_shard(serial: Path, tmp_path: Path) -> None:
    file, out = tmp_path / "map.toml", tmp_path / "map.zarr"
    file.write_text(TOML)
    told = ["campaign", str(file), "--out", str(out)]
    runner = CliRunner()
    made = runner.invoke(app, [*told, "--threads", "2"])
    assert made.exit_code == 0, made.output
    assert "6 of 6 shards" in made.output
    assert Store(out).about["key"] == Store(serial).about["key"]
    assert (Store(out).marks() == Store(serial).marks()).all()
    shown = runner.invoke(app, [*told, "--status"])
    assert "6 of 6 shards" in shown.output
    again = runner.invoke(app, [*told, "--shard", "4"])
    assert "the same bits as in the store" in again.output
    found = digest(compute(MAP, 4))
    assert f"{found:016x}" in again.output
    campaign = Campaign(Definition.read(file), out)
    arrays = compute(campaign.definition, 4)
    arrays["cost"] = arrays["cost"].astype(float) * 1.001
    Store(out).write(campaign.study, 4, arrays)
    Store(out)._group.attrs["processor"] = "an older one"
    changed = " ".join(runner.invoke(app, [*told, "--shard", "4"]).output.split())
    assert re.search(r"the store has other bits: cost at \d+ of 16, by \S+ at most; ", changed)
    assert "another processor, an older one; this is" in changed
    for wrong, words in (
        (["--shard", "6"], "0 to 5"),
        (["--limit", "3"], "--workers 1"),
        (["--threads", "2", "--workers", "1"], "two places"),
        (["--status", "--tables"], "--tables and --status"),
        ([], "--resume"),
    ):
        refused = runner.invoke(app, [*told, *wrong])
        assert refused.exit_code != 0
        assert words in " ".join(refused.output.split())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "regions"}, "one of region, plants, designs"),
        ({"shards": 3}, "Did you mean shard?"),
        ({"shard": 0}, "a whole number from 1"),
        ({"horizon": "long"}, "a number from"),
        ({"axes": {"phi": {"from": np.nan, "to": 1.0, "count": 2}}}, "axes.phi.from.*finite"),
        ({"axes": {"psi": {"from": 0.0, "to": 1.0, "count": 2}}}, "theta, phi"),
        ({"axes": {"phi": {"from": 0.0, "to": 1.0}}}, "axes.phi.count"),
        ({"axes": {"phi": {"from": 0.0, "to": 1.0, "count": 1}}}, "axes.phi.count.*1 from 0 to 1"),
        ({"axes": {"phi": {"from": 1.0, "to": 1.0, "count": 9}}}, "axes.phi.count.*9 from 1 to 1"),
        (
            {"axes": {a: {"from": 0.0, "to": 1.0, "count": 10**7} for a in ("phi", "theta")}},
            "shards of the campaign.*1e\\+06",
        ),
        ({"axes": {"phi": {"from": -90.0, "to": 90.0, "count": 3}}}, "-90 to 90 rad.*two turns"),
        ({"axes": {}}, "states among theta"),
        ({"at": {"phi": 0.1}}, "one of theta"),
        ({"surface": [1.0, 2.0]}, "4 numbers"),
        ({"parameters": {"mass": 1.0}}, "mass"),
        ({"limits": {"voltage": -1.0}}, "voltage"),
        ({"objective": "beauty"}, "one of energy"),
        ({"sliding": "yes"}, "true or false"),
        ({"µ": 1.0, "μ": 2.0}, "U\\+00B5"),
    ],
)
def test_wrong_settings_are_refused_by_name(change: dict[str, Any], words: str) -> None:
    with pytest.raises((InvalidInputError, ModelError), match=words):
        Campaign(Definition.of(RIG, **REGION | change), Path("nowhere"))


def test_steps_that_a_fast_mode_makes_unstable_are_refused() -> None:
    """An arm in oil: its map said that nothing comes home, and simulated motions did."""
    oil, axes = {"d_e": 10.0}, {"phi": {"from": 0.002, "to": 0.004, "count": 2}}
    asked: dict[str, Any] = {"kind": "region", "parameters": oil, "axes": axes}
    with pytest.raises(InvalidInputError, match=r"'step'.*got 0\.002 s, must be at most"):
        study_of(Definition.of(RIG, **asked))
    fine: Any = study_of(Definition.of(RIG, **asked, step=1e-4))
    found = fine.compute(0)
    for phi, event, home in zip((0.002, 0.004), found["event"], found["time"], strict=True):
        damped = ut.mechanisms.rotary_pendulum().with_parameters(**oil)
        loop = ClosedLoop(damped, fine.loop.objective)
        motion = loop.simulate(damped.state(phi=phi), fine.surface)
        assert (event, motion.event) == (Event.REACHED, Event.REACHED)
        assert home == pytest.approx(motion.time, rel=1e-3)


def test_names_of_ones_own_are_spelt_as_they_are_or_refused(tmp_path: Path) -> None:
    """The µ of keyboards is the Greek one; a state called like what is recorded was a traceback."""
    code = tmp_path / "own.py"
    code.write_text(
        "import undertow as ut\n"
        "def make(name):\n"
        "    x, a = ut.Coordinate('x', 'm'), ut.Coordinate(name, 'rad')\n"
        "    v, w, c = x.velocity, a.velocity, __import__('sympy').cos(a.symbol)\n"
        "    return ut.Mechanism.from_energies('own', [x, a], [ut.Input('F', 'N', 9.0)],\n"
        "        kinetic=v**2/2 + c*v*w/5 + w**2/9, potential=2*c)\n"
        "greek, cost = make('µ'), make('cost')\n"
    )
    axis = {"from": -0.1, "to": 0.1, "count": 2}
    named = f"{code}:greek"
    keyboard = Definition.of(named, kind="region", axes={"µ": axis}, at={"µ_dot": 0.1})
    study: Any = study_of(keyboard)
    assert [a.name for a in study.axes] == ["μ"]
    assert study.at[-1] == 0.1
    with pytest.raises(InvalidInputError, match="axis 'cost' of the campaign"):
        study_of(Definition.of(f"{code}:cost", kind="region", axes={"cost": axis}))


CASE = {"surface": [-1.0, -1.59, 1.96, 12.1], "sliding": True, "kind": "region"}
ON_SURFACE = {
    "phi": {"from": -1.2, "to": 1.2, "count": 41},
    "theta": {"from": -6.0, "to": 6.0, "count": 41},
}
REGIONS = Path(__file__).parents[1] / "data" / "regions.json"


def test_every_state_of_a_proved_region_comes_home_without_a_limit() -> None:
    """The proof knows no input limit: then simulation must agree, and with 15 V it need not."""
    limited = Campaign(Definition.of(RIG, **CASE, axes=ON_SURFACE), Path("nowhere"))
    study: Any = limited.study
    proved: Any = proved_set(study, REGIONS)
    _, states = study.states(0)
    with np.errstate(all="ignore"):
        inside = proved(study.surface.sliding_coordinates(states)) <= 1.0
    assert 0.4 < inside.mean() < 0.9
    free = Definition.of(RIG, **CASE, axes=ON_SURFACE, limits={"voltage": 1e6})
    assert (compute(free, 0)["event"].ravel()[inside] == Event.REACHED).all()
    with_limit = compute(limited.definition, 0)["event"].ravel()[inside] == Event.REACHED
    assert 0.98 < with_limit.mean() < 1.0
    other: Any = Campaign(Definition.of(RIG, **CASE | {"surface": [-1, -1.6, 2, 12]},
                                        axes=ON_SURFACE), Path("nowhere")).study  # fmt: skip
    with pytest.raises(InvalidInputError, match="no region on this surface"):
        proved_set(other, REGIONS)


@pytest.mark.slow
def test_pictures_show_slices_volumes_and_proved_sets(serial: Path, tmp_path: Path) -> None:
    flat = picture(Campaign(MAP, serial))
    time, cost = flat.axes[:2]
    assert (time.get_xlabel(), time.get_ylabel()) == ("φ (°)", "φ̇ (°/s)")
    drawn: Any = cost.collections[-1].get_array()
    shown = np.ma.filled(drawn, np.nan)
    assert np.nanmax(abs(shown - dataset(serial).cost.values.T)) == 0
    few = {name: axis | {"count": 21} for name, axis in ON_SURFACE.items()}
    on_surface = Definition.of(RIG, **CASE, axes=few)
    run(on_surface, tmp_path / "on")
    image, words = picture_file(Campaign(on_surface, tmp_path / "on"), REGIONS)
    assert image.startswith(b"\x89PNG")
    assert "in the proved region" in words[0]
    with pytest.raises(InvalidInputError, match="sliding = true"):
        picture(Campaign(MAP, serial), proved_set(study_of(on_surface), REGIONS))  # type: ignore[arg-type]
    axes = AXES | {"theta_dot": {"from": -1.0, "to": 1.0, "count": 3}}
    volume = Definition.of(RIG, **REGION | {"axes": axes})
    run(volume, tmp_path / "volume")
    panels = picture(Campaign(volume, tmp_path / "volume")).axes
    assert [a.get_title(loc="left") for a in panels[:3]][1] == "θ̇ = 0°/s"
    with pytest.raises(ArtefactError, match="definition in the store"):
        picture(Campaign(volume, serial))


@pytest.mark.slow
def test_a_terminal_set_is_drawn_where_states_are_off_the_surface(tmp_path: Path) -> None:
    """Its edge in the slice is |W x| = ρ, and what is said of its reach is that of the edge."""
    rig = ut.mechanisms.rotary_pendulum()
    told = ["certify", RIG, "--seconds", "0", "--out", str(tmp_path)]
    assert CliRunner().invoke(app, told).exit_code == 0
    proof = tmp_path / "certificate.json"
    axes = {"phi": AXES["phi"] | {"count": 3}, "theta_dot": AXES["phi_dot"] | {"count": 3}}
    definition = Definition.of(RIG, **REGION | {"axes": axes})
    run(definition, tmp_path / "store")
    campaign: Any = Campaign(definition, tmp_path / "store")
    proved: Any = proved_set(campaign.study, proof)
    panel = picture(campaign, proved).axes[0].child_axes[0]
    phi, rate = np.radians(np.asarray(panel.lines[0].get_data()))
    states = np.zeros((len(phi), 4))
    states[:, 1], states[:, 2] = phi, rate
    assert proved.level(states) == pytest.approx(1.0, abs=1e-9)
    home = ClosedLoop(rig, ut.MinimumEnergy(horizon=8.0)).batch(states, ut.first_surface(rig))
    assert home.reached.all()
    (words,) = picture_file(campaign, proof)[1]
    reach = [float(v) for v in re.findall(r"± ([\d.e-]+)", words)]
    assert reach == pytest.approx([np.degrees(v).max() for v in (phi, rate)], rel=1e-2)
    for other in ({"surface": [-1.0, -1.59, 1.96, 12.1]}, {"limits": {"voltage": 5.0}}):
        changed: Any = study_of(Definition.of(RIG, **REGION | other))
        with pytest.raises(UndertowError):
            proved_set(changed, proof)
    aside = Campaign(Definition.of(RIG, **REGION, at={"theta": 0.1}), tmp_path / "aside")
    run(aside.definition, aside.path)
    with pytest.raises(InvalidInputError, match="other states at the target"):
        picture(aside, proved)


def test_a_definition_runs_no_code(tmp_path: Path) -> None:
    """A Python file is run where the command line names it, and its content counts."""
    code = tmp_path / "own.py"
    code.write_text("import undertow as ut\nrig = ut.mechanisms.rotary_pendulum(m=0.1)\n")
    file = tmp_path / "map.toml"
    file.write_text(TOML.replace("rotary_pendulum", f"{code}:rig"))
    with pytest.raises(InvalidInputError, match="--mechanism"):
        Definition.read(file)
    named = Definition.read(file, f"{code}:rig")
    first = Campaign(named, tmp_path / "store")
    assert first.study.mechanism.parameter_values[2] == 0.1
    file.write_text("kind = ")
    with pytest.raises(ArtefactError, match="TOML"):
        Definition.read(file)
    code.write_text("raise SystemExit('it was run')\n")
    for more in ("", f'mechanism = "{RIG}"\n'):
        file.write_text(f'{more}kind = "league"\nmechanisms = ["{RIG}", "{code}:rig"]\n')
        with pytest.raises(InvalidInputError, match="--mechanism"):
            study_of(Definition.read(file))


def test_model_files_lie_beside_the_definition(tmp_path: Path) -> None:
    """With joints behind their names, and among several mechanisms, too."""
    (tmp_path / "own.urdf").write_text("<robot/>")
    whole = f"{tmp_path / 'own.urdf'}:j_1"
    file = tmp_path / "map.toml"
    file.write_text('mechanism = "own.urdf:j_1"')
    assert Definition.read(file).mechanism == whole
    file.write_text(f'mechanisms = ["{RIG}", "own.urdf:j_1"]')
    assert Definition.read(file).said["mechanisms"] == [RIG, whole]
