"""The README's Python runs as it stands, and its commands exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from undertow.cli import app

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_the_quick_start_runs_as_it_stands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ten lines at most, nothing to fill in: they print what the README shows, and draw."""
    monkeypatch.chdir(tmp_path)
    (code,) = blocks("python")
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    exec(compile(code, "README.md", "exec"), {})
    assert (tmp_path / "motion.png").read_bytes().startswith(b"\x89PNG")
    printed = capsys.readouterr().out
    shown = blocks("text")[0]
    # The last digits depend on the processor; the words and the size of the numbers do not.
    assert re.sub(r"-?[\d.]+", "#", printed) == re.sub(r"-?[\d.]+", "#", shown)
    seconds = [[float(v) for v in re.findall(r"([\d.]+) s", text)] for text in (printed, shown)]
    assert seconds[0] == pytest.approx(seconds[1], rel=0.05)
    assert seconds[0][0] < seconds[0][1]


def test_commands_exist() -> None:
    """Every command line of the README is understood."""
    lines = [line.split("#")[0] for block in blocks("sh") for line in block.splitlines()]
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("undertow ")]
    assert len(commands) >= 4
    for words in commands:
        command: Any = get_command(app)
        while words and words[0] in getattr(command, "commands", {}):
            command = command.commands[words.pop(0)]
        assert not hasattr(command, "commands")
        if words != ["--help"]:
            command.make_context("", words)


def test_the_map_names_every_package_in_the_order_of_imports_and_every_page() -> None:
    """The first table has each package once, above what it imports; the second's files exist."""
    first, second = README.split("may import only packages")[1].split("To change something")
    package = ROOT / "src" / "undertow"
    rows = [re.findall(r"`(\w+)`", row.split("|")[1]) for row in first.splitlines() if "|" in row]
    named = [name for row in rows for name in row]
    assert sorted(named) == sorted(path.parent.name for path in package.glob("*/__init__.py"))
    level = {name: k for k, row in enumerate(rows) for name in row}
    for name in named:
        text = "".join(path.read_text(encoding="utf-8") for path in (package / name).rglob("*.py"))
        for other in set(re.findall(r"^\s*from undertow\.(\w+)", text, re.MULTILINE)) - {name}:
            assert level[name] < level[other], (name, other)
    files = re.findall(r"`([\w/]+\.py)`", second)
    assert files
    for file in files:
        assert (package / file).is_file() or (ROOT / file).is_file(), file
    for page in (ROOT / "docs").glob("*.md"):
        assert f"docs/{page.name}" in README


def test_links_and_pictures_are_there() -> None:
    """Every relative link leads to a file of the repository."""
    targets = re.findall(r"\]\(([^)]+)\)", README)
    assert targets
    for target in targets:
        assert (ROOT / target.partition("#")[0]).exists(), target


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs").glob("*.md")))
def test_pages_link_to_what_is_there(page: str) -> None:
    """The same for the pages under docs/."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        page = (ROOT / "docs" / target).exists()
        example = (ROOT / "examples" / f"{target}.py").exists()  # made into a page of the gallery
        assert page or example or target == "gallery/index", target
