"""The README's Python runs as it stands, and its commands exist."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from undertow.cli import app

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")


def blocks(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README, re.DOTALL)


def test_ten_lines_run_as_they_stand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """About ten lines, nothing to fill in: they print what the README shows, and draw."""
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
        result = CliRunner().invoke(app, [words[0], "--help"])
        assert result.exit_code == 0
        known = set(re.findall(r"--[a-z-]+", result.stdout))
        assert {word for word in words if word.startswith("--")} <= known


def test_links_and_pictures_are_there() -> None:
    """Every relative link leads to a file of the repository."""
    targets = re.findall(r"\]\(([^)]+)\)", README)
    assert targets
    for target in targets:
        assert (ROOT / target).exists(), target


@pytest.mark.parametrize("page", ["notation.md", "paper.md"])
def test_pages_link_to_what_is_there(page: str) -> None:
    """The same for the pages under docs/."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (ROOT / "docs" / target).exists(), target
