"""What each extra adds to an installation: packages and megabytes, of this environment.

Sizes are those of the files that the installed distributions record, from importlib.metadata.  An
extra counts what it needs, and what that needs in turn, beyond what the package itself needs.  What
is not installed is named and not counted.

    python benchmarks/extras.py [--quick]
"""

from __future__ import annotations

from harness import command_line, table  # isort: skip  first: one thread

import sys
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

#: Where the extras are listed.
PROJECT = Path(__file__).parents[1] / "pyproject.toml"

#: Extras for those who change this package, not for those who use it.
OWN = ("dev", "docs")


@cache
def installed(name: str) -> Distribution | None:
    """An installed distribution; nothing where it is not."""
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def needs(name: str, extra: str = "") -> list[Requirement]:
    """What a distribution needs here, of its own or for an extra."""
    found = installed(name)
    lines = [] if found is None else found.requires or []
    wanted = [Requirement(line) for line in lines]
    return [
        one
        for one in wanted
        if one.marker is None
        or (one.marker.evaluate({"extra": extra}) and (not extra or "extra" in str(one.marker)))
    ]


def closure(wanted: Iterable[Requirement]) -> set[str]:
    """All distributions that requirements lead to, by their canonical names."""
    found: set[str] = set()
    waiting = [(canonicalize_name(one.name), frozenset(one.extras)) for one in wanted]
    seen = set()
    while waiting:
        name, extras = waiting.pop()
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        found.add(name)
        more = needs(name) + [one for extra in extras for one in needs(name, extra)]
        waiting += [(canonicalize_name(one.name), frozenset(one.extras)) for one in more]
    return found


@cache
def megabytes(name: str) -> float:
    """Size of the files of a distribution, MB; 0 where it is not installed."""
    found = installed(name)
    files = [] if found is None else found.files or []
    places = [Path(str(file.locate())) for file in files]
    return sum(place.stat().st_size for place in places if place.is_file()) / 1e6


def main() -> int:
    """Print the sizes."""
    command_line(__doc__, clocks=False).parse_args()
    project = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["project"]
    core = closure(map(Requirement, project["dependencies"]))
    rows = [row("(core)", core)]
    for extra, wanted in sorted(project["optional-dependencies"].items()):
        if extra not in OWN:
            rows.append(row(extra, closure(map(Requirement, wanted)) - core))
    table("what is installed", ("extra", "packages", "MB", "the largest"), rows)
    return 0


def row(extra: str, names: set[str]) -> tuple[str, ...]:
    """A line of the table."""
    here = sorted((name for name in names if installed(name)), key=megabytes, reverse=True)
    missing = sorted(names - set(here))
    largest = ", ".join(f"{name} {megabytes(name):.0f}" for name in here[:3])
    words = f"{largest}; not installed: {', '.join(missing)}" if missing else largest
    return extra, str(len(here)), f"{sum(map(megabytes, here)):.0f}", words


if __name__ == "__main__":
    sys.exit(main())
