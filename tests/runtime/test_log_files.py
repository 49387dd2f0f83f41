"""Logs as MCAP and Parquet: read back by the reference readers they hold what the log holds."""

from __future__ import annotations

import json
import math
import sys
from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import undertow as ut
from runs import run as typed
from undertow.base import ArtefactError, MissingExtraError, write_file
from undertow.plants import IdealRig
from undertow.runtime import Recording, column_units, read_log, to_mcap, to_parquet

RIG = ut.mechanisms.rotary_pendulum()


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A short run with an answer in it."""
    log = tmp_path_factory.mktemp("log") / "run.db"
    cascade = ut.Cascade(
        RIG, ut.objective_for(RIG, "bench-energy"), cold=ut.Budget(512), warm=ut.Budget(64)
    )
    rig = IdealRig(RIG, RIG.state(phi=0.2), 0.001)
    ut.run(cascade, rig, seconds=0.3, log=log, simulated=True, phi=0.2)
    return read_log(log)


def strictly(text: str | bytes) -> Any:
    """Read JSON as other languages do, in which Infinity and NaN are no words."""

    def refused(word: str) -> None:
        raise AssertionError(word)

    return json.loads(text, parse_constant=refused)


def test_units_are_those_of_the_mechanism(recording: Recording) -> None:
    units = column_units(recording)
    assert list(units) == list(recording.columns)
    said = {"theta": "rad", "phi_dot": "rad/s", "phi_dot_measured": "rad/s", "voltage": "V"}
    said |= {"voltage_demand": "V", "t": "s", "late_us": "µs", "margin": "", "k": "", "s_0": ""}
    assert {name: units[name] for name in said} == said
    older = {k: v for k, v in recording.meta.items() if k != "coordinates"}
    assert column_units(replace(recording, meta=older)) == units
    unknown = column_units(replace(recording, meta=older | {"mechanism": "mine"}))
    assert (unknown["theta"], unknown["theta_dot"], unknown["voltage"]) == ("", "", "V")


def test_a_coordinate_called_like_a_column_of_the_loop_does_not_lend_it_its_unit(
    recording: Recording,
) -> None:
    """A coordinate 'margin' made the law's margin radians; an input 's_0' made s newtons."""
    names = ("clock", "margin")
    columns = ["k", "t", "clock", "margin", "s_0", *(f"{n}_" for n in names)]
    columns += [f"{n}__measured" for n in names] + ["margin_dot", "margin_dot_measured"]
    columns += ["clock_dot", "clock_dot_measured", "s_0_", "s_0__demand"]
    meta = {"coordinates": dict.fromkeys(names, "rad"), "units": {"s_0": "N"}}
    units = column_units(replace(recording, columns=tuple(columns), meta=meta))
    assert (units["margin"], units["clock"], units["s_0"]) == ("", "s", "")
    assert (units["margin_"], units["clock__measured"], units["s_0__demand"]) == ("rad", "rad", "N")
    assert units["margin_dot"] == units["clock_dot_measured"] == "rad/s"


def test_a_log_is_not_written_over(recording: Recording) -> None:
    """`undertow export log run.db --mcap run.db` took the log away, and so did `show --save`."""
    before = recording.path.read_bytes()
    for write_to in (to_mcap, to_parquet):
        with pytest.raises(ArtefactError, match="one of another kind, which is there already"):
            write_to(recording, recording.path)
    with pytest.raises(ArtefactError, match="one of another kind"):
        write_file(recording.path, b"<!doctype html>")
    assert recording.path.read_bytes() == before


def test_pandas_reads_the_parquet_file_to_the_last_bit(
    recording: Recording, tmp_path: Path
) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    pandas = pytest.importorskip("pandas")
    path = to_parquet(recording, tmp_path / "run.parquet")
    frame = pandas.read_parquet(path)
    assert list(frame) == list(recording.columns)
    np.testing.assert_array_equal(frame.to_numpy(dtype=float), recording.steps)
    assert frame["mode"].dtype == np.int64
    schema = parquet.read_schema(path)
    assert {f.name: f.metadata[b"unit"].decode() for f in schema} == column_units(recording)
    rest = strictly(schema.metadata[b"undertow"])
    assert rest["meta"]["mechanism"] == "rotary_pendulum"
    assert [tuple(event) for event in rest["events"]] == list(recording.events)
    assert len(rest["answers"]) == len(recording.answers) > 0


