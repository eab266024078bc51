"""Frame -> profile and template -> match -> verified relative pose. It knows no cells, no graph and no solver."""

from __future__ import annotations

from collections.abc import Callable

from hybridmap.config.vision import VisionConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.metrics import StageClock
from hybridmap.plugins import Table
from hybridmap.streams.base import Rig
from hybridmap.vision.base import FrontEnd

__all__ = ["Factory", "create_front_end", "register"]

Factory = Callable[[VisionConfig, Rig, int, StageClock], FrontEnd | None]
"""Makes a front-end from its settings, the sensors of the source, a seed, and a clock for stages of its own."""


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


def _none(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> None:
    del config, rig, seed, clock


_FRONT_ENDS: Table[Factory] = Table(
    "front-end", {"laser": _laser, "rgbd": _rgbd, "none": _none}, "hybridmap.front_ends", ConfigError
)


def register(name: str, factory: Factory) -> None:
    """Add a front-end, which `vision.sensor` then takes by its name; packages have entry points `hybridmap.front_ends`.

    Raises:
        ConfigError: there is one of this name already.
    """
    _FRONT_ENDS.register(name, factory)


def create_front_end(config: VisionConfig, rig: Rig, seed: int, clock: StageClock | None = None) -> FrontEnd | None:
    """The front-end for a source: `auto` takes laser if there is one, else RGB-D; None for `none` (dead reckoning).

    Args:
        config: settings of the visual side.
        rig: sensors of the source.
        seed: for RANSAC.
        clock: is given the stage `search` by an RGB-D front-end.

    Raises:
        ConfigError: there is no front-end of this name.
        StreamError: the configuration asks for a sensor that the source does not have.
    """
    sensor = config.sensor
    if sensor == "auto":
        sensor = "laser" if rig.laser is not None else "rgbd" if rig.camera is not None else "none"
    return _FRONT_ENDS[sensor](config, rig, seed, clock or StageClock())
