"""A campaign's results in zarr: written by the workers, one chunk a shard, then a mark in a mask.

The mask holds a digest of every finished shard.  What was killed while it wrote has none, and what
was damaged afterwards has another one than the chunks: both are computed again.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from undertow.base import ArtefactError, error_text, printable, require_extra
from undertow.studies.campaign.study import Arrays, Study

#: The mask's name, and that of the dimension that numbers the shards.
DONE, SHARD = "done", "shard"

#: What a campaign is made from, by the names of what a store says of it.
PARTS = {
    "definition": "definition",
    "mechanism_identity": "mechanism",
    "code": "--entrant",
    "code_hashes": "version of an entrant's file",
}

#: Name and version of the layout.
FORMAT = "undertow-campaign 1"


class Store:
    """A folder with the results of one campaign.

    Parameters
    ----------
    path
        The folder.
    key
        Hash of the campaign that it must hold; ``None`` takes any.
    mine
        What its attributes say of that campaign, see :attr:`Campaign.about`.

    Raises
    ------
    ArtefactError
        When it is none, damaged, or of another campaign.
    MissingExtraError
        Without zarr.
    """

    def __init__(
        self, path: Path, key: str | None = None, mine: Mapping[str, Any] | None = None
    ) -> None:
        self.path = path
        if not (path / "zarr.json").is_file():
            raise ArtefactError(
                f"store '{path}'",
                value="none",
                limit="a campaign's",
                remedy="Name that of an earlier campaign, or begin one, without --resume, "
                "--status, --tables and --picture",
            )
        try:
            self._group: Any = _zarr().open_group(str(path), mode="r+")
            self.about: dict[str, Any] = dict(self._group.attrs)
            form, found = self.about["format"], self.about["key"]
            self._arrays: dict[str, Any] = dict(self._group.arrays())
            self._done = self._arrays[DONE]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise _damaged(path, error) from error
        if form != FORMAT or (key is not None and found != key):
            names = [*(mine or {}), *self.about] if form == FORMAT else []
            differ = {n for n in names if self.about.get(n) != (mine or {}).get(n)}
            if "code" in differ:  # other files have other hashes
                differ.discard("code_hashes")
            others = [word for name, word in PARTS.items() if name in differ]
            raise ArtefactError(
                f"store '{path}'",
                value=f"another campaign, {printable(str(found))[:12]}, of another "
                + (" and another ".join(others) or "version"),
                limit=f"this one, {str(key)[:12]}" if form == FORMAT else FORMAT,
                remedy="Give the file, --mechanism and --entrant that it was begun with, or "
                "name another folder with --out",
            )

    @classmethod
    def create(cls, path: Path, study: Study, key: str, about: dict[str, Any]) -> Store:
        """Make an empty store for a study; all of it is there, or nothing.

        Raises
        ------
        ArtefactError
            When there is something already, or it cannot be written.
        """
        if path.exists():
            one = (path / "zarr.json").is_file()
            raise ArtefactError(
                f"store '{path}'",
                value="a store that is there" if one else "something else that is there",
                limit="a new folder",
                remedy="Go on with it: --resume; or name another with --out"
                if one
                else "Name another with --out",
            )
        zarr = _zarr()
        making = path.with_name(f".{path.name}.{os.getpid()}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            facts = {"format": FORMAT, "key": key} | about
            group = zarr.create_group(str(making), attributes=facts)
            for axis in study.axes:
                array = group.create_array(
                    axis.name, shape=axis.values.shape, dtype=axis.values.dtype,
                    chunks=axis.values.shape, dimension_names=[axis.name],
                    attributes={"units": axis.unit} | _meanings(axis.words),
                )  # fmt: skip
                array[:] = axis.values
            for name, variable in study.variables.items():
                words = {"units": variable.unit, "long_name": variable.meaning}
                words |= _meanings(variable.flags)
                group.create_array(
                    name, shape=study.shape, dtype=variable.dtype, chunks=study.chunk,
                    dimension_names=[axis.name for axis in study.axes], attributes=words,
                    fill_value=variable.missing,
                )  # fmt: skip
            group.create_array(
                DONE, shape=(study.shards,), dtype="uint64", chunks=(1,), compressors=None,
                dimension_names=[SHARD], fill_value=0,
                attributes={"long_name": "digest of a finished shard, 0 for others"},
            )  # fmt: skip
            os.rename(making, path)
        except OSError as error:
            shutil.rmtree(making, ignore_errors=True)
            raise unwritten(path, error) from error
        return cls(path, key)

    @contextmanager
    def alone(self) -> Iterator[None]:
        """Keep every other process of this machine from running a campaign into this store.

        Raises
        ------
        ArtefactError
            When another one does.
        """
        try:
            import fcntl
        except ImportError:  # no such locks: two processes write the same bits, and work twice
            yield
            return
        handle = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise ArtefactError(
                    f"store '{self.path}'",
                    value="in use by another process",
                    limit="one campaign at a time",
                    remedy="Wait until it ends; --status shows how far it is",
                ) from error
            yield
        finally:
            os.close(handle)

    def write(self, study: Study, shard: int, arrays: Arrays) -> None:
        """Write the arrays of a shard, then its mark.

        Raises
        ------
        ArtefactError
            When the system refuses, like a full disk: nothing is marked then.
        """
        try:
            for name, values in arrays.items():
                self._arrays[name][study.part(shard)] = values
            self._done[shard] = digest(study.same_bits(arrays))
        except OSError as error:
            raise unwritten(self.path, error) from error

    def read(self, study: Study, shard: int) -> Arrays:
        """Return what the store has of a shard.

        Raises
        ------
        ArtefactError
            For a chunk that cannot be read.
        """
        try:
            return {name: self._arrays[name][study.part(shard)] for name in study.variables}
        except (OSError, ValueError, RuntimeError) as error:
            raise _damaged(self.path, error) from error

    def marks(self) -> NDArray[np.uint64]:
        """Return the mask, (shards,): digests, 0 for what is not finished."""
        try:
            found: NDArray[np.uint64] = self._done[:]
        except (OSError, ValueError, RuntimeError):  # one of them is damaged: one by one
            found = np.zeros(self._done.shape, dtype=np.uint64)
            for shard in range(len(found)):
                with suppress(OSError, ValueError, RuntimeError):
                    found[shard] = self._done[shard]
        return found

    def repair(self, study: Study) -> list[int]:
        """Unmark finished shards whose chunks are not what was written; return their numbers.

        Also what killed workers left of files goes away.
        """
        for left in self.path.rglob("*.partial"):
            left.unlink(missing_ok=True)
        damaged = self.damaged(study)
        for shard in damaged:
            self._done[shard] = 0
        return damaged

    def damaged(self, study: Study) -> list[int]:
        """Return the numbers of finished shards whose chunks are not what was written."""
        marks = self.marks()
        done = np.flatnonzero(marks).tolist()
        return [shard for shard in done if not self.has(study, shard, int(marks[shard]))]

    def has(self, study: Study, shard: int, mark: int) -> bool:
        """Whether the chunks of a shard can be read, and have this digest."""
        try:
            return digest(study.same_bits(self.read(study, shard))) == mark
        except ArtefactError:
            return False


def _meanings(words: Sequence[str]) -> dict[str, Any]:
    """Return the attributes that say what whole numbers stand for, by CF's convention."""
    joined = " ".join(word.replace(" ", "_") for word in words)
    return {"flag_values": list(range(len(words))), "flag_meanings": joined} if words else {}


