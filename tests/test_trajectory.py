"""The TUM format and interpolation."""

from __future__ import annotations

import numpy as np
import pytest

from hybridmap.errors import GeometryError, StreamError
from hybridmap.trajectory import Trajectory, format_stamp, read_tum, write_tum


@pytest.fixture
def walk() -> Trajectory:
    stamps = np.array([1600000000_123456789, 1600000000_223456789, 1600000001_000000001])
    return Trajectory(stamps, np.array([[0.1, 0.2, 0.3], [1 / 3, -2.0, 3.0], [1.0, 2.0, -3.0]]))


def test_write_and_read_keep_every_digit(walk, tmp_path):
    write_tum(tmp_path / "a.tum", walk)
    back = read_tum(tmp_path / "a.tum")
    assert np.array_equal(back.stamps_ns, walk.stamps_ns)
    assert np.array_equal(back.poses[:, :2], walk.poses[:, :2])
    assert np.allclose(back.poses[:, 2], walk.poses[:, 2], atol=1e-15)
    write_tum(tmp_path / "b.tum", back)
    assert (tmp_path / "b.tum").read_text().split()[0] == "1600000000.123456789"


def test_interpolation_turns_the_short_way(walk):
    middle = walk.at([(int(walk.stamps_ns[1]) + int(walk.stamps_ns[2])) // 2])[0]
    assert abs(abs(middle[2]) - np.pi) < 0.01


def test_beyond_the_ends_the_pose_is_held(walk):
    assert np.allclose(walk.at([0, 2 * 10**18]), walk.poses[[0, -1]])


def test_negative_stamp_is_exact():
    assert format_stamp(70_179699000) == "70.179699000"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "holds no pose"),
        ("1 2 3\n", "expected 8"),
        ("1 nan 0 0 0 0 0 1\n", "NaN"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "goes back"),
        ("x 0 0 0 0 0 0 1\n", "expected a stamp"),
        ("1 0 0 0 0 0 y 1\n", "expected numbers"),
        ("1700000000123 0 0 0 0 0 0 1\n", "milliseconds"),
        ("1700000000123456789 0 0 0 0 0 0 1\n", "nanoseconds"),
        ("1e999990 0 0 0 0 0 0 1\n", "expected a stamp"),
        ("1 0 0 0 0 0 0 0\n", "expected a rotation"),
        ("1 1e12 0 0 0 0 0 1\n", "expected metres"),
    ],
)
def test_damage_is_named_with_its_line(tmp_path, text, expected):
    path = tmp_path / "bad.tum"
    path.write_text(text)
    with pytest.raises(StreamError, match=expected):
        read_tum(path)


def test_a_trajectory_refuses_nonsense():
    with pytest.raises(GeometryError, match="increase"):
        Trajectory(np.array([1, 1]), np.zeros((2, 3)))
    with pytest.raises(GeometryError, match="NaN"):
        Trajectory(np.array([1]), np.full((1, 3), np.nan))
