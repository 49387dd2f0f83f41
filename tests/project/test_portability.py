"""What a system without POSIX lacks is not asked for on import, in simulate, certify and export."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

#: Takes away, once what others wrote is imported, what only POSIX systems have.
WITHOUT_POSIX = """
import importlib.abc, os, signal, socket, sys
import asyncio, concurrent.futures.process, ctypes, multiprocessing.connection
import multiprocessing.reduction
import sqlite3, subprocess, tempfile
import matplotlib.figure, numba, numpy, rich.console, scipy.linalg, sympy, typer

MISSING = {"fcntl", "resource", "termios", "tty", "pty", "pwd", "grp", "syslog", "posix"}

class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in MISSING:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

sys.meta_path.insert(0, Refuse())
for name in MISSING:
    sys.modules.pop(name, None)
for name in ("fork", "forkpty", "getuid", "geteuid", "getgid", "getegid", "setsid", "killpg",
             "sched_setscheduler", "sched_getscheduler", "sched_setaffinity", "sched_getaffinity",
             "sched_param", "SCHED_FIFO", "O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC", "fchmod",
             "fchown", "chown", "uname", "getpgid", "getloadavg", "sysconf", "register_at_fork"):
    if hasattr(os, name):
        delattr(os, name)
for name in ("SIGKILL", "SIGHUP", "SIGQUIT", "SIGTSTP", "SIGCONT", "SIGSTOP", "SIGUSR1", "SIGUSR2",
             "SIGALRM", "SIGCHLD", "SIGPIPE", "pthread_sigmask", "sigwait", "sigtimedwait",
             "setitimer", "alarm", "pause"):
    if hasattr(signal, name):
        delattr(signal, name)
sys.platform = "win32"
"""

IMPORT_ALL = """
import importlib, pkgutil
import undertow
for module in pkgutil.walk_packages(undertow.__path__, "undertow."):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except Exception as error:
            if type(error).__name__ != "MissingExtraError":
                raise
"""

USE = """
import undertow as ut
pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
surface = ut.Surface(alpha_a=-1, lambda_a=-1.59, alpha_u=1.96, lambda_u=12.1)
budgets = {"cold": ut.Budget(64), "warm": ut.Budget(32)}
cascade = ut.Cascade(pendulum, ut.MinimumEnergy(), first=surface, belief="exact", **budgets)
run = cascade.simulate(phi=0.3, duration=0.3)
assert run.cost > 0
"""

EXPORT = """
import undertow as ut
from pathlib import Path
pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
surface = ut.Surface(alpha_a=-1, lambda_a=-1.59, alpha_u=1.96, lambda_u=12.1)
assert ut.export_c(pendulum, surface, Path(OUT)).exists()
"""

CERTIFY = """
import undertow as ut
pendulum = ut.mechanisms.rotary_pendulum(d_e=0.025)
surface = ut.Surface(alpha_a=-1, lambda_a=-1.59, alpha_u=1.96, lambda_u=12.1)
assert ut.certify(pendulum, surface, seconds=2.0)
"""


def without_posix(code: str, folder: Path) -> None:
    """Run code in a process from which POSIX has been taken away."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path), "MPLBACKEND": "Agg"}
    given = f"OUT = {str(folder / 'out')!r}\n"
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(WITHOUT_POSIX) + given + code],
        capture_output=True, text=True, check=False, env=environment, cwd=folder,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        pytest.param(IMPORT_ALL + USE, id="import and simulate"),
        pytest.param(EXPORT, id="export"),
        pytest.param(CERTIFY, id="certify"),
    ],
)
def test_nothing_asks_for_posix(code: str, tmp_path: Path) -> None:
    """Blocked: modules, calls and signals that Windows does not have."""
    without_posix(code, tmp_path)
