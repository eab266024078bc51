"""Velocity tables."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap import geometry
from hybridmap.config import Config
from hybridmap.errors import StreamError
from hybridmap.streams import open_stream
from hybridmap.streams.base import Rig, Velocity
from hybridmap.streams.synchronise import Synchroniser
from tests.narrowing import known

HEADER = "stamp_s,v_m_s,omega_rad_s\n"


def _write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


def test_rows_become_velocities_with_exact_stamps(tmp_path):
    path = _write(tmp_path / "drive.csv", HEADER + "1248444187.156,0.086,-0.398\n1248444187.186,0.1,0.0\n")
    stream = open_stream(path, Config())
    for _ in range(2):
        assert list(stream) == [Velocity(1248444187156000000, 0.086, -0.398), Velocity(1248444187186000000, 0.1, 0.0)]
    assert stream.rig == Rig()
    assert (stream.expected_observations, stream.groundtruth) == (0, None)
    assert stream.report.counts == {"velocities": 2}


def test_a_truth_beside_the_table_is_found_and_a_part_can_be_cut_out(tmp_path):
    path = _write(tmp_path / "drive.csv", HEADER + "".join(f"{10 + i},1,0\n" for i in range(5)))
    _write(tmp_path / "drive_groundtruth.tum", "10 1 2 0 0 0 0 1\n")
    stream = open_stream(path, Config(), start_s=1, end_s=3)
    with pytest.raises(StreamError, match=r"the recording has it from 0.000 to \d+.000 s"):
        open_stream(path, Config(), start_s=1e6)
    assert [sample.stamp_ns // 10**9 for sample in stream] == [11, 12, 13]
    np.testing.assert_array_equal(known(stream.groundtruth).poses, [[1, 2, 0]])


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a,b\n1,2\n", ["header", "stamp_s,v_m_s,omega_rad_s", "a,b"]),
        (HEADER, ["holds no velocity"]),
        (HEADER + "1,2\n", [":2", "3 fields"]),
        (HEADER + "1,2,x\n", [":2", "expected numbers"]),
        (HEADER + "1,0,0\n2,nan,0\n", [":3", "NaN"]),
        (HEADER + "1,0,0\n2,1e300,0\n", [":3", "1000 m/s", "1e300"]),
        (HEADER + "1,0,0\n3,0,0\n4,0,0\n2,0,0\n", ["stamp 2.000000000", "goes back"]),
    ],
)
def test_a_damaged_table_is_refused(tmp_path, text, words):
    path = _write(tmp_path / "drive.csv", text)
    with pytest.raises(StreamError) as caught:
        open_stream(path, Config())
    for word in [str(path), *words]:
        assert word in str(caught.value)


@pytest.mark.data
@pytest.mark.slow
@pytest.mark.parametrize(("robot", "rows", "error_m"), [(1, 61785, 1.31), (5, 60567, 0.86)])
def test_dead_reckoning_of_real_commands_is_as_far_off_as_published(data_dir, robot, rows, error_m):
    """The error after 16.8 m of true path, begun at the true pose, as the data's README has it."""
    stream = open_stream(data_dir / f"real/mrclam6/robot{robot}.csv", Config())
    synchroniser = Synchroniser()
    steps = [step for sample in stream for step in synchroniser.push(sample)]
    assert stream.report.counts == {"velocities": rows}
    stamps = np.array([step.stamp_ns for step in steps])
    truth = known(stream.groundtruth)
    grid = np.arange(stamps[0], min(stamps[-1], truth.stamps_ns[-1]), 200_000_000)
    true_poses = truth.at(grid)
    path_m = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(true_poses[:, :2], axis=0), axis=1))])
    end = int(np.searchsorted(path_m, 16.8))
    reached = steps[int(np.searchsorted(stamps, grid[end]))].pose_odom_robot
    estimate = geometry.compose(true_poses[0], reached)
    assert np.linalg.norm(estimate[:2] - true_poses[end, :2]) == pytest.approx(error_m, abs=0.05)
