"""The sensors that a configuration describes, for those who feed the mapper themselves."""

from __future__ import annotations

from hybridmap.config.inputs import SensorsConfig
from hybridmap.streams.base import Rig
from hybridmap.streams.cameras import from_intrinsics, mounted, pinhole


def rig_of(config: SensorsConfig) -> Rig:
    """The rig that a configuration alone gives: the camera where both its intrinsics and its mounting are set."""
    if config.camera_intrinsics is None or config.camera_mounting is None:
        return Rig()
    return Rig(camera=pinhole(from_intrinsics(config.camera_intrinsics), mounted(config.camera_mounting)))
