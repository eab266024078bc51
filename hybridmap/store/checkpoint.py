"""The state of a run in a file, from which it can be gone on with after a kill or an error.

The file is a line that says what the state is good for, and the pickled state. What never changes, as scans do, is written once
into a file beside it, so that a checkpoint costs what is new. Only our own classes and plain values are unpickled
(`pickling.Reader.find_class`); settings and the map file are referred to and put in by the reader.
"""

from __future__ import annotations

import io
import json
import os
import pickle
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hybridmap.errors import OutputError, StoreError
from hybridmap.output import write_bytes
from hybridmap.store.pickling import Numbered, PartWriter, Reader, Writer

_MAGIC = "hybridmap checkpoint"


class UnusableError(StoreError):
    """A state that cannot be written or read: it holds what is not ours, or the file is missing or damaged."""


@dataclass(frozen=True, slots=True)
class Origin:
    """What a state was made from; with anything else it cannot be gone on with.

    Attributes:
        code: digest of hybridmap's code and of the libraries, for the state has their classes.
        version: version of hybridmap, for people.
        config: the resolved configuration, as YAML.
        source: name of what is mapped.
        expected: number of observations of the source; None if unknown.
        first_ns: stamps of the first samples, ns.
    """

    code: str
    version: str
    config: str
    source: str
    expected: int | None
    first_ns: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Read:
    """What was read.

    Attributes:
        state: the object that was written.
        parts: its unchanging parts, to write the next state with.
    """

    state: Any
    parts: Parts


def write(path: Path, origin: Origin, state: Any, known: Mapping[str, Any], parts: Parts) -> int:
    """Write a state atomically, its new unchanging parts first; returns how many bytes were written.

    Args:
        path: of the file; that of the parts lies beside it.
        origin: what the state was made from.
        state: the object.
        known: name -> object that is referred to and not written.
        parts: with what earlier states have written.

    Raises:
        UnusableError: the state holds something that is not ours.
        OutputError: a file cannot be written.
    """
    buffer = io.BytesIO()
    names = {id(value): name for name, value in known.items()}
    try:
        Writer(buffer, names, parts).dump(state)
        added = parts.append(names)
    except (pickle.PicklingError, TypeError, AttributeError) as error:
        raise UnusableError(f"{path}: the state cannot be written: {error}") from None
    content = buffer.getbuffer()
    head = {"format": _MAGIC, "crc32": zlib.crc32(content), "parts": asdict(parts.extent), **asdict(origin)}
    write_bytes(path, json.dumps(head).encode() + b"\n" + content)
    return len(content) + added


def read_origin(path: Path) -> Origin:
    """What the state in a file was made from; the state itself is not read.

    Raises:
        UnusableError: there is no such file, or it is damaged.
    """
    return _head(path, _content(path).partition(b"\n")[0])[0]


def read(path: Path, known: Mapping[str, Any]) -> Read:
    """The state that `write` wrote, with the objects of `known` in their places.

    Raises:
        UnusableError: there is no such file, or it is damaged.
    """
    head, _, content = _content(path).partition(b"\n")
    _, crc32, extent = _head(path, head)
    packed = _content(_beside(path))[: extent.size]
    if zlib.crc32(content) != crc32 or zlib.crc32(packed) != extent.crc32:
        raise UnusableError(f"{path}: damaged: the state is not what was written")
    parts = Parts(path, extent)
    try:
        stream = io.BytesIO(packed)
        for _ in range(extent.count):
            parts.keep(Reader(stream, known, parts).load())
        return Read(Reader(io.BytesIO(content), known, parts).load(), parts)
    except Exception as error:  # noqa: BLE001  # a damaged state may raise anything
        raise UnusableError(f"{path}: damaged: {error}") from None


def remove(path: Path) -> None:
    """Remove a state with its parts, if there is one."""
    for file in (path, _beside(path)):
        file.unlink(missing_ok=True)


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.parts")


@dataclass(frozen=True, slots=True)
class Extent:
    """How much of the file of parts belongs to a state: how often it was appended to, bytes, and their checksum."""

    count: int = 0
    size: int = 0
    crc32: int = 0


class Parts(Numbered):
    """Objects of a state that never change, such as scans: each is written once, into a file that only grows.

    Attributes:
        extent: what is in the file.
    """

    def __init__(self, path: Path, extent: Extent = Extent()) -> None:
        """Begin without any, or with what `read` has found; `path` is that of the state."""
        super().__init__()
        self.extent = extent
        self._path = _beside(path)

    def append(self, names: Mapping[int, str]) -> int:
        """Write the new objects, all at once; returns the number of bytes. `names` are as for a `Writer`.

        Raises:
            OutputError: the file cannot be written.
        """
        buffer = io.BytesIO()
        PartWriter(buffer, names, self).dump(self.new)
        added = buffer.getvalue()
        try:
            with self._path.open("r+b" if self.extent.size else "wb") as file:
                file.truncate(self.extent.size)  # a run that died may have left more
                file.seek(self.extent.size)
                file.write(added)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise OutputError(f"{self._path}: cannot be written: {error.strerror}") from None
        size, crc32 = self.extent.size + len(added), zlib.crc32(added, self.extent.crc32)
        self.extent = Extent(self.extent.count + 1, size, crc32)
        self.note_written()
        return len(added)


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UnusableError(f"{path}: cannot be read: {error.strerror}") from None


def _head(path: Path, line: bytes) -> tuple[Origin, int, Extent]:
    try:
        found = json.loads(line)
        if found.pop("format") != _MAGIC:
            raise ValueError("another format")
        crc32, extent = int(found.pop("crc32")), Extent(**found.pop("parts"))
        return Origin(**{**found, "first_ns": tuple(found["first_ns"])}), crc32, extent
    except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
        raise UnusableError(f"{path}: damaged: {error}") from None
