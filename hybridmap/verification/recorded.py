"""A recorded path, of a robot or an animal, as a drive for the cells: reading it, and the bins of the rate maps over it."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridmap.errors import StreamError, quoted
from hybridmap.geometry import Array, between
from hybridmap.trajectory import FARTHEST_M, NS_PER_S, Trajectory, known_at, read_stamp_ns, read_tum
from hybridmap.verification.drives import ExactDrive

RATE_HZ = 50.0
"""Steps per second of the cells: that of the video by which animals are tracked."""
SHORTEST_S, LONGEST_S = 60.0, 6.0 * 3600.0
"""Seconds that a path must cover, so that spikes can be shifted by 20 s and more, and may: two hours take 0.8 GB."""
COVERAGE_MIN = 0.4
"""Least share of the squares of the path's bounding box that it visits. A disc fills 0.79 of its box."""
BINS_PER_SPACING, SMOOTHINGS_PER_SPACING, SQUARES_PER_SPACING = 10.0, 6.0, 3.0
"""Spacing of the finest grid over the side of a bin, over the standard deviation of the smoothing, and over the side of the
squares of which coverage is counted: 1.2, 2 and 4 cm for 12 cm. With wider bins grid scores depend on the bins."""
_SLOWEST_M_S = 0.025
"""Below this speed the direction of movement is that of before."""
_DIRECTION_S = 0.1
_WIDEST_M = 25.0
_COLUMNS = {
    "t": ("t", "time", "timestamp", "timestamps", "stamp"),
    "x": ("x", "pos_x", "position_x"),
    "y": ("y", "pos_y", "position_y"),
    "heading": ("heading", "yaw", "theta", "hd", "head_direction"),
}
_UNITS = {"": 1.0, "s": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "rad": 1.0, "deg": np.pi / 180.0}
_UNITS_OF = {"t": ("s",), "x": ("m", "cm", "mm"), "y": ("m", "cm", "mm"), "heading": ("rad", "deg")}
_HEADER = "t,x,y (s, m) and, if there is one, heading (rad)"


@dataclass(frozen=True, slots=True)
class RecordedPath:
    """A path as a file has it.

    Attributes:
        stamps_ns: (N,) int64, strictly increasing, nanoseconds.
        positions_m: (N, 2) x and y, m.
        headings_rad: (N,) counter-clockwise from x, rad; None if the file has none.
        start: time of stamp 0; None if the file does not say.
        source: the file, and where in it the position was.
    """

    stamps_ns: NDArray[np.int64]
    positions_m: Array
    headings_rad: Array | None
    start: datetime | None
    source: str


def read_path(path: Path) -> RecordedPath:
    """Read a path from an NWB file (`.nwb`), a table (`.csv`: `t,x,y[,heading]`), or any other file in the TUM format.

    Raises:
        StreamError: the file is missing or damaged, holds no position, has other columns or units, a value that is not finite,
            or stamps that do not increase; or it is an NWB file and pynwb is not installed.
    """
    if not path.is_file():
        raise StreamError(f"{path}: no such trajectory; expected a TUM, CSV or NWB file")
    if path.suffix.lower() == ".nwb":
        from hybridmap.verification.nwb import read_nwb

        return read_nwb(path)
    if path.suffix.lower() == ".csv":
        return _read_csv(path)
    trajectory = read_tum(path)
    return RecordedPath(trajectory.stamps_ns, trajectory.poses[:, :2], trajectory.poses[:, 2], None, path.name)


def _read_csv(path: Path) -> RecordedPath:
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        try:
            rows = [(number, row) for number, row in enumerate(csv.reader(file), start=1) if any(map(str.strip, row))]
        except csv.Error as error:
            raise StreamError(f"{path}: no table of comma-separated values: {error}") from None
    header = rows[0][1] if rows else []
    columns = _columns_of(path, header)
    stamps: list[int] = []
    values: list[list[float]] = []
    for number, row in rows[1:]:
        if len(row) != len(header):
            raise StreamError(f"{path}:{number}: expected {len(header)} fields, found {len(row)}")
        try:
            stamps.append(read_stamp_ns(row[columns["t"][0]].strip()))
        except ValueError as error:
            raise StreamError(f"{path}:{number}: {error}") from None
        try:
            values.append([factor * float(row[index]) for name, (index, factor) in columns.items() if name != "t"])
        except ValueError:
            raise StreamError(f"{path}:{number}: expected numbers, found {quoted(','.join(row))}") from None
        if not np.isfinite(values[-1]).all():
            raise StreamError(f"{path}:{number}: found NaN or Inf, expected finite numbers; leave such rows out")
        if len(stamps) > 1 and stamps[-1] <= stamps[-2]:
            raise StreamError(f"{path}:{number}: the stamp {row[columns['t'][0]]} is not after the one before; sort the rows")
    table = np.array(values).reshape(len(values), len(columns) - 1)
    headings = table[:, 2] if "heading" in columns else None
    return checked(RecordedPath(np.array(stamps, dtype=np.int64), table[:, :2], headings, None, path.name), str(path))


