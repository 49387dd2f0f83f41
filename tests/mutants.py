"""Mutants of the core: one change of one expression, and whether a test notices.

``python tests/mutants.py --count 300`` changes 300 places, spread evenly over the core's files,
runs the tests of the package that was changed (then those of the packages that stand on it), and
lists the mutants that survive.  ``--list`` shows them without running anything; a mutant comes out
again with ``--seed N --only NUMBER``.

Where it is known which test reaches which line, a mutant meets those tests first, and is over
sooner::

    make coverage                                     # writes .coverage
    python tests/mutants.py --package law --reached .coverage --near

``--near`` leaves all others out, but for those that name a module of compiled lines, of which
coverage sees some alone: what survives then may yet be killed by another test.  The data are of the
tests as they stand: one that is gone would count as one that fails.
"""

from __future__ import annotations

import argparse
import ast
import multiprocessing
import os
import random
import re
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import coverage
import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "src" / "undertow"

#: The packages that are mutated: to the tests that should notice, the nearest first.
CORE = {
    "law": (("law",), ("closed_loop", "optimiser", "cascade")),
    "closed_loop": (("closed_loop",), ("optimiser", "cascade")),
    "optimiser": (("optimiser",), ("cascade",)),
    "estimators": (("estimators",), ("runtime",)),
    "cascade": (("cascade",), ("runtime",)),
    "proofs": (("proofs",), ("studies",)),
}

#: The packages that stand on what is generated and compiled, and are no part of it.
ABOVE = ("optimiser", "estimators", "proofs")

#: What every run of tests imports, and no mutant changes: imported once, see :func:`outcome`.
OTHERS = ["matplotlib.pyplot", "numba", "pytest", "scipy.optimize", "sympy", "typer"]

SURVIVED = "SURVIVED"
TOO_LONG = "ran out of time"

#: Longest time of the tests of one package on one mutant, s: one that does not end is noticed, too,
#: and is counted apart, for on a busy machine it may be one that nothing would notice.
LIMIT = 600.0

