"""What every other package stands on: checks of arguments, errors, verdicts, files and tables."""

from undertow.base.interrupt import INTERRUPTED, at_once, by_exception

at_once()

# ruff: noqa: E402 - what follows, here and in other packages, takes a second to import

from undertow.base.arguments import (
    REMEDIES,
    at_least,
    check_fields,
    checked,
    floats,
    one_of,
    positive,
)
from undertow.base.artefacts import (
    as_text,
    check_folder,
    facts,
    finite,
    manifest,
    markdown_table,
    number,
    table,
    to_csv,
    to_json,
    versions,
    write_file,
    write_files,
)
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
    require_extra,
)
from undertow.base.files import check_file, file_hash, parse_json, read_file
from undertow.base.progress import Progress, duration, no_progress
from undertow.base.verdict import Verdict, inward

__all__ = [
    "INTERRUPTED",
    "REMEDIES",
    "ArtefactError",
    "InfeasibleError",
    "InvalidInputError",
    "MissingExtraError",
    "ModelError",
    "Progress",
    "ResourceError",
    "SingularSurfaceError",
    "UndertowError",
    "UnstableSurfaceError",
    "Verdict",
    "as_text",
    "at_least",
    "at_once",
    "by_exception",
    "check_fields",
    "check_file",
    "check_folder",
    "checked",
    "duration",
    "facts",
    "file_hash",
    "finite",
    "floats",
    "inward",
    "manifest",
    "markdown_table",
    "near",
    "no_progress",
    "number",
    "one_of",
    "parse_json",
    "positive",
    "printable",
    "raised_at",
    "read_file",
    "require_extra",
    "table",
    "to_csv",
    "to_json",
    "versions",
    "write_file",
    "write_files",
]
