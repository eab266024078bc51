"""A velocity table `stamp_s,v_m_s,omega_rad_s`: self-motion alone, for path integration and dead reckoning."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np

from hybridmap.config.root import Config
from hybridmap.errors import StreamError, quoted
from hybridmap.streams.base import Rig, Sample, StreamReport, Velocity
from hybridmap.streams.order import Window, sorted_order
from hybridmap.trajectory import Trajectory, read_stamp_ns, read_tum

COLUMNS = ("stamp_s", "v_m_s", "omega_rad_s")
_FASTEST = 1000.0  # m/s and rad/s; no robot comes near it


class VelocityStream:
    """A velocity table `stamp_s,v_m_s,omega_rad_s` as a stream; `<name>_groundtruth.tum` next to it is its ground truth."""

    def __init__(self, path: Path, config: Config, window: Window | None = None, *, skip_damaged: bool = False) -> None:
        """Read the table. There are no observations in it to be skipped.

        Raises:
            StreamError: missing, empty, wrong columns, a value that is not a finite number, stamps out of order, or none
                in the window.
        """
        self.name = path.name
        self.rig = Rig()
        samples = read_table(path)
        stamps_ns = np.array([sample.stamp_ns for sample in samples])
        low, high = (window or Window()).limits_over(stamps_ns, samples[0].stamp_ns, str(path))
        self._samples = [sample for sample in samples if low <= sample.stamp_ns <= high]
        truth = path.with_name(f"{path.stem}_groundtruth.tum")
        self.groundtruth: Trajectory | None = read_tum(truth) if truth.is_file() else None
        self.expected_observations: int | None = 0
        self.uses = {"velocity": path.name} | ({"groundtruth": truth.name} if truth.is_file() else {})
        self.report = StreamReport()

    def __iter__(self) -> Iterator[Sample]:
        """Yield the velocities in order of stamp."""
        self.report = StreamReport({"velocities": len(self._samples)})
        yield from self._samples


def read_table(path: Path) -> list[Velocity]:
    """Read all rows of a velocity table, in order of stamp.

    Raises:
        StreamError: the table is empty or damaged, or its stamps are out of order.
    """
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        rows = _rows(path, file)
        header = tuple(name.strip() for name in next(rows, []))
        if header != COLUMNS:
            raise StreamError(
                f"{path}: expected the header {','.join(COLUMNS)}, found {quoted(','.join(header)) if header else 'nothing'}"
            )
        samples = [_read_row(path, number, row) for number, row in enumerate(rows, start=2) if row]
    if not samples:
        raise StreamError(f"{path}: holds no velocity; expected one line per reading after the header")
    order = sorted_order(np.array([sample.stamp_ns for sample in samples], dtype=np.int64), str(path))
    return [samples[i] for i in order]


def _rows(path: Path, file: TextIO) -> Iterator[list[str]]:
    try:
        yield from csv.reader(file)
    except csv.Error as error:
        raise StreamError(f"{path}: no table of comma-separated values: {error}") from None


def _read_row(path: Path, number: int, row: list[str]) -> Velocity:
    try:
        values = [float(field) for field in row[1:]]
    except ValueError:
        raise StreamError(f"{path}:{number}: expected numbers {','.join(COLUMNS)}, found {quoted(','.join(row))}") from None
    try:
        stamp_ns = read_stamp_ns(row[0].strip())
    except ValueError as error:
        raise StreamError(f"{path}:{number}: {error}") from None
    if len(values) != 2:
        raise StreamError(f"{path}:{number}: expected 3 fields ({','.join(COLUMNS)}), found {len(row)}")
    if not np.isfinite(values).all():
        raise StreamError(f"{path}:{number}: found NaN or Inf in {' or '.join(COLUMNS[1:])}, expected finite numbers")
    if max(map(abs, values)) > _FASTEST:
        found = quoted(",".join(row[1:]))
        raise StreamError(
            f"{path}:{number}: {', '.join(COLUMNS[1:])}: expected at most {_FASTEST:g} m/s and rad/s, found {found}"
        )
    return Velocity(stamp_ns, values[0], values[1])
