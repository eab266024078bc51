"""Reading a recorded path, and laying bins over it."""

import numpy as np
import pytest

from hybridmap.errors import StreamError
from hybridmap.geometry import between, compose
from hybridmap.trajectory import Trajectory, write_tum
from hybridmap.verification.recorded import RATE_HZ, arena_of, read_path, track_of
from tests.verification.paths_for_tests import recorded, there_and_back, write_csv


def test_a_table_and_a_tum_file_give_the_same_path(tmp_path):
    stamps, xy = there_and_back()
    yaw = np.linspace(-3.0, 3.0, len(xy))
    write_tum(tmp_path / "path.tum", Trajectory(stamps, np.column_stack([xy, yaw])))
    rows = [
        f"{y:.12f} , {t / 1e9:.9f},{np.degrees(a):.12f},{100.0 * x:.12f}" for t, (x, y), a in zip(stamps, xy, yaw, strict=True)
    ]
    (tmp_path / "path.csv").write_text("\n".join(["Y,timestamp,head_direction_deg,x_cm", *rows, "", " , , , "]))
    table, tum = read_path(tmp_path / "path.csv"), read_path(tmp_path / "path.tum")
    assert np.array_equal(table.stamps_ns, tum.stamps_ns)
    assert table.positions_m == pytest.approx(tum.positions_m, abs=1e-9)
    assert table.headings_rad == pytest.approx(tum.headings_rad, abs=1e-9)
    assert read_path(write_csv(tmp_path / "none.csv", stamps, xy)).headings_rad is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "found nothing"),
        ("t,x\n0,1\n", "columns t,x,y"),
        ("t,x_px,y_px\n0,1,2\n", "columns t,x,y"),
        ("t,x,y\n", "holds no position"),
        ("t,x,y\n0,1\n", ":2: expected 3 fields"),
        ("t,x,y\n0,1,2\n1,nan,2\n", ":3: found NaN"),
        ("t,x,y\n0,1,2\n1,inf,2\n", ":3: found NaN or Inf"),
        ("t,x,y\n0,1,two\n", ":2: expected numbers"),
        ("t,x,y\nnan,1,2\n", ":2: expected a stamp"),
        ("t,x,y\n1,1,2\n0,1,2\n", ":3: the stamp 0 is not after"),
        ("t,x,y\n1,1,2\n1,1,2\n", ":3: the stamp 1 is not after"),
        ("t,x,y\n0,1e10,2\n", "beyond 1e9 m"),
        ("t_m,x,y\n0,1,2\n", "column 't_m' is in m; expected s$"),
        ("t,x_deg,y\n0,1,2\n", "column 'x_deg' is in deg; expected m or cm or mm$"),
        ("t,x,y,heading_cm\n0,1,2,3\n", "column 'heading_cm' is in cm; expected rad or deg$"),
    ],
)  # fmt: skip
def test_a_table_that_is_no_path_is_refused(tmp_path, text, said):
    (tmp_path / "path.csv").write_text(text)
    with pytest.raises(StreamError, match=said):
        read_path(tmp_path / "path.csv")


def test_a_track_is_the_path_in_steps_of_the_cells():
    for path in (recorded(hz=31.0), recorded(headings_rad=np.linspace(0.0, 9.0, len(there_and_back()[0])))):
        track = track_of(path)
        assert len(track.stamps_s) == len(track.poses) == len(track.known) == len(track.drive.deltas) + 1
        assert np.diff(track.stamps_s) == pytest.approx(1.0 / RATE_HZ)
        assert track.poses[:, 0] == pytest.approx(
            np.interp(track.stamps_s, path.stamps_ns / 1e9, path.positions_m[:, 0]), abs=1e-4
        )
        assert track.known.all()
        pose = track.poses[0]
        for delta in track.drive.deltas:
            pose = compose(pose, delta)
        assert between(track.poses[-1], pose) == pytest.approx(np.zeros(3), abs=1e-9)


def test_without_a_heading_it_is_the_direction_of_movement_and_stays_while_nothing_moves():
    stamps, xy = there_and_back()
    xy[1000:1300] = xy[1000]
    track = track_of(type(recorded())(stamps, xy, None, None, "lines"))
    along = np.abs(np.sin(track.poses[:, 2])) < 0.1
    assert along.mean() > 0.8
    assert track.poses[1100:1250, 2] == pytest.approx(track.poses[1100, 2])


def test_nothing_is_counted_in_a_gap():
    stamps, xy = there_and_back()
    kept = np.ones(len(stamps), dtype=bool)
    kept[500:600] = False  # two seconds
    track = track_of(type(recorded())(stamps[kept], xy[kept], None, None, "lines"))
    assert np.count_nonzero(~track.known) == 100
    arena = arena_of(track, 0.12)
    assert len(arena.bins) == track.known.sum()
    assert arena.dwell_s.sum() == pytest.approx(track.known.sum() / RATE_HZ)


def test_a_rate_map_gives_back_the_rate():
    arena = arena_of(track_of(recorded()), 0.12)
    assert np.nanmax(np.abs(arena.rate_map(np.full(len(arena.bins), 3.0 / RATE_HZ)) - 3.0)) < 1e-9
    assert arena.dwell_s.shape == arena.reached.shape == arena.rate_map(np.zeros(len(arena.bins))).shape
    assert arena.reached.all()


@pytest.mark.parametrize(
    ("path", "said"),
    [
        (lambda: recorded(speed_m_s=0.5), "expected 60 s to 6 h"),
        (lambda: recorded(hz=0.0002, speed_m_s=0.0001), "expected 60 s to 6 h"),
        (lambda: recorded(hz=0.5), "less than a second apart"),
        (lambda: recorded(side_m=0.2, apart_m=0.005, speed_m_s=0.1), "needs two spacings"),
        (lambda: recorded(side_m=3.0, apart_m=0.5), r"neural.spacing_min_m=0\.\d+ --set"),
    ],
)  # fmt: skip
def test_a_path_that_gives_no_rate_map_is_refused(path, said):
    with pytest.raises(StreamError, match=said):
        arena_of(track_of(path()), 0.12)


def test_the_wider_grids_that_are_proposed_are_covered(tmp_path):
    track = track_of(recorded(side_m=3.0, apart_m=0.2))
    with pytest.raises(StreamError) as refused:
        arena_of(track, 0.12)
    proposed = float(str(refused.value).partition("neural.spacing_min_m=")[2].partition(" ")[0])
    assert arena_of(track, proposed).reached.mean() > 0.5
