"""The visual side: frames become profiles and view templates, are matched, and give verified relative poses.

It knows nothing of the neural network, the graph and the solvers.
"""

from __future__ import annotations

from collections.abc import Callable

from hybridmap.config.vision import VisionConfig
from hybridmap.errors import ConfigError, StreamError
from hybridmap.metrics import StageClock
from hybridmap.plugins import Table, loaded
from hybridmap.streams import sensors
from hybridmap.streams.base import Rig
from hybridmap.vision.base import FrontEnd
from hybridmap.vision.without_loops import WithoutLoops

__all__ = ["Factory", "create_front_end", "register"]

Factory = Callable[[VisionConfig, Rig, int, StageClock], FrontEnd | None]
"""Makes a front-end from its settings, the sensors of the source, a seed, and a clock for stages of its own."""


def _none(config: VisionConfig, rig: Rig, seed: int, clock: StageClock) -> None:
    del config, rig, seed, clock


FRONT_ENDS: Table[str | Factory] = Table(
    "front-end", {**{kind.name: kind.front_end for kind in sensors.kinds()}, "none": _none}, "hybridmap.front_ends", ConfigError
)
"""Front-ends by name; `register` adds to it."""

_BY = {"scanline": "hybridmap.vision.scanline.front_end:create", "ratslam": "hybridmap.ratslam.front_end:create"}
"""Front-ends for every kind of sensor, by `vision.closing.by`. RatSLAM's has cells of its own and so is no part of vision."""


def register(name: str, factory: Factory) -> None:
    """Add a front-end under a name, so that the setting `vision.sensor` can choose it.

    Installed packages can offer one by an entry point of the group `hybridmap.front_ends`. A new kind of sensor brings its
    front-end with it, see `streams.sensors.register`. `factory` gets the arguments of `create_front_end`; it may return None.

    Raises:
        ConfigError: a front-end of this name exists.
    """
    FRONT_ENDS.register(name, factory)


def create_front_end(config: VisionConfig, rig: Rig, seed: int, clock: StageClock | None = None) -> FrontEnd | None:
    """Make the front-end that the setting `vision.sensor` names; `auto` chooses that of the source's first kind of sensor.

    Args:
        config: settings of the visual side.
        rig: sensors of the source.
        seed: seed of the RANSAC of an RGB-D front-end.
        clock: measures the time that an RGB-D front-end spends on its search for candidates (stage `search`).

    Returns:
        None if no sensor is chosen or the source has none: then the map is made by dead reckoning alone.

    Raises:
        ConfigError: no front-end has the configured name.
        StreamError: the configuration asks for a sensor that the source does not have.
    """
    if config.sensor == "auto":
        chosen: str | Factory = next((kind.front_end for kind, _ in sensors.carried(rig)), _none)
    else:
        chosen = _named(config.sensor, rig)
    if chosen is not _none:
        chosen = _BY.get(config.closing.by, chosen)
    factory: Factory = loaded(chosen) if isinstance(chosen, str) else chosen
    made = factory(config, rig, seed, clock or StageClock())
    return WithoutLoops(made) if made is not None and config.closing.by == "nothing" else made


def _named(name: str, rig: Rig) -> str | Factory:
    for kind in sensors.kinds():
        if kind.name == name and kind.sensor_name in rig.sensors:
            return kind.front_end
        if kind.name == name:
            raise StreamError(f"vision.sensor is {name}, but the source has no {kind.needs}: choose another sensor or none")
    return FRONT_ENDS[name]
