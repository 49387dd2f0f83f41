"""What is compiled lies where nobody else can write; without such a place it is made anew."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import sympy as sp

import undertow as ut
from undertow.base import ArtefactError
from undertow.models import lagrange
from undertow.symbolic import parse_expression, private, store
from undertow.symbolic.machine import caching
from undertow.symbolic.private import is_private, private_folder

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="owners and modes of POSIX")


@pytest.fixture
def shared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory of temporary files, and no usable cache of the user's."""
    monkeypatch.setenv("UNDERTOW_CACHE", "/dev/null/nowhere")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    tmp_path.chmod(0o1777)
    private._own_temporary.cache_clear()
    return tmp_path


@pytest.mark.parametrize("mode", [0o777, 0o707, 0o702])
def test_a_cache_that_others_can_write_is_not_used(
    shared: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, mode: int
) -> None:
    """Nor is one inside a folder that others can write: they could put another in its place."""
    open_to_all = shared / "cache"
    open_to_all.mkdir()
    open_to_all.chmod(mode)
    for chosen in (open_to_all, open_to_all / "inside"):
        monkeypatch.setenv("UNDERTOW_CACHE", str(chosen))
        found = private_folder()
        assert open_to_all not in (found, *found.parents)
        assert found.stat().st_mode & 0o777 == 0o700
    assert [str(open_to_all) in record.getMessage() for record in caplog.records] == [True, True]
    monkeypatch.setenv("UNDERTOW_CACHE", str(open_to_all))
    (open_to_all / "planted_x.txt").write_text("x")
    assert store.recall("planted", "x") is None
    module = store.load_module("elsewhere", f"value = {os.getpid()}\n")
    assert not str(module.__file__).startswith(str(open_to_all))


def test_the_folder_in_the_temporary_directory_is_ours_or_another_is_made(
    shared: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Made for its user alone; somebody else's of that name, or a link, is left alone."""
    ours = private_folder()
    assert ours == shared / f"undertow-{os.geteuid()}"
    assert ours.stat().st_mode & 0o777 == 0o700
    ours.rmdir()
    (shared / "planted").mkdir()
    ours.symlink_to(shared / "planted")
    made = private_folder()
    assert made not in (ours, shared / "planted")
    assert made.stat().st_mode & 0o777 == 0o700
    ours.unlink()
    ours.mkdir(mode=0o700)
    stranger = os.geteuid() + 1
    assert is_private(ours)
    monkeypatch.setattr(private, "_user", lambda: stranger)
    assert not is_private(ours)


def test_a_group_of_its_own_user_is_nobody_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "cache"
    folder.mkdir()
    folder.chmod(0o770)
    monkeypatch.setattr(private, "_group_of_one", lambda _: True)
    assert is_private(folder)
    monkeypatch.setattr(private, "_group_of_one", lambda _: False)
    assert not is_private(folder)


def test_no_place_at_all_is_said(shared: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(shared / "missing" / "folder"))
    (shared / "missing").write_text("in the way")
    with pytest.raises(ArtefactError, match="UNDERTOW_CACHE"):
        private_folder()
    private._own_temporary.cache_clear()


# -- equations are data ------------------------------------------------------------------------

PAYLOAD = "__import__('pathlib').Path({mark!r}).touch()"


@pytest.mark.parametrize(
    "form",
    ["{0}", 'Abs("{0}")', 'Symbol({0})', 'Matrix([["{0}"]])', 'sympify("{0}")', 'Integer("{0}")',
     "Lambda(({0},), 1)", "[{0} for _ in [1]]", "Symbol('x').__class__", "ImmutableDenseMatrix(S)"],
)  # fmt: skip
def test_equations_in_the_cache_are_read_and_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str
) -> None:
    mark = tmp_path / "mark"
    text = form.format(PAYLOAD.format(mark=str(mark)))
    with pytest.raises((ValueError, SyntaxError)):
        parse_expression(text)
    q, v = sp.symbols("q_0 q_1", real=True), sp.symbols("v_0 v_1", real=True)
    given = ("x", q, v, (v[0] ** 2 + v[1] ** 2) / 2, sp.cos(q[1]), sp.Integer(0))
    right = lagrange.derived(*given)
    monkeypatch.setattr(lagrange, "recall", lambda _name, _key: f"{text}\n{text}")
    assert lagrange.derived(*given) == right
    assert not mark.exists()