def digest(arrays: Arrays) -> int:
    """Return 64 bits of SHA-256 of arrays; every NaN counts as the same, and none gives 0."""
    total = hashlib.sha256()
    for name in sorted(arrays):
        values = np.ascontiguousarray(arrays[name])
        if values.dtype.kind == "f":
            values = np.where(np.isnan(values), values.dtype.type(np.nan), values)
        total.update(json.dumps([name, str(values.dtype), values.shape]).encode())
        total.update(values.tobytes())
    return int.from_bytes(total.digest()[:8], "little") or 1


def dataset(path: Path) -> Any:
    """Return a store as an ``xarray.Dataset``, read lazily; units and provenance in its attributes.

    Raises
    ------
    ArtefactError
        When it is none.
    MissingExtraError
        Without xarray.
    """
    Store(path)
    xarray = require_extra("xarray", "campaign", "results are read with xarray")
    return xarray.open_zarr(str(path), consolidated=False).drop_vars(DONE)


def loaded(path: Path, data: Any) -> Any:
    """Return what was opened of a store, read into memory.

    Raises ArtefactError where a chunk is damaged.
    """
    try:
        return data.load()
    except (OSError, ValueError, RuntimeError) as error:
        raise ArtefactError(
            f"store '{path}'",
            value=printable(error_text(error))[:200],
            limit="one whose chunks can be read",
            remedy="Go on with --resume: what is damaged is computed again",
        ) from error


def unwritten(path: Path, error: OSError) -> ArtefactError:
    """Return the condition of a store that the system does not let us write."""
    return ArtefactError(
        f"store '{path}'",
        value=error.strerror or str(error),
        limit="a folder that can be written, with room on its disk",
        remedy="Make room, then go on with --resume: what is marked is kept",
    )


def _damaged(path: Path, error: Exception) -> ArtefactError:
    return ArtefactError(
        f"store '{path}'",
        value=printable(error_text(error))[:200],
        limit="a campaign's",
        remedy="It is damaged or something else: name another folder with --out",
    )


def _zarr() -> Any:
    return require_extra("zarr", "campaign", "campaigns are stored with zarr")