def _columns_of(path: Path, header: Sequence[str]) -> dict[str, tuple[int, float]]:
    """Where each quantity is in a table, and the factor to its unit, in the order of `_COLUMNS`."""
    found = {}
    for quantity, names in _COLUMNS.items():
        for index, name in enumerate(header):
            parts = re.fullmatch(r"(\w+?)(?:_(s|m|cm|mm|rad|deg))?", name.strip().lower())
            if parts and parts[1] in names and quantity not in found:
                if parts[2] and parts[2] not in _UNITS_OF[quantity]:
                    expected = " or ".join(_UNITS_OF[quantity])
                    raise StreamError(f"{path}: the column {quoted(name.strip())} is in {parts[2]}; expected {expected}")
                found[quantity] = (index, _UNITS[parts[2] or ""])
    if not {"t", "x", "y"} <= found.keys():
        said = quoted(",".join(header)) if header else "nothing"
        raise StreamError(f"{path}: expected a header with the columns {_HEADER}, found {said}")
    return found


def checked(recorded: RecordedPath, where: str) -> RecordedPath:
    """The same path, if it is one.

    Raises:
        StreamError: it is empty, not finite, out of order, or farther away than any place on earth.
    """
    values = [recorded.positions_m] if recorded.headings_rad is None else [recorded.positions_m, recorded.headings_rad[:, None]]
    bad = ~np.isfinite(np.concatenate(values, axis=1)).all(axis=1)
    if len(recorded.stamps_ns) == 0:
        raise StreamError(f"{where}: holds no position")
    if bad.any():
        raise StreamError(
            f"{where}: found NaN or Inf in {bad.sum()} of {bad.size} samples, first in number {int(bad.argmax())}; "
            "leave such samples out"
        )
    require_increasing(recorded.stamps_ns, where)
    if np.abs(recorded.positions_m).max() > FARTHEST_M:
        raise StreamError(f"{where}: found positions beyond 1e9 m; expected metres")
    return recorded


def require_increasing(stamps: NDArray[Any], where: str) -> None:
    """Refuse stamps (N,) that do not increase.

    Raises:
        StreamError: a stamp is not after the one before.
    """
    late = np.diff(stamps) <= 0
    if late.any():
        raise StreamError(
            f"{where}: the stamp of sample {int(late.argmax()) + 1} is not after the one before; sort the samples"
        )


@dataclass(frozen=True, slots=True)
class Track:
    """A recorded path at the steps of the cells.

    Attributes:
        recorded: what the file has.
        stamps_s: (T,) seconds since the first of them, `RATE_HZ` a second.
        poses: (T, 3) in the frame of the file, m and rad.
        known: (T,) whether the file has positions less than a second apart there; elsewhere the pose is interpolated, and
            nothing is counted.
        drive: the same as motion, for the cells.
    """

    recorded: RecordedPath
    stamps_s: Array
    poses: Array
    known: NDArray[np.bool_]
    drive: ExactDrive


def track_of(recorded: RecordedPath) -> Track:
    """Sample a path at `RATE_HZ`; where it has no heading, the direction of movement is taken.

    Raises:
        StreamError: the path is too short or too long.
    """
    stamps = recorded.stamps_ns
    duration_s = float(stamps[-1] - stamps[0]) / NS_PER_S
    if not SHORTEST_S <= duration_s <= LONGEST_S:
        limits = f"expected {SHORTEST_S:g} s to {LONGEST_S / 3600.0:g} h"
        raise StreamError(f"{recorded.source}: covers {duration_s:.6g} s; {limits}")
    steps = np.arange(int(duration_s * RATE_HZ) + 1)
    at_ns = stamps[0] + np.round(steps * (NS_PER_S / RATE_HZ)).astype(np.int64)
    if recorded.headings_rad is not None:
        trajectory = Trajectory(stamps, np.column_stack([recorded.positions_m, recorded.headings_rad]))
        poses = trajectory.at(at_ns)
    else:
        offset = (at_ns - stamps[0]).astype(np.float64)
        known = (stamps - stamps[0]).astype(np.float64)
        position = np.stack([np.interp(offset, known, recorded.positions_m[:, axis]) for axis in (0, 1)], axis=1)
        trajectory = Trajectory(at_ns, np.column_stack([position, _direction_of(position)]))
        poses = trajectory.poses
    seen = known_at(Trajectory(stamps, np.zeros((len(stamps), 3))), at_ns)
    if (seen_s := np.count_nonzero(seen) / RATE_HZ) < SHORTEST_S:
        raise StreamError(
            f"{recorded.source}: has positions less than a second apart for {seen_s:.3g} s only; "
            f"expected {SHORTEST_S:g} s and more"
        )
    moved = between(poses[:-1], poses[1:])
    drive = ExactDrive(moved, between(poses[:1], poses[1:]), np.cumsum(np.hypot(*moved[:, :2].T)), RATE_HZ)
    return Track(recorded, steps / RATE_HZ, poses, seen, drive)