def test_of_many_texts_the_oldest_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A study of thousands of plants does not fill the disk; other kinds are left alone."""
    monkeypatch.setenv("UNDERTOW_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(store, "KEPT", 10)
    store.remember("other", "ff" * 32, "stays")
    for k in range(1, 50):
        store.remember("text", f"{k:02x}" * 32, f"{k}")
        written = private_folder() / f"text_{f'{k:02x}' * 16}.txt"
        os.utime(written, (k, k))
    assert store.recall("text", "01" * 32) == "1"
    store.remember("text", "00" * 32, "the one that clears")
    assert len(list(private_folder().glob("text_*.txt"))) == 10
    assert store.recall("text", "01" * 32) is None
    assert store.recall("text", "31" * 32) == "49"
    assert store.recall("text", "00" * 32) == "the one that clears"
    assert store.recall("other", "ff" * 32) == "stays"


def test_equations_come_back_from_the_cache_as_they_were() -> None:
    for make in (ut.mechanisms.rotary_pendulum, ut.mechanisms.tora, ut.mechanisms.gantry_crane):
        mechanism = make()
        for matrix in (mechanism.mass_matrix, mechanism.force):
            read = parse_expression(sp.srepr(matrix))
            assert read == matrix
            assert sp.srepr(read) == sp.srepr(matrix)


# -- numba's cache, and systems without -----------------------------------------------------------

WHERE = """
import undertow as ut
from undertow.optimiser.trust_region import __dict__ as names
from numba.core.dispatcher import Dispatcher
found = {f._cache.cache_path for f in names.values() if isinstance(f, Dispatcher)}
print(*found, sep="\\n")
"""

COMPILED = """
import os
import undertow as ut
from undertow.symbolic import store
source = '''import numba

@numba.njit(cache=True)
def twice(x):
    return 2 * x
'''
module = store.load_module("proof", source)
assert module.twice(21) == 42
print(module.__file__)
print(module.twice._cache.cache_path)
"""


def run(code: str, lock: bool = False, **environment: str) -> list[str]:
    """Run code in a process of its own; ``lock``: the administrator too keeps to modes."""

    def keep_to_modes() -> None:
        libc = ctypes.CDLL(None, use_errno=True)
        for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
            libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP

    environment.setdefault("PYTHONPATH", str(Path(ut.__file__).parents[1]))
    kept = {k: v for k, v in os.environ.items() if k in ("PATH", "LANG", "VIRTUAL_ENV")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=kept | environment, capture_output=True, text=True,
        check=False, preexec_fn=keep_to_modes if lock else None,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.slow
def test_numba_keeps_our_functions_where_nobody_else_can_write(tmp_path: Path) -> None:
    """Not where the environment says, if others can write there: what it keeps are pickles."""
    anybody = tmp_path / "anybody"
    anybody.mkdir()
    anybody.chmod(0o777)
    found = run(WHERE, NUMBA_CACHE_DIR=str(anybody), HOME=str(tmp_path))
    assert found
    assert all(is_private(Path(path)) for path in found)
    assert not list(anybody.iterdir())


def test_other_functions_keep_their_place() -> None:
    """Those of a user's own files are numba's affair."""
    locators = (getattr(caching, "CacheImpl", None) or caching._CacheImpl)._locator_classes
    assert locators[0].from_function(ut.deg, "/somewhere/else.py") is None


TOTAL = """from undertow.symbolic.compiler import compiled
@compiled()
def total(values):
    result = 0.0
    for value in values:
        result += value
    return result
"""


def test_two_that_compile_at_once_do_not_take_each_others_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Claim: where the index of one and the files of another were the last, nothing is mixed.

    numba's own names are numbers, and both began with the first: code for arrays ran on pairs.
    """

    def first_use(folder: Path, values: object) -> float:
        monkeypatch.setenv("UNDERTOW_CACHE", str(folder))
        module = store.load_module("total", TOTAL)
        del sys.modules[module.__name__]
        return float(module.total(values))

    arrays, pairs, mixed = (tmp_path / name for name in ("arrays", "pairs", "mixed"))
    assert first_use(arrays, np.ones(3)) == 3
    assert first_use(pairs, (1.0, 1.0)) == 2
    shutil.copytree(pairs, mixed)
    for path in arrays.rglob("*.nbc"):
        shutil.copy2(path, mixed / path.relative_to(arrays))
    assert len(list(mixed.rglob("*.nbc"))) == 2
    assert first_use(mixed, (1.0, 1.0)) == 2
    assert first_use(mixed, np.ones(3)) == 3


READ_ONLY_RUN = (
    COMPILED
    + """
motion = ut.ClosedLoop(ut.mechanisms.rotary_pendulum(), step=0.002).simulate(
    [0.0, 0.1, 0.0, 0.0], ut.Plan.of(ut.Surface(-1, -1.59, 1.96, 12.1)), duration=0.1
)
assert len(motion.t) > 10
"""
)


