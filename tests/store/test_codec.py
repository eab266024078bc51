from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridmap.store.records import rig_from_json
from hybridmap.store.schema import pack, unpack

DTYPES = ("|b1", "|u1", "|i1", "<u2", ">u2", "<i4", "<i8", "<f4", ">f4", "<f8")


@settings(max_examples=80, deadline=None)
@given(st.sampled_from(DTYPES), st.lists(st.integers(0, 6), max_size=4), st.integers(0, 2**31))
def test_any_array_comes_back(dtype, shape, seed):
    array = np.random.default_rng(seed).integers(0, 256, shape).astype(dtype)
    packed = pack(array)
    back = unpack(packed)
    assert back.shape == array.shape
    assert back.dtype == array.dtype.newbyteorder("<")
    np.testing.assert_array_equal(back, array)
    assert pack(array.copy()) == packed


def test_images_keep_their_channels_and_depth():
    rng = np.random.default_rng(0)
    color = rng.integers(0, 256, (20, 30, 3)).astype(np.uint8)
    depth = rng.integers(0, 65536, (20, 30)).astype(np.uint16)
    for image in (color, depth, color[..., 0]):
        packed = pack(image)
        assert packed.codec == "png"
        np.testing.assert_array_equal(unpack(packed), image)


def test_nan_and_inf_survive():
    array = np.array([np.nan, np.inf, -np.inf, -0.0], np.float32)
    assert unpack(pack(array)).tobytes() == array.tobytes()


@pytest.mark.parametrize("array", [np.arange(100.0), np.zeros((9, 9), np.uint8)])
def test_damage_is_said(array):
    packed = pack(array)
    with pytest.raises(ValueError, match="cannot be unpacked"):
        unpack(replace(packed, data=packed.data[: len(packed.data) // 2]))


def test_a_rig_of_an_older_map_and_of_a_kind_that_is_not_known_is_read():
    laser = {"bearings_rad": [0.0, 1.0], "range_min_m": 0.1, "range_max_m": 9.0, "pose_base_laser": [0.2, 0.0, 0.0]}
    rig = rig_from_json({"camera": None, "laser": laser, "radar": {"power_w": 3.0}})
    assert list(rig.sensors) == ["laser"]
    np.testing.assert_array_equal(rig.sensors["laser"].bearings_rad, [0.0, 1.0])
