"""The page on bringing one's own mechanism: what it shows is run, and is true."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "your-own-mechanism.md").read_text(encoding="utf-8")


def numbers(text: str) -> list[float]:
    return [float(v) for v in re.findall(r"[\d.]+", text)]


@pytest.mark.slow  # kernels of its own, and films
def test_every_block_of_the_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Claim: a mechanism of one's own takes under 25 lines, and prints what the page shows.

    The blocks after it run too, films with fewer frames: formulas, dials, a stick figure; and
    MJCF and URDF of the same bar have its M and f.
    """
    monkeypatch.chdir(tmp_path)
    first, *more = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    (shown,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    assert len([line for line in first.splitlines() if line.strip()]) < 25
    scope: dict[str, object] = {}
    exec(compile(first, "first", "exec"), scope)
    assert numbers(capsys.readouterr().out) == pytest.approx(numbers(shown), rel=0.03)
    films = 0
    for block in more:
        quick = block.replace('animate("bar.gif"', 'animate("bar.gif", fps=2.0')
        exec(compile(quick, "block", "exec"), scope)
        if "animate(" in block:
            assert (tmp_path / "bar.gif").read_bytes().startswith(b"GIF8")
            (tmp_path / "bar.gif").unlink()
            films += 1
    assert films == 2
    assert len(more) == 4