@pytest.fixture
def read_only(tmp_path: Path) -> dict[str, str]:
    """An installation and a home that cannot be written, and a directory of temporary files."""
    package, home, temporary = (tmp_path / name for name in ("package", "home", "tmp"))
    ignored = shutil.ignore_patterns("__pycache__")
    shutil.copytree(Path(ut.__file__).parent, package / "undertow", ignore=ignored)
    home.mkdir()
    temporary.mkdir()
    for folder in (home, package, *(p for p in package.rglob("*") if p.is_dir())):
        folder.chmod(0o555)
    return {"PYTHONPATH": str(package), "HOME": str(home), "TMPDIR": str(temporary)}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="capabilities of Linux")
@pytest.mark.parametrize("code", [COMPILED, READ_ONLY_RUN], ids=["import", "run"])
def test_an_installation_and_a_home_that_cannot_be_written_are_no_obstacle(
    read_only: dict[str, str], code: str
) -> None:
    """Import failed there: numba found no place to keep what it compiles."""
    probe = "import os; print(os.access(os.environ['HOME'], os.W_OK))"
    if run(probe, lock=True, **read_only) != ["False"]:
        pytest.skip("modes do not bind this user")
    places = run(code, lock=True, **read_only)
    assert len(places) == 2
    assert all(place.startswith(read_only["TMPDIR"]) for place in places)
    assert not list(Path(read_only["PYTHONPATH"]).rglob("__pycache__"))


OTHER_SYSTEM = """
import importlib, multiprocessing.context, os, signal, sys
import numpy, sympy, numba, scipy.linalg, matplotlib.figure, typer, rich.table  # as installed there
for name in ("getuid", "geteuid", "getgid", "fork", "setsid", "O_DIRECTORY", "O_NONBLOCK",
             "sched_setscheduler", "sched_getscheduler", "mkfifo", "chown"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGHUP", "SIGTSTP", "SIGQUIT", "SIGKILL", "SIGSTOP", "SIGALRM", "SIGCONT"):
    delattr(signal, name)
del multiprocessing.context.ForkProcess
for name in ("fcntl", "pwd", "grp", "resource", "termios"):
    sys.modules[name] = None
import undertow as ut
import undertow.cli, undertow.runtime, undertow.studies.trials.report
import undertow.proofs, undertow.export
from pathlib import Path
from undertow.base.errors import InvalidInputError
from undertow.runtime import Recipe, replay
from undertow.runtime.processes import fork
from undertow.runtime.session import session
recipe = Recipe(parameters={"d_e": 0.025}, evaluations=64, start=(0.0, 0.3, 0.0, 0.0))
with session(recipe, log=Path("run.db"), simulated=True) as runtime:
    report = runtime.run(0.3)
assert report.steps > 250, report
assert replay(Path("run.db")).identical
try:
    fork(print, (), "worker")
except InvalidInputError as error:
    print(error)
"""


@pytest.mark.slow
def test_a_system_without_users_forks_and_posix_signals_simulates_and_replays(
    tmp_path: Path,
) -> None:
    """As on Windows, by taking away what it has not."""
    cache = os.environ.get("UNDERTOW_CACHE", str(tmp_path / "cache"))
    code = f"import os; os.chdir({str(tmp_path)!r})\n{OTHER_SYSTEM}"
    (said,) = run(code, UNDERTOW_CACHE=cache, HOME=str(tmp_path))
    assert "cannot fork" in said


#: Compiled once and kept, and loaded by the next process; then something that is compiled afresh.
PROBE = '''
import sys
import numpy as np
from undertow.symbolic import numba
from undertow.symbolic.store import load_module

kept = load_module("probe", """
import numba
import numpy as np


@numba.njit(cache=True)
def doubled(x):
    out = np.empty(len(x))
    for i in range(len(x)):
        out[i] = 2.0 * x[i]
    return out
""").doubled
x = np.arange(3.0)
print(kept(x).sum(), kept.stats.cache_hits.total(), "numba.np.arraymath" in sys.modules)


@numba.njit
def theirs(x):
    return x.max() + kept(x).sum()


print(round(theirs(x), 6))
'''


@pytest.mark.slow
def test_kept_machine_code_loads_without_what_compiling_needs(tmp_path: Path) -> None:
    """Claim: a second process runs it without numba's own functions, and can still compile."""
    paths = os.pathsep.join(sys.path)
    environment = os.environ | {"UNDERTOW_CACHE": str(tmp_path), "PYTHONPATH": paths}
    first, second = (
        subprocess.run(
            [sys.executable, "-c", PROBE],
            capture_output=True, text=True, env=environment, check=True,
        ).stdout.splitlines()
        for _ in range(2)
    )  # fmt: skip
    assert first[0] == "6.0 0 True"
    assert second[0] == "6.0 1 False"
    assert first[1] == second[1] == str(2.0 + 6.0)
