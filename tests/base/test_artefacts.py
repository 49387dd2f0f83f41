"""Results as tables, text and files."""

from __future__ import annotations

import errno
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest
from rich.console import RenderableType
from rich.text import Text

from undertow.base import (
    as_text,
    check_folder,
    check_place,
    facts,
    file_name,
    finite,
    manifest,
    markdown_table,
    number,
    one_of,
    table,
    to_csv,
    write_file,
    write_files,
)
from undertow.base.errors import ArtefactError, InvalidInputError
from undertow.cascade import Run
from undertow.display.animation import Film


def shown(*parts: RenderableType) -> list[str]:
    return [line.rstrip() for line in as_text(*parts).decode().splitlines()]


def test_numbers_end_at_the_right_and_text_is_no_markup() -> None:
    rows: list[tuple[RenderableType, ...]] = [
        ("a [b]", "1.5", "[red]x"),
        (Text("longer"), "-12.25", "y"),
    ]
    lines = shown(table(("name", "value", "word"), rows, left=("word",)))
    assert lines == [
        "name     value  word",
        "a [b]      1.5  [red]x",
        "longer  -12.25  y",
    ]


def test_a_row_may_have_fewer_cells_than_heads() -> None:
    assert shown(table(("name", "n", "whole"), [("a", "1")], whole=("whole",)))[1].split() == [
        "a",
        "1",
    ]


def test_a_ruled_table_has_its_title_above_and_its_note_below() -> None:
    lines = shown(
        table(("", "n"), [("a", "1")], title="Counts of all", note="n: how many", ruled=True)
    )
    words = [" ".join(line.split()) for line in lines if line.strip(" ─")]
    assert words == ["Counts of all", "n", "a 1", "n: how many"]
    assert any(set(line.strip()) == {"─"} for line in lines)


def test_facts_are_two_columns() -> None:
    assert shown(facts([("cost", "12 V² s"), ("t", "[3] s")])) == ["cost  12 V² s", "t     [3] s"]


def test_what_is_not_finite_is_a_dash_for_people_and_an_empty_cell_in_files() -> None:
    values = (1.25, math.inf, math.nan)
    assert [number(v, ".1f") for v in values] == ["1.2", "—", "—"]
    assert to_csv(("v",), [(finite(v),) for v in values]) == b'v\n1.25\n""\n""\n'


def test_markdown_columns_of_numbers_end_at_the_right() -> None:
    lines = markdown_table(("case", "x"), [(1, "2.5")], right=("x",))
    assert lines == ["| case | x |", "| --- | ---: |", "| 1 | 2.5 |"]


def test_a_number_that_is_none_loses_no_result() -> None:
    """A diverged motion's cost, an interval without end: null, where json.dumps raised."""
    facts = {"cost": math.nan, "rows": [{"low": -math.inf, "high": np.float64(2.0)}]}
    content = json.loads(manifest("undertow x", {"horizon": math.inf}, **facts))
    assert (content["cost"], content["request"]) == (None, {"horizon": None})
    assert content["rows"] == [{"low": None, "high": 2.0}]


def test_a_manifest_says_what_was_run_with_which_versions() -> None:
    content = json.loads(manifest("undertow x", {"out": Path("a"), "seed": 1}, gap=None))
    assert content["what"] == "undertow x"
    assert content["request"] == {"out": "a", "seed": 1}
    assert content["gap"] is None
    assert content["versions"]["numpy"]


def test_files_of_an_earlier_run_are_moved_not_lost(tmp_path: Path) -> None:
    assert write_files(tmp_path, {"a.txt": b"1"}) is None
    assert write_files(tmp_path, {"a.txt": b"2", "b.txt": b"3"}) == tmp_path / "earlier-1"
    assert (tmp_path / "earlier-1" / "a.txt").read_bytes() == b"1"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.txt", "earlier-1"]


def test_a_full_disk_names_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Claim: of a write that fails Python does not say where; the refusal does."""

    def full(_self: Path, _content: bytes) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(ArtefactError, match=r"No space left .*out/a\.txt\)"):
        write_files(tmp_path / "out", {"a.txt": b"1"})


def test_an_unknown_name_is_refused_with_those_that_are_like_it() -> None:
    one_of("colour", "red", ["red", "green"])
    with pytest.raises(InvalidInputError, match=r"got 'gren', must be one of red, green. Did you"):
        one_of("colour", "gren", ["red", "green"])


def test_a_name_of_somebodys_is_a_file_in_the_folder_that_is_named(tmp_path: Path) -> None:
    """A mechanism called "../../cart" wrote its formulas two folders up."""
    for name in ("../../cart", "a/b", "..", "tab\t", "x" * 300, "Wagen ü"):
        write_files(tmp_path / name[:1].replace(".", "p"), {f"{file_name(name)}.txt": b"1"})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["W", "a", "p", "t", "x"]


def test_a_picture_has_the_ending_of_what_it_is(tmp_path: Path) -> None:
    """``--picture map.jpg`` and ``run.animate("film.mp4")`` wrote a PNG and a GIF."""
    png, gif = b"\x89PNG\r\n", b"GIF89a"
    for name, content in (("a.png", png), ("A.PNG", png), ("plain", png), ("a.gif", gif)):
        assert write_file(tmp_path / name, content).read_bytes() == content
    for name, content, better in (("map.jpg", png, "map.png"), ("film.mp4", gif, "film.gif")):
        with pytest.raises(ArtefactError, match=rf"Name it .*{better}"):
            write_file(tmp_path / name, content)
        assert not (tmp_path / name).exists()


def test_a_file_of_another_kind_is_refused_in_one_sentence(tmp_path: Path) -> None:
    """What was refused was refused once more around it, with another remedy."""
    log = tmp_path / "run.db"
    log.write_bytes(b"SQLite format 3")
    with pytest.raises(ArtefactError) as caught:
        write_file(log, b"PAR1")
    assert str(caught.value).count("got ") == 1
    assert str(caught.value).endswith("Choose another name")


def test_a_place_is_refused_before_what_is_written_there_is_made(tmp_path: Path) -> None:
    """A folder, a name that is too long, a missing folder; a long name that is not is written."""
    (tmp_path / "film.gif").mkdir()
    for name in ("film.gif", f"{'n' * 252}.gif", "none/film.gif", "film.mp4"):
        with pytest.raises(ArtefactError, match=r"Choose another folder or name|which is what"):
            check_place(tmp_path / name, b"GIF8")
    assert write_file(tmp_path / f"{'n' * 251}.gif", b"GIF89a").exists()


def test_a_film_is_not_drawn_for_a_place_where_it_cannot_be(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(Film, "of", lambda *_, **__: pytest.fail("drawn"))
    run = Run.__new__(Run)
    with pytest.raises(ArtefactError, match="directory"):
        run.animate(tmp_path)


def test_a_zero_byte_in_the_name_of_a_folder_is_said(tmp_path: Path) -> None:
    with pytest.raises(ArtefactError, match="got a zero byte in its name"):
        check_folder(tmp_path / "re\0sults")


def test_a_folder_in_python_is_not_told_of_an_option_of_the_command_line(tmp_path: Path) -> None:
    """``ut.export_c`` into a file's place advised ``--out``, which is an option of a command."""
    (tmp_path / "taken").write_text("here first")
    with pytest.raises(ArtefactError, match="Name another one") as refusal:
        write_files(tmp_path / "taken" / "deeper", {"a": b"1"})
    assert "--" not in str(refusal.value)
