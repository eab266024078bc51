"""The whole configuration, and reading it: by name or path, with `extends` and overrides."""

from __future__ import annotations

from collections.abc import Mapping
from copy import deepcopy
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Self

import yaml
from pydantic import Field, ValidationError, model_validator

from hybridmap.config.backends import BackendsConfig
from hybridmap.config.gone import without_gone
from hybridmap.config.inputs import SensorsConfig, SimulationConfig
from hybridmap.config.mapping import CalibrationConfig, EdgesConfig, NeuralConfig, NodesConfig
from hybridmap.config.section import Section, mapping_of, read_mapping, said
from hybridmap.config.vision import VisionConfig
from hybridmap.errors import ConfigError


class Config(Section):
    """The whole configuration, which determines a map: one section per processing stage, in the order of processing."""

    seed: int = Field(default=0, ge=0)
    """Random seed of the run (the simulator's world and noise, RANSAC)."""
    simulation: SimulationConfig = SimulationConfig()
    """The simulated world and drive; ignored for recordings."""
    sensors: SensorsConfig = SensorsConfig()
    """Topics, mountings, synchronisation."""
    neural: NeuralConfig = NeuralConfig()
    """Head-direction, band, grid and place cells; the place attractor."""
    nodes: NodesConfig = NodesConfig()
    """When a node is made."""
    vision: VisionConfig = VisionConfig()
    """Scanline profiles, loop closure, registration."""
    edges: EdgesConfig = EdgesConfig()
    """Noise of odometry edges; how loop closures enter the map."""
    backends: BackendsConfig = BackendsConfig()
    """Which back-ends run, and their settings."""
    calibration: CalibrationConfig = CalibrationConfig()
    """Online calibration of odometry."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.neural.modules == 0 and self.nodes.rule not in ("travel", "every-visit", "views"):
            expected = "expected travel or views where neural.modules is 0 (no place code)"
            raise ValueError(f"nodes.rule: {expected}, found {self.nodes.rule}")
        if self.nodes.rule == "views":
            self._require_views()
        if self.vision.closing.by == "ratslam" and self.edges.hanging != "ratslam":  # it reckons with being seen from the match
            raise ValueError(f"vision.closing.by is ratslam: expected edges.hanging ratslam, found {self.edges.hanging}")
        return self

    def _require_views(self) -> None:
        """Check that views can make nodes: else the whole drive would be one node."""
        vision = self.vision
        if vision.sensor == "none":
            raise ValueError("nodes.rule is views: expected a vision.sensor, which makes the nodes, found none")
        by_laser = vision.sensor in ("laser", "auto") and vision.closing.by not in ("ratslam", "scanline")
        if by_laser and not vision.laser.scan.templates:
            raise ValueError("nodes.rule is views: of a laser it needs vision.laser.scan.templates true, found false")

    @classmethod
    def load(
        cls,
        source: str | Path | None = None,
        overrides: Mapping[str, Any] | None = None,
        *,
        overridden_by: str = "command line",
    ) -> Self:
        """Read a configuration and apply overrides.

        Args:
            source: name of one that comes with hybridmap (`rgbd`), or path of a YAML file; None for the defaults.
            overrides: dotted key -> value, e.g. `{"nodes.distance_m": 0.3}`.
            overridden_by: origin of the overrides, named in error messages.

        Raises:
            ConfigError: the file does not exist or is not YAML, a key is unknown, or a value is out of range. The message names
                the key, and the file or the origin of the override.
        """
        tree: dict[str, Any] = {} if source is None else _read_tree(source, seen=())
        changed = deepcopy(tree)
        for dotted, value in (overrides or {}).items():
            _merge(changed, _nest(dotted, value))
        try:
            return cls.from_tree(changed, overridden_by)
        except ConfigError:
            cls.from_tree(tree, str(source))
            raise

    @classmethod
    def from_tree(cls, tree: Mapping[str, Any], origin: str) -> Self:
        """Validate a nested mapping of settings.

        Args:
            tree: section -> key -> value.
            origin: name of the source of the mapping, used in error messages.

        Raises:
            ConfigError: a key is unknown or a value out of range.
        """
        try:
            return cls.model_validate(tree)
        except ValidationError as error:
            raise ConfigError(f"{origin}: {said(error, cls)}") from None

    @classmethod
    def stored(cls, text: str, origin: str) -> Self:
        """Read the configuration that is stored with a session; settings that have been removed since are left out.

        Args:
            text: the configuration as YAML.
            origin: name of the file, used in error messages.

        Raises:
            ConfigError: the text is not YAML, a key was never a setting, or a value is out of range.
        """
        return cls.from_tree(without_gone(mapping_of(text, origin)), origin)

    def to_yaml(self) -> str:
        """The whole configuration, defaults included, as YAML. `load` reads it back to an equal configuration."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)


@cache
def is_allowed(key: str, value: float) -> bool:
    """Whether a setting can have a value while all others have their defaults; False for an unknown key."""
    try:
        Config.load(None, {key: value})
    except ConfigError:
        return False
    return True


def named_configs() -> dict[str, Path]:
    """Name -> file of each configuration that comes with hybridmap."""
    packaged = Path(str(resources.files("hybridmap"))) / "configs"
    folder = packaged if packaged.is_dir() else Path(str(resources.files("hybridmap"))).parent / "configs"
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}


_LONGEST_CHAIN = 20
"""Configurations that extend one another."""


def _find(source: str | Path, beside: Path | None) -> Path:
    path = Path(source)
    for candidate in (path, beside / path if beside else path):
        if candidate.is_file():
            return candidate
    known = named_configs()
    if str(source) in known:
        return known[str(source)]
    raise ConfigError(f"{source}: no such configuration file; names that come with hybridmap: {', '.join(known)}")


def _read_tree(source: str | Path, seen: tuple[Path, ...], beside: Path | None = None) -> dict[str, Any]:
    path = _find(source, beside)
    if path in seen or len(seen) >= _LONGEST_CHAIN:
        raise ConfigError(f"{path}: `extends` forms a cycle, or a chain of more than {_LONGEST_CHAIN} files")
    tree = read_mapping(path)
    parent = tree.pop("extends", None)
    if parent is None:
        return tree
    base = _read_tree(str(parent), (*seen, path), path.parent)
    _merge(base, tree)
    return base


def _nest(dotted: str, value: Any) -> dict[str, Any]:
    for key in reversed(dotted.split(".")):
        value = {key: value}
    return dict(value)


def _merge(base: dict[str, Any], top: Mapping[str, Any]) -> None:
    for key, value in top.items():
        if isinstance(value, Mapping) and isinstance(base.get(key), dict):
            _merge(base[key], value)
        else:
            base[key] = dict(value) if isinstance(value, Mapping) else value
