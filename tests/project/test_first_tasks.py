"""What a new user does first, from the words of the docs alone: their blocks and their commands."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[2]

pytestmark = pytest.mark.slow  # each in processes of its own, some with code to compile


def section(page: str, title: str = "") -> str:
    """Return a page of the docs, or what stands under one of its titles."""
    text = (ROOT / page).read_text(encoding="utf-8")
    if title:
        text = text[text.index(f"\n## {title}\n") :]
        text = text[: text.find("\n## ", 4)]
    return text


def blocks(text: str, language: str) -> list[str]:
    found = re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)
    assert found, f"no {language} block"
    return found


def python(code: str, folder: Path) -> str:
    """Run a block as a script; what it prints."""
    (folder / "script.py").write_text(code, encoding="utf-8")
    return ended([sys.executable, "script.py"], folder)


def typed(line: str, folder: Path, codes: tuple[int, ...] = (0,)) -> str:
    """Type a line of the docs."""
    words = shlex.split(line.partition("#")[0])
    assert words[0] == "undertow"
    return ended([sys.executable, "-m", *words], folder, codes)


def ended(command: list[str], folder: Path, codes: tuple[int, ...] = (0,)) -> str:
    path = os.pathsep.join(filter(None, sys.path))
    environment = os.environ | {"PYTHONPATH": path, "MPLBACKEND": "agg", "COLUMNS": "160"}
    done = subprocess.run(
        command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode in codes, done.stdout + done.stderr
    return done.stdout


def is_a_picture(path: Path) -> None:
    """A PNG on which something is drawn."""
    with Image.open(path) as image:
        assert len(image.convert("RGB").getcolors(1 << 24) or ()) > 20


def lines(text: str, begin: str) -> list[str]:
    """Return the lines of its shell blocks that begin so."""
    found = "\n".join(blocks(text, "sh")).splitlines()
    return [line for line in found if line.startswith(begin)]


def test_first_balance(tmp_path: Path) -> None:
    """The first page's ten lines: it is balanced, drawn and filmed."""
    (code,) = blocks(section("docs/index.md"), "python")
    assert re.search(r"balanced after [\d.]+ s", python(code, tmp_path))
    is_a_picture(tmp_path / "motion.png")
    assert (tmp_path / "film.gif").read_bytes().startswith(b"GIF89a")


def test_ones_own_mechanism_from_urdf(tmp_path: Path) -> None:
    """The tutorial's file by its name: balanced, with a picture; and a page that replays."""
    text = section("docs/tutorial.md", "2. A mechanism of your own")
    (urdf,) = blocks(text, "xml")
    (tmp_path / "pole.urdf").write_text(urdf, encoding="utf-8")
    simulate, show = lines(text, "undertow ")
    assert "reached" in typed(simulate, tmp_path)
    pictures = list((tmp_path / "pole").glob("*.png"))
    assert pictures
    for picture in pictures:
        is_a_picture(picture)
    typed(f"{show.partition('#')[0]} --save page.html", tmp_path)
    assert b'id="recording"' in (tmp_path / "page.html").read_bytes()


def test_ones_own_cost(tmp_path: Path) -> None:
    (first, *_) = blocks(section("docs/recipes.md"), "python")
    (code,) = blocks(section("docs/recipes.md", "A cost of your own"), "python")
    assert float(python(first + code, tmp_path)) > 0


def test_a_comparison_with_lqr(tmp_path: Path) -> None:
    """A row for each controller on each plant."""
    pytest.importorskip("casadi")
    (first, *_) = blocks(section("docs/recipes.md"), "python")
    (code,) = blocks(
        section("docs/recipes.md", "LQR and predictive control in one table"), "python"
    )
    printed = python(first + code, tmp_path)
    for name in ("cascade", "LQR", "NMPC"):
        assert len(re.findall(rf"^\W*{name}\b", printed, re.MULTILINE)) == 2, printed


def test_a_picture_of_the_region(tmp_path: Path) -> None:
    """Some starts come home and some do not, and the picture shows which."""
    (first, *_) = blocks(section("docs/recipes.md"), "python")
    (code,) = blocks(section("docs/recipes.md", "A map of the region"), "python")
    printed = python(f"{first}surface = ut.first_surface(rig)\n{code}", tmp_path)
    home, of = map(int, re.findall(r"\d+", printed))
    assert 0 < home < of
    is_a_picture(tmp_path / "region.png")


def test_a_driver_skeleton_runs(tmp_path: Path) -> None:
    """The driver and the card that stands in for a real one, through swing-up and catch.

    Whether all deadlines are kept is this machine's; that it is caught is the driver's.
    """
    text = section("docs/rigs.md", "A driver of your own")
    driver, card, *_ = blocks(text, "python")
    (tmp_path / "my_rig.py").write_text(driver, encoding="utf-8")
    (tmp_path / "daq.py").write_text(card, encoding="utf-8")
    command = next(line for line in lines(text, "undertow run ") if "my_rig.py" in line)
    printed = typed(command, tmp_path, (0, 3, 6))
    assert "SWING_UP" in printed
    assert "BALANCE" in printed
    assert (tmp_path / "run.db").exists()
