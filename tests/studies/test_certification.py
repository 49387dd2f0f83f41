"""What people see of proofs: tables, pictures, the log of a run's decisions."""

from __future__ import annotations

import io
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from typer.testing import CliRunner

import undertow as ut
from undertow.base import InvalidInputError, Verdict
from undertow.cli import app
from undertow.closed_loop.figures import COLOURS
from undertow.plants.bench import srv02_rig
from undertow.proofs import LoopClaim, RegionClaim, read_certificate
from undertow.proofs.gate import GatePolicy, certified_gate
from undertow.proofs.region.lyapunov import LyapunovFunction
from undertow.proofs.region.motion import SurfaceMotion
from undertow.proofs.search.region import ProvedRegion
from undertow.studies import motion
from undertow.studies.certification import (
    Certified,
    appendix_report,
    certify_appendix,
    certify_bench,
    certify_run,
    decide,
    figures,
    loop_figure,
    region_figure,
    run_report,
    subject_report,
)
from undertow.studies.certification.bench import BenchLoop
from undertow.studies.paper.appendix import CASES

pytest.importorskip("flint", reason="the appendix's cases take the extra undertow[appendix]")

RIG = ut.mechanisms.rotary_pendulum(d_e=0.025)
GOOD = ut.Surface(-1, -1.59, 1.96, 12.1)
GOAL = ut.MinimumTime(horizon=20.0)


def text(shown: Any, width: int = 150) -> str:
    console = Console(width=width, record=True, file=io.StringIO())
    console.print(shown)
    return console.export_text()


@pytest.fixture(scope="module")
def run() -> ut.Run:
    """A short cascade whose gate asks for evidence."""
    gate = certified_gate(GatePolicy(("region", "dual")))
    cascade = ut.Cascade(
        RIG, GOAL, gate=gate, first=GOOD, cold=ut.Budget(64), warm=ut.Budget(32), belief="exact"
    )
    return cascade.simulate(phi=0.2)


@pytest.fixture(scope="module")
def certified(run: ut.Run) -> tuple[Certified, ...]:
    """What is proved of each of its surfaces."""
    return certify_run(RIG, run)


def test_the_log_of_a_run_has_a_verdict_for_each_decision(run: ut.Run) -> None:
    files = motion.motion_files({}, run.trajectory, run.cost, run.surfaces, run)
    decisions = json.loads(files["manifest.json"])["decisions"]
    assert len(decisions) == len(run.updates)
    for decision, update in zip(decisions, run.updates, strict=True):
        assert decision["reason"] == update.admission.reason
        assert decision["verdict"]["kind"] in ("proved", "sampled", "undecided")
        assert decision["surface"] == update.surface.vector.tolist()
        (whole,) = decision["plan"]
        assert whole == {"from": 0.0, "surface": decision["surface"], "eta": [20.0], "layer": [0.1]}
    assert decisions[-1]["verdict"]["evidence"] in ("region", "dual")
    own = ut.Plan((GOOD, GOOD), (0.0, 0.1), (ut.ReachingLaw(5.0, 0.2), ut.ReachingLaw(6.0, 0.3)))
    free = replace(run, updates=(replace(run.updates[0], plan=own),))
    files = motion.motion_files({}, run.trajectory, run.cost, run.surfaces, free)
    (decision,) = json.loads(files["manifest.json"])["decisions"]
    told = [(one["from"], one["eta"], one["layer"]) for one in decision["plan"]]
    assert told == [(0.0, [5.0], [0.2]), (0.1, [6.0], [0.3])]
    start = RIG.state(phi=0.2)
    shown = text(motion.motion_report(RIG, GOAL, start, run.trajectory, run.surfaces[0], run))
    assert "evidence" in shown
    assert "predicted into a proved set" in shown


def test_a_run_is_shown_decision_by_decision(run: ut.Run) -> None:
    shown = text(run_report(run))
    assert f"{len(run.updates)} decisions" in shown
    assert "dual, sampled" in shown
    assert "Lemma 3" in shown
    bare = replace(run, updates=tuple(
        replace(u, admission=replace(u.admission, verdict=None)) for u in run.updates
    ))  # fmt: skip
    assert "without accepted evidence" in text(run_report(bare))


