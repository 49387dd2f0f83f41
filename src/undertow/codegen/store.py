"""Generated modules on disk: written once, named by their content, compiled once.

numba's cache needs a real file and does not notice changed globals, so the file's name
carries a hash of its source and of the versions that shape the machine code.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import platform
import sys
import tempfile
from pathlib import Path
from types import ModuleType

from undertow.codegen.machine import numba

__all__ = ["cache_folder", "load_module"]


def cache_folder() -> Path:
    """Return the folder of generated kernels: ``$UNDERTOW_CACHE`` or the user's cache."""
    chosen = os.environ.get("UNDERTOW_CACHE")
    if chosen:
        return Path(chosen)
    root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return root / "undertow"


def load_module(name: str, source: str) -> ModuleType:
    """Import ``source`` from the cache, writing it first if it is new.

    The file appears whole or not at all, so several processes may ask at once.
    """
    versions = f"{numba.__version__} {sys.version} {platform.machine()}"
    digest = hashlib.sha256((versions + source).encode()).hexdigest()[:16]
    module_name = f"{name}_{digest}"
    if module_name in sys.modules:
        return sys.modules[module_name]
    path = _writable_folder() / f"{module_name}.py"
    if not path.exists() or path.read_text(encoding="utf-8") != source:
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(source)
        os.replace(temporary, path)
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