def _direction_of(position_m: Array) -> Array:
    """Direction (T,), rad, in which a position (T, 2) moves; while it stands, the last one."""
    from scipy import ndimage

    velocity = np.gradient(ndimage.gaussian_filter1d(position_m, _DIRECTION_S * RATE_HZ, axis=0), 1.0 / RATE_HZ, axis=0)
    moves = np.hypot(*velocity.T) > _SLOWEST_M_S
    if not moves.any():
        return np.zeros(len(position_m))
    latest = np.maximum.accumulate(np.where(moves, np.arange(len(moves)), 0))
    latest[: int(moves.argmax())] = int(moves.argmax())
    return np.asarray(np.arctan2(velocity[latest, 1], velocity[latest, 0]))


@dataclass(frozen=True, slots=True)
class Arena:
    """The bins over the known part of a track: K samples, at `RATE_HZ`.

    Attributes:
        pitch_m: side of a bin.
        corner_m: (2,) least x and y.
        bins: (K,) which bin each known sample is in, as a flat index.
        headings_rad: (K,) heading at each known sample.
        dwell_s: (H, W) time spent in each bin; bins along x and y.
        smoothed_s: (H, W) the same, smoothed as spikes are.
        reached: (H, W) whether the path comes within two standard deviations of the smoothing.
    """

    pitch_m: float
    corner_m: Array
    bins: NDArray[np.int64]
    headings_rad: Array
    dwell_s: Array
    smoothed_s: Array
    reached: NDArray[np.bool_]

    def rate_map(self, counts: Array) -> Array:
        """Rate map (H, W), Hz, of spikes counted in each known sample (K,); NaN where the path does not reach.

        Spikes and time are smoothed alike by a Gaussian and then divided.
        """
        total = _per_bin(self.bins, counts, self.dwell_s.shape)
        return np.where(self.reached, _smoothed(total) / np.where(self.reached, self.smoothed_s, 1.0), np.nan)


def _per_bin(bins: NDArray[np.int64], counts: Array, shape: tuple[int, ...]) -> Array:
    """Sum (H, W) over each bin of what was counted in each sample (K,) that is in it."""
    return np.asarray(np.bincount(bins, counts, minlength=math.prod(shape)).reshape(shape))


def _smoothed(total: Array) -> Array:
    from scipy import ndimage

    return np.asarray(ndimage.gaussian_filter(total, BINS_PER_SPACING / SMOOTHINGS_PER_SPACING, mode="constant"))


def arena_of(track: Track, spacing_min_m: float) -> Arena:
    """Lay bins over a track: `BINS_PER_SPACING` to the finest grid's spacing.

    Raises:
        StreamError: the track does not visit enough of its bounding box for a rate map, or the box is too small.
    """
    from scipy import ndimage

    position = track.poses[track.known, :2]
    corner = position.min(axis=0)
    sides = position.max(axis=0) - corner
    said = f"{track.recorded.source}: the path"
    if min(sides) < 2.0 * spacing_min_m:
        raise StreamError(
            f"{said} stays within {sides[0]:.3g} x {sides[1]:.3g} m; a rate map needs two spacings of the finest grid "
            f"({2.0 * spacing_min_m:g} m) each way"
        )
    visited, square_m = _visited(position, spacing_min_m), spacing_min_m / SQUARES_PER_SPACING
    if visited < COVERAGE_MIN:
        raise StreamError(
            f"{said} visits {100.0 * visited:.2g} % of the squares of {100.0 * square_m:.3g} cm in its {sides[0]:.3g} x "
            f"{sides[1]:.3g} m; a rate map needs {100.0 * COVERAGE_MIN:g} %: take a longer path, or wider grids"
            f"{_wider(position, spacing_min_m)}"
        )
    pitch_m = spacing_min_m / BINS_PER_SPACING
    at = np.floor((position - corner) / pitch_m).astype(np.int64)
    high, wide = (int(count) for count in at.max(axis=0) + 1)
    bins = at[:, 0] * wide + at[:, 1]
    dwell = _per_bin(bins, np.full(len(bins), 1.0 / RATE_HZ), (high, wide))
    reached = ndimage.distance_transform_edt(dwell == 0.0) <= 2.0 * BINS_PER_SPACING / SMOOTHINGS_PER_SPACING
    return Arena(pitch_m, corner, bins, track.poses[track.known, 2], dwell, _smoothed(dwell), reached)


def _visited(position_m: Array, spacing_m: float) -> float:
    """Share of the squares of a path's bounding box that it visits."""
    at = np.floor((position_m - position_m.min(axis=0)) * (SQUARES_PER_SPACING / spacing_m)).astype(np.int64)
    high, wide = (int(count) for count in at.max(axis=0) + 1)
    return len(np.unique(at, axis=0)) / (high * wide)


def _wider(position_m: Array, spacing_m: float) -> str:
    """Settings of wider grids under which a path covers its box, in words; empty if there are none."""
    widest = min(0.5 * float(np.ptp(position_m, axis=0).min()), _WIDEST_M)
    while (spacing_m := float(f"{1.25 * spacing_m:.2g}")) <= widest:
        if _visited(position_m, spacing_m) >= COVERAGE_MIN:
            return f", e.g. --set neural.spacing_min_m={spacing_m:g} --set neural.spacing_max_m={4.0 * spacing_m:g}"
    return ""
