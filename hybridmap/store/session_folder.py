"""The session folder: which files it holds, how it is prepared and how results get into it."""

from __future__ import annotations

import json
import logging
import math
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hybridmap.errors import StoreError
from hybridmap.metrics import Metric, to_json
from hybridmap.store.lock import hold, is_being_written
from hybridmap.store.map_store import MapStore
from hybridmap.store.schema import MAP_NAME
from hybridmap.trajectory import Trajectory, read_tum, write_text_atomic, write_tum

log = logging.getLogger(__name__)

_OURS = (
    MAP_NAME,
    f"{MAP_NAME}-wal",
    f"{MAP_NAME}-shm",
    "config.yaml",
    "metrics.json",
    "trajectory",
    "reference",
    "report.html",
)
_PREVIOUS = ".previous"
_MOVING = ".previous.partial"  # a kill may leave part of a session here, and so never in `_PREVIOUS`


@dataclass(frozen=True, slots=True)
class MetricsFile:
    """What `metrics.json` holds: the keys beside the list, and the list."""

    head: dict[str, Any]
    metrics: list[Metric]


@dataclass(frozen=True, slots=True)
class SessionFolder:
    """Paths and files of one session.

    Attributes:
        path: the folder itself, what `--out` names.
    """

    path: Path

    @property
    def map_db(self) -> Path:
        """The map file."""
        return self.path / MAP_NAME

    @property
    def config_yaml(self) -> Path:
        """The resolved configuration."""
        return self.path / "config.yaml"

    @property
    def metrics_json(self) -> Path:
        """The figures."""
        return self.path / "metrics.json"

    @property
    def trajectory(self) -> Path:
        """Folder of the estimates."""
        return self.path / "trajectory"

    @property
    def groundtruth(self) -> Path:
        """The known truth, where there is one."""
        return self.path / "reference" / "groundtruth.tum"

    @property
    def report(self) -> Path:
        """The page."""
        return self.path / "report.html"

    @contextmanager
    def writing(self, *, overwrite: bool = False) -> Iterator[None]:
        """Write a new session in the block, and nobody else meanwhile; an error takes it back, see `discard`.

        So does Ctrl-C where a session was there before; where there was none, what is written so far stays.

        Raises:
            StoreError: as `prepare`, or another run is writing here.
        """
        with self._hold():
            self.prepare(overwrite=overwrite)
            try:
                yield
            except KeyboardInterrupt:
                self.restore_previous()
                raise
            except BaseException:
                self.discard()
                raise
            self.keep()

    def _hold(self) -> ExitStack:
        try:
            if self.path.exists() and not self.path.is_dir():
                raise StoreError(f"{self.path}: is a file; expected a folder that is empty or does not exist")
            self.path.mkdir(parents=True, exist_ok=True)
            return hold(self.path)
        except OSError as error:
            raise StoreError(f"{self.path}: cannot be used as output folder: {error.strerror}") from None

    def prepare(self, *, overwrite: bool = False) -> None:
        """Make the folder ready for a new session; what an old one left is set aside until `keep` or `discard`.

        Raises:
            StoreError: it holds a session and `overwrite` is not given, holds something else, or cannot be made.
        """
        try:
            self._prepare(overwrite)
        except OSError as error:
            raise StoreError(f"{self.path}: cannot be used as output folder: {error.strerror}") from None

    def _prepare(self, overwrite: bool) -> None:
        if self.path.exists() and not self.path.is_dir():
            raise StoreError(f"{self.path}: is a file; expected a folder that is empty or does not exist")
        self._put_back()  # what a run that was killed while it moved files had not done
        if overwrite and not _ended(self.path):
            self.restore_previous()  # a run that was killed while it overwrote: the session set aside is the whole one
        found = sorted(entry.name for entry in self.path.iterdir()) if self.path.exists() else []
        session = MAP_NAME in found or (bool(found) and set(found) <= {*_OURS, _PREVIOUS})
        if session and not overwrite:
            raise StoreError(f"{self.path}: holds a session already; choose another folder or give --overwrite")
        if found and not session:
            raise StoreError(f"{self.path}: not empty and no session (it holds {found[0]!r}); choose another folder")
        self.path.mkdir(parents=True, exist_ok=True)
        ours = [self.path / name for name in _OURS if name in found]
        if ours:
            self._set_aside(ours)

    def _set_aside(self, ours: Sequence[Path]) -> None:
        moving, previous = self.path / _MOVING, self.path / _PREVIOUS
        try:
            moving.mkdir()
            for entry in ours:
                entry.rename(moving / entry.name)
            shutil.rmtree(previous, ignore_errors=True)
            moving.rename(previous)
        except BaseException:
            self._put_back()
            raise

    def _put_back(self) -> None:
        """Move the files back that are between a session and the folder it is set aside in."""
        moving = self.path / _MOVING
        if moving.is_dir():
            for entry in sorted(moving.iterdir()):
                entry.rename(self.path / entry.name)
            moving.rmdir()

    def keep(self) -> None:
        """The new session stands: drop the one set aside by `prepare`."""
        shutil.rmtree(self.path / _PREVIOUS, ignore_errors=True)

    def restore_previous(self) -> None:
        """The new session was broken off: an overwritten one comes back; where there was none, what is mapped so far stays."""
        if (self.path / _PREVIOUS).is_dir():
            self.discard()

    def discard(self) -> None:
        """The new session failed: remove what it wrote, bring back the one set aside, and leave no empty folder."""
        for name in _OURS:
            entry = self.path / name
            if entry.is_dir():
                shutil.rmtree(entry)
            else:
                entry.unlink(missing_ok=True)
        previous = self.path / _PREVIOUS
        if previous.is_dir():
            previous.rename(self.path / _MOVING)
            self._put_back()
        if self.path.is_dir() and not any(self.path.iterdir()):
            self.path.rmdir()

    def require(self) -> None:
        """Check that there is a session, and warn where its run did not end.

        Raises:
            StoreError: the folder is missing or holds no map.
        """
        self.require_map()
        if not _ended(self.path):
            log.warning("%s: %s", self.path, self._why_unended())

    def require_map(self) -> None:
        """Check that there is a session, whether or not its run ended.

        Raises:
            StoreError: as `require`.
        """
        if not self.map_db.is_file():
            what = "holds no session (no map.db)" if self.path.is_dir() else "no such session folder"
            raise StoreError(f"{self.path}: {what}; expected what `hybridmap map SOURCE --out DIR` writes")

    def _why_unended(self) -> str:
        if is_being_written(self.path):
            return "is still being written: this is the map so far"
        broken_off = "its run was broken off: this is the map up to there"
        previous = self.path / _PREVIOUS
        if not _ended(previous):
            return broken_off
        return f"{broken_off}; the finished session that it was to replace is {previous}: move it elsewhere to have it back"

    def write_config(self, config_yaml: str) -> None:
        """Write the resolved configuration."""
        write_text_atomic(self.config_yaml, config_yaml)

    def write_metrics(self, head: dict[str, Any], metrics: Iterable[Metric]) -> None:
        """Write `metrics.json`, replacing what was there, in one move."""
        write_text_atomic(self.metrics_json, to_json(head, metrics) + "\n")

    def read_metrics(self) -> MetricsFile:
        """The figures so far; empty if there are none.

        Raises:
            StoreError: the file is damaged.
        """
        if not self.metrics_json.is_file():
            return MetricsFile({}, [])
        try:
            tree = json.loads(self.metrics_json.read_text(encoding="utf-8"))
            metrics = [_metric(row) for row in tree.pop("metrics")]
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise StoreError(f"{self.metrics_json}: damaged: {error}; map again or delete it") from None
        return MetricsFile(tree, metrics)

    def merge_metrics(self, metrics: Iterable[Metric]) -> None:
        """Put figures into `metrics.json`: of the same name the new one counts, others stay; order is kept.

        Where it may not be written, it stays as it is and a warning says so.

        Raises:
            StoreError: the file is damaged.
        """
        before = self.read_metrics()
        rows = {metric.name: metric for metric in before.metrics}
        rows |= {metric.name: metric for metric in metrics}
        try:
            self.write_metrics(before.head, rows.values())
        except OSError as error:
            log.warning("%s: cannot be written: %s; the figures are not kept", self.metrics_json, error.strerror)

    def write_trajectory(self, name: str, trajectory: Trajectory) -> None:
        """Write an estimate: `odometry`, `<backend>` or `<backend>_online`."""
        write_tum(self.trajectory / f"{name}.tum", trajectory)

    def write_groundtruth(self, trajectory: Trajectory) -> None:
        """Write the known truth."""
        write_tum(self.groundtruth, trajectory)

    def trajectories(self) -> dict[str, Trajectory]:
        """Name -> estimate, for every file in `trajectory/`, sorted by name."""
        return {path.stem: read_tum(path) for path in sorted(self.trajectory.glob("*.tum"))}


def _ended(folder: Path) -> bool:
    """Whether the run that wrote a map came to its end."""
    try:
        with MapStore.open(folder) as store:
            return store.ended
    except StoreError:
        return False


def _metric(row: dict[str, Any]) -> Metric:
    value = math.nan if row["value"] is None else float(row["value"])
    return Metric(row["name"], value, row["unit"], row["description"], row.get("bar"), row.get("passed"))
