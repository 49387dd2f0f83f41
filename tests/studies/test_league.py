"""The league: anybody's controller is run as ours are, and what it does wrong costs it alone."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest
from typer.testing import CliRunner

from undertow.base import ArtefactError, InvalidInputError, as_text
from undertow.cli import app
from undertow.mechanisms import LIBRARY
from undertow.models import linearise
from undertow.objective import objective_for
from undertow.plants import Encoder, RealisticRig
from undertow.plants.bench import bench_for
from undertow.runtime import estimator_for
from undertow.studies.campaign import Campaign, Definition, compute, dataset, executor_for
from undertow.studies.campaign.definition import Settings
from undertow.studies.campaign.entrants import FAULTS, ForfeitError, Refereed, steered
from undertow.studies.campaign.league import TASKS, VERSION, League, home
from undertow.studies.campaign.league_report import median_interval, tables, wilson
from undertow.studies.campaign.report import alone
from undertow.studies.campaign.run import study_of
from undertow.studies.trials.steering import CascadeSteering

pytest.importorskip("zarr")
pytest.importorskip("casadi")

RIG = "rotary_pendulum"
LEAGUE: dict[str, Any] = {
    "kind": "league", "mechanisms": [RIG], "entrants": ["lqr"], "tasks": ["exact"], "plants": 1,
    "seconds": 4.0,
}  # fmt: skip

OTHERS = '''
import numpy as np
from scipy.linalg import solve_continuous_are
from undertow.mechanisms import LIBRARY
from undertow.models import linearise


class Gains:
    """Linear feedback; one of its settings has the wrong sign."""

    settings = [{"sign": 1.0}, {"sign": -1.0}]

    def __init__(self, mechanism, objective, sign):
        lin = linearise(mechanism)
        P = solve_continuous_are(lin.A, lin.input, np.eye(4), np.eye(1))
        self.K = sign * lin.input.T @ P

    def reset(self, x0):
        pass

    def step(self, t, x):
        return -self.K @ x


class Idle:
    def __init__(self, mechanism, objective):
        self.mechanism = mechanism

    def reset(self, x0):
        pass

    def step(self, t, x):
        return np.zeros(1)


class Raises(Idle):
    def step(self, t, x):
        return 1 / 0


class Unbegun:
    def __init__(self, mechanism, objective):
        pass

    def step(self, t, x):
        return np.zeros(1)


class Wide(Idle):
    def step(self, t, x):
        return np.zeros(2)


class Nothing(Idle):
    def step(self, t, x):
        return [np.nan if t > 0.5 else 0.0]


class Complex(Idle):
    def step(self, t, x):
        return [0.1 + 0.1j]


class Leaves(Idle):
    def step(self, t, x):
        raise SystemExit


class Huge(Idle):
    def step(self, t, x):
        return [1e9]


OTHER = 3


class Unmade(Idle):
    def __init__(self, mechanism, objective):
        raise RuntimeError("not for this mechanism")
'''


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("others") / "others.py"
    path.write_text(OTHERS, encoding="utf-8")
    return path


def test_a_mechanism_without_a_start_is_refused_before_any_work() -> None:
    """Not shard by shard."""
    still = replace(LIBRARY[RIG](), start={})
    settings = Settings({k: LEAGUE[k] for k in ("entrants", "tasks", "plants")}, "")
    with pytest.raises(InvalidInputError, match="start of 'rotary_pendulum': got none"):
        League(still, settings)


def entered(file: Path, *names: str, **changes: Any) -> Definition:
    definition = Definition.of(RIG, **LEAGUE | changes)
    return Definition(definition.mechanism, definition.text, tuple(f"{file}:{n}" for n in names))


def found(definition: Definition, *names: str) -> dict[str, dict[str, Any]]:
    """Arrays of a league of one mechanism by entrant."""
    entrants = study_of(definition).axes[1].words
    return {k: compute(definition, i) for i, k in enumerate(entrants) if k in (names or entrants)}


def test_what_an_entrant_does_wrong_costs_it_alone(file: Path) -> None:
    wrong = {
        "Raises": "raised", "Unmade": "raised", "Unbegun": "raised", "Wide": "wrong_shape",
        "Nothing": "not_finite", "Complex": "wrong_shape", "Leaves": "raised",
    }  # fmt: skip
    others = *wrong, "Idle", "Huge"
    rows = found(entered(file, *others, seconds=2.0), *others)
    for name, fault in wrong.items():
        assert FAULTS[int(rows[name]["fault"].item())] == fault
        assert rows[name]["won"].item() == 0
    for name in ("Idle", "Huge"):  # no fault: the actuator has its limit, the pendulum falls
        assert (rows[name]["fault"].item(), rows[name]["won"].item()) == (0, 0)


def test_a_shard_alone_says_why_runs_were_forfeited(file: Path, tmp_path: Path) -> None:
    """What raised was told nowhere: whoever wrote it saw that it had raised, and no more."""
    league = Campaign(entered(file, "Unmade", entrants=["lqr"], seconds=2.0), tmp_path / "store")
    said = alone(league, league.study.axes[1].words.index("Unmade"))
    line = OTHERS[: OTHERS.index("raise RuntimeError")].count("\n") + 1
    words = f"forfeited: RuntimeError: not for this mechanism, {file} line {line}"
    assert said[-1] == words


@pytest.mark.slow
def test_nobody_beats_hindsight_on_the_exact_plant(file: Path) -> None:
    """The bound is of another derivation, collocation; sampling at 1 kHz gains nothing on it."""
    rows = found(entered(file, entrants=["lqr", "kept"], seconds=8.0))
    for name in ("lqr", "kept"):
        assert rows[name]["won"].item() == 1
        assert rows[name]["cost"].item() > 0.999 * rows["bound"]["cost"].item()


@pytest.mark.slow
def test_the_better_setting_is_chosen_and_kept(file: Path) -> None:
    rows = found(entered(file, "Gains"), "Gains")
    assert (rows["Gains"]["setting"].item(), rows["Gains"]["won"].item()) == (0, 1)
    text = OTHERS.replace('[{"sign": 1.0}, {"sign": -1.0}]', '[{"sign": -1.0}, {"sign": 1.0}]')
    other = file.with_name("swapped.py")
    other.write_text(text, encoding="utf-8")
    rows = found(entered(other, "Gains"), "Gains")
    assert (rows["Gains"]["setting"].item(), rows["Gains"]["won"].item()) == (1, 1)


@pytest.mark.slow
def test_threads_and_serial_give_the_same_bits_and_a_changed_file_is_another_league(
    file: Path, tmp_path: Path
) -> None:
    mine = file.with_name("mine.py")
    mine.write_text(OTHERS, encoding="utf-8")
    definition = entered(mine, "Idle", seconds=1.5)
    stores = []
    for threads in (1, 2):
        campaign = Campaign(definition, tmp_path / f"{threads}.zarr")
        with executor_for(threads=threads) as (pool, width):
            assert campaign.run(pool, width=width).complete
        stores.append(dataset(campaign.path))
        assert stores[-1].attrs["code"] == [f"{mine}:Idle"]
    serial, threaded = stores
    for name, variable in study_of(definition).variables.items():
        same = np.array_equal(serial[name].values, threaded[name].values, equal_nan=True)
        assert same or variable.measured
    mine.write_text(OTHERS + "\n# changed\n", encoding="utf-8")
    changed = Definition(definition.mechanism, definition.text + " ", definition.code)
    alone = Definition(definition.mechanism, definition.text)
    for other, what in ((changed, "version of an entrant's file,"), (alone, "--entrant,")):
        with (
            executor_for() as (pool, _),
            pytest.raises(ArtefactError, match=f"another campaign.*another {what}.*--mechanism"),
        ):
            Campaign(other, tmp_path / "1.zarr").run(pool, resume=True)


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS)
def test_every_task_is_a_bench_on_which_a_regulator_stands(task: str, file: Path) -> None:
    rows = found(entered(file, tasks=[task], seconds=6.0))
    assert rows["lqr"]["won"].item() == 1
    assert 0.05 < rows["bound"]["cost"].item() < rows["lqr"]["cost"].item()


@pytest.mark.parametrize(
    "name",
    [
        "rotary_pendulum",
        *(
            pytest.param(k, marks=pytest.mark.slow)
            for k in ("overhead_crane", "two_motor_three_link")
        ),
    ],
)
def test_the_push_moves_the_free_coordinate_by_half_of_the_start(name: str) -> None:
    """The speed after the impulse, times the slowest time constant, against ‖q(0)‖_∞ / 2."""
    study: Any = study_of(Definition.of(name, **LEAGUE | {"mechanisms": [name]}))
    mechanism = study.mechanisms[0]
    rig = RealisticRig(study.bench(mechanism, "push"), np.zeros(2 * mechanism.n))
    fastest = 0.0
    while rig.read().t < 3.01:
        rig.write(np.zeros(mechanism.m))
        fastest = max(fastest, abs(float(rig.truth[mechanism.n + mechanism.m])))
    rates = np.abs(np.linalg.eigvals(linearise(mechanism).A)).max()
    wanted = 0.5 * np.abs(mechanism.usual_start[: mechanism.n]).max() * rates
    assert fastest == pytest.approx(wanted, rel=0.1)


def test_nothing_is_home_where_it_starts() -> None:
    """Otherwise to do nothing would win."""
    for build in LIBRARY.values():
        mechanism = build()
        away = np.abs(mechanism.usual_start[: mechanism.n]) > home(mechanism)
        assert away.any(), mechanism.name


def test_intervals_are_those_of_scipy_and_hold_what_they_say() -> None:
    for won, runs in ((0, 5), (3, 7), (54, 60), (60, 60)):
        theirs = binomtest(won, runs).proportion_ci(method="wilson")
        assert wilson(won, runs) == pytest.approx((theirs.low, theirs.high), abs=1e-9)
    rng = np.random.default_rng(1)
    inside = 0
    for _ in range(200):
        _, low, high = median_interval(rng.standard_normal(40))
        inside += low <= 0.0 <= high
    assert 0.88 <= inside / 200 <= 1.0
    assert math.isnan(median_interval(np.zeros(0))[0])


def test_most_runs_won_come_first_and_of_equals_the_cheaper() -> None:
    """Costs count where a run was won, over hindsight's; nobody is first where none won."""
    import xarray

    won = np.ones((2, 4, 1, 2), dtype=int)  # mechanism, entrant, task, plant
    cost = np.full(won.shape, 2.0)
    cost[0, 1:, 0, 0] = 6.0, 4.0, 2.0
    cost[0, 1:, 0, 1] = 8.0, 4.0, 2.0
    won[0, 3, 0, 0] = 0  # the cheapest loses a run
    won[1, 1:] = 0
    won[1, 1, 0, 1] = -1  # not finished
    words = {"mechanism": "easy too_hard", "entrant": "hindsight dear fair cheap", "task": "exact"}
    shape = ("mechanism", "entrant", "task", "plant")
    zeros = np.zeros(won.shape)
    fault = zeros.copy()
    fault[1, 2, 0, 0] = 1
    data = xarray.Dataset(
        {"won": (shape, won), "cost": (shape, cost), "fault": (shape, fault),
         "step_mean": (shape, zeros + 2e-6), "step_most": (shape, zeros + 5e-3)},
        {name: (name, range(len(text.split())), {"flag_meanings": text})
         for name, text in words.items()},
    )  # fmt: skip
    scores, tasks, mechanisms, best = (as_text(one).decode() for one in tables(data))
    rows = [line.split() for line in scores.splitlines()]
    first, second, third = (row for row in rows if row[:1] in (["dear"], ["fair"], ["cheap"]))
    assert first[:4] == ["dear", "2", "of", "3"]
    assert first[5] == "3.50"
    assert second[:4] == ["fair", "2", "of", "4"]
    assert third[:4] == ["cheap", "1", "of", "4"]
    assert third[5] == "1.00"
    assert first[-2:] == ["2", "5.0"]
    assert "forfeited runs: fair in 1" in scores
    assert next(x.split() for x in tasks.splitlines() if "exact" in x)[1:] == ["67", "50", "25"]
    assert next(x.split() for x in mechanisms.splitlines() if "easy" in x)[1:] == [
        "100", "100", "50",
    ]  # fmt: skip
    assert next(x.split() for x in best.splitlines() if "easy" in x)[1:] == ["fair"]
    assert next(x.split() for x in best.splitlines() if "too hard" in x)[2:] == ["—"]


