"""Generated modules on disk: written once, named by their content, compiled once.

numba's cache needs a real file and does not notice changed globals, so the file's name
carries a hash of its source and of the versions that shape the machine code.
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
from collections.abc import Callable, Iterable
from functools import lru_cache
from pathlib import Path
from types import ModuleType

import numpy as np
import sympy as sp

from undertow.codegen.machine import numba

__all__ = [
    "cache_folder",
    "content_key",
    "generated",
    "generators",
    "load_module",
    "recall",
    "remember",
]

#: Files of this package that every generated module depends on: they turn a mechanism into
#: formulas, and formulas into code.
FORMULAS = (
    "mechanism.py",
    "partition.py",
    "quantities.py",
    "codegen/names.py",
    "codegen/scalar.py",
    "codegen/tape.py",
)


def cache_folder() -> Path:
    """Return the folder of generated kernels: ``$UNDERTOW_CACHE`` or the user's cache."""
    chosen = os.environ.get("UNDERTOW_CACHE")
    if chosen:
        return Path(chosen)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "undertow"


def content_key(*texts: str, sources: Iterable[str] = ()) -> str:
    """Return a hash of texts, of the files of this package that use them, and of versions.

    Parameters
    ----------
    *texts
        Everything that a stored result depends on.
    sources
        Paths of the Python files that compute the result: it is not theirs any more once they
        change.
    """
    digest = hashlib.sha256(_versions().encode())
    for text in texts:
        digest.update(f"{len(text)} {text}".encode())
    for path in sources:
        digest.update(_file_digest(path))
    return digest.hexdigest()


@lru_cache(maxsize=64)
def _file_digest(path: str) -> bytes:
    return hashlib.sha256(Path(path).read_bytes()).digest()


def _versions() -> str:
    libraries = f"{numba.__version__} {sp.__version__} {np.__version__}"
    return f"{libraries} {sys.version} {platform.machine()}"


def recall(name: str, key: str) -> str | None:
    """Return the text that was remembered under a key, ``None`` where there is none."""
    try:
        seal, _, text = (
            (_writable_folder() / f"{name}_{key[:32]}.txt")
            .read_text(encoding="utf-8")
            .partition("\n")
        )
    except (OSError, UnicodeDecodeError):
        return None
    return text if seal == _seal(key, text) else None


def remember(name: str, key: str, text: str) -> None:
    """Keep a text under a key; a disk that refuses only costs time later."""
    with contextlib.suppress(OSError):
        path = _writable_folder() / f"{name}_{key[:32]}.txt"
        _write(path, f"{_seal(key, text)}\n{text}")


def generators(*names: str) -> tuple[str, ...]:
    """Return the paths of files of this package, by name, and of ``FORMULAS``.

    What they generate is theirs no more once one of them changes: for :func:`content_key`.
    """
    package = Path(__file__).parent.parent
    return tuple(str(package / name) for name in (*names, *FORMULAS))


def generated(kind: str, name: str, key: str, write: Callable[[], str]) -> ModuleType:
    """Import a generated module, writing its source only where none is kept under the key.

    Parameters
    ----------
    kind, name
        What is generated, and for which mechanism: the module's name.
    key
        Everything that the source depends on, see :func:`content_key`.
    write
        Returns the source.
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
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(text)
    os.replace(temporary, path)


def load_module(name: str, source: str) -> ModuleType:
    """Import ``source`` from the cache, writing it first if it is new.

    The file appears whole or not at all, so several processes may ask at once.
    """
    digest = hashlib.sha256((_versions() + source).encode()).hexdigest()[:16]
    module_name = f"{re.sub(r'[^A-Za-z0-9_]', '_', name)[:80]}_{digest}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    path = _writable_folder() / f"{module_name}.py"
    if not path.exists() or path.read_text(encoding="utf-8") != source:
        _write(path, source)
    spec = importlib.util.spec_from_file_location(module_name, path)
    assert spec is not None  # a plain .py file always has a spec and a loader
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module
    spec.loader.exec_module(module)
    return module


def _writable_folder() -> Path:
    """Return the cache folder, or a private temporary one where it cannot be written."""
    for folder in (cache_folder(), Path(tempfile.gettempdir()) / f"undertow-{os.getuid()}"):
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(folder, os.W_OK):
            return folder
    return Path(tempfile.mkdtemp(prefix="undertow-"))