def test_reports_are_readable_on_a_terminal_of_80_columns(
    run: ut.Run, certified: tuple[Certified, ...]
) -> None:
    """A few lines for each decision and claim: no column is squeezed to a letter a line."""
    decisions = text(run_report(run), 80).splitlines()
    assert len(decisions) <= 7 * min(len(run.updates), 13) + 5
    last = certified[-1]
    claims = text(subject_report(RIG, last), 80).splitlines()
    count = len(last.subject.claims) + len(last.subject.remarks)
    assert count >= 4
    assert len(claims) <= 9 * count + 5


def test_each_surface_of_a_run_is_certified(run: ut.Run, certified: tuple[Certified, ...]) -> None:
    assert [c.subject.surface for c in certified] == list(dict.fromkeys(run.surfaces))
    for item in certified:
        assert {"stability"} <= {claim.kind for claim in item.subject.claims}


def test_a_run_is_certified_with_the_reaching_laws_of_its_plans(run: ut.Run) -> None:
    """Where a cascade chose gains and layers, the claims are about those."""
    own = ut.ReachingLaw(30.0, 0.5)
    update = run.updates[0]
    plan = replace(update.plan, reaching=(own,) * len(update.plan.surfaces))
    twice = replace(run, updates=(update, replace(update, plan=plan)))
    certified = certify_run(RIG, twice)
    assert [c.subject.reaching for c in certified] == [ut.ReachingLaw(), own]
    assert len({c.subject.surface for c in certified}) == 1


def test_the_papers_cases_at_once() -> None:
    cases = certify_appendix(ut.mechanisms.rotary_pendulum())
    shown = text(appendix_report(cases))
    assert shown.count("proved,") == 10
    assert "0.5481 1/s" in shown  # the rate of docs/appendix.md


def region(size: float = 0.02) -> ProvedRegion:
    """A round set, by default small enough to be one of attraction."""
    import scipy.linalg

    motion = SurfaceMotion(RIG, GOOD)
    P = scipy.linalg.solve_continuous_lyapunov(motion.jacobian.T, -np.diag([30.0, 0.3, 3.0]))
    squares = np.array([[2, 0, 0], [1, 1, 0], [1, 0, 1], [0, 2, 0], [0, 1, 1], [0, 0, 2]])
    values = [P[0, 0], 2 * P[0, 1], 2 * P[0, 2], P[1, 1], 2 * P[1, 2], P[2, 2]]
    V = LyapunovFunction(np.eye(3), squares, np.array(values) / size)
    sound = Verdict("a region", "proved")
    return ProvedRegion(motion, np.eye(3)[0], (V,), sound, size, Verdict("a larger one", "refuted"))


def test_a_region_for_every_plant_of_a_box() -> None:
    """As many functions as hold for all of them; where none does, nothing is claimed."""
    radius = next(p.value for p in RIG.parameters if p.name == "r_o")
    box = {"r_o": (0.99 * radius, 1.01 * radius)}
    asked = decide._Decisions(RIG, GOOD, ut.ReachingLaw(), np.zeros(4), box)
    claim, verdict = asked.region_in_box(region())
    assert isinstance(claim, RegionClaim)
    assert verdict
    assert dict(claim.parameters) == box
    assert "for every r_o in" in verdict.claim
    wide = {"r_o": (0.01 * radius, 10 * radius)}
    claim, verdict = replace(asked, uncertain=wide).region_in_box(region())
    assert claim is None
    assert not verdict


