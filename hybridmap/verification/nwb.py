"""Neurodata Without Borders: the position of an animal from an NWB file, and the cells along a path as one (extra `nwb`)."""

from __future__ import annotations

import warnings
from datetime import UTC, datetime, timedelta
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from hybridmap.errors import ExportError, HybridMapError, StreamError, quoted
from hybridmap.geometry import Array, wrap_angle
from hybridmap.trajectory import LATEST_S, NS_PER_S
from hybridmap.verification.recorded import RATE_HZ, RecordedPath, checked, require_increasing
from hybridmap.verification.single_cells import PEAK_HZ, PathVerification

_METRES = {"m": 1.0, "meter": 1.0, "metre": 1.0, "cm": 0.01, "centimeter": 0.01, "centimetre": 0.01, "mm": 0.001}
_METRES |= {"millimeter": 0.001, "millimetre": 0.001}
_RADIANS = {"rad": 1.0, "radian": 1.0, "deg": np.pi / 180.0, "degree": np.pi / 180.0}
_NO_DATE = datetime(2000, 1, 1, tzinfo=UTC)
"""Start of a session whose path has no date; its description says so."""
_NO_ANIMAL = "No animal: a network model of the cells of a rat. Archives ask for a species and an age; the age stands for none."
_SPIKE_S = 1e-6
"""Resolution of the times of spikes, s."""
_DATED_S = 315_532_800.0
"""Stamps beyond this, the year 1980, are taken for seconds since 1970; earlier ones for seconds of the recording."""


def pynwb_for(what: str, error: type[HybridMapError]) -> Any:
    """The package pynwb.

    Raises:
        HybridMapError: it is not installed; an `error` that says that `what` needs the extra.
    """
    try:
        import pynwb
    except ImportError:
        raise error(f"{what} needs the extra `nwb`: pip install 'hybridmap[nwb]'") from None
    return pynwb


def read_nwb(path: Path) -> RecordedPath:
    """Read the position of the animal from an NWB file, and its head direction if there is one.

    It is the first spatial series in a `Position`, by its place in the file; else the first of all. The head direction is the
    first series of a `CompassDirection`, brought to the stamps of the position.

    Raises:
        StreamError: pynwb is not installed, the file is no NWB file, holds no position in a plane or one of unknown units, or
            its samples are no path (`recorded.checked`).
    """
    pynwb = pynwb_for(f"{path}: reading NWB", StreamError)
    try:
        with warnings.catch_warnings(), pynwb.NWBHDF5IO(str(path), "r") as io:
            warnings.simplefilter(
                "ignore"
            )  # of versions of the schema and details of other objects; positions are checked here
            return _path_in(io.read(), path, pynwb)
    except StreamError:
        raise
    except Exception as error:  # noqa: BLE001 (hdmf and h5py raise whatever a damaged file leads them to)
        raise StreamError(f"{path}: cannot be read as NWB: {' '.join(str(error).split())[:120]}") from None


def _path_in(file: Any, path: Path, pynwb: Any) -> RecordedPath:
    series = {_place_of(found): found for found in file.objects.values() if isinstance(found, pynwb.behavior.SpatialSeries)}
    compasses = sorted(name for name in series if type(series[name].parent).__name__ == "CompassDirection")
    positions = [name for name in sorted(series) if name not in compasses]
    if not positions:
        raise StreamError(f"{path}: holds no position; expected a SpatialSeries, usually in processing/behavior/Position")
    name = min(positions, key=lambda place: (type(series[place].parent).__name__ != "Position", place))
    where = f"{path}: {name}"
    position = series[name]
    values = _values(position, where, _METRES, "metres")
    if values.ndim != 2 or values.shape[1] not in (2, 3):
        raise StreamError(f"{where}: expected positions (T, 2) or (T, 3), found {values.shape}")
    stamps_s = _stamps_s(position, len(values), where)
    headings = None
    if compasses:
        compass, there = series[compasses[0]], f"{path}: {compasses[0]}"
        turned = _values(compass, there, _RADIANS, "radians").reshape(-1)
        at_s = _stamps_s(compass, len(turned), there)
        require_increasing(at_s, there)
        headings = np.interp(stamps_s, at_s, np.unwrap(turned))
    stamps_ns = np.round(stamps_s * NS_PER_S).astype(np.int64)
    recorded = RecordedPath(stamps_ns, values[:, :2], headings, file.timestamps_reference_time, f"{path.name}, {name}")
    return checked(recorded, where)


