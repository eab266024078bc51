"""Open a source and choose its configuration, from the options of a command."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from hybridmap.config import Config
from hybridmap.config.section import value_of
from hybridmap.errors import ConfigError
from hybridmap.streams import open_stream
from hybridmap.streams.base import Stream
from hybridmap.streams.open import world_of
from hybridmap.streams.sensors import carried, config_for


@dataclass(frozen=True, slots=True)
class OpenedSource:
    """A stream and the configuration to map it with."""

    stream: Stream
    config: Config


def parse_settings(settings: list[str] | None) -> dict[str, Any]:
    """Read the values of `--set`: `["nodes.distance_m=0.3"]` becomes `{"nodes.distance_m": 0.3}`; values are read as YAML.

    None gives {}. Of a key given twice the last value counts. Whether a key exists is not checked.

    Raises:
        ConfigError: an entry has no `=` or no key, or its value is not YAML.
    """
    parsed: dict[str, Any] = {}
    for setting in settings or []:
        key, equals, value = setting.partition("=")
        if not equals or not key.strip():
            raise ConfigError(f"--set {setting}: expected KEY=VALUE, e.g. nodes.distance_m=0.3")
        parsed[key.strip()] = value_of(value, f"--set {setting}")
    return parsed


def choose(
    source: str,
    config_name: str | None,
    overrides: Mapping[str, Any],
    *,
    start_s: float | None = None,
    end_s: float | None = None,
    skip_damaged: bool = False,
) -> OpenedSource:
    """Open a source (recording or simulated world) and load its configuration.

    Without `config_name`, a simulated world gets the configuration of its own name, and a recording the one named after the
    first kind of sensor found in it (`laser` or `rgbd`).

    Args:
        source: path of a recording, or name of a simulated world.
        config_name: name or path of a configuration.
        overrides: dotted key -> value; they win over the configuration.
        start_s, end_s: the part of the source to read, seconds after its first stamp.
        skip_damaged: leave out damaged scans and pictures while the stream is read, and count them in its report.

    Raises:
        StreamError: the source cannot be opened.
        ConfigError: the configuration does not exist or is not valid.
    """
    opened = partial(open_stream, source, start_s=start_s, end_s=end_s, skip_damaged=skip_damaged)
    if config_name is None:
        config_name = world_of(source)
    if config_name is not None:
        config = Config.load(config_name, overrides)
        return OpenedSource(opened(config), config)
    default = Config.load(None, overrides)
    stream = opened(default)
    config = config_for(next((kind for kind, _ in carried(stream.rig)), None), overrides)
    if config.sensors != default.sensors:
        stream = opened(config)
    return OpenedSource(stream, config)