SWAPS: dict[type[ast.AST], tuple[str, str]] = {
    ast.Lt: ("<", "<="), ast.LtE: ("<=", "<"), ast.Gt: (">", ">="), ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="), ast.NotEq: ("!=", "=="), ast.Is: ("is", "is not"),
    ast.IsNot: ("is not", "is"), ast.In: ("in", "not in"), ast.NotIn: ("not in", "in"),
    ast.Add: ("+", "-"), ast.Sub: ("-", "+"), ast.Mult: ("*", "/"), ast.Div: ("/", "*"),
    ast.Pow: ("**", "*"), ast.FloorDiv: ("//", "*"), ast.Mod: ("%", "*"), ast.MatMult: ("@", "*"),
    ast.And: ("and", "or"), ast.Or: ("or", "and"),
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change: ``old`` at a place of a file becomes ``new``."""

    file: Path
    line: int
    start: int
    end: int
    old: str
    new: str

    def __str__(self) -> str:
        place = f"{self.file.relative_to(ROOT)}:{self.line}"
        return f"{place}: {' '.join(self.old.split())} -> {' '.join(self.new.split())}"

    def text(self) -> bytes:
        """Return the file with the change."""
        content = self.file.read_bytes()
        return content[: self.start] + self.new.encode() + content[self.end :]


def mutants(path: Path) -> Iterator[Mutant]:
    """Yield all changes of a file that are tried."""
    content = path.read_bytes()
    starts = [0]
    for line in content.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def begin(node: ast.expr | ast.stmt) -> int:
        return starts[node.lineno - 1] + node.col_offset

    def end(node: ast.expr | ast.stmt) -> int:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return starts[node.end_lineno - 1] + node.end_col_offset

    def change(line: int, start: int, stop: int, new: str) -> Mutant:
        return Mutant(path, line, start, stop, content[start:stop].decode(), new)

    def between(left: ast.expr, right: ast.expr, kind: type[ast.AST]) -> Iterator[Mutant]:
        old, new = SWAPS[kind]
        if (at := content.find(old.encode(), end(left), begin(right))) >= 0:
            yield change(left.lineno, at, at + len(old), new)

    for node in _computing(ast.parse(content)):
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            yield from between(node.left, node.comparators[0], type(node.ops[0]))
        elif isinstance(node, ast.BinOp) and type(node.op) in SWAPS:
            yield from between(node.left, node.right, type(node.op))
        elif isinstance(node, ast.BoolOp):
            yield from between(node.values[0], node.values[1], type(node.op))
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not):
            sign = 1 if isinstance(node.op, ast.USub) else len("not")
            yield change(node.lineno, begin(node), begin(node) + sign, "")
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
            yield change(node.lineno, begin(node), end(node), str(not node.value))
        elif isinstance(node, ast.Constant) and isinstance(node.value, int):
            yield change(node.lineno, begin(node), end(node), str(node.value + 1))
        elif isinstance(node, ast.Constant) and isinstance(node.value, float):
            yield change(node.lineno, begin(node), end(node), repr(2 * node.value + 1e-3))
        elif isinstance(node, ast.If) and not _of_types(node.test):
            test = content[begin(node.test) : end(node.test)].decode()
            yield change(node.lineno, begin(node.test), end(node.test), f"not ({test})")
        elif isinstance(node, ast.AugAssign) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        ):
            yield change(node.lineno, begin(node), end(node), "pass")


def _of_types(test: ast.expr) -> bool:
    return isinstance(test, ast.Name) and test.id == "TYPE_CHECKING"


def _is_true(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and node.value is True


def _computing(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what computes: no words, no annotations, no settings of caches, no errors' texts.

    Nor ``strict=True`` of ``zip``: it asserts that what is paired is equally long, and where that
    holds the program does the same without it.
    """
    if isinstance(node, ast.JoinedStr | ast.Raise) or (
        isinstance(node, ast.FunctionDef) and node.name in ("__repr__", "__str__")
    ):
        return
    if isinstance(node, ast.keyword) and node.arg == "strict" and _is_true(node.value):
        return
    yield node
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list", "type_comment"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield from _computing(child)


def chosen(count: int, seed: int, packages: list[str]) -> list[Mutant]:
    """Return ``count`` mutants, as many of each file as of any other where it has them."""
    rng = random.Random(seed)
    files = [path for name in packages for path in sorted((PACKAGE / name).rglob("*.py"))]
    rest = {path: list(mutants(path)) for path in files}
    for some in rest.values():
        rng.shuffle(some)
    found: list[Mutant] = []
    while len(found) < count and any(rest.values()):
        turn = [path for path in files if rest[path]]
        rng.shuffle(turn)
        found += [rest[path].pop() for path in turn[: count - len(found)]]
    return found


def nearest(mutant: Mutant, names: tuple[str, ...]) -> list[str]:
    """Return the files of tests that name the module that was changed: they notice first."""
    word = re.compile(rf"\b{mutant.file.stem}\b")
    files = [path for name in names for path in sorted((ROOT / "tests" / name).glob("test_*.py"))]
    return [str(path.relative_to(ROOT)) for path in files if word.search(path.read_text())]


@lru_cache(maxsize=1)
def _data(*files: str) -> tuple[coverage.CoverageData, ...]:
    data = tuple(coverage.CoverageData(name) for name in files)
    for one in data:
        one.read()
    return data


def reaching(mutant: Mutant, files: tuple[str, ...]) -> list[str]:
    """Return the tests that reach the statement that was changed, the narrowest first.

    Coverage sees compiled code where it also ran in Python, and no second use of a value that is
    remembered: a test that is not among them may notice the mutant, too.
    """
    nodes = ast.walk(ast.parse(mutant.file.read_bytes()))
    spans = [_span(node) for node in nodes if isinstance(node, ast.stmt)]
    first, last = max(span for span in spans if span[0] <= mutant.line <= span[1])
    width, found = Counter[str](), set[str]()
    for data in _data(*files):
        for line, tests in data.contexts_by_lineno(str(mutant.file)).items():
            names = {name.partition("|")[0] for name in tests if name}
            width.update(names)
            if first <= line <= last:
                found |= names
    return sorted(found, key=lambda name: (width[name], name))


def _span(node: ast.stmt) -> tuple[int, int]:
    """Return the first and the last line of a statement, without those that it holds."""
    assert node.end_lineno is not None
    body = getattr(node, "body", None)
    return node.lineno, max(node.lineno, body[0].lineno - 1) if body else node.end_lineno


def _in_machine_code(mutant: Mutant) -> bool:
    """Whether what was changed may be in what numba keeps: that is decorated, or a constant."""
    nodes = ast.walk(ast.parse(mutant.file.read_bytes()))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef)]
    around = [f for f in functions if f.lineno <= mutant.line <= (f.end_lineno or 0)]
    return not around or any(f.decorator_list for f in around)