def _place_of(series: Any) -> str:
    """Where an object is in its file, such as `processing/behavior/Position/led`."""
    names = []
    while series is not None and series.parent is not None:
        names.append(series.name)
        series = series.parent
    return "/".join(reversed(names))


def _values(series: Any, where: str, units: dict[str, float], expected: str) -> Array:
    """The data of a series in metres or radians.

    Raises:
        StreamError: its unit is another one.
    """
    unit = str(series.unit).strip().lower()
    factor = units.get(unit, units.get(unit.removesuffix("s")))
    if factor is None:
        raise StreamError(f"{where}: its unit is {quoted(series.unit)}; expected {expected}")
    values = np.asarray(series.data[:], dtype=np.float64)
    return np.asarray((values * float(series.conversion) + float(series.offset)) * factor)


def _stamps_s(series: Any, count: int, where: str) -> Array:
    if series.timestamps is not None:
        stamps = np.asarray(series.timestamps[:], dtype=np.float64)
    elif series.rate:
        stamps = float(series.starting_time or 0.0) + np.arange(count) / float(series.rate)
    else:
        raise StreamError(f"{where}: has neither timestamps nor a rate")
    if np.isfinite(stamps).all() and np.abs(stamps).max(initial=0.0) > LATEST_S:
        raise StreamError(f"{where}: found timestamps to {np.abs(stamps).max():.3g}; expected seconds")
    if len(stamps) != count or not np.isfinite(stamps).all():
        raise StreamError(f"{where}: expected {count} finite timestamps, found {np.isfinite(stamps).sum()}")
    return stamps


def write_nwb(path: Path, result: PathVerification, seed: int) -> None:
    """Write the path, and of each cell the rate, the spikes and what they show, as an NWB file.

    Position and heading are in `processing/behavior`, the rates (T, C), Hz, in `processing/misc`, the spikes in `units`, one
    row a cell in the same order. The values are the same for the same seed; the identifiers of the objects are not.

    Raises:
        ExportError: pynwb is not installed.
        OutputError: the file cannot be written.
    """
    pynwb = pynwb_for("--nwb", ExportError)
    track = result.track
    first_s = float(track.recorded.stamps_ns[0]) / NS_PER_S
    start, said = _start_of(track.recorded, first_s)
    file = pynwb.NWBFile(
        session_description=f"Model cells of hybridmap along a recorded path: {track.recorded.source}. {said}",
        identifier=f"hybridmap {track.recorded.source} seed {seed}",
        session_start_time=start,
        experiment_description="Simulated head-direction, band, grid and place cells with Poisson spikes; no animal.",
        subject=pynwb.file.Subject(
            subject_id="hybridmap", description=_NO_ANIMAL, species="Rattus norvegicus", age="P0D", sex="U"
        ),
        keywords=["grid cells", "head-direction cells", "place cells", "simulation"],
        source_script=f"hybridmap {version('hybridmap')} verify --trajectory --nwb --seed {seed}",
        source_script_file_name="hybridmap",
    )
    _add_behaviour(file, pynwb, result)
    _add_rates(file, pynwb, result)
    file.units = pynwb.misc.Units(name="units", description="the cells", resolution=_SPIKE_S)
    _add_units(file, result)
    with pynwb.NWBHDF5IO(str(path), "w") as io:
        io.write(file)


