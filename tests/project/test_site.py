"""The documentation site, without building it: pages, gallery and reference are complete."""

from __future__ import annotations

import importlib
import importlib.util
import pkgutil
import re
from pathlib import Path
from types import ModuleType

import pytest

import undertow as ut

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
GALLERY = sorted((ROOT / "examples" / "gallery").glob("*.py"))
TREES = re.compile(r"```\{toctree\}\n(.*?)```", re.DOTALL)


def _listed() -> list[str]:
    """Return what the tables of contents of the first page name."""
    trees = TREES.findall((DOCS / "index.md").read_text(encoding="utf-8"))
    return [line for tree in trees for line in tree.split() if not line.startswith(":")]


def _reference() -> list[str]:
    """Return the modules that have a page of the reference."""
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    return re.findall(r"^   (undertow[\w.]*)$", page, re.MULTILINE)


def test_every_page_is_in_the_table_of_contents() -> None:
    """Once, and nothing is listed that is not there; the gallery's page is made."""
    pages = {path.stem for path in DOCS.glob("*.md")} - {"index"}
    listed = [
        name for name in _listed() if not name.isupper() and name in pages | {"gallery/index"}
    ]
    assert sorted(listed) == sorted(pages | {"gallery/index"})


@pytest.mark.parametrize("example", GALLERY, ids=lambda path: path.stem)
def test_an_example_is_a_short_page_with_a_picture(example: Path) -> None:
    """A title with its rule and a sentence, at most 30 lines, and a figure among its variables."""
    text = example.read_text(encoding="utf-8")
    assert re.match(r'"""\n([^\n]+)\n=+\n\n.{40,}?"""\n', text, re.DOTALL)
    assert len(text.splitlines()) <= 30
    assert re.search(r"^(figure|figure, .*) = ", text, re.MULTILINE)


def test_the_gallery_takes_every_example() -> None:
    """All of them, in the order of their numbers; links into it lead to examples."""
    assert [path.stem[:2] for path in GALLERY] == [f"{k:02}" for k in range(1, len(GALLERY) + 1)]
    assert len(GALLERY) >= 20
    settings = (DOCS / "conf.py").read_text(encoding="utf-8")
    assert '"examples_dirs": ["../examples/gallery"]' in settings
    assert r'"filename_pattern": r"\.py$"' in settings
    names = {path.stem for path in GALLERY} | {"index"}
    for page in DOCS.glob("*.md"):
        linked = re.findall(r"\(gallery/(\w+)\)", page.read_text(encoding="utf-8"))
        assert set(linked) <= names, page.name


def _packages() -> list[ModuleType]:
    found = pkgutil.walk_packages(ut.__path__, "undertow.")
    return [ut, *(importlib.import_module(module.name) for module in found if module.ispkg)]


def test_every_public_name_has_its_place_in_the_reference() -> None:
    """A page for each package that exports names, and each of them is there to be described."""
    pages = _reference()
    assert len(pages) == len(set(pages))
    public = {package.__name__ for package in _packages() if getattr(package, "__all__", ())}
    assert public <= set(pages), "packages that export names and have no page in docs/api.md"
    for name in pages:
        module = importlib.import_module(name)
        assert module.__doc__, name
        for one in getattr(module, "__all__", ()):
            assert hasattr(module, one), (name, one)


@pytest.mark.slow
def test_the_example_of_the_first_page_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its ten lines, as they stand."""
    page = (DOCS / "index.md").read_text(encoding="utf-8")
    code = page.split("```python\n")[1].split("```")[0]
    assert len([line for line in code.splitlines() if line.strip()]) <= 10
    monkeypatch.chdir(tmp_path)
    exec(code, {})
    assert {path.name for path in tmp_path.iterdir()} == {"motion.png", "film.gif"}


@pytest.mark.slow  # controllers compared, and several mechanisms compiled
@pytest.mark.parametrize("name", ["tutorial", "recipes", "interfaces"])
def test_what_a_page_shows_runs(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All Python of the page, in its order."""
    for extra in (
        "casadi", "flint", "clarabel", "pandas", "xarray", "control", "gymnasium", "pyarrow",
    ):  # fmt: skip
        pytest.importorskip(extra)
    page = (DOCS / f"{name}.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL):
        exec(block, names)


def test_the_check_of_links_finds_what_is_broken(tmp_path: Path) -> None:
    """Claim: a lost file, a lost place and a picture from elsewhere are named; a sound page not."""
    spec = importlib.util.spec_from_file_location("check_links", DOCS / "check_links.py")
    assert spec is not None
    assert spec.loader is not None
    check = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(check)
    (tmp_path / "a.html").write_text(
        '<p id="here"></p><a href="b.html#there"></a><a href="#here"></a>'
        '<a href="https://doi.org/x"></a><img src="data:image/png;base64,">'
    )
    (tmp_path / "b.html").write_text('<h1 id="there"></h1>')
    assert check.broken(tmp_path) == []
    (tmp_path / "b.html").write_text(
        '<a href="a.html#gone"></a><a href="gone.html"></a><script src="https://x.org/y.js">'
    )
    wrong = check.broken(tmp_path)
    assert len(wrong) == 4
    for words in ("a.html#gone: no such place", "gone.html: no such file", "y.js: loaded from"):
        assert any(words in line.replace("> ", " ") or words in line for line in wrong), words
