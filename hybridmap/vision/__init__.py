"""Frame -> profile and template -> match -> verified relative pose. It knows no cells, no graph and no solver."""

from __future__ import annotations

from hybridmap.config.vision import VisionConfig
from hybridmap.errors import StreamError
from hybridmap.metrics import StageClock
from hybridmap.streams.base import Rig
from hybridmap.vision.base import FrontEnd

__all__ = ["create_front_end"]


def _laser(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> FrontEnd:
    from hybridmap.vision.laser.front_end import LaserFrontEnd

    del clock
    if rig.laser is None:
        raise StreamError("vision.sensor is laser, but the source has no laser scans: choose rgbd or none")
    return LaserFrontEnd(config, rig.laser, seed)


def _rgbd(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> FrontEnd:
    from hybridmap.vision.rgbd.front_end import RgbdFrontEnd

    if rig.camera is None:
        raise StreamError("vision.sensor is rgbd, but the source has no colour with depth: choose laser or none")
    return RgbdFrontEnd(config, rig.camera, seed, clock)


_FRONT_ENDS = {"laser": _laser, "rgbd": _rgbd}


def create_front_end(config: VisionConfig, rig: Rig, seed: int, clock: StageClock | None = None) -> FrontEnd | None:
    """The front-end for a source: `auto` takes laser if there is one, else RGB-D, else None (dead reckoning).

    Args:
        config: settings of the visual side.
        rig: sensors of the source.
        seed: for RANSAC.
        clock: is given the stage `search` by an RGB-D front-end.

    Raises:
        StreamError: the configuration asks for a sensor that the source does not have.
    """
    sensor: str = config.sensor
    if sensor == "auto":
        sensor = "laser" if rig.laser is not None else "rgbd" if rig.camera is not None else "none"
    if sensor == "none":
        return None
    return _FRONT_ENDS[sensor](config, rig, seed, clock or StageClock())