def _start_of(recorded: RecordedPath, first_s: float) -> tuple[datetime, str]:
    """When the first sample was, and words on how that is known. All times in the file count from there."""
    if recorded.start is not None:
        return recorded.start + timedelta(seconds=first_s), "Time 0 is the first sample of that file's position."
    if first_s > _DATED_S:
        return datetime.fromtimestamp(first_s, UTC), "Time 0 is its first stamp."
    return _NO_DATE, "It has no date; 2000-01-01 stands for none. Time 0 is its first stamp."


def _add_behaviour(file: Any, pynwb: Any, result: PathVerification) -> None:
    track = result.track
    behaviour = file.create_processing_module("behavior", "the path on which the cells ran")
    frame = "x and y of the recorded path; headings counter-clockwise from x"
    position = pynwb.behavior.SpatialSeries(
        name="position",
        description=f"position, interpolated to {RATE_HZ:g} Hz",
        data=_packed(pynwb, track.poses[:, :2]),
        unit="meters",
        reference_frame=frame,
        rate=RATE_HZ,
        starting_time=0.0,
    )
    heading = pynwb.behavior.SpatialSeries(
        name="heading",
        description="heading of the path, or its direction of movement where the recording has no heading",
        data=_packed(pynwb, np.asarray(wrap_angle(track.poses[:, 2]))),
        unit="radians",
        reference_frame=frame,
        rate=RATE_HZ,
        starting_time=0.0,
    )
    behaviour.add(pynwb.behavior.Position(spatial_series=position))
    behaviour.add(pynwb.behavior.CompassDirection(spatial_series=heading))


def _add_rates(file: Any, pynwb: Any, result: PathVerification) -> None:
    module = file.create_processing_module("misc", "what the model's cells did")
    module.add(
        pynwb.TimeSeries(
            name="rates",
            description="rate of each cell of the table `units`, in its order; it is 0 Hz where a cell is silent and "
            f"{', '.join(f'{rate:g} Hz ({kind})' for kind, rate in PEAK_HZ.items())} where it fires most",
            data=_packed(pynwb, result.rates_hz.T),
            unit="Hz",
            rate=RATE_HZ,
            starting_time=0.0,
        )
    )


def _add_units(file: Any, result: PathVerification) -> None:
    """One row a cell: spikes, what kind of cell it is, and its scores with those of its shuffled spikes."""
    names = sorted({name for scores in result.results for name in scores.scores})
    columns = {
        "cell_type": "grid, band, place or head-direction",
        "grid_module": "number of its grid module, from the finest; -1: none",
        "spacing_m": "spacing of its grid or period of its stripes, m; NaN: none",
        "preferred_rad": "preferred heading, or direction across the stripes, rad; NaN: none",
        "tuning_width_rad": "width of its head-direction tuning at half height, rad; NaN: no head-direction cell",
    }
    for name in names:
        columns[name] = f"score of its spikes: {name.replace('_', ' ')}; NaN: not asked of this kind, or none"
        columns[f"{name}_chance"] = "95th percentile of that score over spikes shifted in time"
    for name, description in columns.items():
        file.add_unit_column(name, description)
    intervals = _intervals(result)
    for cell, times, scores in zip(result.cells, result.spike_times_s, result.results, strict=True):
        file.add_unit(
            spike_times=_SPIKE_S * np.round(times / _SPIKE_S),
            obs_intervals=intervals,
            cell_type=cell.kind,
            grid_module=cell.module,
            spacing_m=cell.spacing_m,
            preferred_rad=cell.preferred_rad,
            tuning_width_rad=scores.width_rad,
            **{name: scores.scores.get(name, float("nan")) for name in names},
            **{f"{name}_chance": scores.chance.get(name, float("nan")) for name in names},
        )


def _intervals(result: PathVerification) -> Array:
    """Start and end (I, 2), s, of the stretches in which the path is known."""
    steps = np.diff(np.concatenate([[0], result.track.known.astype(np.int64), [0]]))
    return np.stack([np.flatnonzero(steps > 0), np.flatnonzero(steps < 0)], axis=1) / RATE_HZ


def _packed(pynwb: Any, values: Any) -> Any:
    return pynwb.H5DataIO(values, compression="gzip")
