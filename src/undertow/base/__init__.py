"""What every other package stands on: checks of arguments, errors, verdicts, files."""

from undertow.base.interrupt import INTERRUPTED, at_once, by_exception

at_once()

# ruff: noqa: E402 - what follows, here and in other packages, takes a second to import

from undertow.base.arguments import REMEDIES, at_least, check_fields, checked, floats
from undertow.base.artefacts import to_csv, versions
from undertow.base.errors import (
    ArtefactError,
    InfeasibleError,
    InvalidInputError,
    MissingExtraError,
    ModelError,
    ResourceError,
    SingularSurfaceError,
    UndertowError,
    UnstableSurfaceError,
    near,
    printable,
    raised_at,
)
from undertow.base.files import check_file, file_hash, parse_json, read_file
from undertow.base.verdict import Verdict, inward

__all__ = [
    "INTERRUPTED",
    "REMEDIES",
    "ArtefactError",
    "InfeasibleError",
    "InvalidInputError",
    "MissingExtraError",
    "ModelError",
    "ResourceError",
    "SingularSurfaceError",
    "UndertowError",
    "UnstableSurfaceError",
    "Verdict",
    "at_least",
    "at_once",
    "by_exception",
    "check_fields",
    "check_file",
    "checked",
    "file_hash",
    "floats",
    "inward",
    "near",
    "parse_json",
    "printable",
    "raised_at",
    "read_file",
    "to_csv",
    "versions",
]
