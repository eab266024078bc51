"""What a sample must be before it goes to the mapping process."""

import numpy as np
import pytest

from hybridmap.errors import StreamError
from hybridmap.live.samples import check, used
from hybridmap.streams.base import Rig
from hybridmap.streams.laser import Laser
from hybridmap.streams.rgbd import Camera, RgbdFrame

LASER = Laser(np.linspace(-1.0, 1.0, 5), 0.1, 10.0, np.zeros(3))
CAMERA = Camera(6, 4, 5.0, 5.0, 3.0, 2.0, np.eye(4))
COLOR, DEPTH = np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32)


def test_the_first_sensor_is_mapped_with_unless_another_is_named():
    rig = Rig(camera=CAMERA, laser=LASER)
    assert list(used(rig, "auto").sensors) == ["laser"]
    assert list(used(rig, "rgbd").sensors) == ["camera"]
    assert list(used(rig, "none").sensors) == []
    assert list(used(Rig(camera=CAMERA), "auto").sensors) == ["camera"]


def test_a_frame_is_one_of_the_camera():
    check(RgbdFrame(0, COLOR, DEPTH), Rig(camera=CAMERA))
    for color, depth in (
        (COLOR[:2], DEPTH),
        (COLOR, DEPTH[:2]),
        (COLOR[..., 0], DEPTH),
        (COLOR.astype(float), DEPTH),
        (COLOR, DEPTH.astype(float)),
    ):
        with pytest.raises(StreamError, match="expected"):
            check(RgbdFrame(0, color, depth), Rig(camera=CAMERA))
    with pytest.raises(StreamError, match="no camera"):
        check(RgbdFrame(0, COLOR, DEPTH), Rig(laser=LASER))