def test_the_papers_cases_with_their_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    """The claim of the full loop joins the others; what is sampled is a remark."""
    rig = ut.mechanisms.rotary_pendulum(d_e=0.073)
    kept = read_certificate(Path(__file__).parents[1] / "data" / "closed_loop_v2.json")
    stated = kept.subjects[3].claims[0]
    claim, sound = LoopClaim.of(stated.claim), Verdict("starts", "proved", 0.68, "rad")
    reaches: list[float] = []

    def prove(asked: decide._Decisions, hold: int, seconds: float) -> tuple[LoopClaim, Verdict]:
        reaches.append(np.degrees(asked.start[1]))
        return claim, sound

    monkeypatch.setattr(decide._Decisions, "loop", prove)
    monkeypatch.setattr(decide, "CASES", CASES[3:4])
    (case,) = certify_appendix(rig, loop=True)
    assert reaches == [pytest.approx(44.62, abs=0.02)]  # docs/certificates.md
    assert case.subject.claims[-1].kind == "closed loop"
    assert case.subject.remarks[-1].kind == "sampled"
    assert "full loop" in text(appendix_report([case]))


@pytest.mark.slow
def test_the_picture_names_its_axes_in_degrees(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "GRID", 9)
    drawn = region_figure(region(), ut.ReachingLaw(), "a title")
    left, right = drawn.axes
    assert left.get_xlabel() == "φ (°)"
    assert "°/s" in left.get_ylabel()
    assert right.get_ylabel().startswith("w = θ")
    assert len(drawn.legends) == 1


def test_unknown_evidence_is_refused() -> None:
    words = ["simulate", "rotary_pendulum", "--start", "phi=5deg", "--accept", "faith"]
    answer = CliRunner().invoke(app, words)
    assert answer.exit_code == 2
    assert "faith" in answer.output


def test_what_the_actuators_can_keep_on_the_surface() -> None:
    """At φ = 50° on the surface the law asks for more than 15 V; at the target for nothing."""
    motion = region().motion
    assert isinstance(motion, SurfaceMotion)
    surface = motion.surface
    x = motion.mechanism.state(phi=ut.deg(50), theta=0.0)
    x[2] = float((surface.lambda_u * x[1] / -surface.alpha_a).item())
    law = ut.SlidingModeLaw(motion.mechanism, surface)(0.0, x)
    assert float(law.s[0]) == pytest.approx(0.0, abs=1e-12)
    spare = figures.held(motion, np.array([surface.sliding_coordinates(x), np.zeros(3)]))
    assert spare[0] == pytest.approx(1 - abs(law.demand[0]) / 15)
    assert spare[0] < 0
    assert spare[1] == 1.0


@pytest.mark.slow  # draws
def test_the_picture_of_a_region_has_the_input_limit_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """It names the limit, and is as wide as what comes home: less with a weaker motor."""
    monkeypatch.setattr(figures, "GRID", 9)
    one, fastest = region(20.0), []
    assert isinstance(one.motion, SurfaceMotion)
    for volts in (15.0, 1.0):
        motion = SurfaceMotion(one.motion.mechanism.with_input_limit(volts), one.motion.surface)
        drawn = region_figure(replace(one, motion=motion), ut.ReachingLaw(), "a title")
        words = [text.get_text() for text in drawn.legends[0].get_texts()]
        assert f"comes home with {volts:g} V, simulated" in words
        assert "proved, input not limited" in words
        fastest.append(drawn.axes[0].get_ylim()[1])
    assert fastest[1] < 0.5 * fastest[0]
    assert fastest[0] < 3000  # °/s


