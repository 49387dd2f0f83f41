"""A folder that nobody else can write: what lies in it is run.

Generated modules, and the machine code that numba keeps beside them (pickles, which are
programs too), are read back and executed.  They are kept only where nobody but this user, and
the system's administrator, can put anything.
"""

from __future__ import annotations

import atexit
import contextlib
import logging
import os
import shutil
import stat
import tempfile
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from undertow.base.errors import or_refused


def cache_folder() -> Path:
    """Return the folder of generated kernels: ``$UNDERTOW_CACHE`` or the user's cache.

    Raises RuntimeError when the user has no home.
    """
    chosen = os.environ.get("UNDERTOW_CACHE")
    if chosen:
        return Path(chosen)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "undertow"


def private_folder() -> Path:
    """Return the cache folder where it is this user's alone, or else a temporary one that is.

    The folder in the temporary directory is made for the user, and kept; where somebody else has
    made one of its name, a new one is made for this process, and removed at its end. Raises
    ArtefactError when there is no such folder, and none can be made.
    """
    for folder in _candidates():
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            resolved = folder.resolve()
        except (OSError, RuntimeError):
            continue
        if os.access(resolved, os.W_OK | os.X_OK):
            if is_private(resolved):
                return resolved
            _say(resolved)
    return _own_temporary()


@lru_cache(maxsize=8)
def _say(folder: Path) -> None:
    """Say once why a cache is not used: without it everything is compiled again and again."""
    logging.getLogger("undertow").warning(
        "the cache %s is not used: others can write there, or in a folder above it", folder
    )


def _candidates() -> Iterator[Path]:
    with contextlib.suppress(RuntimeError):
        chosen = cache_folder()
        yield chosen
    with contextlib.suppress(OSError):
        user = _user()
        shared = Path(tempfile.gettempdir()) / f"undertow-{'cache' if user is None else user}"
        if not shared.is_symlink():
            yield shared


def _user() -> int | None:
    """Return the number of the user; ``None`` where users have none, as on Windows."""
    return os.geteuid() if hasattr(os, "geteuid") else None


@lru_cache(maxsize=1)
def _own_temporary() -> Path:
    """Make a folder for this process; its copies, which ``fork`` makes, share it."""
    refusal = "one that you alone can write", "Name one: UNDERTOW_CACHE=FOLDER"
    with or_refused("folder for compiled code", *refusal):
        folder = Path(tempfile.mkdtemp(prefix="undertow-")).resolve()
    process = os.getpid()

    def remove() -> None:
        if os.getpid() == process:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(remove)
    return folder


def is_private(folder: Path) -> bool:
    """Whether this user alone, and the administrator, can put something into a folder.

    The folder must be the user's own.  So must be those that it lies in, or the administrator's;
    who can write one of these could put another folder in its place, unless it is sticky, as
    the directory of temporary files is.  On a system without numbers of users (Windows), a
    user's folders are protected by lists that are not read here.

    The folder is absolute, without links.
    """
    user = _user()
    if user is None:
        return True
    try:
        own, *above = [os.lstat(part) for part in (folder, *folder.parents)]
    except OSError:
        return False
    if not stat.S_ISDIR(own.st_mode) or own.st_uid != user or _others_write(own):
        return False
    return all(
        facts.st_uid in (0, user) and (not _others_write(facts) or facts.st_mode & stat.S_ISVTX)
        for facts in above
    )


def _others_write(facts: os.stat_result) -> bool:
    if facts.st_mode & stat.S_IWOTH:
        return True
    return bool(facts.st_mode & stat.S_IWGRP) and not _group_of_one(facts.st_gid)


@lru_cache(maxsize=16)
def _group_of_one(number: int) -> bool:
    """Whether a group is the user's own, of the same name and with nobody else in it."""
    import grp
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(number)
    except KeyError:
        return False
    same = user.pw_gid == number and user.pw_name == group.gr_name
    return same and set(group.gr_mem) <= {user.pw_name}