def test_a_referee_names_what_was_wrong() -> None:
    class Late:
        def reset(self, x0: Any) -> None:
            pass

        def step(self, t: float, x: Any) -> Any:
            return "late"

    with pytest.raises(ForfeitError, match="late"):
        Refereed(Late(), np.zeros(4), 1)(0.0, np.zeros(4))


@pytest.mark.slow
def test_our_entrants_are_made_for_the_estimator_that_they_hear() -> None:
    """Coarse encoders leave more of the input to noise: other gains, another gate."""
    rig = LIBRARY[RIG]()
    objective, usual = objective_for(rig), bench_for(rig)
    coarse = replace(usual, encoders={c.name: Encoder(0.006, noise=0.006) for c in rig.coordinates})
    noises = []
    for bench in (usual, coarse):
        entrant, estimator = steered(rig, objective), estimator_for(rig, bench)
        entrant.reset(rig.usual_start)
        entrant.listen(estimator)
        steering = entrant._feedback
        assert isinstance(steering, CascadeSteering)
        noise = steering.cascade.covariance
        assert noise is not None
        assert np.array_equal(noise, estimator.noise_covariance())
        noises.append(noise[2, 2])
    assert noises[1] > 2 * noises[0]


def test_wrong_entries_are_refused_before_any_work(file: Path) -> None:
    with pytest.raises(InvalidInputError, match="takes none"):
        study_of(Definition(RIG, '{"kind": "plants", "plants": 1}', (f"{file}:Idle",)))
    with pytest.raises(InvalidInputError, match="each once"):
        study_of(entered(file, "Idle", "Idle"))
    with pytest.raises(InvalidInputError, match="class or function"):
        study_of(entered(file, "OTHER"))


