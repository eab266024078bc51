"""Odometry that was measured again at the end of a drive can be kept in a checkpoint."""

from __future__ import annotations

import io

import numpy as np

from hybridmap.calibration.online import OdometryWatch, Remeasured
from hybridmap.config import Config
from hybridmap.mapper import Mapper
from hybridmap.store.pickling import Numbered, Reader, Writer


def test_what_gives_the_poses_again_is_written_and_read():
    watch = Mapper(Config.load("laser", {"vision.sensor": "none"})).calibration
    assert isinstance(watch, OdometryWatch)
    again = Remeasured(np.zeros((2, 3)), watch.clock.poses_again, None, "late")
    file, parts = io.BytesIO(), Numbered()
    names = {id(watch): "watch"}
    Writer(file, names, parts).dump(again)
    file.seek(0)
    found = Reader(file, {"watch": watch}, parts).load()
    assert found.why == "late"
    assert found.poses_at.__name__ == "poses_again"
