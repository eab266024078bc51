"""The table of kinds of sensors, and functions for any of them.

A new kind is one `SensorKind`, given to `register`. Nothing else in the package needs to change.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from hybridmap.config.inputs import SensorsConfig
from hybridmap.config.root import Config, named_configs
from hybridmap.errors import ConfigError
from hybridmap.plugins import Table
from hybridmap.streams.base import Keyframe, Observation, Rig, Seen, SensorKind
from hybridmap.streams.laser import LASER
from hybridmap.streams.rgbd import RGBD

SENSORS: Table[SensorKind] = Table(
    "kind of sensor", {kind.name: kind for kind in (LASER, RGBD)}, "hybridmap.sensors", ConfigError
)
"""`vision.sensor: auto` takes the first kind that a source has."""


def register(kind: SensorKind) -> None:
    """Add a kind of sensor; sources, map files, exports, pages and `vision.sensor` then accept it.

    Installed packages use the entry points `hybridmap.sensors`.

    Raises:
        ConfigError: the name is taken.
    """
    SENSORS.register(kind.name, kind)


def kinds() -> tuple[SensorKind, ...]:
    """All kinds of sensors, in the order in which a source is searched for them."""
    return SENSORS.values()


def wanted(sensor: str) -> tuple[SensorKind, ...]:
    """The kinds of sensors for a value of `vision.sensor`: one for its name, none for `none`, all for any other (`auto`)."""
    if sensor == "none":
        return ()
    return tuple(kind for kind in kinds() if kind.name == sensor) or kinds()


def carried(rig: Rig) -> Iterator[tuple[SensorKind, Any]]:
    """Kind and sensor, for every sensor of a rig whose kind is known, in the order of the table."""
    for kind in kinds():
        if kind.sensor_name in rig.sensors:
            yield kind, rig.sensors[kind.sensor_name]


def kind_of(observation: Observation) -> SensorKind:
    """The kind of sensor that made an observation; it must be one of the table."""
    return next(kind for kind in kinds() if isinstance(observation, kind.sample))


def rig_of(config: SensorsConfig) -> Rig:
    """The rig of those sensors that a configuration alone describes, for users who feed the mapper themselves."""
    return Rig(**{kind.sensor_name: kind.configured(config) for kind in kinds()})


def config_for(kind: SensorKind | None, overrides: Mapping[str, Any]) -> Config:
    """The configuration named after a kind of sensor, with dotted key -> value over it; without one that for self-motion alone.

    Raises:
        ConfigError: a key or value is not valid.
    """
    if kind is None:
        return Config.load(None, {**overrides, "vision.sensor": "none"})
    return Config.load(kind.name if kind.name in named_configs() else None, overrides)


def message_types() -> tuple[str, ...]:
    """All message types in bags that some kind of sensor reads."""
    return tuple(name for kind in kinds() if kind.in_bag is not None for name in kind.in_bag.types)


def words(rig: Rig) -> list[str]:
    """Short description of each sensor of a rig, for people, such as `RGB-D, 320x240 pixels`."""
    return [kind.words(sensor) for kind, sensor in carried(rig)]


def see(keyframe: Keyframe, rig: Rig, max_range_m: float) -> Seen | None:
    """The points of a keyframe, by the first sensor of the rig that has data in it; None if there is none."""
    seen = (kind.see(keyframe, sensor, max_range_m) for kind, sensor in carried(rig))
    return next((found for found in seen if found is not None), None)
