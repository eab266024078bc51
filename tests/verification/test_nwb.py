"""NWB files: positions from them, and the cells along a path as one. They need the extra `nwb`."""

import sys
from datetime import UTC, datetime

import numpy as np
import pytest

from hybridmap.errors import ExportError, StreamError
from hybridmap.verification import verify_along
from hybridmap.verification.nwb import pynwb_for, read_nwb, write_nwb
from hybridmap.verification.recorded import RATE_HZ, RecordedPath, read_path, track_of
from hybridmap.verification.single_cells import SCORES
from tests.narrowing import known
from tests.verification.paths_for_tests import FEW, recorded, there_and_back


def test_without_pynwb_the_error_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pynwb", None)
    (tmp_path / "rat.nwb").write_bytes(b"")
    with pytest.raises(StreamError, match=r"rat\.nwb: reading NWB needs the extra `nwb`: pip install 'hybridmap\[nwb\]'"):
        read_path(tmp_path / "rat.nwb")
    with pytest.raises(ExportError, match=r"hybridmap\[nwb\]"):
        pynwb_for("--nwb", ExportError)


@pytest.fixture(scope="module")
def pynwb():
    return pytest.importorskip("pynwb", reason="needs the extra nwb (pynwb)")


@pytest.fixture(scope="module")
def written(pynwb, tmp_path_factory):
    stamps, xy = there_and_back()
    kept = np.ones(len(stamps), dtype=bool)
    kept[500:600] = False
    path = RecordedPath(stamps[kept], xy[kept], None, None, "lines")
    result = verify_along(path, 4, FEW, 5.0, shuffles=2, workers=1)
    place = tmp_path_factory.mktemp("nwb") / "cells.nwb"
    write_nwb(place, result, 4)
    return place, result


def test_what_is_written_is_what_the_cells_did(pynwb, written):
    place, result = written
    with pynwb.NWBHDF5IO(str(place), "r") as io:
        file = io.read()
        position = file.processing["behavior"]["Position"]["position"]
        assert position.data[:] == pytest.approx(result.track.poses[:, :2])
        assert (position.rate, position.unit) == (RATE_HZ, "meters")
        assert file.processing["misc"]["rates"].data[:] == pytest.approx(result.rates_hz.T)
        units = file.units
        assert list(units["cell_type"][:]) == [cell.kind for cell in result.cells]
        for number, times in enumerate(result.spike_times_s):
            assert units["spike_times"][number] == pytest.approx(times, abs=1e-6)
            seen = units["obs_intervals"][number]
            assert ((times[:, None] >= seen[:, 0]) & (times[:, None] <= seen[:, 1] + 1e-9)).any(axis=1).all()
            for name in SCORES[result.cells[number].kind]:
                assert units[name][number] == pytest.approx(result.results[number].scores[name], nan_ok=True)
        assert len(units["obs_intervals"][0]) == 2


def test_what_is_written_can_be_read_again(written):
    place, result = written
    again = read_path(place)
    assert again.positions_m == pytest.approx(result.track.poses[:, :2])
    assert np.cos(known(again.headings_rad) - result.track.poses[:, 2]) == pytest.approx(np.ones(len(result.track.poses)))
    assert "Position/position" in again.source
    assert again.start == datetime(2000, 1, 1, tzinfo=UTC)
    assert track_of(again).poses[:, :2] == pytest.approx(result.track.poses[:, :2], abs=1e-6)


def test_a_file_passes_the_inspection_of_the_format(written):
    inspector = pytest.importorskip("nwbinspector", reason="needs nwbinspector")
    found = list(inspector.inspect_nwbfile(nwbfile_path=written[0]))
    assert [message.check_function_name for message in found if message.importance.name in ("CRITICAL", "ERROR")] == []


def file_with(pynwb, place, *series, in_position=True, compass=None):
    file = pynwb.NWBFile("a rat", "1", datetime(2020, 5, 1, tzinfo=UTC))
    behaviour = file.create_processing_module("behavior", "tracking")
    if in_position and series:
        behaviour.add(pynwb.behavior.Position(spatial_series=list(series)))
    elif series:
        file.add_acquisition(series[0])
    if compass is not None:
        behaviour.add(pynwb.behavior.CompassDirection(spatial_series=compass))
    with pynwb.NWBHDF5IO(str(place), "w") as io:
        io.write(file)
    return place


