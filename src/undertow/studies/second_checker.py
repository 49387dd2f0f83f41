"""The second checker of certificates, a program of its own (``make checker`` builds it).

Its code in ``checker/`` shares none with the library: here it is only found, run, and read.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table

from undertow.base import MissingExtraError, table
from undertow.base.errors import CertificateError

NAME = "undertow-checker"
BUILT = Path(__file__).parents[3] / "build" / NAME
COMPILERS = ("g++", "clang++")


def second_checker() -> Path:
    """Return the program: in this checkout's ``build/``, else on the PATH.

    Raises MissingExtraError where it is not built; the remedy names the compiler if that is missing
    too.
    """
    found = str(BUILT) if BUILT.is_file() else shutil.which(NAME)
    if found is None:
        remedy = "Build it in a checkout of the repository: make checker"
        if not any(map(shutil.which, COMPILERS)):
            remedy = (
                f"No compiler is found ({' or '.join(COMPILERS)}): install one, then make checker"
            )
        raise MissingExtraError(
            f"second checker '{NAME}'", value="not built", limit="built", remedy=remedy
        )
    return Path(found)


def decide_again(file: Path, *, seconds: float = 600.0) -> list[tuple[str, float]]:
    """Return verdict and time in s of every claim of a file, in its order, by the second checker.

    The file is a certificate of version 2; each claim may take ``seconds``, s. Raises
    CertificateError where it refuses the file; MissingExtraError where it is not built.
    """
    command = [str(second_checker()), str(file), "--seconds", repr(float(seconds))]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    if run.returncode not in (0, 1) or run.stderr:
        raise CertificateError(
            "certificate before the second checker",
            value=run.stderr.strip() or f"exit status {run.returncode}",
            limit="a file of version 2",
        )
    lines = re.findall(r"^claim \d+: (\w+), ([\d.]+) s$", run.stdout, re.MULTILINE)
    return [(kind, float(time)) for kind, time in lines]


def agree(first: str, second: str) -> bool:
    """Return whether both or neither call a claim proved."""
    return (first == "proved") == (second == "proved")


def agreement_table(
    kinds: Sequence[str], first: Sequence[tuple[str, float]], second: Sequence[tuple[str, float]]
) -> tuple[Table, bool]:
    """Return a table for the terminal, claim by claim, and whether both checkers agree on all.

    ``first`` and ``second`` are verdict and time, s, of each claim, by the kernel and by the second
    checker.
    """
    rows, heads = [], ("claim", "kernel", "second checker", "")
    fine = len(kinds) == len(first) == len(second)
    for kind, (a, s), (b, t) in zip(kinds, first, second, strict=False):
        one_alone = "undecided" in (a, b)
        word = "agree" if agree(a, b) else "proved by one alone" if one_alone else "DISAGREE"
        rows.append((kind, f"{a}, {s:.3f} s", f"{b}, {t:.3f} s", word))
        fine = fine and agree(a, b)
    return table(heads, rows, left=heads), fine
