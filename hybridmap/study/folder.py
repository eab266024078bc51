"""The study's folder: results by key, one file each, written in one move, and the tables at the end."""

from __future__ import annotations

import fcntl
import json
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from hybridmap.errors import StudyError
from hybridmap.study.cell import CellResult
from hybridmap.study.sources import Frozen

STUDY, CELLS_CSV, TIMINGS_CSV, SUMMARY_CSV = "study.yaml", "cells.csv", "timings.csv", "summary.csv"
METRICS, PAGE = "metrics.json", "report.html"
_CELLS, _SOURCES, _LOCK = "cells", "sources", ".lock"
_OURS = (STUDY, CELLS_CSV, TIMINGS_CSV, SUMMARY_CSV, METRICS, PAGE, _CELLS, _SOURCES, _LOCK)


@dataclass(frozen=True, slots=True)
class StudyFolder:
    """Paths and files of one study; results of earlier configurations stay and do no harm.

    Attributes:
        path: the folder itself, what `--out` names.
    """

    path: Path

    def check(self) -> None:
        """Check that a study may be written here; makes nothing.

        Raises:
            StudyError: it is a file, or holds something else.
        """
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise StudyError(f"{self.path}: is a file; expected a folder that is empty, does not exist or holds a study")
        found = sorted(entry.name for entry in self.path.iterdir())
        other = [name for name in found if name not in _OURS and not name.endswith(".partial")]
        if other:
            raise StudyError(f"{self.path}: not empty and no study (it holds {other[0]!r}); choose another folder")

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Make the folder and hold it against other runs; a killed run holds nothing. What it left half-written goes.

        Raises:
            StudyError: another run has it, or it cannot be made.
        """
        try:
            for part in (_CELLS, _SOURCES):
                (self.path / part).mkdir(parents=True, exist_ok=True)
            lock = (self.path / _LOCK).open("w")
        except OSError as error:
            raise StudyError(f"{self.path}: cannot be used as output folder: {error.strerror}") from None
        with lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                raise StudyError(
                    f"{self.path}: another run of a study is writing here; wait for it or choose another"
                ) from None
            for partial in sorted(self.path.rglob(".*.partial")):
                partial.unlink(missing_ok=True)
            yield

    def result(self, key: str) -> CellResult | None:
        """What is known of a cell; None where it is not known, or damaged, as by a loss of power."""
        try:
            return CellResult(**json.loads(self._cell(key).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def keep_result(self, result: CellResult) -> None:
        """Write a result; a kill at any time leaves all of it or nothing."""
        self._write(self._cell(result.key), json.dumps(asdict(result), allow_nan=False).encode())

    def frozen(self, key: str) -> bytes | None:
        """A packed graph; None where there is none yet, or a damaged one."""
        try:
            data = self._source(key).read_bytes()
            Frozen.unpack(data)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        return data

    def keep_frozen(self, key: str, data: bytes) -> None:
        """Write a packed graph, all or nothing."""
        self._write(self._source(key), data)

    def _cell(self, key: str) -> Path:
        return self.path / _CELLS / key[:2] / f"{key}.json"

    def _source(self, key: str) -> Path:
        return self.path / _SOURCES / f"{key}.npz"

    def _write(self, path: Path, data: bytes) -> None:
        partial = path.with_name(f".{path.name}.partial")
        try:
            path.parent.mkdir(exist_ok=True)
            with partial.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            partial.replace(path)
        except OSError as error:
            raise StudyError(f"{path}: cannot be written: {error.strerror}; what is done so far is kept") from None
