"""Generated modules on disk: written once, named by their content, compiled once.

numba's cache needs a real file and does not notice changed globals, so the file's name
carries a hash of its source and of the versions that shape the machine code.  All of it lies
in a folder that nobody else can write, see :mod:`undertow.symbolic.private`.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib.util
import os
import platform
import re
import sys
import tempfile
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from types import ModuleType

import numpy as np
import sympy as sp

from undertow.base.errors import or_refused
from undertow.symbolic.machine import PACKAGE, numba
from undertow.symbolic.private import private_folder

#: Texts of a kind that a clearance leaves; one write in 256 clears.
KEPT = 1024


def content_key(*texts: str) -> str:
    """Return a hash of texts, of the sources of this package, and of versions.

    ``*texts``: everything else that a stored result depends on.
    """
    digest = hashlib.sha256(_versions().encode())
    for text in (*texts, sources_digest()):
        digest.update(f"{len(text)} {text}".encode())
    return digest.hexdigest()


@lru_cache(maxsize=1)
def sources_digest() -> str:
    """Return a hash of the text of every Python file of this package."""
    digest = hashlib.sha256()
    for path in sorted(PACKAGE.rglob("*.py")):
        digest.update(path.relative_to(PACKAGE).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _versions() -> str:
    libraries = f"{numba.__version__} {sp.__version__} {np.__version__}"
    return f"{libraries} {sys.version} {platform.machine()}"


def recall(name: str, key: str) -> str | None:
    """Return the text that was remembered under a key, ``None`` where there is none."""
    try:
        seal, _, text = (
            (private_folder() / f"{name}_{key[:32]}.txt")
            .read_text(encoding="utf-8")
            .partition("\n")
        )
    except (OSError, UnicodeDecodeError):
        return None
    return text if seal == _seal(key, text) else None


def remember(name: str, key: str, text: str) -> None:
    """Keep a text under a key; a disk that refuses only costs time later.

    Now and then, by the key, the oldest of too many of its kind go: a study of many plants has
    many texts.
    """
    with contextlib.suppress(OSError, UnicodeEncodeError):
        folder = private_folder()
        _write(folder / f"{name}_{key[:32]}.txt", f"{_seal(key, text)}\n{text}")
        if key.startswith("00"):
            written = sorted(folder.glob(f"{name}_*.txt"), key=lambda path: path.stat().st_mtime)
            for old in written[:-KEPT]:
                old.unlink(missing_ok=True)


def generated(kind: str, name: str, key: str, write: Callable[[], str]) -> ModuleType:
    """Import a generated module, writing its source only where none is kept under the key.

    The key is everything that the source depends on, see :func:`content_key`; ``write`` returns the
    source; ``kind`` and ``name``, of the mechanism, are the module's name.
    """
    source = recall(kind, key)
    if source is None:
        source = write()
        remember(kind, key, source)
    return load_module(f"{kind}_{name}", source)


def _seal(key: str, text: str) -> str:
    """Hash that ties a stored text to its whole key and shows that it is whole."""
    return hashlib.sha256(f"{key} {text}".encode()).hexdigest()


def _write(path: Path, text: str) -> None:
    """Write a file that appears whole or not at all."""
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(text)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def load_module(name: str, source: str) -> ModuleType:
    """Import ``source`` from the cache, writing it first if it is new.

    The file appears whole or not at all, so several processes may ask at once. Raises ArtefactError
    when the disk refuses.
    """
    digest = hashlib.sha256((_versions() + source).encode()).hexdigest()[:16]
    module_name = f"{re.sub(r'[^A-Za-z0-9_]', '_', name)[:80]}_{digest}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    path = private_folder() / f"{module_name}.py"
    if not path.exists() or path.read_bytes() != source.encode():
        limit, remedy = "one with room", "Free some space, or name another: UNDERTOW_CACHE=FOLDER"
        with or_refused(f"folder of compiled code '{path.parent}'", limit, remedy):
            _write(path, source)
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None  # a plain .py file always has a spec and a loader
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    spec.loader.exec_module(module)
    return module
