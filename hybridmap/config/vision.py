"""Settings of the visual side."""

from __future__ import annotations

from typing import Literal

from hybridmap.config.laser import LaserConfig
from hybridmap.config.rgbd import RgbdConfig
from hybridmap.config.section import Section


class VisionConfig(Section):
    """Which sensor closes loops, and how."""

    sensor: Literal["auto", "laser", "rgbd", "none"] = "auto"
    """The sensor to map with; `auto` takes laser if the source has one, else RGB-D."""
    laser: LaserConfig = LaserConfig()
    """Laser front-end."""
    rgbd: RgbdConfig = RgbdConfig()
    """RGB-D front-end."""
