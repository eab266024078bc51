"""The folder of a study: one file per result, named by its key and written atomically, and the tables at the end."""

from __future__ import annotations

import json
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path

from hybridmap.output import Kind, holds_only, write_bytes
from hybridmap.study.cell import CellResult
from hybridmap.study.frozen import Frozen

STUDY, CELLS_CSV, TIMINGS_CSV, SUMMARY_CSV = "study.yaml", "cells.csv", "timings.csv", "summary.csv"
BARS_CSV, EFFECTS_CSV, METRICS, PAGE = "bars.csv", "effects.csv", "metrics.json", "report.html"
_CELLS, _SOURCES = "cells", "sources"
_OLD_LOCK = ".lock"  # of earlier versions
_FILES = (STUDY, CELLS_CSV, TIMINGS_CSV, SUMMARY_CSV, BARS_CSV, EFFECTS_CSV, METRICS, PAGE, _CELLS, _SOURCES, _OLD_LOCK)
STUDY_FOLDER = Kind("study", _FILES, lambda folder: holds_only(folder, _FILES), continued=True)


@dataclass(frozen=True, slots=True)
class StudyFolder:
    """Paths and files of one study. Results of other configurations may stay in the folder; they are not read.

    Attributes:
        path: the folder, as given by `--out`.
    """

    path: Path

    def result(self, key: str) -> CellResult | None:
        """The stored result with this key; None if there is none, or if its file is damaged, e.g. by a loss of power."""
        try:
            return CellResult(**json.loads(self._cell(key).read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            return None

    def keep_result(self, result: CellResult) -> None:
        """Write the result of a cell atomically under its key; it replaces one with the same key."""
        write_bytes(self._cell(result.key), json.dumps(asdict(result), allow_nan=False).encode())

    def frozen(self, key: str) -> bytes | None:
        """The stored bytes of the frozen graph with this key (`Frozen.pack`); None if there are none, or if they are broken."""
        try:
            data = self._source(key).read_bytes()
            Frozen.unpack(data)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None
        return data

    def keep_frozen(self, key: str, data: bytes) -> None:
        """Write the bytes of a frozen graph (`Frozen.pack`) atomically under its key; they replace those with the same key."""
        write_bytes(self._source(key), data)

    def _cell(self, key: str) -> Path:
        return self.path / _CELLS / key[:2] / f"{key}.json"

    def _source(self, key: str) -> Path:
        return self.path / _SOURCES / f"{key}.npz"