def test_the_picture_of_a_loop_shows_what_is_proved_and_what_falls(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A kept claim of a pole on a cart: proved starts are as wide as it says, horizontal falls."""
    monkeypatch.setattr(figures, "STARTS", 12)
    monkeypatch.setattr(figures, "FOLLOWED", 5.0)
    rig = ut.mechanisms.cart_pendulum()
    path = Path(__file__).parents[1] / "data/mechanism_loops/cart_pendulum.json"
    data = json.loads(path.read_text())["subjects"][0]["claims"][0]
    claim = LoopClaim({name: value for name, value in data.items() if name != "kind"})
    drawn = loop_figure(rig, ut.first_surface(rig), ut.ReachingLaw(), claim, "a pole on a cart")
    over_time, plane = drawn.axes
    assert (over_time.get_ylabel(), plane.get_ylabel()) == ("φ (°)", "dφ/dt (°/s)")
    assert not claim.box(rig)[[0, 2, 3]].any()  # it starts with φ alone
    proved = np.degrees(claim.box(rig)[1, 1])
    bar, *_ = (line for line in over_time.lines if line.get_linewidth() > 2)
    assert np.max(bar.get_ydata()) == pytest.approx(proved)
    motions = [line for line in over_time.lines if line is not bar]
    for line in motions[:-1]:
        proved_start = np.asarray(line.get_ydata())[0] <= proved * (1 + 1e-9)
        assert line.get_color() == COLOURS["blue" if proved_start else "sky"]
    assert sum(line.get_color() == COLOURS["blue"] for line in motions) == 2
    assert motions[-1].get_color() == COLOURS["vermilion"]
    assert np.abs(motions[-1].get_ydata()).max() > 90
    assert "|force| ≤ 20 N" in drawn.get_suptitle()
    assert "renewed at every instant" in drawn.get_suptitle()


def test_without_searches_half_of_the_work_is_done_before_the_samples() -> None:
    """It was taken for a tenth, and minutes were said to be left where seconds were."""
    parts: dict[str, float] = {}
    ut.certify(
        RIG, GOOD, phi=0.2, seconds=0, progress=lambda what, part: parts.update({what: part})
    )
    assert parts["prediction"] >= 0.5 > parts["disturbances"]
    assert list(parts.values()) == sorted(parts.values())


def test_a_run_is_certified_with_the_law_that_it_had(run: ut.Run) -> None:
    law = ut.ReachingLaw(layer=0.2)
    assert {one.subject.reaching for one in certify_run(RIG, run, reaching_law=law)} == {law}


def test_lemma_3_is_asked_of_its_own_case_alone(run: ut.Run) -> None:
    """Another plant, and a target that moves, may raise predictions: nothing says ≥ 0 wanted."""
    start, surface = RIG.state(phi=0.2), run.surfaces[0]

    def shown(run: ut.Run, target: ut.Reference | None = None) -> str:
        moved = run.trajectory
        report = motion.motion_report(RIG, GOAL, start, moved, surface, run, None, target)
        return " ".join(text(report).split())

    assert "≥ 0 wanted" in shown(run)
    heavy = replace(run.trajectory, mechanism=RIG.with_parameters(m=0.2))
    other = shown(replace(run, trajectory=heavy))
    assert "the plant, which is not the model, raised it by" in other
    moving = shown(run, ut.Reference.sine(0.5, theta=0.1))
    assert "the moving target raised it by" in moving
    for said in (other, moving):
        assert "wanted" not in said


def test_a_cost_of_a_motion_that_did_not_arrive_says_so(run: ut.Run) -> None:
    """Least time cost as long as the motion lasted, arrived or not."""
    start = RIG.state(phi=0.2)
    for event, words in ((ut.Event.REACHED, ""), (ut.Event.SINGULAR, ", without arriving")):
        motion_there = replace(run.trajectory, event=event)
        report = motion.motion_report(RIG, GOAL, start, motion_there, run.surfaces[0])
        flat = " ".join(text(report).split())
        assert f"cost {motion_there.cost:.6g} {GOAL.unit}{words} largest" in flat


def test_friction_that_a_motion_leaves_out_is_told_of(run: ut.Run) -> None:
    """Only the line of what was left out of a file had it."""
    start, told = RIG.state(phi=0.2), "simulated without disturbances"
    most = RIG.B[0, 0] * RIG.input_limits[0]
    for part, words in ((0.0, ""), (0.09, ""), (0.25, "theta, 25%")):
        rubbing = RIG.with_disturbance_bounds(part * most, 0.0)
        shown = motion.motion_report(rubbing, GOAL, start, run.trajectory, run.surfaces[0], run)
        flat = " ".join(text(shown).split())
        assert (told in flat) == bool(words)
        assert words in flat
    free = RIG.with_disturbance_bounds(1.0, 0.0).with_input_limit(math.inf)
    shown = motion.motion_report(free, GOAL, start, run.trajectory, run.surfaces[0], run)
    assert told not in text(shown)


BENCH = srv02_rig()
WORDS = ("1.5 ms from reading to action", "theta 0.03", "a_e ± 12 %", "standard deviation")
needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")


def on_bench(loop_seconds: float, **start: float) -> Certified:
    """What is known of the loop of the paper's bench; law and C are tried on a few rigs."""
    rig = BENCH.mechanism
    surface, far = ut.first_surface(rig), rig.state(**start)
    return certify_bench(BENCH, surface, far, loop_seconds=loop_seconds, trials=(48.0, 24.0))


@needs_gcc
@pytest.mark.slow
def test_the_loop_of_a_bench_is_proved_as_held_and_tried_from_what_is_proved() -> None:
    """Period and layer are those of a run; the file's claim is decided again."""
    subject = on_bench(600.0, phi=math.radians(1)).subject
    (held,) = (c.claim for c in subject.claims if c.kind == "closed loop")
    claim = LoopClaim.of(held)
    assert claim.period == BENCH.timing.period
    assert float(claim.box(BENCH.mechanism)[1, 1]) == pytest.approx(math.radians(1))
    assert claim.decide(BENCH.mechanism, subject.surface, subject.reaching)
    assert ["|phi| ≤ 0.01745," in verdict.claim for verdict in subject.remarks[-2:]] == [True] * 2


@needs_gcc
@pytest.mark.slow
def test_the_law_and_the_exported_c_are_tried_with_what_a_proof_leaves_out() -> None:
    """Where no loop is proved, from up to the start; what is left out stands above all proofs."""
    found = on_bench(1e-9, phi=0.3)
    run = ut.runtime.reaching_for(ut.runtime.estimator_for(BENCH.mechanism, BENCH))
    assert found.subject.reaching == run
    law, exported = found.subject.remarks[-2:]
    assert (law.kind, exported.kind) == ("sampled", "sampled")
    assert (law.details["trials"], exported.details["trials"]) == (6, 3)
    assert "|phi| ≤ 0.3," in law.claim
    assert law.margin == pytest.approx(0.001 ** (1 / 6))  # 1 − p with (1 − p)⁶ = 1 − confidence
    shown = text(subject_report(BENCH.mechanism, found), 80)
    first = shown.index("Routh")
    assert all(0 < shown.index(words) < first for words in WORDS)
    assert shown.index("simulated runs") > first


def test_a_bench_that_a_law_does_not_bear_is_refuted_with_a_start() -> None:
    """An arm that sticks with more than the motor has: no run comes home."""
    stuck = BENCH.with_friction(200.0)
    law = ut.runtime.reaching_for(ut.runtime.estimator_for(BENCH.mechanism, BENCH))
    box = np.outer(BENCH.mechanism.state(phi=1.0), [0.2, 0.3])
    verdict = BenchLoop(stuck, ut.first_surface(BENCH.mechanism), law, box).tried(24.0)
    assert (verdict.kind, verdict.margin) == ("refuted", -1.0)
    assert 0.2 <= verdict.witness["phi"] <= 0.3


def test_the_period_of_a_bench_that_is_certified_is_whole_ms() -> None:
    odd = BENCH.with_timing(period=0.0004)
    with pytest.raises(InvalidInputError, match=r"0\.4 ms"):
        certify_bench(odd, ut.first_surface(BENCH.mechanism), BENCH.mechanism.state())


def test_a_certificate_in_python_takes_the_bench_of_its_mechanism_alone() -> None:
    surface = ut.first_surface(RIG)
    with pytest.raises(InvalidInputError, match="mechanism of the bench"):
        ut.certify(RIG, surface, bench=BENCH)
    own = replace(BENCH, mechanism=RIG)
    with pytest.raises(InvalidInputError, match="left out"):
        ut.certify(RIG, surface, bench=own, hold=2)