def _judge(words: list[str], environment: dict[str, str]) -> None:
    """Run tests in this process, and end with their exit status."""
    os.environ |= environment
    os.chdir(ROOT)
    sys.path[:0] = [str(ROOT), environment["PYTHONPATH"]]
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    os._exit(int(pytest.main(words)))


def outcome(mutant: Mutant, reached: tuple[str, ...] = (), near: bool = False) -> str:
    """Return what becomes of a mutant: killed, ran out of time or SURVIVED.

    Its tests run in a process that is forked from one that has imported other people's packages.
    """
    package = mutant.file.relative_to(PACKAGE).parts[0]
    compiled = re.search(rb"njit|compiled\b", mutant.file.read_bytes())
    turns = [reaching(mutant, reached)]
    if near and compiled:
        turns.append(nearest(mutant, CORE[package][0]))
    elif not near:
        turns += [
            [*nearest(mutant, names), *(f"tests/{name}" for name in names)]
            for names in CORE[package]
        ]
    stale = compiled and _in_machine_code(mutant)
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        tree = Path(folder) / "undertow"
        # What numba keeps of functions contains those that they call: none of it, if one changes.
        shutil.copytree(
            PACKAGE, tree, ignore=shutil.ignore_patterns("*.nbi", "*.nbc") if stale else None
        )
        (tree / mutant.file.relative_to(PACKAGE)).write_bytes(mutant.text())
        # So it does of generated modules, but for what stands above all of those.
        own = stale and package not in ABOVE
        cache = Path(folder if own else tempfile.gettempdir()) / "mutants"
        environment = {"PYTHONPATH": folder, "UNDERTOW_CACHE": str(cache)}
        for tests in filter(None, turns):
            words = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--hypothesis-seed=0"]
            run = multiprocessing.get_context("forkserver").Process(
                target=_judge, args=([*words, *tests], environment)
            )
            run.start()
            run.join(LIMIT)
            if run.is_alive():
                run.kill()
                return TOO_LONG
            if run.exitcode not in (0, pytest.ExitCode.NO_TESTS_COLLECTED):
                return "killed"
    return SURVIVED


def main() -> int:
    """Try mutants from the command line; exit status 1 when fewer than asked are killed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=300, help="mutants")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--package", choices=sorted(CORE), action="append", help="all by default")
    parser.add_argument("--only", type=int, action="append", help="number of a mutant")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument("--reached", action="append", default=[], help="data of coverage")
    parser.add_argument("--near", action="store_true", help="tests that reach or name it alone")
    parser.add_argument("--least", type=float, default=85.0, help="share to be killed, %%")
    parser.add_argument("--list", action="store_true", help="show them alone")
    asked = parser.parse_args()
    every = chosen(asked.count, asked.seed, asked.package or list(CORE))
    numbered = [(k, one) for k, one in enumerate(every) if not asked.only or k in asked.only]
    if asked.list:
        for number, mutant in numbered:
            print(f"{number}: {mutant}")
        return 0
    began, found = time.monotonic(), Counter[str]()
    multiprocessing.get_context("forkserver").set_forkserver_preload(OTHERS)
    with ThreadPoolExecutor(asked.jobs) as pool:
        outcomes = pool.map(
            lambda item: outcome(item[1], tuple(asked.reached), asked.near), numbered
        )
        for done, ((number, mutant), word) in enumerate(zip(numbered, outcomes, strict=True), 1):
            found[word] += 1
            print(f"{done} of {len(numbered)}, {word}: #{number} {mutant}", flush=True)
    killed = len(numbered) - found[SURVIVED]
    share = 100 * killed / max(1, len(numbered))
    print(f"{killed} of {len(numbered)} mutants killed, {share:.0f} %, "
          f"{found[TOO_LONG]} of them by time, seed {asked.seed}, "
          f"{time.monotonic() - began:.0f} s")  # fmt: skip
    return 0 if share >= asked.least else 1


if __name__ == "__main__":
    raise SystemExit(main())