def test_the_reference_reader_finds_every_step_in_the_mcap_file(
    recording: Recording, tmp_path: Path
) -> None:
    """In order of time, each message with fields of its schema and of no other."""
    reader = pytest.importorskip("mcap.reader")
    path = to_mcap(recording, tmp_path / "run.mcap")
    said: dict[str, list[Any]] = defaultdict(list)
    times: list[int] = []
    with open(path, "rb") as stream:
        found = reader.make_reader(stream)
        for schema, channel, message in found.iter_messages(log_time_order=False):
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            values = json.loads(message.data, parse_constant=pytest.fail)
            assert set(values) <= set(json.loads(schema.data)["properties"])
            said[channel.topic].append((message.log_time, values))
            times.append(message.log_time)
        (facts,) = found.iter_metadata()
    assert times == sorted(times)
    told = {name: strictly(said) for name, said in facts.metadata.items()}
    assert told["mechanism"] == "rotary_pendulum"
    for topic, names in (("/state", RIG.state_names), ("/input", ["voltage"])):
        table = [[values[name] for name in names] for _, values in said[topic]]
        expected = np.stack([recording[name] for name in names], axis=1)
        np.testing.assert_array_equal(table, expected)
    stamps = [t for t, _ in said["/state"]]
    np.testing.assert_allclose(stamps, 1e9 * recording["t"], atol=1)
    assert len(said["/answers"]) == len(recording.answers)
    assert len(said["/events"]) == len(recording.events)
    assert all(values["message"] for _, values in said["/events"])


def test_what_is_infinite_is_null_in_either_file(recording: Recording, tmp_path: Path) -> None:
    """As the usual ``Settings.output_limit`` is: 'Infinity' is a word of Python's JSON alone."""
    parquet = pytest.importorskip("pyarrow.parquet")
    reader = pytest.importorskip("mcap.reader")
    endless = replace(recording, meta={"settings": {"output_limit": math.inf, "left": [math.nan]}})
    schema = parquet.read_schema(to_parquet(endless, tmp_path / "run.parquet"))
    nothing = {"output_limit": None, "left": [None]}
    assert strictly(schema.metadata[b"undertow"])["meta"]["settings"] == nothing
    with open(to_mcap(endless, tmp_path / "run.mcap"), "rb") as stream:
        (facts,) = reader.make_reader(stream).iter_metadata()
    assert strictly(facts.metadata["settings"]) == nothing


def test_what_is_not_a_number_is_left_out(recording: Recording, tmp_path: Path) -> None:
    """A sensor that gave nothing is a message without it: JSON has no NaN."""
    reader = pytest.importorskip("mcap.reader")
    steps = recording.steps.copy()
    steps[3, recording.columns.index("phi_measured")] = np.nan
    path = to_mcap(replace(recording, steps=steps), tmp_path / "run.mcap")
    with open(path, "rb") as stream:
        rows = [
            json.loads(message.data)
            for *_, message in reader.make_reader(stream).iter_messages(topics=["/measured"])
        ]
    assert [k for k, row in enumerate(rows) if "phi_measured" not in row] == [3]
    assert len(rows) == len(steps)


def test_the_command_writes_both_and_asks_for_one(recording: Recording, tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    pytest.importorskip("pyarrow")
    mcap, parquet = tmp_path / "run.mcap", tmp_path / "run.parquet"
    given = ("--mcap", str(mcap), "--parquet", str(parquet))
    code, out, _ = typed("export", "log", str(recording.path), *given)
    assert code == 0
    assert f"{len(recording.steps):,} steps" in out
    assert mcap.read_bytes().startswith(b"\x89MCAP0\r\n")
    assert parquet.read_bytes().startswith(b"PAR1")
    code, _, err = typed("export", "log", str(recording.path))
    assert code == 2
    assert "--mcap run.mcap" in err


def test_a_folder_that_is_not_there_is_refused_and_nothing_is_left(
    recording: Recording, tmp_path: Path
) -> None:
    pytest.importorskip("mcap")
    with pytest.raises(ArtefactError, match="a file that can be written"):
        to_mcap(recording, tmp_path / "nowhere" / "run.mcap")
    broken = replace(recording, answers=({"k": 0},))
    with pytest.raises(KeyError):
        to_mcap(broken, tmp_path / "run.mcap")
    assert not list(tmp_path.iterdir())


def test_a_missing_extra_is_named(
    recording: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module, write in (("pyarrow", to_parquet), ("mcap.writer", to_mcap)):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match=r"undertow\[logs\]"):
            write(recording, tmp_path / "run")
