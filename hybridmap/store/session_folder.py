"""The session folder: which files it holds and how results get into it."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel, TypeAdapter, ValidationError

from hybridmap.errors import OutputError, StoreError, quoted
from hybridmap.metrics import Metric, to_json
from hybridmap.output import PREVIOUS, Kind, Unfinished, held, holds_only, is_held, write_text
from hybridmap.store.map_store import MapStore
from hybridmap.store.schema import MAP_NAME
from hybridmap.store.tables import LIVE
from hybridmap.trajectory import Trajectory, read_tum, write_tum

log = logging.getLogger(__name__)

_FILES = (
    MAP_NAME,
    f"{MAP_NAME}-wal",
    f"{MAP_NAME}-shm",
    "config.yaml",
    "metrics.json",
    "trajectory",
    "reference",
    "report.html",
    "checkpoint",
    "checkpoint.parts",
)


ON_MAP = "on_map"
"""Name of the trajectory of a drive in the frame of the map that it was localised on."""


def _is_session(folder: Path) -> bool:
    return (folder / MAP_NAME).is_file() or holds_only(folder, _FILES)  # a run that was killed early had no map yet


SESSION = Kind("session", _FILES, _is_session, useful_unfinished=True)


class _Reason(BaseModel):
    words: str


_HEAD: dict[str, Any] = {
    "graph_hash": str,
    "primary_backend": str,
    "backends": list[str],
    "source": str,
    "failed_backends": dict[str, str],
    "stream": dict[str, int],
    "lost": dict[str, tuple[int, int]],
    "remarks": list[str],
    "verdict": str,
    "reasons": list[_Reason],
    "judged_by": dict[str, str],
}
"""Keys of `metrics.json` beside the metrics that are read again, and what they hold."""


@dataclass(frozen=True, slots=True)
class MetricsFile:
    """Content of `metrics.json`: the list of metrics, and in `head` all other keys."""

    head: dict[str, Any]
    metrics: list[Metric]


@dataclass(frozen=True, slots=True)
class SessionFolder:
    """Paths and files of one session.

    Attributes:
        path: the folder.
    """

    path: Path

    @property
    def map_db(self) -> Path:
        """Path of the map file."""
        return self.path / MAP_NAME

    @property
    def config_yaml(self) -> Path:
        """Path of the resolved configuration."""
        return self.path / "config.yaml"

    @property
    def metrics_json(self) -> Path:
        """Path of the metrics."""
        return self.path / "metrics.json"

    @property
    def trajectory(self) -> Path:
        """Path of the folder of estimated trajectories."""
        return self.path / "trajectory"

    @property
    def groundtruth(self) -> Path:
        """Path of the ground-truth trajectory; the file exists only if the source has one."""
        return self.path / "reference" / "groundtruth.tum"

    def groundtruth_of(self, session: int, *, newest: bool) -> Path:
        """Path of the ground truth of one session of several; that of the newest is `groundtruth` if it has no own file."""
        own = self.path / "reference" / f"session-{session}.tum"
        return self.groundtruth if newest and not own.is_file() else own

    @property
    def report(self) -> Path:
        """Path of the HTML report."""
        return self.path / "report.html"

    @property
    def checkpoint(self) -> Path:
        """Path of the state from which a run that did not end can be resumed; it exists only until its end."""
        return self.path / "checkpoint"

    @contextmanager
    def writing(self, *, overwrite: bool = False, resume: bool = False) -> Iterator[Unfinished]:
        """Context in which a session is written, locked against other runs.

        On an error what was written is removed and a session that was there before is restored, unless the new one is worth
        keeping (`Unfinished`): then it stays, and the one before lies in `.previous`. Ctrl-C restores one too; if there was
        none, what is written so far stays.

        Args:
            overwrite: replace a session that is there.
            resume: go on with the one that is there; what is written stays on any error.

        Raises:
            OutputError: the folder holds a session and neither argument is set, holds something else, is written by another
                run, or cannot be written to.
        """
        with (
            held(self.path, SESSION, overwrite=overwrite, resume=resume) as place,
            place.resumed() if resume else place.replaced() as unfinished,
        ):
            yield unfinished

    @property
    def ended(self) -> bool:
        """Whether the folder holds a session whose run came to its end."""
        return _ended(self.path)

    def require(self) -> None:
        """Check that the folder holds a session, and warn if its run did not end.

        Raises:
            StoreError: the folder is missing or holds no map, or the map is damaged.
        """
        self.require_map()
        with MapStore.open(self.path) as store:
            if store.ended:
                return
            store.check()
            reason, repeatable = store.broken_off, store.info(LIVE) is None
        log.warning("%s: %s", self.path, self._why_unended(reason, repeatable=repeatable))

    def require_map(self) -> None:
        """Check that the folder holds a session, whether or not its run ended. The map is not opened.

        Raises:
            StoreError: the folder is missing or holds no map.
        """
        if not self.map_db.is_file():
            what = "holds no session (no map.db)" if self.path.is_dir() else "no such session folder"
            what = "is a file, not a session folder" if self.path.is_file() else what
            raise StoreError(f"{self.path}: {what}; expected what `hybridmap map SOURCE --out DIR` writes")

    def require_foreign(self, target: Path) -> None:
        """Check that a file to be written is not one of the session's own files.

        Raises:
            OutputError: it is one of them.
        """
        folder, file = self.path.resolve(), target.resolve()
        if file.is_relative_to(folder) and {*file.relative_to(folder).parts[:1]} & {*_FILES}:
            raise OutputError(f"{target}: is a file of the session that is read; choose another name")

    def require_apart(self, out: Path) -> None:
        """Check that an output folder is neither the session's own nor lies in it.

        Raises:
            OutputError: it does.
        """
        if out.resolve().is_relative_to(self.path.resolve()):
            raise OutputError(f"{out}: is in the folder of a map that is read; choose another one")

    def require_free(self, *, overwrite: bool = False) -> None:
        """Check that a session may be written here, before the work that leads to it.

        Raises:
            OutputError: as for `writing`.
        """
        with held(self.path, SESSION, overwrite=overwrite):
            pass

    def _why_unended(self, reason: str, *, repeatable: bool) -> str:
        if is_held(self.path):
            return "is still being written: this is the map so far"
        because = f" ({reason})" if reason else ""
        return f"its run was broken off{because}: this is the map up to there; {self.what_to_do(repeatable=repeatable)}"

    def what_to_do(self, *, repeatable: bool = True) -> str:
        """How to go on with a session whose run was broken off, and how to have the one before it back, if there is one.

        A live drive is not `repeatable`, so nothing goes on with it.
        """
        onward = "`hybridmap map` with --resume goes on with it" if repeatable else "a live drive cannot be resumed"
        previous = self.path / PREVIOUS
        if not _ended(previous):
            return onward
        return f"{onward}; the finished session that it was to replace is {previous}: move it elsewhere to have it back"

    def write_config(self, config_yaml: str) -> None:
        """Write the resolved configuration."""
        write_text(self.config_yaml, config_yaml)

    def write_metrics(self, head: dict[str, Any], metrics: Iterable[Metric]) -> None:
        """Write `metrics.json` from its list of metrics and its other keys (`head`); replaces the whole file at once."""
        write_text(self.metrics_json, to_json(head, metrics) + "\n")

    def read_metrics(self) -> MetricsFile:
        """Read `metrics.json`; without metrics and other keys if the file does not exist.

        Raises:
            StoreError: the file is damaged.
        """
        if not self.metrics_json.is_file():
            return MetricsFile({}, [])
        try:
            tree = json.loads(self.metrics_json.read_text(encoding="utf-8"))
            metrics = [_metric(row) for row in tree.pop("metrics")]
            for key, kind in _HEAD.items():
                if key in tree:
                    TypeAdapter(kind).validate_python(tree[key])
        except (ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError) as error:
            found = quoted(error.errors()[0]["msg"] if isinstance(error, ValidationError) else error)[1:-1]
            raise StoreError(f"{self.metrics_json}: damaged: {found}; map again or delete it") from None
        return MetricsFile(tree, metrics)

    def merge_metrics(self, metrics: Iterable[Metric], judged_by: dict[str, str] | None = None) -> None:
        """Put metrics into `metrics.json`: one replaces that of the same name in its place, others are added at the end.

        If the file cannot be written, it stays as it is and a warning says so.

        Args:
            metrics: the metrics.
            judged_by: kind of file (`reference`, `relations`) -> path of the file that the metrics are errors against; it
                replaces that of the same kind in `judged_by` of `metrics.json`. An empty path removes it: the session's own
                truth was used.

        Raises:
            StoreError: the file is damaged.
        """
        before = self.read_metrics()
        rows = {metric.name: metric for metric in before.metrics}
        rows |= {metric.name: metric for metric in metrics}
        files = before.head.get("judged_by", {}) | (judged_by or {})
        named = {"judged_by": {kind: path for kind, path in files.items() if path}} if files else {}
        try:
            self.write_metrics(before.head | named, rows.values())
        except OutputError as error:
            log.warning("%s; the figures are not kept", error)

    def write_trajectory(self, name: str, trajectory: Trajectory) -> None:
        """Write an estimated trajectory under a name: `odometry`, `<backend>` or `<backend>_online`."""
        write_tum(self.trajectory / f"{name}.tum", trajectory)

    def write_groundtruth(self, trajectory: Trajectory) -> None:
        """Write the ground-truth trajectory."""
        write_tum(self.groundtruth, trajectory)

    def trajectories(self) -> dict[str, Trajectory]:
        """Every estimated trajectory of the session, by the name under which it was written, sorted; empty if there is none."""
        return {path.stem: read_tum(path) for path in sorted(self.trajectory.glob("*.tum"))}


def _ended(folder: Path) -> bool:
    """Whether the run that wrote a map came to its end."""
    try:
        with MapStore.open(folder) as store:
            return store.ended
    except StoreError:
        return False


def _metric(row: dict[str, Any]) -> Metric:
    value = math.nan if row["value"] is None else row["value"]
    return _METRIC.validate_python({**row, "value": value})


_METRIC = TypeAdapter(Metric)