@pytest.mark.parametrize(
    "changes",
    [{"limits": {"voltage": 5.0}}, {"parameters": {"m": 0.2}}, {"mechanisms": ["acrobot", RIG]}],
)
def test_what_only_a_single_mechanism_can_have_is_refused_beside_a_list(
    file: Path, changes: dict[str, Any]
) -> None:
    """They were taken, kept in the store's definition, and not used."""
    with pytest.raises(InvalidInputError, match=r"'mechanisms'.*besides"):
        study_of(entered(file, **changes))
    alone = study_of(entered(file, **changes | {"mechanisms": []}))
    assert [m.name for m in alone.studied] == [RIG]


def test_a_run_that_ends_before_the_push_is_refused(file: Path) -> None:
    with pytest.raises(InvalidInputError, match=r"'seconds'.*3\.5.*from 4"):
        study_of(entered(file, tasks=["exact", "push"], seconds=3.5))
    assert study_of(entered(file, tasks=["exact"], seconds=3.5)).shards == 2


@pytest.mark.slow
def test_the_page_says_how_to_enter(tmp_path: Path) -> None:
    """The controller of docs/league.md, entered as it says, in at most 30 lines."""
    page = (Path(__file__).parents[2] / "docs" / "league.md").read_text(encoding="utf-8")
    assert f"a fixed benchmark, version {VERSION}," in page
    code = re.search(r"```python\n(.*?)```", page, re.S)
    assert code is not None
    assert code[1].count("\n") <= 30
    (tmp_path / "mine.py").write_text(code[1], encoding="utf-8")
    (tmp_path / "league.toml").write_text(
        'kind = "league"\nmechanisms = ["acrobot"]\nentrants = ["lqr"]\ntasks = ["exact"]\n'
        "plants = 1\nseconds = 4.0\n",
        encoding="utf-8",
    )
    where = ["campaign", str(tmp_path / "league.toml"), "--out", str(tmp_path / "league.zarr")]
    where += ["--entrant", f"{tmp_path / 'mine.py'}:PolePlacement"]
    result = CliRunner().invoke(app, where)
    assert result.exit_code == 0, result.output
    assert re.search(r"PolePlacement\s+1 of 1", result.output)
    again = CliRunner().invoke(app, [*where, "--tables"])
    assert re.search(r"PolePlacement\s+1 of 1", again.output)