def series(pynwb, data, name="led", unit="meters", **more):
    timing = more if more else {"rate": 25.0}
    return pynwb.behavior.SpatialSeries(name=name, data=data, unit=unit, reference_frame="corner", **timing)


def test_units_stamps_and_head_direction_are_those_of_the_file(pynwb, tmp_path):
    xy, t = np.random.default_rng(0).uniform(size=(500, 2)), 100.0 + np.arange(500) / 25.0
    led = series(pynwb, 100.0 * xy, unit="cm", timestamps=t)
    turn = series(pynwb, np.degrees(0.05 * np.arange(250)) % 360.0, "hd", "degrees", rate=12.5, starting_time=100.0)
    found = read_nwb(file_with(pynwb, tmp_path / "rat.nwb", led, series(pynwb, xy, "other"), compass=turn))
    assert found.positions_m == pytest.approx(xy)
    assert found.stamps_ns == pytest.approx(1e9 * t)
    assert np.cos(known(found.headings_rad)[:490] - 0.025 * np.arange(490)) == pytest.approx(np.ones(490))
    assert found.start == datetime(2020, 5, 1, tzinfo=UTC)
    raw = read_nwb(file_with(pynwb, tmp_path / "raw.nwb", series(pynwb, np.column_stack([xy, t])), in_position=False))
    assert raw.positions_m == pytest.approx(xy)
    assert raw.headings_rad is None


def test_head_directions_whose_stamps_go_back_are_refused(pynwb, tmp_path):
    stamps = 0.04 * np.arange(50)
    stamps[30] = stamps[10]
    turn = series(pynwb, np.linspace(0.0, 3.0, 50), "hd", "radians", timestamps=stamps)
    place = file_with(pynwb, tmp_path / "rat.nwb", series(pynwb, np.ones((50, 2))), compass=turn)
    with pytest.raises(StreamError, match=r"CompassDirection/hd: the stamp of sample 30 is not after the one before"):
        read_nwb(place)


def nan_at(xy, row):
    xy = xy.copy()
    xy[row] = np.nan
    return xy


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda p, xy: [], "holds no position"),
        (lambda p, xy: [series(p, xy, unit="pixels")], "unit is 'pixels'; expected metres"),
        (lambda p, xy: [series(p, xy[:, 0])], "expected positions"),
        (lambda p, xy: [series(p, nan_at(xy, 3))], "NaN or Inf in 1 of 50 samples, first in number 3"),
        (lambda p, xy: [series(p, xy, timestamps=np.arange(50.0)[::-1])], "sample 1 is not after"),
        (lambda p, xy: [series(p, xy, timestamps=np.full(50, np.nan))], "expected 50 finite timestamps, found 0"),
        (lambda p, xy: [series(p, xy, timestamps=1e12 * np.arange(50.0))], "expected seconds"),
    ],
)
def test_a_file_without_a_path_is_refused(pynwb, tmp_path, make, said):
    place = file_with(pynwb, tmp_path / "rat.nwb", *make(pynwb, np.ones((50, 2))))
    with pytest.raises(StreamError, match=said):
        read_nwb(place)


def test_a_file_that_is_no_nwb_is_refused(pynwb, tmp_path):
    (tmp_path / "rat.nwb").write_bytes(b"no hdf")
    with pytest.raises(StreamError, match=r"rat\.nwb: cannot be read as NWB"):
        read_path(tmp_path / "rat.nwb")


def test_a_date_that_the_path_has_is_the_start_of_the_session(pynwb, tmp_path):
    path = recorded()
    for stamps, start in ((path.stamps_ns + 1_600_000_000 * 10**9, None), (path.stamps_ns, datetime(2021, 1, 1, tzinfo=UTC))):
        dated = RecordedPath(stamps, path.positions_m, None, start, "lines")
        write_nwb(tmp_path / "cells.nwb", verify_along(dated, 1, FEW, shuffles=1, workers=1), 1)
        said = start or datetime.fromtimestamp(1_600_000_000, UTC)
        assert read_nwb(tmp_path / "cells.nwb").start == said
